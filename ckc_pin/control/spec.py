"""The `[controller]` table of a scene, as a typed structure."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

__all__ = ["ControllerSpec", "Gain", "HarmonicsSpec", "SetPointSpec", "TrackingSpec"]

Gain = float | dict[str, float] | list[list[float]]
Limit = Annotated[float, msgspec.Meta(gt=0)]


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="type"):
    torque_limit: Limit | dict[str, Limit] | None = None
    model: str | None = None
    sample_time: Annotated[float, msgspec.Meta(gt=0)] | None = None  # s; absent: u is continuous
    delay: Annotated[float, msgspec.Meta(ge=0)] = 0.0  # s, from a sample to its action


class SetPointSpec(_Spec, frozen=True, tag="set_point"):
    """Eq. 14."""

    K_P: Gain
    K_V: Gain
    q_d: dict[str, float]


class TrackingSpec(_Spec, frozen=True, tag="tracking"):
    """Eq. 16. `desired` is {joint: harmonics} or {file: CSV}."""

    Lambda: Gain
    K_D: Gain
    desired: dict[str, Any]


ControllerSpec = SetPointSpec | TrackingSpec


class HarmonicsSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Offset + sum of amplitude * sin(frequency * t + phase)."""

    offset: float = 0.0
    harmonics: list[tuple[float, float, float]] = []
