"""Force arrows: forces of loops and joints as straight arrows, motor torques as arrows around their joint's axis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.dynamics.inverse import loop_wrenches
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.view import commands
from ckc_pin.view.bodies import escape_path
from ckc_pin.view.commands import Command, Track
from ckc_pin.view.geometry import Placements, find_position_loops, homogeneous
from ckc_pin.view.visuals import Colour

__all__ = ["Arrow", "compute_arrow_scales", "compute_arrows", "create_arrow_tracks", "create_joint_arrows",
           "create_loop_arrows", "create_motor_arrows", "draw_arrows", "forces_path", "format_arrow_scales",
           "place_arrows"]  # fmt: skip

LOOP_COLOUR: Colour = (0.00, 0.62, 0.45)
MOTOR_COLOUR: Colour = (0.55, 0.20, 0.60)
JOINT_COLOUR: Colour = (0.90, 0.62, 0.00)
FULL_LENGTH = 0.35  # of the mechanism's size: the length of an arrow at full scale
FULL_SCALE_PERCENTILE = 98.0  # of all sizes; a peak near a singularity does not set the scale
MAX_LENGTH_RATIO = 1.5  # of an arrow's length to the full length
MIN_LENGTH_RATIO = 1e-6  # the viewer cannot draw an object of size zero
CIRCUMFERENCE_POINTS = 12  # of an arrow's cross section
ARC_POINTS = 24  # along an arrow around an axis


@dataclass(frozen=True)
class Arrow:
    """A force or a torque at output times of a run, or at one pose (m = 1).

    Attributes
    ----------
    name : str
    colour : (r, g, b)
    is_torque : bool
    position : (m, 3) array
        Point of application in the world, m.
    vector : (m, 3) array
        In the world, N or N m.
    """

    name: str
    colour: Colour
    is_torque: bool
    position: Array
    vector: Array


def compute_arrows(run: Run, rows: IntArray, poses: Placements) -> list[Arrow]:
    """Compute the arrows of a run at output times: one for each loop at its frame A, one for each driven joint.

    A loop force that the dynamics do not determine is zero.
    """
    mechanism = run.mechanism
    multipliers = np.zeros((len(rows), mechanism.closure.rows))
    for loop, forces in run.loop_forces().items():
        multipliers[:, [name == loop for name, _ in mechanism.closure.names]] = np.nan_to_num(forces[rows])
    wrenches = []
    for k, row in enumerate(rows):
        kinematics = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[row]))
        wrenches.append(loop_wrenches(Terms(mechanism, kinematics, run.v_tree[row]), multipliers[k]))
    return create_loop_arrows(mechanism, wrenches, poses) + create_motor_arrows(mechanism, run.tau[rows], poses)


def create_loop_arrows(mechanism: Mechanism, wrenches: Sequence[Mapping[str, Array]], poses: Placements) -> list[Arrow]:
    """Return an arrow at frame A of each loop that constrains a position, from the wrenches by loop at m poses."""
    arrows, position_loops = [], find_position_loops(mechanism)
    for spec in mechanism.spec.loop:
        if spec.name in position_loops:
            frame = mechanism.frames.find(spec.frame_a, spec.name)
            position = poses.point_positions(frame.joint, frame.translation)
            forces = np.array([of_loops[spec.name][:3] for of_loops in wrenches])
            arrows.append(Arrow(f"loop:{spec.name}", LOOP_COLOUR, False, position, forces))
    return arrows


def create_motor_arrows(mechanism: Mechanism, tau: Array, poses: Placements) -> list[Arrow]:
    """Return an arrow at each driven joint, from motor torques (m, motors)."""
    arrows, model, efforts = [], mechanism.tree.model, np.nan_to_num(tau @ mechanism.motors.transmission)
    for joint in range(1, model.njoints):
        column = model.joints[joint].idx_v
        if model.joints[joint].nv == 1 and np.any(mechanism.motors.transmission[:, column]):
            axis, is_rotation = mechanism.tree.axis(joint)
            vector = (poses.rotation[:, joint] @ axis) * efforts[:, column, None]
            name = f"motor:{model.names[joint]}"
            arrows.append(Arrow(name, MOTOR_COLOUR, is_rotation, poses.translation[:, joint], vector))
    return arrows


def create_joint_arrows(
    mechanism: Mechanism, wrenches: Sequence[Mapping[str, Array]], poses: Placements
) -> list[Arrow]:
    """Return an arrow at each joint: the force on the body that it carries, from the wrenches by joint at m poses."""
    names = list(mechanism.tree.model.names)
    return [
        Arrow(f"joint:{name}", JOINT_COLOUR, False, poses.translation[:, names.index(name)],
              np.array([of_joints[name][:3] for of_joints in wrenches]))
        for name in wrenches[0]
    ]  # fmt: skip


def compute_arrow_scales(groups: Sequence[Sequence[Arrow]]) -> dict[bool, float]:
    """Return the sizes that are drawn at full length: of forces (False), N, and of torques (True), N m."""
    sizes: dict[bool, list[Array]] = {False: [], True: []}
    for arrow in (arrow for group in groups for arrow in group):
        sizes[arrow.is_torque].append(np.linalg.norm(arrow.vector, axis=1))
    scales = {kind: float(np.percentile(np.concatenate(arrays), FULL_SCALE_PERCENTILE))
              for kind, arrays in sizes.items() if arrays}  # fmt: skip
    return {kind: scale for kind, scale in scales.items() if scale > 0}


def format_arrow_scales(scales: Mapping[bool, float]) -> str:
    """Return the force and the torque that an arrow of full length stands for, as "20 N, 5 N m"."""
    return ", ".join(f"{scales[is_torque]:.3g} {'N m' if is_torque else 'N'}" for is_torque in sorted(scales))


def forces_path(root: str) -> str:
    """Return the path of a run's arrows."""
    return f"{root}/forces"


def draw_arrows(root: str, arrows: Sequence[Arrow], opacity: float) -> Iterator[Command]:
    """Draw arrows of one metre, forces along z and torques around z; `create_arrow_tracks` places and scales them."""
    for arrow in arrows:
        corners, faces = _create_round_arrow() if arrow.is_torque else _create_straight_arrow()
        material = commands.create_material(arrow.colour, opacity)
        yield commands.draw_surface(f"{_arrow_path(root, arrow)}/arrow", corners, faces, np.eye(4), material)


def create_arrow_tracks(
    root: str, arrows: Sequence[Arrow], t: Array, size: float, scales: dict[bool, float]
) -> Iterator[Track]:
    """Create the keyframes that place, rotate and scale arrows; `size` is the mechanism's, m."""
    for arrow in arrows:
        lengths = _drawn_lengths(arrow.vector, scales.get(arrow.is_torque, 1.0), size)
        values = {
            "position": arrow.position,
            "quaternion": np.array([rotation.coeffs() for rotation in _orient(arrow.vector)]),
            "scale": np.tile(lengths[:, None], (1, 3)),
        }
        yield Track(_arrow_path(root, arrow), t, values)


def place_arrows(root: str, arrows: Sequence[Arrow], size: float, scales: Mapping[bool, float]) -> Iterator[Command]:
    """Place, rotate and scale arrows at the first of their poses; `size` is the mechanism's, m."""
    vectors = np.array([arrow.vector[0] for arrow in arrows]).reshape(-1, 3)
    full = np.array([scales.get(arrow.is_torque, 1.0) for arrow in arrows])
    lengths = _drawn_lengths(vectors, full, size)
    for arrow, rotation, length in zip(arrows, _orient(vectors), lengths, strict=True):
        matrix = homogeneous(length * rotation.matrix(), arrow.position[0])
        yield commands.set_transform(_arrow_path(root, arrow), matrix)


def _arrow_path(root: str, arrow: Arrow) -> str:
    return f"{forces_path(root)}/{escape_path(arrow.name)}"


def _drawn_lengths(vectors: Array, full: Array | float, size: float) -> Array:
    """Return the lengths, m, at which vectors (m, 3) are drawn; vectors of size `full` are drawn at full length."""
    ratios = np.linalg.norm(vectors, axis=1) / full
    return np.asarray(FULL_LENGTH * size * np.maximum(np.minimum(ratios, MAX_LENGTH_RATIO), MIN_LENGTH_RATIO))


def _orient(vectors: Array) -> list[pin.Quaternion]:
    """Return the rotations that turn z to vectors (m, 3); none for zero vectors."""
    z = np.array([0.0, 0.0, 1.0])
    return [pin.Quaternion.FromTwoVectors(z, v if v.any() else z) for v in vectors]


# --- shapes --------------------------------------------------------------------------------------


def _create_straight_arrow() -> tuple[Array, IntArray]:
    """Return the surface of an arrow of one metre along z."""
    radii = np.array([0.0, 0.03, 0.03, 0.09, 0.0])
    centres = np.outer([0.0, 0.0, 0.72, 0.72, 1.0], [0.0, 0.0, 1.0])
    return _create_tube(radii, centres, np.tile([1.0, 0.0, 0.0], (5, 1)), np.tile([0.0, 1.0, 0.0], (5, 1)))


def _create_round_arrow() -> tuple[Array, IntArray]:
    """Return the surface of an arrow along three quarters of a circle around z, with a radius of half a metre."""
    positions = np.array([0.0, *np.linspace(0.0, 0.8, ARC_POINTS), 0.8, 1.0])
    radii = np.array([0.0, *[0.03] * ARC_POINTS, 0.09, 0.0])
    angles = 1.5 * np.pi * positions
    outward = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    return _create_tube(radii, 0.5 * outward, np.tile([0.0, 0.0, 1.0], (len(positions), 1)), outward)


def _create_tube(radii: Array, centres: Array, x: Array, y: Array) -> tuple[Array, IntArray]:
    """Return the surface through circles around centres (m, 3), in the planes of x and y (m, 3)."""
    angles = 2 * np.pi * np.arange(CIRCUMFERENCE_POINTS) / CIRCUMFERENCE_POINTS
    rings = centres[:, None] + radii[:, None, None] * (
        np.cos(angles)[:, None] * x[:, None] + np.sin(angles)[:, None] * y[:, None]
    )
    ring = np.arange(CIRCUMFERENCE_POINTS)
    next_ring = np.roll(ring, -1)
    strip = np.vstack([np.column_stack([ring, next_ring, ring + CIRCUMFERENCE_POINTS]),
                       np.column_stack([next_ring, next_ring + CIRCUMFERENCE_POINTS,
                                        ring + CIRCUMFERENCE_POINTS])])  # fmt: skip
    faces = np.vstack([strip + k * CIRCUMFERENCE_POINTS for k in range(len(radii) - 1)])
    return rings.reshape(-1, 3), faces
