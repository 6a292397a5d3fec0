"""Typed structure of a plan's file, `NAME.optimize.toml`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import FileStruct, convert, join_dotted_keys, read_text, read_toml
from ckc_pin.control.spec import Limit, TorqueLimit
from ckc_pin.mechanism.spec import Pair, Vector3
from ckc_pin.scene.overrides import apply_overrides

__all__ = [
    "KeepOutSpec",
    "LimitsSpec",
    "MinimizeSpec",
    "OptimizeSpec",
    "PathSpec",
    "PeriodicSpec",
    "SphereSpec",
    "StateSpec",
    "ViaSpec",
    "make_spec",
    "read_optimize",
]

# Their keys are names that may contain dots.
TABLES_BY_NAME = (("parameters",), *((place, key) for place in ("from", "to") for key in ("q", "q_dot")),
                  ("limits", "q"))  # fmt: skip
Weight = Annotated[float, msgspec.Meta(ge=0)]


class StateSpec(FileStruct, frozen=True, kw_only=True):
    """A configuration and its rates, as ``[from]`` and ``[to]``: one of q, point and at.

    Attributes
    ----------
    q : rad, m
        Independent coordinates by name. Dependent ones may be added to select the assembly branch.
        ``q = {theta_1 = -1.2, theta_3 = -1.9}``
    point : m
        Position of one ``[[point]]``, in the working mode of the assembled configuration.
        ``point = {plate = [0.1, 0.05, -0.3]}``
    at
        A configuration by name.
        ``at = "equilibrium"``
    q_dot : rad/s, m/s
        Rates of independent coordinates; 0 for the others.
        ``q_dot = {theta_1 = 0.5}``
    """

    q: dict[str, float] | None = None
    point: dict[str, Vector3] | None = None
    at: Literal["assembled", "equilibrium"] | None = None
    q_dot: dict[str, float] = {}


class ViaSpec(FileStruct, frozen=True, kw_only=True):
    """A place that a motion from ``[from]`` to ``[to]`` passes: one of q and point.

    Motor torques may jump there.

    Attributes
    ----------
    q : rad, m
        Independent coordinates by name. The others are free.
        ``q = {theta_1 = -1.2}``
    point : m
        Position of one ``[[point]]``, as in ``[to]``.
        ``point = {plate = [0.1, 0.05, -0.3]}``
    q_dot : rad/s, m/s
        Rates of independent coordinates. The others are free.
        ``q_dot = {theta_1 = 0.5}``
    rest
        Whether all rates are zero.
        ``rest = true``
    dwell : s
        Time at rest at the place.
        ``dwell = 0.2``
    time : s
        When the motion reaches the place; free if absent.
        ``time = 0.5``
    parameters : as the parameter's
        Values of masses, centres of mass and inertias of links from the place on, which the motion leaves from rest.
        ``parameters = {"link.plate.mass" = 0.3}``
    """

    q: dict[str, float] | None = None
    point: dict[str, Vector3] | None = None
    q_dot: dict[str, float] = {}
    rest: bool = False
    dwell: Weight = 0.0
    time: Limit | None = None
    parameters: dict[str, float | list[float]] = {}


class PeriodicSpec(FileStruct, frozen=True, kw_only=True):
    """A motion that repeats: it ends in the state in which it begins, up to whole turns.

    Attributes
    ----------
    turns : 2π rad
        Whole turns of independent coordinates in a period; 0 for the others.
        ``turns = {crank = 1}``
    time : s
        The period. Default: free, as the duration of other motions.
        ``time = 0.8``
    """

    turns: dict[str, int] = {}
    time: Limit | None = None


class PathSpec(FileStruct, frozen=True, kw_only=True):
    """A path that the motion follows from its first to its last place, at rest at both: one of q and point, or neither.

    Attributes
    ----------
    q : rad, m
        Places by independent coordinate, equally many of each.
        ``q = {theta_1 = [-1.2, -1.0, -1.2], theta_3 = [-1.9, -1.7, -1.6]}``
    point : m
        Places of one ``[[point]]``.
        ``point = {tip = [[0.1, -0.4, 0.0], [0.2, -0.4, 0.0]]}``
    shape
        ``"spline"`` through the places, or straight ``"lines"`` with rounded corners. ``"free"`` is a short path from
        ``[from]`` to ``[to]`` without singular configurations, within limits of coordinates, singularity and points.
        ``shape = "lines"``
    rounding : rad, m
        Distance from a corner at which its rounding begins, of ``shape = "lines"``; default: a tenth of the shorter of
        its two lines.
        ``rounding = 0.01``
    """

    q: dict[str, list[float]] | None = None
    point: dict[str, list[Vector3]] | None = None
    shape: Literal["spline", "lines", "free"] = "spline"
    rounding: Limit | None = None


class MinimizeSpec(FileStruct, frozen=True, kw_only=True):
    """Weights of the parts of the cost.

    Attributes
    ----------
    time : 1/s
        Of the duration.
        ``time = 1.0``
    effort : 1/(N² m² s)
        Of the integral of the squared motor torques.
        ``effort = 0.1``
    energy : 1/J
        Of the positive mechanical work of the motors: what they draw if they cannot store what they brake. Heat of the
        windings is proportional to effort.
        ``energy = 0.2``
    jerk : s⁵/rad²
        Of the integral of the squared jerks of the independent coordinates.
        ``jerk = 1e-6``
    torque_rate : s/(N² m²)
        Of the integral of the squared rates of the motor torques, which makes them smooth.
        ``torque_rate = 1e-4``
    peak_torque : 1/(N m)
        Of the largest motor torque.
        ``peak_torque = 0.5``
    tracking : 1/(rad² s)
        Of the integral of the squared distance of the independent coordinates from those of ``desired``. The duration
        is ``limits.time``.
        ``tracking = 10.0``
    """

    time: Weight = 0.0
    effort: Weight = 0.0
    energy: Weight = 0.0
    jerk: Weight = 0.0
    torque_rate: Weight = 0.0
    peak_torque: Weight = 0.0
    tracking: Weight = 0.0


class SphereSpec(FileStruct, frozen=True, kw_only=True):
    """A sphere.

    Attributes
    ----------
    centre : m
        In the world's axes.
        ``centre = [0.1, -0.3, 0.0]``
    radius : m
        Of the sphere.
        ``radius = 0.05``
    """

    centre: Vector3
    radius: Limit


class KeepOutSpec(FileStruct, frozen=True, kw_only=True):
    """A region that points stay out of.

    Attributes
    ----------
    sphere
        The region.
        ``sphere = {centre = [0.1, -0.3, 0.0], radius = 0.05}``
    points
        Names of ``[[point]]``.
        ``points = ["tip"]``
    """

    sphere: SphereSpec
    points: Annotated[list[str], msgspec.Meta(min_length=1)]


class LimitsSpec(FileStruct, frozen=True, kw_only=True):
    """Limits of a plan. The limits of joints and motors in the mechanism's files hold in addition.

    Attributes
    ----------
    torque : N m, N
        Of the motors: those of ``[[motor]]`` only, a largest size, or lower and upper limits; a table is by motor.
        ``torque = {theta_1 = 3.0, theta_3 = [-1.0, 2.0]}``
    torque_rate : N m/s, N/s
        Of the rate of motor torques, point to point; a table is by motor.
        ``torque_rate = 50.0``
    q : rad, m
        Lowest and highest values of coordinates.
        ``q = {theta_1 = [-2.0, 0.0]}``
    rate : rad/s, m/s
        Largest rates of the independent coordinates; a table may name any coordinates.
        ``rate = 3.0``
    acceleration : rad/s², m/s²
        Largest accelerations, as ``rate``.
        ``acceleration = {theta_1 = 20.0}``
    jerk : rad/s³, m/s³
        Largest jerks of the independent coordinates, point to point; a table is by coordinate.
        ``jerk = 500.0``
    power : W
        Largest mechanical power of the motors, driving or braking, point to point; a table is by motor.
        ``power = 200.0``
    total_power : W
        Most mechanical power of all motors together, from a common supply. Braking motors give theirs to the others.
        ``total_power = 500.0``
    time : s
        Longest duration.
        ``time = 1.0``
    singularity
        Smallest singular value of φ_z, relative to its value at the start; a ratio.
        ``singularity = 0.1``
    keep_out
        Regions that points stay out of, from one configuration to another.
        ``keep_out = [{sphere = {centre = [0.1, -0.3, 0.0], radius = 0.05}, points = ["tip"]}]``
    """

    torque: Literal["motors"] | TorqueLimit | dict[str, TorqueLimit] = "motors"
    torque_rate: Limit | dict[str, Limit] | None = None
    q: dict[str, Pair] = {}
    rate: Limit | dict[str, Limit] | None = None
    acceleration: Limit | dict[str, Limit] | None = None
    jerk: Limit | dict[str, Limit] | None = None
    power: Limit | dict[str, Limit] | None = None
    total_power: Limit | None = None
    time: Limit | None = None
    singularity: Annotated[float, msgspec.Meta(gt=0, le=1)] | None = None
    keep_out: list[KeepOutSpec] = []


class OptimizeSpec(FileStruct, frozen=True, kw_only=True):
    """A motion to plan: from one configuration to another, or along a path.

    Attributes
    ----------
    mechanism
        A shipped name, or a path relative to this file.
        ``mechanism = "delta"``
    parameters : as the parameter's
        Values of parameters that differ from the mechanism's files.
        ``parameters = {"link.plate.mass" = 0.3}``
    from
        Where the motion begins; as assembled if absent. A periodic motion begins anywhere if it is absent, and
        coordinates and rates that it does not name are free.
        ``from = {at = "equilibrium"}``
    to
        Where it ends; either this, ``path`` or ``periodic``, or both with ``path = {shape = "free"}``.
        ``to = {point = {plate = [0.1, 0.05, -0.3]}}``
    via
        Places that the motion passes on its way, in their order.
        ``via = [{point = {plate = [0.0, 0.0, -0.27]}}]``
    periodic
        The motion repeats.
        ``periodic = {turns = {crank = 1}, time = 0.8}``
    path
        The path of a time-optimal motion.
        ``path = {point = {plate = [[0.0, 0.0, -0.3], [0.1, 0.05, -0.3]]}}``
    minimize
        Weights of the cost; the time alone if absent.
        ``minimize = {time = 1.0, effort = 0.01}``
    limits
        Limits of the motion.
        ``limits = {torque = 5.0}``
    cross_singularities
        Singular configurations may be crossed, where the independent coordinates do not determine the others and the
        motors cannot produce every force.
        ``cross_singularities = true``
    desired
        The motion that ``minimize.tracking`` refers to, as ``desired`` of a scene's tracking controller.
        ``desired = {file = "way.csv"}``
    intervals
        Intervals of the grid, of a path 1000 if absent; of a motion from one configuration to another 40 at first.
        ``intervals = 200``
    """

    mechanism: str
    parameters: dict[str, float | list[float]] = {}
    start: StateSpec | None = msgspec.field(name="from", default=None)
    to: StateSpec | None = None
    via: list[ViaSpec] = []
    periodic: PeriodicSpec | None = None
    path: PathSpec | None = None
    minimize: MinimizeSpec = MinimizeSpec(time=1.0)
    limits: LimitsSpec = LimitsSpec()
    cross_singularities: bool = False
    desired: dict[str, Any] | None = None
    intervals: Annotated[int, msgspec.Meta(ge=4, le=20_000)] | None = None


def read_optimize(path: str | Path, overrides: Mapping[str, Any] | None = None) -> tuple[OptimizeSpec, Sources]:
    """Read a plan's file, with values replaced by dotted key.

    Raises
    ------
    InputError
        The file does not exist, is not TOML, or has an unknown key or a wrong value.
    """
    path = Path(path)
    data = read_toml(read_text(path, "plan"), str(path))
    data = apply_overrides(data, overrides or {}, OptimizeSpec, TABLES_BY_NAME, "plan")
    for table in data["via"] if isinstance(data.get("via"), list) else ():
        join_dotted_keys(table, "parameters")
    sources = Sources(str(path), path.parent)
    return make_spec(data, sources.name), sources


def make_spec(data: Mapping[str, Any], source: str) -> OptimizeSpec:
    """Convert the data of a plan's file (InputError)."""
    return convert(dict(data), OptimizeSpec, source)
