"""What acts on a mechanism or within it, as typed structures: gears, springs, forces, joints themselves, motors."""

from __future__ import annotations

from typing import Annotated

import msgspec

from ckc_pin.base.toml import FileStruct
from ckc_pin.mechanism.spec_frames import Frame, Name, NonNegative, Positive

__all__ = ["CouplingSpec", "ForceSpec", "JointSpec", "MotorSpec", "SpringSpec"]


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
