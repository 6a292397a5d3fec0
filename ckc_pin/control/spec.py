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
    """How redundant motors share u: the sum of weight * (tau - preload)^2 is the least there is.

    Attributes
    ----------
    weights
        By motor: what its torque costs; 1 for what is not named.
        ``weights = {left = 2.0}``
    preload : N m, N
        By motor: what tau is without u, as far as it moves nothing; 0 for what is not named.
        ``preload = {left = 1.0, right = 1.0}``
    """

    weights: dict[str, Limit] = {}
    preload: dict[str, float] = {}


class SensorSpec(_Part, frozen=True):
    """What a sampled controller sees of q and q_dot; a number, or a table by coordinate.

    Noise is added to the position before it is quantised, and to the rate.

    Attributes
    ----------
    resolution : rad, m
        Step of the encoders; a table is by coordinate; 0: exact.
        ``resolution = {theta_1 = 1e-4, theta_3 = 2e-4}``
    rate
        Q̇ as it is, or (q - q before) / sample_time of what is measured, 0 at the first sample.
        ``rate = "difference"``
    filter : s
        Time constant T of a first-order filter of the rate: y += (1 - exp(-sample_time / T)) (rate - y),
        from the first rate on.
        ``filter = 0.005``
    q_noise : rad, m
        Standard deviation; a table is by coordinate.
        ``q_noise = 1e-5``
    q_dot_noise : rad/s, m/s
        Standard deviation, of ``rate = "exact"``.
        ``q_dot_noise = 1e-3``
    seed
        Of the noise.
        ``seed = 7``
    """

    resolution: Size | dict[str, Size] = 0.0
    rate: Literal["exact", "difference"] = "exact"
    filter: Limit | None = None
    q_noise: Size | dict[str, Size] = 0.0
    q_dot_noise: Size | dict[str, Size] = 0.0
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0


class DriveSpec(_Part, frozen=True):
    """What a sampled controller's drives make of tau; a number, or a table by motor.

    Attributes
    ----------
    torque_resolution : N m, N
        Step of tau; a table is by motor.
        ``torque_resolution = 0.01``
    torque_rate : N m/s, N/s
        The fastest that tau changes, from 0 at the start; a table is by motor.
        ``torque_rate = {theta_1 = 50.0}``
    """

    torque_resolution: Limit | dict[str, Limit] | None = None
    torque_rate: Limit | dict[str, Limit] | None = None


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="type"):
    """What every controller takes.

    Attributes
    ----------
    torque_limit : N m, N
        Acts on tau, with the motors' own limits; a table is by motor.
        ``torque_limit = {theta_1 = 30.0, theta_3 = 20.0}``
    """

    torque_limit: Limit | dict[str, Limit] | None = None


class _Feedback(_Spec, frozen=True, kw_only=True):
    """What eqs. 14 and 16 take.

    Attributes
    ----------
    allocation
        How redundant motors share u.
        ``allocation = {weights = {left = 2.0}}``
    model
        The controller's own idea of the plant: a mechanism file.
        ``model = "lighter.toml"``
    sample_time : s
        Zero-order hold of u between samples; absent: continuous.
        ``sample_time = 0.002``
    delay : s
        From a sample to its action; needs ``sample_time``.
        ``delay = 0.001``
    sensor
        What the controller sees; needs ``sample_time``.
        ``sensor = {resolution = 1e-4}``
    drive
        What becomes of its torques; needs ``sample_time``.
        ``drive = {torque_resolution = 0.01}``
    """

    allocation: AllocationSpec | None = None
    model: str | None = None
    sample_time: Limit | None = None
    delay: Size = 0.0
    sensor: SensorSpec | None = None
    drive: DriveSpec | None = None


class SetPointSpec(_Feedback, frozen=True, tag="set_point"):
    """Set-point control, eq. 14: ``type = "set_point"``.

    Attributes
    ----------
    K_P : N m/rad, N/m
        Positive definite: a number, a table by joint, or a matrix in ``independent`` order.
        ``K_P = 10.0``
    K_V : N m s/rad, N s/m
        Positive semi-definite, in the same ways.
        ``K_V = {theta_1 = 1.0, theta_3 = 2.0}``
    q_d : rad, m
        The target.
        ``q_d = {theta_1 = -1.0, theta_3 = -2.0}``
    """

    K_P: Gain
    K_V: Gain
    q_d: dict[str, float]


class TrackingSpec(_Feedback, frozen=True, tag="tracking"):
    """Tracking control, eq. 16: ``type = "tracking"``.

    Attributes
    ----------
    Lambda : 1/s
        Λ; ΛᵀK_D symmetric positive definite.
        ``Lambda = 1.0``
    K_D : N m s/rad, N s/m
        Symmetric positive definite.
        ``K_D = [[10.0, 0.0], [0.0, 10.0]]``
    desired
        A table for each independent coordinate, or ``file``, or ``point`` with its path.
        ``desired = {theta_1 = {offset = -1.4}, theta_3 = {harmonics = [[0.2, 1.0, 0.0]]}}``
    """

    Lambda: Gain
    K_D: Gain
    desired: dict[str, Any]


class TorquesSpec(_Spec, frozen=True, tag="torques"):
    """The motors' torques over time, measured or computed elsewhere: ``type = "torques"``.

    Attributes
    ----------
    file
        CSV with the column ``t``, s, and one for each motor, N m or N.
        ``file = "torques.csv"``
    interpolation
        Each row until the next one, or lines between them.
        ``interpolation = "linear"``
    """

    file: str
    interpolation: Literal["hold", "linear"] = "hold"


FeedbackSpec = SetPointSpec | TrackingSpec
ControllerSpec = SetPointSpec | TrackingSpec | TorquesSpec


class HarmonicsSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Offset + sum of amplitude * sin(frequency * t + phase).

    Attributes
    ----------
    offset : rad, m
        What the waves swing about.
        ``offset = -1.4``
    harmonics : rad or m, rad/s, rad
        Any number of waves, ``[amplitude, frequency, phase]`` each.
        ``harmonics = [[1.0472, 1.0, 0.0]]``
    """

    offset: float = 0.0
    harmonics: list[tuple[float, float, float]] = []
