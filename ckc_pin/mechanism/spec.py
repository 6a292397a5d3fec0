"""The mechanism file, `mechanism.toml`, as a typed structure.

What a key means stands in its structure's docstring, from which the reference is made: where numpydoc has the type,
which the annotation says, stands the unit, and the last line is an example.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from ckc_pin.base.toml import FileStruct

__all__ = [
    "CouplingSpec",
    "ForceSpec",
    "Frame",
    "FrameSpec",
    "JointSpec",
    "LoopSpec",
    "LoopType",
    "MechanismSpec",
    "MotorSpec",
    "Name",
    "NonNegative",
    "PointSpec",
    "Positive",
    "SpringSpec",
    "TreeSpec",
    "Vector3",
]

Vector3 = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Name = Annotated[str, msgspec.Meta(min_length=1)]


class FrameSpec(FileStruct, frozen=True):
    """A frame placed in a link (or ``joint:NAME``, or ``world``).

    Attributes
    ----------
    link
        A link, ``joint:NAME`` or ``world``.
        ``link = "rod"``
    xyz : m
        Position in it.
        ``xyz = [0.6, 0.0, 0.0]``
    rpy : rad
        Orientation in it: roll, pitch, yaw about fixed axes, as in a URDF.
        ``rpy = [0.0, 1.5707963, 0.0]``
    """

    link: Name
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)


Frame = Name | FrameSpec


class CouplingSpec(FileStruct, frozen=True):
    """joint = ratio * other + offset.

    Attributes
    ----------
    joint
        a in a = ratio b + offset.
        ``joint = "wheel"``
    other
        b.
        ``other = "pinion"``
    ratio : a's by b's
        Gear ratio, with its sign.
        ``ratio = -0.5``
    offset : rad, m
        Of a where b is 0.
        ``offset = 0.1``
    """

    joint: Name
    other: Name
    ratio: float
    offset: float = 0.0


class SpringSpec(FileStruct, frozen=True):
    """A spring and damper between two frames' origins, or on a joint.

    Attributes
    ----------
    frame_a
        One end, with ``frame_b``; or ``joint``.
        ``frame_a = "world"``
    frame_b
        The other end.
        ``frame_b = {link = "rod", xyz = [0.3, 0.0, 0.0]}``
    rest_length : m
        Of the spring between two frames; absent: 0.
        ``rest_length = 0.25``
    joint
        A joint of one freedom, in the place of two frames.
        ``joint = "hip"``
    rest : rad, m
        The joint's position without force; absent: 0.
        ``rest = 1.2``
    stiffness : N/m, N m/rad
        Force by elongation.
        ``stiffness = 800.0``
    damping : N s/m, N m s/rad
        Force by rate of elongation.
        ``damping = 5.0``
    """

    frame_a: Frame | None = None
    frame_b: Frame | None = None
    rest_length: NonNegative | None = None
    joint: Name | None = None
    rest: float | None = None
    stiffness: NonNegative = 0.0
    damping: NonNegative = 0.0


class ForceSpec(FileStruct, frozen=True):
    """A constant force or torque on a joint, N or N m: part of the mechanism, with potential -value * coordinate.

    A motor's fixed drive torque, a weight on a string: what pushes a joint without being a controller.

    Attributes
    ----------
    joint
        A joint of one freedom.
        ``joint = "slider"``
    value : N, N m
        Along its coordinate; potential -value × coordinate.
        ``value = -9.81``
    """

    joint: Name
    value: float


class JointSpec(FileStruct, frozen=True):
    """What one joint itself does; what is absent is the URDF's, N, N m, kg m^2 (kg) and N m s/rad (N s/m).

    Attributes
    ----------
    name
        A joint of one freedom.
        ``name = "hip"``
    armature : kg m², kg
        Inertia of a rotor, reflected through its gear; on the diagonal of D'; absent: none.
        ``armature = 0.02``
    damping : N m s/rad, N s/m
        Viscous friction; absent: the URDF's.
        ``damping = 0.1``
    friction : N m, N
        Dry friction: the most that holds it at rest, and what opposes its motion; absent: the URDF's.
        ``friction = 0.3``
    stops
        The URDF's limits are walls.
        ``stops = true``
    restitution
        Of an impact at a stop: speed after over speed before.
        ``restitution = 0.5``
    """

    name: Name
    armature: NonNegative | None = None
    damping: NonNegative | None = None
    friction: NonNegative | None = None
    stops: bool = False
    restitution: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0


class MotorSpec(FileStruct, frozen=True):
    """A motor on a joint, or on a sum of joints: its angle is ratio times the sum of what `joints` says.

    torque_limit, speed_limit and tau are its own, before the gear: it acts on a joint as ratio * tau.

    Attributes
    ----------
    name
        Its key wherever tau is given by name; absent: the joint's.
        ``name = "hip_motor"``
    joint
        A joint of one freedom.
        ``joint = "hip"``
    joints
        What it turns with each of several joints, ``{a = 1.0, b = -1.0}``; needs a ``name``.
        ``joints = {left = 1.0, right = -1.0}``
    ratio : its by the joint's
        Gear, with its sign; not 0.
        ``ratio = 50.0``
    rotor_inertia : kg m², kg
        Of the rotor: ratio² times it is added to the joint's armature; for a motor on one joint.
        ``rotor_inertia = 1.2e-5``
    torque_limit : N m, N
        |tau| never exceeds it.
        ``torque_limit = 0.6``
    speed_limit : rad/s, m/s
        Of the motor; nothing holds it there, a run says where it is exceeded.
        ``speed_limit = 300.0``
    """

    name: Name | None = None
    joint: Name | None = None
    joints: dict[str, float] = {}
    ratio: float = 1.0
    rotor_inertia: NonNegative = 0.0
    torque_limit: Positive | None = None
    speed_limit: Positive | None = None


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
