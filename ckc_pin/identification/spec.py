"""Typed structures of `NAME.identify.toml` and `NAME.calibrate.toml`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import FileStruct, convert, read_text, read_toml
from ckc_pin.errors import InputError
from ckc_pin.scene.overrides import apply_overrides

__all__ = ["UNITS", "CalibrateSpec", "DataSpec", "EstimateSpec", "IdentifySpec", "read_calibrate", "read_identify"]

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "rad": 1.0, "deg": 0.017453292519943295, "m": 1.0, "mm": 1e-3,
         "N": 1.0, "mN": 1e-3, "N m": 1.0, "mN m": 1e-3, "rad/s": 1.0, "deg/s": 0.017453292519943295, "rpm":
         0.10471975511965978, "m/s": 1.0, "mm/s": 1e-3}  # fmt: skip
TABLES_BY_NAME = (("parameters",), ("units",), ("estimate", "prior"), ("estimate", "noise"))  # keys contain dots
T = TypeVar("T", bound=FileStruct)
PositiveFloat = Annotated[float, msgspec.Meta(gt=0)]


class DataSpec(FileStruct, frozen=True, kw_only=True):
    """One recorded motion.

    Attributes
    ----------
    file
        A CSV or Parquet file, or a recording of ROS (MCAP, rosbag2), in the folder of this one. Its columns are ``t``
        and quantities by name: coordinates, ``v.COORDINATE``, ``tau.MOTOR``, and points as ``tip.x``. An empty field is
        a gap.
        ``file = "swing.csv"``
    noise : the quantity's
        Standard deviations of measurements by quantity; estimated for the others.
        ``noise = {theta_1 = 1e-4, "tau.theta_1" = 0.01}``
    names
        Columns by quantity, if the file calls them otherwise.
        ``names = {t = "stamp", theta_1 = "position_1"}``
    units
        Units by quantity, if they are not SI: deg, mm, ms, rpm and others.
        ``units = {theta_1 = "deg", t = "ms"}``
    delay : s
        Delays of quantities: how much later than it happened a value was recorded. ``"estimate"`` for torques finds one
        delay of all torques, of up to 0.05 s.
        ``delay = {"tau.theta_1" = 0.002}``
    span : s
        First and last time that are used.
        ``span = [0.5, 9.5]``
    validation
        The motion is not fitted; the fit is compared with it.
        ``validation = true``
    """

    file: str
    noise: dict[str, PositiveFloat] = {}
    names: dict[str, str] = {}
    units: dict[str, str] = {}
    delay: dict[str, float | Literal["estimate"]] = {}
    span: tuple[float, float] | None = None
    validation: bool = False


class EstimateSpec(FileStruct, frozen=True, kw_only=True):
    """What is estimated, and how.

    Attributes
    ----------
    parameters
        Names of parameters, with wildcards. ``link.NAME.inertial`` are the ten inertial numbers of a link.
        ``parameters = ["link.*.inertial", "joint.*.friction"]``
    method
        ``"torques"``: eq. 1, which is linear in the parameters. ``"motion"``: simulated runs are fitted to what was
        measured.
        ``method = "motion"``
    physical
        Whether inertias have to be those of a body that can exist. Runs need such inertias.
        ``physical = false``
    robust
        Whether instants with large residuals have less weight.
        ``robust = true``
    prior : the parameter's
        Standard deviations of start values, such as those of CAD, by parameter with wildcards. A text in percent is
        relative to the start value.
        ``prior = {"link.*.mass" = "5 %", "joint.hip.damping" = 0.01}``
    """

    parameters: Annotated[list[str], msgspec.Meta(min_length=1)]
    method: Literal["torques", "motion"] = "torques"
    physical: bool = True
    robust: bool = False
    prior: dict[str, PositiveFloat | str] = {}


class IdentifySpec(FileStruct, frozen=True, kw_only=True):
    """An identification: a mechanism, recorded motions, and the parameters that are estimated from them.

    Attributes
    ----------
    mechanism
        A shipped name, or a path relative to this file.
        ``mechanism = "five_bar"``
    parameters : as the parameter's
        Known values of parameters that differ from the mechanism's files.
        ``parameters = {"link.link_2.mass" = 0.3}``
    data
        Recorded motions.
        ``data = [{file = "swing.csv"}]``
    estimate
        What is estimated.
        ``estimate = {parameters = ["joint.*.friction"]}``
    """

    mechanism: str
    data: Annotated[list[DataSpec], msgspec.Meta(min_length=1)]
    estimate: EstimateSpec
    parameters: dict[str, float | list[float]] = {}


class CalibrateEstimateSpec(FileStruct, frozen=True, kw_only=True):
    """What a calibration estimates, and how.

    Attributes
    ----------
    parameters
        Names of geometric parameters, with wildcards, and ``encoder.COORDINATE.offset``.
        ``parameters = ["joint.theta_2.xyz.x", "encoder.*.offset"]``
    noise : the reading's
        Standard deviations of readings, with wildcards; estimated for the others, one for all angles and one for all
        lengths.
        ``noise = {"theta_*" = 1e-4}``
    prior : the parameter's
        Standard deviations of start values, with wildcards.
        ``prior = {"joint.*.xyz" = 1e-3}``
    tracker
        Frame of the points' readings; the placement of an unknown one is estimated.
        ``tracker = "unknown"``
    loss
        ``"huber"`` finds outliers, which are left out.
        ``loss = "huber"``
    """

    parameters: Annotated[list[str], msgspec.Meta(min_length=1)]
    noise: dict[str, PositiveFloat] = {}
    prior: dict[str, PositiveFloat] = {}
    tracker: Literal["world", "unknown"] = "world"
    loss: Literal["squares", "huber"] = "squares"


class CalibrateSpec(FileStruct, frozen=True, kw_only=True):
    """A calibration: a mechanism, readings of many poses, and the parameters that are estimated from them.

    Attributes
    ----------
    mechanism
        A shipped name, or a path relative to this file.
        ``mechanism = "five_bar"``
    parameters : as the parameter's
        Known values of parameters that differ from the mechanism's files.
        ``parameters = {"joint.theta_4.xyz.x" = 0.28}``
    poses
        A CSV file in the folder of this one, with a column for each reading and a row for each pose: coordinates, and
        points as ``tip.x``. An empty field is a missing reading.
        ``poses = "poses.csv"``
    units
        Units by reading, if they are not SI: deg, mm and others.
        ``units = {theta_1 = "deg"}``
    estimate
        What is estimated.
        ``estimate = {parameters = ["encoder.*.offset"]}``
    """

    mechanism: str
    poses: str
    estimate: CalibrateEstimateSpec
    units: dict[str, str] = {}
    parameters: dict[str, float | list[float]] = {}


def read_identify(path: str | Path, overrides: Mapping[str, Any] | None = None) -> tuple[IdentifySpec, Sources]:
    """Read an identification's file, with values replaced by dotted key.

    Raises
    ------
    InputError
        The file does not exist, is not TOML, or has an unknown key or a wrong value.
    """
    spec, sources = _read(Path(path), overrides, IdentifySpec, "identification")
    for entry in spec.data:
        _require_units(entry.units, f"{sources.name}: data: {entry.file}")
    return spec, sources


def read_calibrate(path: str | Path, overrides: Mapping[str, Any] | None = None) -> tuple[CalibrateSpec, Sources]:
    """Read a calibration's file, with values replaced by dotted key (InputError)."""
    spec, sources = _read(Path(path), overrides, CalibrateSpec, "calibration")
    _require_units(spec.units, sources.name)
    return spec, sources


def _read(path: Path, overrides: Mapping[str, Any] | None, spec: type[T], file: str) -> tuple[T, Sources]:
    data = read_toml(read_text(path, file), str(path))
    data = apply_overrides(data, overrides or {}, spec, TABLES_BY_NAME, file)
    sources = Sources(str(path), path.parent)
    return convert(data, spec, sources.name), sources


def _require_units(units: Mapping[str, str], where: str) -> None:
    for quantity, unit in units.items():
        if unit not in UNITS:
            raise InputError(f"{where}: units: {quantity}: no unit {unit!r}; there are {', '.join(UNITS)}")
