"""The `[controller]` table of a scene as typed structures, and its gains as matrices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, Protocol, cast

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.toml import FileStruct
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.control.piecewise import Interpolation, Profile
from ckc_pin.errors import InputError
from ckc_pin.mechanism.spec import Pair

__all__ = [
    "AllocationSpec",
    "ControllerSpec",
    "DriveSpec",
    "FeedbackSpec",
    "Gain",
    "JointServoSpec",
    "Limit",
    "MotionSpec",
    "SampledSpec",
    "SensorSpec",
    "ServoSpec",
    "SetPointSpec",
    "TableSpec",
    "TorqueLimit",
    "TorquesSpec",
    "TrackingSpec",
    "Waypoints",
    "gain_matrix",
    "require_positive_definite",
    "require_profile",
]

MAX_GAIN = 1e100  # products of gains and their squares do not overflow
SYMMETRY_TOLERANCE = 1e-12  # relative to the largest entry
EIGENVALUE_TOLERANCE = 1e-14  # relative to the largest entry: [[1, 1], [1, 1]] is semi-definite up to rounding

Gain = float | dict[str, float] | list[float | list[float]]
Limit = Annotated[float, msgspec.Meta(gt=0)]
TorqueLimit = Limit | Pair  # of |tau|, or lower and upper
Size = Annotated[float, msgspec.Meta(ge=0)]


class AllocationSpec(FileStruct, frozen=True):
    """Allocation of u among redundant motors: minimize the sum of weight * (tau - preload)^2.

    Attributes
    ----------
    weights
        By motor: cost of its torque; default 1.
        ``weights = {left = 2.0}``
    preload : N m, N
        By motor: torque without u, as far as it moves nothing (the null space); default 0.
        ``preload = {left = 1.0, right = 1.0}``
    """

    weights: dict[str, Limit] = {}
    preload: dict[str, float] = {}


class SensorSpec(FileStruct, frozen=True):
    """Sensors of a sampled controller's q and q_dot. Values are numbers, or tables or lists by coordinate.

    Noise is added to the position before quantization, and to the rate.

    Attributes
    ----------
    resolution : rad, m
        Step of the encoders; a table is by coordinate; 0: exact.
        ``resolution = {theta_1 = 1e-4, theta_3 = 2e-4}``
    rate
        The exact rate, or the difference quotient of measured positions, which is 0 at the first sample.
        ``rate = "difference"``
    filter : s
        Time constant T of a first-order filter of the rate, y += (1 - exp(-sample_time / T)) (rate - y),
        which starts at the first rate.
        ``filter = 0.005``
    q_noise : rad, m
        Standard deviation; a table is by coordinate.
        ``q_noise = 1e-5``
    q_dot_noise : rad/s, m/s
        Standard deviation, of ``rate = "exact"``.
        ``q_dot_noise = 1e-3``
    seed
        Seed of the noise.
        ``seed = 7``
    """

    resolution: Size | dict[str, Size] = 0.0
    rate: Literal["exact", "difference"] = "exact"
    filter: Limit | None = None
    q_noise: Size | dict[str, Size] = 0.0
    q_dot_noise: Size | dict[str, Size] = 0.0
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0


class DriveSpec(FileStruct, frozen=True):
    """Drives of a sampled controller, which quantize torques and limit their rates.

    Values may be tables by motor, or lists in the order of the motors.

    Attributes
    ----------
    torque_resolution : N m, N
        Step of tau; a table is by motor.
        ``torque_resolution = 0.01``
    torque_rate : N m/s, N/s
        Limit of the rate of tau, which starts at 0; a table is by motor.
        ``torque_rate = {theta_1 = 50.0}``
    """

    torque_resolution: Limit | dict[str, Limit] | None = None
    torque_rate: Limit | dict[str, Limit] | None = None


class _ControllerSpec(FileStruct, frozen=True, kw_only=True, tag_field="type"):
    """Keys of every controller.

    Attributes
    ----------
    torque_limit : N m, N
        Limit of |tau|, or the smallest and the largest tau as ``[-1.0, 3.0]``, in addition to the motors' own limits. A
        table is by motor, and a list of limits in the order of the motors.
        ``torque_limit = {theta_1 = 30.0, theta_3 = [0.0, 20.0]}``
    """

    torque_limit: TorqueLimit | dict[str, TorqueLimit] | None = None


class _SampledSpec(_ControllerSpec, frozen=True, kw_only=True):
    """Keys of controllers that can be sampled.

    Attributes
    ----------
    sample_time : s
        Period of a sampled controller, which holds u between samples; default: continuous.
        ``sample_time = 0.002``
    delay : s
        Time from a sample to its action; needs ``sample_time``.
        ``delay = 0.001``
    sensor
        Sensors of q and q̇; needs ``sample_time``.
        ``sensor = {resolution = 1e-4}``
    drive
        Drives of the motors; needs ``sample_time``.
        ``drive = {torque_resolution = 0.01}``
    """

    sample_time: Limit | None = None
    delay: Size = 0.0
    sensor: SensorSpec | None = None
    drive: DriveSpec | None = None


class _FeedbackSpec(_SampledSpec, frozen=True, kw_only=True):
    """Keys of the controllers of eqs. 14 and 16.

    Attributes
    ----------
    allocation
        Allocation of u among redundant motors.
        ``allocation = {weights = {left = 2.0}}``
    model
        The controller's own model of the plant: a mechanism file.
        ``model = "lighter.toml"``
    """

    allocation: AllocationSpec | None = None
    model: str | None = None


class SetPointSpec(_FeedbackSpec, frozen=True, tag="set_point"):
    """Set-point control, eq. 14: ``type = "set_point"``.

    Attributes
    ----------
    K_P : N m/rad, N/m
        Positive definite: a number, a table by joint, or in ``independent`` order a list of the diagonal or a matrix.
        ``K_P = 10.0``
    K_V : N m s/rad, N s/m
        Positive semi-definite; the same forms.
        ``K_V = {theta_1 = 1.0, theta_3 = 2.0}``
    q_d : rad, m
        The target; a list is in the order of ``independent``.
        ``q_d = {theta_1 = -1.0, theta_3 = -2.0}``
    """

    K_P: Gain
    K_V: Gain
    q_d: dict[str, float]


class TrackingSpec(_FeedbackSpec, frozen=True, tag="tracking"):
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
        A table for each independent coordinate, a list of them in the order of ``independent``, or ``file``, or
        ``point`` with its path.
        ``desired = {theta_1 = {offset = -1.4}, theta_3 = {harmonics = [[0.2, 1.0, 0.0]]}}``
    """

    Lambda: Gain
    K_D: Gain
    desired: dict[str, Any]


class TorquesSpec(_ControllerSpec, frozen=True, tag="torques"):
    """Recorded motor torques over time: ``type = "torques"``.

    Attributes
    ----------
    file
        CSV with the column ``t``, s, and a column for each motor, N m or N.
        ``file = "torques.csv"``
    interpolation
        Each row is held until the next one, or interpolated linearly.
        ``interpolation = "linear"``
    """

    file: str
    interpolation: Literal["hold", "linear"] = "hold"


class Waypoints(Protocol):
    """The keys of a table that describe a motion through waypoints."""

    @property
    def waypoints(self) -> Sequence[Any] | None:
        """Pairs of a time and a value or a position."""

    @property
    def profile(self) -> Profile | None:
        """The kind of motion between them."""

    @property
    def max_rate(self) -> float | None:
        """Limit of a trapezoidal profile, 1/s."""

    @property
    def max_acceleration(self) -> float | None:
        """Limit of a trapezoidal profile, 1/s²."""


class MotionSpec(FileStruct, frozen=True, kw_only=True):
    """Motion of one coordinate: offset + rate t + sum of amplitude sin(frequency t + phase) + waypoints.

    Attributes
    ----------
    offset : rad, m
        Constant part of the value.
        ``offset = -1.4``
    rate : rad/s, m/s
        Constant part of the rate, for ever.
        ``rate = 6.2832``
    harmonics : rad or m, rad/s, rad
        Any number of waves, ``[amplitude, frequency, phase]`` each.
        ``harmonics = [[1.0472, 1.0, 0.0]]``
    waypoints : s, rad or m
        ``[t, value]`` each, at least two; the value is held before the first and after the last.
        ``waypoints = [[0.0, 0.0], [1.0, 0.8], [2.0, 0.5]]``
    profile
        Of the motion between waypoints; ``"quintic"`` if absent.
        ``profile = "trapezoidal"``
    max_rate : rad/s, m/s
        Limit of the rate, of ``profile = "trapezoidal"`` only.
        ``max_rate = 2.0``
    max_acceleration : rad/s², m/s²
        Acceleration at the beginning and at the end of each piece, of ``profile = "trapezoidal"`` only.
        ``max_acceleration = 8.0``
    """

    offset: float = 0.0
    rate: float = 0.0
    harmonics: list[tuple[float, float, float]] = []
    waypoints: list[tuple[float, float]] | None = None
    profile: Profile | None = None
    max_rate: Limit | None = None
    max_acceleration: Limit | None = None


class ServoSpec(FileStruct, frozen=True, kw_only=True):
    """Servo of the joint that a motor drives.

    The force on the joint is -K_P e - K_I ∫e dt - K_D ė, where e is the position minus the desired one. In velocity
    mode e is the rate minus the desired one, and there is no K_D.

    Attributes
    ----------
    mode
        What is controlled.
        ``mode = "velocity"``
    K_P : N m/rad or N/m; in velocity mode N m s/rad or N s/m
        Proportional gain, at the joint.
        ``K_P = 50.0``
    K_I : N m/(rad s) or N/(m s); in velocity mode N m/rad or N/m
        Integral gain. The integral starts at 0.
        ``K_I = 20.0``
    K_D : N m s/rad, N s/m
        Derivative gain, of ``mode = "position"`` only.
        ``K_D = 2.0``
    anti_windup : s
        While the motor is at its torque limit, the integral approaches the value that the limit admits with this time
        constant; default K_P / K_I, or 1 s without K_P.
        ``anti_windup = 0.1``
    desired
        Motion of the joint, as in ``[controller.desired]``; at rest at 0 if absent.
        ``desired = {rate = 6.2832}``
    """

    mode: Literal["position", "velocity"] = "position"
    K_P: Size = 0.0
    K_I: Size = 0.0
    K_D: Size = 0.0
    anti_windup: Limit | None = None
    desired: MotionSpec = MotionSpec()


class JointServoSpec(_SampledSpec, frozen=True, tag="joint_servo"):
    """P, PI, PD or PID control of single joints: ``type = "joint_servo"``.

    The motors need not drive independent coordinates, and motors without a servo have no torque.

    Attributes
    ----------
    motor
        A servo for each of some motors, each of which drives one joint.
        ``motor = {crank = {K_P = 50.0, K_D = 2.0, desired = {offset = 0.3}}}``
    gravity
        Add the torques that balance gravity and springs at rest.
        ``gravity = true``
    """

    motor: dict[str, ServoSpec]
    gravity: bool = False


FeedbackSpec = SetPointSpec | TrackingSpec
SampledSpec = FeedbackSpec | JointServoSpec
ControllerSpec = SampledSpec | TorquesSpec


class TableSpec(FileStruct, frozen=True, kw_only=True):
    """A desired motion in a CSV file, alone in ``[controller.desired]``.

    Attributes
    ----------
    file
        CSV with the column ``t``, s, and a column for each independent coordinate, rad or m.
        ``file = "way.csv"``
    interpolation
        Between rows; if absent, ``"quintic"`` with at least six rows.
        ``interpolation = "linear"``
    """

    file: str
    interpolation: Interpolation | None = None


def require_profile(spec: Waypoints, where: str) -> None:
    """Raise InputError if the keys about waypoints do not go together. `where` is their table, for messages."""
    limits = {"max_rate": spec.max_rate, "max_acceleration": spec.max_acceleration}
    present = [name for name, value in limits.items() if value is not None]
    missing = [name for name, value in limits.items() if value is None]
    if spec.waypoints is None:
        extra = [*(["profile"] if spec.profile is not None else []), *present]
        if extra:
            raise InputError(
                f"{where}: {extra[0]} belongs to waypoints, which are missing; add waypoints = [[t, value], ...]"
            )
    elif spec.profile == "trapezoidal" and missing:
        raise InputError(
            f'{where}: profile = "trapezoidal" needs max_rate and max_acceleration; {missing[0]} is missing'
        )
    elif spec.profile != "trapezoidal" and present:
        raise InputError(
            f'{where}: {present[0]} belongs to profile = "trapezoidal", not to "{spec.profile or "quintic"}", whose '
            "rate follows from the times; remove it or change the profile"
        )


def gain_matrix(gain: Gain | Array, names: Sequence[str], what: str) -> Array:
    """Return a gain as a (d, d) matrix.

    Parameters
    ----------
    gain : number, {joint: number}, (d,) array or (d, d) array
        A number, a table or a list of d numbers makes a diagonal matrix.
    names : sequence of str
        Independent coordinates.
    what : str
        Name of the gain, for messages.

    Raises
    ------
    InputError
        Wrong shape, an unknown or missing joint, or a number that is not finite.
    """
    d = len(names)
    if isinstance(gain, dict):
        unknown = [name for name in gain if name not in names]
        missing = [name for name in names if name not in gain]
        if unknown or missing:
            problem = f"{unknown[0]!r} is none of them" if unknown else f"{missing[0]!r} is missing"
            raise InputError(f"controller.{what}: a table needs the joints {', '.join(names)}; {problem}")
        matrix = np.diag([float(gain[name]) for name in names])
    elif is_number(gain):
        matrix = float(cast(float, gain)) * np.eye(d)
    else:
        matrix = _read_matrix(gain, names, what)
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"controller.{what}: an entry is not a finite number")
    if np.abs(matrix).max(initial=0.0) > MAX_GAIN:
        raise InputError(f"controller.{what}: an entry is above {MAX_GAIN:g}")
    return matrix


def _read_matrix(gain: Any, names: Sequence[str], what: str) -> Array:
    """Return the matrix of a list of d numbers, its diagonal, or of d rows of d numbers."""
    d = len(names)
    forms = f"a number, a table by joint, a list of {d} numbers (the diagonal) or a {d} x {d} matrix"
    expected = f"controller.{what}: expected {forms} in the order {', '.join(names)}"
    if not isinstance(gain, list | tuple | np.ndarray):
        raise InputError(f"{expected}, got {describe_value(gain)}")
    try:
        matrix = np.array(gain, dtype=float)
    except (TypeError, ValueError):  # rows of different lengths, or words among the numbers
        raise InputError(f"{expected}, got rows of different lengths or entries that are not numbers") from None
    if matrix.shape == (d,):
        return np.diag(matrix)
    if matrix.shape != (d, d):
        shape = " x ".join(map(str, matrix.shape))
        got = f"a list of {len(matrix)} numbers" if matrix.ndim == 1 else f"a {shape} matrix"
        raise InputError(f"{expected}, got {got}")
    return matrix


def require_positive_definite(matrix: Array, what: str, *, semi: bool = False) -> None:
    """Raise InputError unless a matrix is symmetric and positive definite, or semi-definite if `semi`."""
    size = float(np.abs(matrix).max(initial=0.0))
    skew = np.abs(matrix - matrix.T)
    if skew.max(initial=0.0) > SYMMETRY_TOLERANCE * size:
        i, j = np.unravel_index(int(np.argmax(skew)), skew.shape)
        entries = f"[{i}][{j}] = {matrix[i, j]:g} and [{j}][{i}] = {matrix[j, i]:g}"
        raise InputError(f"controller: {what} is not symmetric: its entries {entries} differ")
    smallest = float(np.linalg.eigvalsh(matrix)[0]) if len(matrix) else 1.0
    rounding = EIGENVALUE_TOLERANCE * size
    if smallest < -rounding or (smallest <= rounding and not semi):
        kind = "positive semi-definite" if semi else "positive definite"
        raise InputError(f"controller: {what} is not {kind}: its smallest eigenvalue is {smallest:.3g}")
