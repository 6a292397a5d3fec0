"""Propose types for loops whose file marks two coincident points but not the joint, from the geometry.

- If all joints of the loop turn about one direction, and slide across it, the loop moves in a plane. Of the rows of a
  hinge only two are independent then, those of `point_2d` in that plane.
- Otherwise the loop is assembled as a point and the z axes of both frames are compared. They are aligned in an
  assembly drawn around a pin; around a ball joint they need not be.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.formats.conversion import round_vector
from ckc_pin.formats.draft import Draft
from ckc_pin.kinematics.closing import close_loops
from ckc_pin.mechanism.closure import ClosureBuilder
from ckc_pin.mechanism.frames import Frame, Frames
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec
from ckc_pin.mechanism.tree import Tree
from ckc_pin.mechanism.urdf import UrdfTree

__all__ = ["propose_loop_types"]

PARALLEL_TOLERANCE = 1e-5  # relative; the numbers of these files have six digits
ALIGNED_TOLERANCE_RAD = 1e-4  # between the z axes of two frames around a pin
ASSEMBLY_TOLERANCE = 1e-10  # m or rad
CONFIGURATIONS = 4  # random ones; in a single one two axes may be parallel by chance
Z_AXIS = np.array([0.0, 0.0, 1.0])

Proposal = tuple[LoopSpec, str]  # with the reason


def propose_loop_types(draft: Draft) -> None:
    """Add the draft's untyped loops to its loops, with types proposed from the geometry."""
    if not draft.untyped:
        return
    loops_by_proposal: dict[tuple[str, str], list[str]] = {}
    for spec, why in _propose_types(draft, draft.untyped):
        draft.loops.append((spec, f"guessed: {why}"))
        loops_by_proposal.setdefault((spec.type, why), []).append(spec.name)
    for (kind, why), loops in loops_by_proposal.items():
        draft.guessed.append(f"{kind} for loop {', '.join(loops)}: {why}")
    draft.untyped = []


def _propose_types(draft: Draft, untyped: Sequence[LoopSpec]) -> list[Proposal]:
    """Propose a type for each loop of type point, with the reason."""
    tree, frames, urdf = draft.build_tree()
    proposals: dict[str, Proposal] = {}
    for loop in untyped:
        a, b = _ends(loop, frames)
        if a.joint == b.joint:
            proposals[loop.name] = loop, "both frames are on one body"
            continue
        normal = _plane_normal(tree, a, b)
        if normal is not None:
            proposals[loop.name] = _planar_loop(tree, loop, a, b, normal)
    spatial = [loop for loop in untyped if loop.name not in proposals]
    if spatial:
        planar = [spec for spec, _ in proposals.values()]
        pose = _assembled_pose(draft, tree, frames, urdf, [*planar, *spatial])
        for loop in spatial:
            z_a, z_b = (pose.rotation[f.joint] @ f.rotation @ Z_AXIS for f in _ends(loop, frames))
            proposals[loop.name] = _hinge_or_point(loop, z_a, z_b)
    return [proposals[loop.name] for loop in untyped]


def _ends(loop: LoopSpec, frames: Frames) -> list[Frame]:
    return [frames.find(frame, f"loop {loop.name!r}") for frame in (loop.frame_a, loop.frame_b)]


def _assembled_pose(draft: Draft, tree: Tree, frames: Frames, urdf: UrdfTree, loops: Sequence[LoopSpec]) -> Pose:
    """Assemble the tree with the file's loops and couplings and some more loops."""
    spec = draft.to_spec()
    builder = ClosureBuilder(tree, frames)
    for loop in [*spec.loop, *loops]:
        a, b = _ends(loop, frames)
        if a.joint != b.joint:
            builder.add_loop(loop)
    mimics = [CouplingSpec(joint=j, other=o, ratio=r, offset=c) for j, o, r, c in urdf.mimic]
    for coupling in [*spec.coupling, *mimics]:
        builder.add_coupling(coupling)
    closure = builder.build()
    at = close_loops(tree, closure, tree.neutral(), np.ones(tree.n), ASSEMBLY_TOLERANCE)
    return Pose(tree, closure.anchors, at.q_tree)


def _planar_loop(tree: Tree, loop: LoopSpec, a: Frame, b: Frame, normal: Array) -> Proposal:
    """Return the `point_2d` in the plane. The offset of the frames along the normal stays as it is."""
    rotation, translation, _ = _kinematics(tree, tree.neutral())
    p_a, p_b = (rotation[f.joint] @ f.translation + translation[f.joint] for f in (a, b))
    offset = abs(float(normal @ (rotation[a.joint] @ a.rotation).T @ (p_a - p_b)))
    axis = np.where(np.abs(normal) < PARALLEL_TOLERANCE, 0.0, normal)
    why = "its joints move in one plane, where the other rows of a hinge are redundant"
    if offset > PARALLEL_TOLERANCE:
        why += f"; across the plane the frames stay {1e3 * offset:.3g} mm apart"
    axis_a = round_vector(axis / np.linalg.norm(axis))
    return LoopSpec(name=loop.name, type="point_2d", frame_a=loop.frame_a, frame_b=loop.frame_b, axis_a=axis_a), why


def _hinge_or_point(loop: LoopSpec, z_a: Array, z_b: Array) -> Proposal:
    """Return a hinge about z if the z axes of both frames are parallel, otherwise the point."""
    tilt = float(np.arctan2(np.linalg.norm(np.cross(z_a, z_b)), abs(z_a @ z_b)))
    if tilt > ALIGNED_TOLERANCE_RAD:
        why = f"assembled as a point, the frames' z axes are {np.degrees(tilt):.3g} degrees apart"
        return loop, f"{why}; around a pin they would be aligned"
    axis_b = round_vector(Z_AXIS if z_a @ z_b > 0 else -Z_AXIS)
    spec = LoopSpec(name=loop.name, type="hinge", frame_a=loop.frame_a, frame_b=loop.frame_b, axis_b=axis_b)
    return spec, "assembled as a point, the frames' z axes are aligned as around a pin; a ball joint is type 'point'"


def _plane_normal(tree: Tree, a: Frame, b: Frame) -> Array | None:
    """Return the normal of the plane in which a loop moves, in frame A's axes; None if there is no such plane.

    The relative motion of both frames turns about the normal only, and never translates along it.
    """
    random = np.random.default_rng(0)
    angular, linear = [], []
    for _ in range(CONFIGURATIONS):
        q_tree = tree.integrate(tree.neutral(), random.uniform(-1.0, 1.0, tree.n))
        rotation, translation, jacobian = _kinematics(tree, q_tree)
        p_a, p_b = (rotation[f.joint] @ f.translation + translation[f.joint] for f in (a, b))
        (v_a, w_a), (v_b, w_b) = (
            (part[:3] + np.cross(part[3:].T, p).T, part[3:])
            for part, p in ((jacobian * tree.support[a.joint], p_a), (jacobian * tree.support[b.joint], p_b))
        )
        into_a = (rotation[a.joint] @ a.rotation).T
        angular.append(into_a @ (w_b - w_a))
        linear.append(into_a @ (v_b - v_a - np.cross(w_a.T, p_b - p_a).T))  # velocity of B's origin relative to A
    turns, moves = np.hstack(angular), np.hstack(linear)
    directions, sizes, _ = np.linalg.svd(turns)
    if sizes[0] > PARALLEL_TOLERANCE:
        if sizes[1] > PARALLEL_TOLERANCE * sizes[0]:
            return None
        normal = directions[:, 0]
    else:
        normal = np.linalg.svd(moves)[0][:, 2]
    largest = float(np.abs(moves).max())
    if largest == 0 or float(np.abs(normal @ moves).max()) > PARALLEL_TOLERANCE * largest:
        return None
    return np.asarray(normal * np.sign(normal[np.argmax(np.abs(normal))]))


def _kinematics(tree: Tree, q_tree: Array) -> tuple[Array, Array, Array]:
    """Return rotations (joints, 3, 3), translations (joints, 3), and the Jacobian (6, n) of the world's velocities."""
    placement, jacobian = tree.kinematics(q_tree)
    return placement[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1), placement[:, 9:], jacobian
