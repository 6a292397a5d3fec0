"""The mechanism file, `mechanism.toml`, as a typed structure. What each key means: docs/reference.md."""

from __future__ import annotations

from copy import deepcopy
from typing import Annotated, Any, Literal

import msgspec

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

Vector3 = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Name = Annotated[str, msgspec.Meta(min_length=1)]

LoopType = Literal["point", "point_2d", "hinge", "cylindrical", "universal", "prismatic", "weld", "distance"]


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Copy the tables; what is frozen stays what it is."""
        fields = ((name, getattr(self, name)) for name in self.__struct_fields__)
        copied = {name: twin for name, value in fields if (twin := deepcopy(value, memo)) is not value}
        return msgspec.structs.replace(self, **copied) if copied else self


class FrameSpec(_Spec, frozen=True):
    """A frame placed in a link (or ``joint:NAME``, or ``world``)."""

    link: Name
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)


Frame = Name | FrameSpec


class TreeSpec(_Spec, frozen=True):
    """One URDF of the world."""

    file: Name
    prefix: str = ""
    root: Literal["fixed", "free"] = "fixed"
    parent: Name = "world"
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)


class LoopSpec(_Spec, frozen=True):
    """One loop closure between frames A and B."""

    name: Name
    type: LoopType
    frame_a: Frame
    frame_b: Frame
    rows_in: Literal["a", "world"] = "a"
    axis_a: Vector3 = (0.0, 0.0, 1.0)
    axis_b: Vector3 = (0.0, 0.0, 1.0)
    length: Positive | None = None


class CouplingSpec(_Spec, frozen=True):
    """joint = ratio * other + offset."""

    joint: Name
    other: Name
    ratio: float
    offset: float = 0.0


class SpringSpec(_Spec, frozen=True):
    """A spring and damper between two frames' origins, or on a joint."""

    frame_a: Frame | None = None
    frame_b: Frame | None = None
    rest_length: NonNegative | None = None
    joint: Name | None = None
    rest: float | None = None
    stiffness: NonNegative = 0.0
    damping: NonNegative = 0.0


class ForceSpec(_Spec, frozen=True):
    """A constant force or torque on a joint, N or N m: part of the mechanism, with potential -value * coordinate.

    A motor's fixed drive torque, a weight on a string: what pushes a joint without being a controller.
    """

    joint: Name
    value: float


class JointSpec(_Spec, frozen=True):
    """What one joint itself does; what is absent is the URDF's, N, N m, kg m^2 (kg) and N m s (N s/m)."""

    name: Name
    armature: NonNegative | None = None
    damping: NonNegative | None = None
    friction: NonNegative | None = None
    stops: bool = False
    restitution: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0


class MotorSpec(_Spec, frozen=True):
    """A motor on a joint, or on a sum of joints: its angle is ratio times the sum of what `joints` says.

    torque_limit, speed_limit and tau are its own, before the gear: it acts on a joint as ratio * tau.
    """

    name: Name | None = None
    joint: Name | None = None
    joints: dict[str, float] = {}
    ratio: float = 1.0
    rotor_inertia: NonNegative = 0.0
    torque_limit: Positive | None = None
    speed_limit: Positive | None = None


class PointSpec(_Spec, frozen=True):
    """A point to report and to trace."""

    name: Name
    frame: Frame


class MechanismSpec(_Spec, frozen=True):
    """The whole file."""

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

    def plain(self) -> dict[str, Any]:
        """Return the file's content as plain data."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain
