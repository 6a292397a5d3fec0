"""The mechanism file, `mechanism.toml`, as a typed structure.

What a key means stands in its structure's docstring, from which the reference is made: where numpydoc has the type,
which the annotation says, stands the unit, and the last line is an example.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from ckc_pin.base.toml import FileStruct
from ckc_pin.mechanism.spec_frames import Frame, FrameSpec, Name, Positive, Vector3
from ckc_pin.mechanism.spec_parts import CouplingSpec, ForceSpec, JointSpec, MotorSpec, SpringSpec

__all__ = [
    "CouplingSpec",
    "ForceSpec",
    "FrameSpec",
    "JointSpec",
    "LoopSpec",
    "LoopType",
    "MechanismSpec",
    "MotorSpec",
    "PointSpec",
    "SpringSpec",
    "TreeSpec",
    "Vector3",
]

LoopType = Literal["point", "point_2d", "hinge", "cylindrical", "universal", "prismatic", "weld", "distance"]


class TreeSpec(FileStruct, frozen=True):
    """One URDF of the world.

    Attributes
    ----------
    file
        The URDF, beside this file or ``package://...``.
        ``file = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"``
    prefix
        Before every link, joint and frame name of this tree.
        ``prefix = "left_"``
    root
        A free root has the six coordinates ``root.x`` to ``root.rz``.
        ``root = "free"``
    parent
        The link of an earlier tree, or ``world``, that the root stands on.
        ``parent = "table"``
    xyz : m
        Position in the parent.
        ``xyz = [0.0, 0.5, 0.0]``
    rpy : rad
        Orientation in the parent: roll, pitch, yaw about fixed axes, as in a URDF.
        ``rpy = [0.0, 0.0, 1.5707963]``
    """

    file: Name
    prefix: str = ""
    root: Literal["fixed", "free"] = "fixed"
    parent: Name = "world"
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)


class LoopSpec(FileStruct, frozen=True):
    """One loop closure between frames A and B.

    Attributes
    ----------
    name
        Names its rows: ``elbow.x``, ``elbow.y``.
        ``name = "elbow"``
    type
        Which rows it has.
        ``type = "point_2d"``
    frame_a
        Frame A: a link, ``joint:NAME``, ``world``, or a table ``{link, xyz, rpy}``.
        ``frame_a = {link = "rod", xyz = [0.6, 0.0, 0.0]}``
    frame_b
        Frame B, in the same ways.
        ``frame_b = "joint:knee"``
    rows_in
        The axes that p_A - p_B is resolved in: frame A's or the world's.
        ``rows_in = "world"``
    axis_a
        The direction a, in frame A; its length does not matter.
        ``axis_a = [0.0, 1.0, 0.0]``
    axis_b
        The direction b, in frame B.
        ``axis_b = [0.0, 1.0, 0.0]``
    length : m
        Of ``distance``, which needs it; no other type takes it.
        ``length = 0.3``
    """

    name: Name
    type: LoopType
    frame_a: Frame
    frame_b: Frame
    rows_in: Literal["a", "world"] = "a"
    axis_a: Vector3 = (0.0, 0.0, 1.0)
    axis_b: Vector3 = (0.0, 0.0, 1.0)
    length: Positive | None = None


class PointSpec(FileStruct, frozen=True):
    """A point to report and to trace.

    Attributes
    ----------
    name
        The key under ``points``.
        ``name = "tip"``
    frame
        A link, ``joint:NAME``, or a table ``{link, xyz, rpy}``; the point is its origin.
        ``frame = {link = "rod", xyz = [0.6, 0.0, 0.0]}``
    """

    name: Name
    frame: Frame


class MechanismSpec(FileStruct, frozen=True):
    """The whole file.

    Attributes
    ----------
    name
        What it is called.
        ``name = "five_bar"``
    urdf
        File of the one fixed tree, beside this file, or ``package://...``; either this or ``[[tree]]``.
        ``urdf = "five_bar.urdf"``
    tree
        The URDFs of a world of several, or of a free root.
        ``tree = [{file = "left.urdf", prefix = "left_"}]``
    gravity : m/s²
        Acceleration, in the world's axes.
        ``gravity = [0.0, -9.81, 0.0]``
    independent
        q, in the order that u, D, C, h and matrix gains have; absent: chosen by a pivoted factorization,
        coordinates with motors first as far as φ_z stays sound.
        ``independent = ["theta_1", "theta_3"]``
    actuated
        Joints with a motor of their name, without a gear, in tau's order; in the place of ``[[motor]]``;
        absent both: the independent ones.
        ``actuated = ["theta_1", "theta_3"]``
    q_guess : rad, m
        Where assembly starts; it picks the assembly branch; 0 for what is not named. Where it leads beyond stops:
        the nearest within them.
        ``q_guess = {theta_1 = -1.4, "root.z" = 0.5}``
    loop
        Loop closures.
        ``loop = [{name = "elbow", type = "point_2d", frame_a = "left", frame_b = "right"}]``
    coupling
        Gears: one coordinate follows another.
        ``coupling = [{joint = "wheel", other = "pinion", ratio = -0.5}]``
    spring
        Springs and dampers.
        ``spring = [{joint = "hip", stiffness = 3.0}]``
    force
        Constant forces and torques.
        ``force = [{joint = "slider", value = -9.81}]``
    joint
        What joints themselves do: rotors, friction, stops.
        ``joint = [{name = "hip", friction = 0.2}]``
    motor
        Motors with their gears, in tau's order.
        ``motor = [{joint = "hip", ratio = 50.0}]``
    point
        Points that are reported at the end of a run and traced in playback.
        ``point = [{name = "tip", frame = "foot"}]``
    """

    name: Name
    urdf: Name | None = None
    tree: list[TreeSpec] = []
    gravity: Vector3 = (0.0, 0.0, -9.81)
    independent: list[Name] | None = None
    actuated: list[Name] | None = None
    q_guess: dict[str, float] = {}
    loop: list[LoopSpec] = []
    coupling: list[CouplingSpec] = []
    spring: list[SpringSpec] = []
    force: list[ForceSpec] = []
    joint: list[JointSpec] = []
    motor: list[MotorSpec] = []
    point: list[PointSpec] = []

    def to_dict(self) -> dict[str, Any]:
        """Return the file's content as plain data."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain
