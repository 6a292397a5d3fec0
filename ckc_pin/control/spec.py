"""The `[controller]` table of a scene, as a typed structure."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

__all__ = [
    "AllocationSpec",
    "ControllerSpec",
    "DriveSpec",
    "FeedbackSpec",
    "Gain",
    "HarmonicsSpec",
    "SensorSpec",
    "SetPointSpec",
    "TorquesSpec",
    "TrackingSpec",
]

Gain = float | dict[str, float] | list[list[float]]
Limit = Annotated[float, msgspec.Meta(gt=0)]
Size = Annotated[float, msgspec.Meta(ge=0)]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class AllocationSpec(_Part, frozen=True):
    """How redundant motors share u: the sum of weight * (tau - preload)^2 is the least there is."""

    weights: dict[str, Limit] = {}
    preload: dict[str, float] = {}


class SensorSpec(_Part, frozen=True):
    """What a sampled controller sees of q and q_dot; a number, or a table by coordinate.

    `resolution`: the encoders' steps. `rate`: as it is, or by differences of what is measured. `filter`: the time
    constant of a first-order filter of the rate, s. Noise: standard deviations of the position before it is quantised,
    and of the rate.
    """

    resolution: Size | dict[str, Size] = 0.0
    rate: Literal["exact", "difference"] = "exact"
    filter: Limit | None = None
    q_noise: Size | dict[str, Size] = 0.0
    q_dot_noise: Size | dict[str, Size] = 0.0
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0


class DriveSpec(_Part, frozen=True):
    """What a sampled controller's drives make of tau; a number, or a table by motor."""

    torque_resolution: Limit | dict[str, Limit] | None = None
    torque_rate: Limit | dict[str, Limit] | None = None


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="type"):
    torque_limit: Limit | dict[str, Limit] | None = None


class _Feedback(_Spec, frozen=True, kw_only=True):
    allocation: AllocationSpec | None = None
    model: str | None = None
    sample_time: Limit | None = None  # s; absent: u is continuous
    delay: Size = 0.0  # s, from a sample to its action
    sensor: SensorSpec | None = None
    drive: DriveSpec | None = None


class SetPointSpec(_Feedback, frozen=True, tag="set_point"):
    """Eq. 14."""

    K_P: Gain
    K_V: Gain
    q_d: dict[str, float]


class TrackingSpec(_Feedback, frozen=True, tag="tracking"):
    """Eq. 16. `desired` is {joint: harmonics} or {file: CSV}."""

    Lambda: Gain
    K_D: Gain
    desired: dict[str, Any]


class TorquesSpec(_Spec, frozen=True, tag="torques"):
    """The motors' torques over time, from a CSV file."""

    file: str
    interpolation: Literal["hold", "linear"] = "hold"


FeedbackSpec = SetPointSpec | TrackingSpec
ControllerSpec = SetPointSpec | TrackingSpec | TorquesSpec


class HarmonicsSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Offset + sum of amplitude * sin(frequency * t + phase)."""

    offset: float = 0.0
    harmonics: list[tuple[float, float, float]] = []
