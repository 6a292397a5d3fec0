"""What joint a loop probably is, from the geometry: which of its rows are implied where it closes.

A loop whose joints all turn about one direction, and slide across it, moves in a plane: of the rows of a hinge only
two are not implied, those of `point_2d` in that plane. Otherwise the loop is closed as a point and the z axes of
both frames are compared: an assembly drawn around a pin has them aligned, one drawn around a ball joint need not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.formats.draft import Draft, vector
from ckc_pin.kinematics.assembly import close_loops
from ckc_pin.mechanism.closure import ClosureBuilder
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["propose"]

FLAT = 1e-5  # how far directions may be from parallel, and rows from implied; files are rounded to six digits
ALIGNED = 1e-4  # rad
Z = np.array([0.0, 0.0, 1.0])


def propose(draft: Draft, pairs: Sequence[LoopSpec]) -> list[tuple[LoopSpec, str]]:
    """Give pairs of frames a type, and say why.

    Parameters
    ----------
    draft : Draft
        With the tree, and the loops whose types are known.
    pairs : sequence of LoopSpec
        Of type point.
    """
    tree, frames, urdf = draft.tree()
    known = draft.spec().loop
    found: dict[str, tuple[LoopSpec, str]] = {}
    for pair in pairs:
        a, b = (frames.find(f, f"loop {pair.name!r}") for f in (pair.frame_a, pair.frame_b))
        if a.joint == b.joint:
            found[pair.name] = pair, "both frames are on one body"
            continue
        normal = _normal(tree, a, b)
        if normal is not None:
            found[pair.name] = _planar(tree, pair, a, b, normal)
    spatial = [pair for pair in pairs if pair.name not in found]
    if spatial:
        couplings = [CouplingSpec(joint=j, other=o, ratio=r, offset=c) for j, o, r, c in urdf.mimic]
        builder = ClosureBuilder(tree, frames)
        for loop in [*known, *(spec for spec, _ in found.values()), *spatial]:
            if frames.find(loop.frame_a, loop.name).joint != frames.find(loop.frame_b, loop.name).joint:
                builder.add_loop(loop)
        for coupling in [*draft.spec().coupling, *couplings]:
            builder.add_coupling(coupling)
        closure = builder.build()
        closed = close_loops(tree, closure, tree.neutral(), np.ones(tree.n), 1e-10)
        pose = Pose(tree, closure.anchors, closed.q_tree)
        for pair in spatial:
            ends = [frames.find(f, pair.name) for f in (pair.frame_a, pair.frame_b)]
            z_a, z_b = (pose.rotation[f.joint] @ f.rotation @ Z for f in ends)
            found[pair.name] = _pin_or_ball(pair, z_a, z_b)
    return [found[pair.name] for pair in pairs]


def _planar(tree: Tree, loop: LoopSpec, a: Frame, b: Frame, normal: Array) -> tuple[LoopSpec, str]:
    """Return the two rows in the plane; the offset along the normal is what it is."""
    rotation, translation, _ = _kinematics(tree, tree.neutral())
    p_a, p_b = (rotation[f.joint] @ f.translation + translation[f.joint] for f in (a, b))
    offset = abs(float(normal @ (rotation[a.joint] @ a.rotation).T @ (p_a - p_b)))
    axis = np.where(np.abs(normal) < FLAT, 0.0, normal)
    why = "its joints move in one plane, where the other rows of a hinge are implied"
    if offset > FLAT:
        why += f"; across the plane the frames stay {1e3 * offset:.3g} mm apart"
    axis_a = vector(axis / np.linalg.norm(axis))
    return LoopSpec(name=loop.name, type="point_2d", frame_a=loop.frame_a, frame_b=loop.frame_b, axis_a=axis_a), why


def _pin_or_ball(loop: LoopSpec, z_a: Array, z_b: Array) -> tuple[LoopSpec, str]:
    """Return a hinge about z where both frames agree on z, else the point."""
    tilt = float(np.arctan2(np.linalg.norm(np.cross(z_a, z_b)), abs(z_a @ z_b)))
    if tilt > ALIGNED:
        said = f"closed as a point, the frames' z axes stand {np.degrees(tilt):.3g} degrees apart"
        return loop, f"{said}; around a pin they would be aligned"
    axis_b = vector(Z if z_a @ z_b > 0 else -Z)
    spec = LoopSpec(name=loop.name, type="hinge", frame_a=loop.frame_a, frame_b=loop.frame_b, axis_b=axis_b)
    return spec, "closed as a point, the frames' z axes are aligned as around a pin; a ball joint is type 'point'"


def _normal(tree: Tree, a: Frame, b: Frame) -> Array | None:
    """Direction in frame A's axes that the loop never moves along and turns about alone; None if there is none.

    Looked at in several configurations: two axes may be parallel in one by chance.
    """
    random = np.random.default_rng(0)
    turning, moving = [], []
    for _ in range(4):
        q_tree = tree.integrate(tree.neutral(), random.uniform(-1.0, 1.0, tree.n))
        rotation, translation, jacobian = _kinematics(tree, q_tree)
        p_a, p_b = (rotation[f.joint] @ f.translation + translation[f.joint] for f in (a, b))
        (v_a, w_a), (v_b, w_b) = (
            (part[:3] + np.cross(part[3:].T, p).T, part[3:])
            for part, p in ((jacobian * tree.support[a.joint], p_a), (jacobian * tree.support[b.joint], p_b))
        )
        into_a = (rotation[a.joint] @ a.rotation).T
        turning.append(into_a @ (w_b - w_a))
        moving.append(into_a @ (v_b - v_a - np.cross(w_a.T, p_b - p_a).T))  # of B's point, seen from A
    turns, moves = np.hstack(turning), np.hstack(moving)
    directions, sizes, _ = np.linalg.svd(turns)
    if sizes[0] > FLAT:
        if sizes[1] > FLAT * sizes[0]:
            return None
        normal = directions[:, 0]
    else:
        normal = np.linalg.svd(moves)[0][:, 2]
    largest = float(np.abs(moves).max())
    if largest == 0 or float(np.abs(normal @ moves).max()) > FLAT * largest:
        return None
    return np.asarray(normal * np.sign(normal[np.argmax(np.abs(normal))]))


def _kinematics(tree: Tree, q_tree: Array) -> tuple[Array, Array, Array]:
    """Rotations and translations of the joints, and the world Jacobian."""
    placement, jacobian = tree.kinematics(q_tree)
    return placement[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1), placement[:, 9:], jacobian
