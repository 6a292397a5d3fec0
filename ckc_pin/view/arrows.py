"""Forces of a run as arrows: what the loops carry, and what the motors give; a torque is an arrow round its axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.dynamics.inverse import loop_wrenches
from ckc_pin.dynamics.terms import Terms
from ckc_pin.run.run import Run
from ckc_pin.view import commands
from ckc_pin.view.bodies import safe
from ckc_pin.view.commands import Command, Track
from ckc_pin.view.gaps import opening_loops
from ckc_pin.view.skeleton import Placements
from ckc_pin.view.visuals import Colour

__all__ = ["Arrow", "arrow_scales", "arrow_tracks", "arrows", "draw_arrows", "forces_path"]

LOOPS: Colour = (0.00, 0.62, 0.45)
MOTORS: Colour = (0.55, 0.20, 0.60)
LONG = 0.35  # of the mechanism's size, for a large force
USUAL = 98.0  # percentile of sizes that is a large force: a singular end does not count
MOST = 1.5  # times as long at most
CORNERS = 12  # round an arrow
BENDS = 24  # of an arrow round an axis


@dataclass(frozen=True)
class Arrow:
    """A vector that is drawn: where (m, 3) and what (m, 3), N, or N m where it turns."""

    name: str
    colour: Colour
    turns: bool
    at: Array
    vector: Array


def arrows(run: Run, rows: IntArray, moved: Placements) -> list[Arrow]:
    """Return the arrows of a run at output instants: of each loop on its frame A, and of each driven joint.

    Where nothing determines a loop's force its vector is zero.
    """
    mechanism, found = run.mechanism, []
    multipliers = np.zeros((len(rows), mechanism.closure.rows))
    for loop, forces in run.loop_forces().items():
        multipliers[:, [name == loop for name, _ in mechanism.closure.names]] = np.nan_to_num(forces[rows])
    carried = {loop: np.zeros((len(rows), 3)) for loop in opening_loops(mechanism)}
    for k, row in enumerate(rows):
        at = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[row]))
        for loop, wrench in loop_wrenches(Terms(mechanism, at, run.v_tree[row]), multipliers[k]).items():
            if loop in carried:
                carried[loop][k] = wrench[:3]
    for spec in mechanism.spec.loop:
        if spec.name in carried:
            frame = mechanism.frames.find(spec.frame_a, spec.name)
            where = moved.of(frame.joint, frame.translation)
            found.append(Arrow(f"loop:{spec.name}", LOOPS, False, where, carried[spec.name]))
    model, efforts = mechanism.tree.model, run.tau[rows] @ mechanism.motors.transmission
    for joint in range(1, model.njoints):
        column = model.joints[joint].idx_v
        if model.joints[joint].nv == 1 and np.any(mechanism.motors.transmission[:, column]):
            axis, turns = mechanism.tree.axis(joint)
            vector = (moved.rotation[:, joint] @ axis) * np.nan_to_num(efforts[:, column, None])
            found.append(Arrow(f"motor:{model.names[joint]}", MOTORS, turns, moved.translation[:, joint], vector))
    return found


def arrow_scales(groups: Sequence[Sequence[Arrow]]) -> dict[bool, float]:
    """Return the sizes that are drawn at full length: of forces (False), N, and of torques (True), N m."""
    sizes: dict[bool, list[Array]] = {False: [], True: []}
    for arrow in (arrow for group in groups for arrow in group):
        sizes[arrow.turns].append(np.linalg.norm(arrow.vector, axis=1))
    usual = {turns: float(np.percentile(np.concatenate(own), USUAL)) for turns, own in sizes.items() if own}
    return {turns: size for turns, size in usual.items() if size > 0}


def forces_path(root: str) -> str:
    """Return the path of a run's arrows."""
    return f"{root}/forces"


def draw_arrows(root: str, found: Sequence[Arrow], opacity: float) -> Iterator[Command]:
    """Draw arrows of one metre along z, or round it."""
    for arrow in found:
        corners, faces = _round_arrow() if arrow.turns else _straight_arrow()
        look = commands.material(arrow.colour, opacity)
        yield commands.surface(f"{forces_path(root)}/{safe(arrow.name)}/arrow", corners, faces, np.eye(4), look)


def arrow_tracks(
    root: str, found: Sequence[Arrow], t: Array, size: float, scales: dict[bool, float]
) -> Iterator[Track]:
    """Place, turn and stretch the arrows along a run of a mechanism of a size, metres."""
    up = np.array([0.0, 0.0, 1.0])
    for arrow in found:
        lengths = np.linalg.norm(arrow.vector, axis=1) / scales.get(arrow.turns, 1.0)
        scale = LONG * size * np.maximum(np.minimum(lengths, MOST), 1e-6)  # none at all cannot be drawn
        turned = np.array([pin.Quaternion.FromTwoVectors(up, v if np.any(v) else up).coeffs() for v in arrow.vector])
        ways = {"position": arrow.at, "quaternion": turned, "scale": np.tile(scale[:, None], (1, 3))}
        yield Track(f"{forces_path(root)}/{safe(arrow.name)}", t, ways)


# --- shapes --------------------------------------------------------------------------------------


def _straight_arrow() -> tuple[Array, IntArray]:
    """One metre along z."""
    radii = np.array([0.0, 0.03, 0.03, 0.09, 0.0])
    middles = np.outer([0.0, 0.0, 0.72, 0.72, 1.0], [0.0, 0.0, 1.0])
    return _tube(radii, middles, np.tile([1.0, 0.0, 0.0], (5, 1)), np.tile([0.0, 1.0, 0.0], (5, 1)))


def _round_arrow() -> tuple[Array, IntArray]:
    """Three quarters of a circle round z, its radius half a metre."""
    along = np.array([0.0, *np.linspace(0.0, 0.8, BENDS), 0.8, 1.0])
    radii = np.array([0.0, *[0.03] * BENDS, 0.09, 0.0])
    angles = 1.5 * np.pi * along
    out = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    return _tube(radii, 0.5 * out, np.tile([0.0, 0.0, 1.0], (len(along), 1)), out)


def _tube(radii: Array, middles: Array, x: Array, y: Array) -> tuple[Array, IntArray]:
    """Surface of circles round middles (m, 3) in planes of x and y (m, 3), each joined to the next."""
    angles = 2 * np.pi * np.arange(CORNERS) / CORNERS
    rings = middles[:, None] + radii[:, None, None] * (
        np.cos(angles)[:, None] * x[:, None] + np.sin(angles)[:, None] * y[:, None]
    )
    here = np.arange(CORNERS)
    after = np.roll(here, -1)
    strip = np.vstack([np.column_stack([here, after, here + CORNERS]),
                       np.column_stack([after, after + CORNERS, here + CORNERS])])  # fmt: skip
    faces = np.vstack([strip + k * CORNERS for k in range(len(radii) - 1)])
    return rings.reshape(-1, 3), faces
