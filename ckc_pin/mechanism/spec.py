"""The mechanism file, `mechanism.toml`, as a typed structure.

The reference of the keys is generated from the docstrings of these structures. An attribute's docstring has the unit in
the place of numpydoc's type, which the annotation gives, and ends with an example.
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
    "Loop",
    "LoopSpec",
    "LoopType",
    "MechanismSpec",
    "MotorSpec",
    "Name",
    "NonNegative",
    "Pair",
    "PointSpec",
    "Positive",
    "SpringSpec",
    "TreeSpec",
    "Vector3",
]

Vector3 = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
# Not a tuple: msgspec 0.22 reads beyond its arrays if a constrained number or a tuple of fixed length is allowed.
Pair = Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Name = Annotated[str, msgspec.Meta(min_length=1)]


class FrameSpec(FileStruct, frozen=True):
    """A frame relative to a link, to ``joint:NAME`` or to ``world``.

    Attributes
    ----------
    link
        The link, ``joint:NAME`` or ``world`` that it is fixed to.
        ``link = "rod"``
    xyz : m
        Position relative to it.
        ``xyz = [0.6, 0.0, 0.0]``
    rpy : rad
        Orientation relative to it: roll, pitch, yaw about fixed axes, as in a URDF.
        ``rpy = [0.0, 1.5707963, 0.0]``
    """

    link: Name
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)


Frame = Name | FrameSpec


class CouplingSpec(FileStruct, frozen=True):
    """A gear, a nonlinear transmission, or a linear relation between joints of one freedom.

    It has one of four forms:

    - ``joint``, ``other`` and ``ratio``: joint = ratio * other + offset.
    - ``joint``, ``other`` and ``polynomial``: joint = c_0 + c_1 other + c_2 other² + ... + offset.
    - ``joint``, ``other`` and ``table``: joint = s(other) + offset, where s is the not-a-knot quintic spline through
      the points of the table, or their polynomial if there are at most six. Its first four derivatives are continuous.
      Beyond the first and the last point, s keeps the second derivative that it has there.
    - ``joints``: the sum of coefficient * joint over any number of joints equals offset.

    Attributes
    ----------
    name
        Name of the coupling, for its parameters and multipliers. Default: the number of the table for parameters, and
        the names of the joints for multipliers.
        ``name = "waist"``
    joint
        The joint a that follows.
        ``joint = "wheel"``
    other
        The joint b that it follows.
        ``other = "pinion"``
    ratio : unit of a per unit of b
        Gear ratio, with its sign.
        ``ratio = -0.5``
    polynomial : unit of a per power of the unit of b
        Coefficients of the powers of b, the constant first.
        ``polynomial = [0.0, 1.0, -0.3]``
    table : rad, m
        Points [b, a] of a smooth curve, with increasing b; at least three.
        ``table = [[-0.5, -0.4], [0.0, 0.0], [0.5, 0.6]]``
    joints
        Coefficients by joint, whose sum with the joints equals ``offset``.
        ``joints = {left = 0.29, right = -0.29, waist = 1.0}``
    offset : rad, m
        The constant of the relation. Default: 0.
        ``offset = 0.1``
    """

    name: Name | None = None
    joint: Name | None = None
    other: Name | None = None
    ratio: float | None = None
    polynomial: list[float] = []
    table: list[tuple[float, float]] = []
    joints: dict[str, float] = {}
    offset: float = 0.0


class SpringSpec(FileStruct, frozen=True):
    """A spring and damper between two frames' origins, or on a joint.

    Attributes
    ----------
    frame_a
        Frame of one end; requires ``frame_b``.
        ``frame_a = "world"``
    frame_b
        Frame of the other end.
        ``frame_b = {link = "rod", xyz = [0.3, 0.0, 0.0]}``
    rest_length : m
        Length without force, of a spring between frames. Default: 0.
        ``rest_length = 0.25``
    joint
        A joint of one freedom, for a spring on a joint instead of between frames.
        ``joint = "hip"``
    rest : rad, m
        Position of the joint without force. Default: 0.
        ``rest = 1.2``
    stiffness : N/m, N m/rad
        Force per elongation.
        ``stiffness = 800.0``
    damping : N s/m, N m s/rad
        Force per rate of elongation.
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
    """A constant force or torque on a joint, such as a constant drive torque or a weight on a string.

    It belongs to the mechanism, not to a controller, and has the potential energy -value * coordinate.

    Attributes
    ----------
    joint
        A joint of one freedom.
        ``joint = "slider"``
    value : N, N m
        Force along the coordinate; potential energy -value × coordinate.
        ``value = -9.81``
    """

    joint: Name
    value: float


class JointSpec(FileStruct, frozen=True):
    """Rotor inertia, damping, dry friction and stops of one joint.

    Attributes
    ----------
    name
        A joint of one freedom.
        ``name = "hip"``
    armature : kg m², kg
        Inertia of a rotor, reflected through its gear, added to the diagonal of D'. Default: 0.
        ``armature = 0.02``
    damping : N m s/rad, N s/m
        Viscous friction. Default: the value of the URDF.
        ``damping = 0.1``
    friction : N m, N
        Dry friction: the largest force at rest, and the force against the motion. Default: the value of the URDF.
        ``friction = 0.3``
    stops
        Whether the limits of the URDF are stops.
        ``stops = true``
    restitution
        Coefficient of restitution of impacts at the stops: speed after over speed before.
        ``restitution = 0.5``
    """

    name: Name
    armature: NonNegative | None = None
    damping: NonNegative | None = None
    friction: NonNegative | None = None
    stops: bool = False
    restitution: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0


class MotorSpec(FileStruct, frozen=True):
    """A motor on a joint, or on a weighted sum of joints.

    torque_limit, speed_limit and tau are at the shaft of the motor. It acts on a joint with the torque ratio * tau.

    Attributes
    ----------
    name
        Name of the motor, where tau is given by name. Default: the name of the joint.
        ``name = "hip_motor"``
    joint
        A joint of one freedom.
        ``joint = "hip"``
    joints
        Weights of several joints, whose sum times ``ratio`` is the angle of the motor; requires a ``name``.
        ``joints = {left = 1.0, right = -1.0}``
    ratio : unit of the motor per unit of the joint
        Gear ratio, with its sign; not 0.
        ``ratio = 50.0``
    rotor_inertia : kg m², kg
        Inertia of the rotor; ratio² times it is added to the armature of the joint. Of a motor on several joints with
        weights w, ratio² rotor_inertia w wᵀ is added to D'.
        ``rotor_inertia = 1.2e-5``
    torque_limit : N m, N
        Largest |tau|, or the smallest and the largest tau, of which one may be 0.
        ``torque_limit = [-1.0, 3.0]``
    speed_limit : rad/s, m/s
        Largest speed of the motor. A run reports where it is exceeded, but does not enforce it.
        ``speed_limit = 300.0``
    """

    name: Name | None = None
    joint: Name | None = None
    joints: dict[str, float] = {}
    ratio: float = 1.0
    rotor_inertia: NonNegative = 0.0
    torque_limit: Positive | Pair | None = None
    speed_limit: Positive | None = None


LoopType = Literal["point", "point_2d", "hinge", "cylindrical", "universal", "prismatic", "weld", "distance"]


class TreeSpec(FileStruct, frozen=True):
    """One URDF tree of a mechanism.

    Attributes
    ----------
    file
        The URDF, beside this file or ``package://...``.
        ``file = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"``
    prefix
        Prefix of all link, joint and frame names of this tree.
        ``prefix = "left_"``
    root
        Whether the root link is fixed or free; a free root has the six coordinates ``root.x`` to ``root.rz``.
        ``root = "free"``
    parent
        The link of an earlier tree, or ``world``, that the root is placed on.
        ``parent = "table"``
    xyz : m
        Position relative to the parent.
        ``xyz = [0.0, 0.5, 0.0]``
    rpy : rad
        Orientation relative to the parent: roll, pitch, yaw about fixed axes, as in a URDF.
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
        Name of the loop, which prefixes its rows: ``elbow.x``, ``elbow.y``.
        ``name = "elbow"``
    type
        Type of the loop, which determines its constraint rows.
        ``type = "point_2d"``
    frame_a
        Frame A: a link, ``joint:NAME``, ``world``, or a table ``{link, xyz, rpy}``.
        ``frame_a = {link = "rod", xyz = [0.6, 0.0, 0.0]}``
    frame_b
        Frame B, specified in the same way.
        ``frame_b = "joint:knee"``
    rows_in
        The axes that p_A - p_B is resolved in: frame A's or the world's.
        ``rows_in = "world"``
    axis_a
        The direction a in frame A; its length is ignored.
        ``axis_a = [0.0, 1.0, 0.0]``
    axis_b
        The direction b in frame B; its length is ignored.
        ``axis_b = [0.0, 1.0, 0.0]``
    length : m
        Distance between the origins of the frames, for type ``distance`` only.
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


Loop = LoopSpec  # its public name


class PointSpec(FileStruct, frozen=True):
    """A named point, which runs report and playback traces.

    Attributes
    ----------
    name
        Name of the point, its key in ``points``.
        ``name = "tip"``
    frame
        The frame whose origin is the point: a link, ``joint:NAME``, or a table ``{link, xyz, rpy}``.
        ``frame = {link = "rod", xyz = [0.6, 0.0, 0.0]}``
    """

    name: Name
    frame: Frame


class MechanismSpec(FileStruct, frozen=True):
    """The contents of a mechanism file.

    Attributes
    ----------
    name
        Name of the mechanism.
        ``name = "five_bar"``
    urdf
        The URDF of a single fixed tree, beside this file, or ``package://...``. Otherwise give ``[[tree]]``.
        ``urdf = "five_bar.urdf"``
    tree
        URDF trees, for several trees or a free root.
        ``tree = [{file = "left.urdf", prefix = "left_"}]``
    gravity : m/s²
        Acceleration of gravity in world axes.
        ``gravity = [0.0, -9.81, 0.0]``
    independent
        The independent coordinates q, in the order of u, D, C, h and matrix gains. Default: those with
        motors as far as φ_z stays well conditioned, then those nearest the root. The choice does not depend on stops or
        on small changes of ``q_guess``.
        ``independent = ["theta_1", "theta_3"]``
    actuated
        Joints with a motor of the same name and without a gear, in the order of tau, instead of ``[[motor]]``.
        Default: the independent joints.
        ``actuated = ["theta_1", "theta_3"]``
    q_guess : rad, m
        Initial guess of the assembly, which selects the assembly branch. Default: 0 for each coordinate, and for the
        follower of a coupling the value that its master implies. Independent coordinates keep their value if the loops
        can be closed with it. If the guess leads beyond stops, the mechanism is assembled at the nearest configuration
        within them.
        ``q_guess = {theta_1 = -1.4, "root.z" = 0.5}``
    loop
        Loop closures.
        ``loop = [{name = "elbow", type = "point_2d", frame_a = "left", frame_b = "right"}]``
    coupling
        Gears and other relations between joints.
        ``coupling = [{joint = "wheel", other = "pinion", ratio = -0.5}]``
    spring
        Springs and dampers.
        ``spring = [{joint = "hip", stiffness = 3.0}]``
    force
        Constant forces and torques.
        ``force = [{joint = "slider", value = -9.81}]``
    joint
        Rotor inertia, friction and stops of joints.
        ``joint = [{name = "hip", friction = 0.2}]``
    motor
        Motors with their gears, in the order of tau.
        ``motor = [{joint = "hip", ratio = 50.0}]``
    point
        Named points, which runs report and playback traces.
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
        """Return the contents of the file as JSON-ready data."""
        data: dict[str, Any] = msgspec.to_builtins(self)
        return data
