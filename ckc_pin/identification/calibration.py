"""Geometric calibration: lengths, placements and encoder offsets from readings of many poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.validation import describe_value, is_number, match_names, require_table, require_type, suggest_name
from ckc_pin.errors import InputError
from ckc_pin.identification.calibration_fit import Fit, Readings
from ckc_pin.identification.calibration_geometry import Geometry
from ckc_pin.identification.calibration_result import Calibration, make_calibration
from ckc_pin.identification.records import read_csv
from ckc_pin.identification.spec import UNITS, read_calibrate
from ckc_pin.kinematics.loading import as_mechanism, load_beside
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import AXES, parts_of, split_component, split_name, values_of, with_components

__all__ = ["calibrate", "calibrate_file"]

GEOMETRIC = ("xyz", "rpy", "length", "ratio", "offset")  # ends of the names of parameters that move points or loops
TRACKER = tuple(f"tracker.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
MAX_MISS = 0.02  # rad, or mechanism sizes: median distance of a mechanism that can follow its readings
DEGREES_RATIO = 5.0  # readings are in degrees if converted ones are met so much better


def calibrate(
    mechanism: Mechanism | str | Path,
    poses: Mapping[str, Any] | str | Path,
    parameters: Sequence[str] | str,
    *,
    noise: Mapping[str, float] | float | None = None,
    prior: Mapping[str, float] | None = None,
    tracker: str = "world",
    loss: str = "squares",
) -> Calibration:
    """Calibrate the geometry of a mechanism from readings of its coordinates and points in many poses.

    Maximum likelihood with errors in all readings: each pose has a configuration with phi(q', p) = 0, and
    readings z = h(q', p) + noise. Poses need more readings than the mechanism has freedoms: the loops, or the tracker,
    are the measurement.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
    poses : mapping of str to (poses,) arrays, or path of a CSV file
        Readings by name: coordinates of joints (rad, m), and components of points (``tip.x``, m). NaN, or an empty
        cell, is a missing reading.
    parameters : sequence of str
        Geometric parameters (docs/reference/parameters.md): ``joint.NAME.xyz``, ``loop.NAME.frame_a.xyz``,
        ``loop.NAME.length``, ``coupling.K.ratio`` and others, and ``encoder.COORDINATE.offset``: reading = coordinate +
        offset. The name of a vector stands for its components. ``*`` stands for any text.
    noise : mapping of str to float, or float, optional
        Standard deviations of readings, rad or m; names may have ``*``. Others are estimated, one for all angles and
        one for all lengths.
    prior : mapping of str to float, optional
        Standard deviations of start values of parameters; names may have ``*``.
    tracker : "world" or "unknown"
        Frame of the points' readings. The placement of an unknown one is estimated: ``tracker.x`` to ``tracker.rz``,
        position and rotation vector in the world.
    loss : "squares" or "huber"
        Huber's loss finds outliers, which are then left out. Small ones remain, so its standard deviations
        are multiplied by the size of the residuals, relative to the expected one, if that is larger.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        Unknown names, too few readings, readings that the mechanism cannot follow, or parameters that redundant rows of
        loops do not allow to differ.
    """
    mechanism = as_mechanism(mechanism, "calibrate")
    mechanism.refuse_prescribed_joints("calibrate")
    for value, choices, key in ((tracker, ("world", "unknown"), "tracker"), (loss, ("squares", "huber"), "loss")):
        if value not in choices:
            raise InputError(
                f"calibrate: {key}: expected {' or '.join(map(repr, choices))}, got {describe_value(value)}"
            )
    readings = _read(mechanism, poses)
    names, offsets = _expand(mechanism, parameters, readings)
    all_names = [*names, *(f"encoder.{mechanism.coordinates[k]}.offset" for k in offsets)]
    all_names += TRACKER if tracker == "unknown" else ()
    priors = _by_name(prior or {}, all_names, "prior")
    _require_enough(mechanism, readings, int(np.sum(~np.isfinite(priors))), tracker)

    def make_fit(values: Readings) -> Fit:
        geometry = Geometry(mechanism, names)
        return Fit(mechanism, geometry, values, offsets, tracker == "unknown", priors, loss == "huber")

    with one_blas_thread():
        fit = make_fit(readings)
        fit.place_poses()
        _require_radians(fit, readings, make_fit)
        sigma = _by_name({"*": noise} if is_number(noise) else noise or {}, readings.names, "noise")
        fit.sigma = np.where(np.isfinite(sigma), sigma, fit.sigma)
        groups = [~np.isfinite(sigma) & (readings.in_metres == metres) for metres in (False, True)]
        converged, iterations = fit.fit_with_noise([group for group in groups if group.any()])
        _require_follows(fit)
        return make_calibration(fit, all_names, converged, iterations)


def calibrate_file(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Calibration:
    """Run the calibration that a file describes, with values replaced by dotted key (InputError)."""
    spec, sources = read_calibrate(path, overrides)
    folder, estimate = Path(path).parent, spec.estimate
    columns = read_csv(folder / spec.poses)
    missing = next((name for name in spec.units if name not in columns), None)
    if missing is not None:
        raise InputError(
            f"{sources.name}: units: {missing}: no such column; there are {', '.join(columns)}"
            f"{suggest_name(missing, columns)}"
        )
    poses = {name: UNITS[spec.units.get(name, "rad")] * np.array(column) for name, column in columns.items()}
    mechanism = load_beside(spec.mechanism, folder, spec.parameters)
    return calibrate(
        mechanism, poses, estimate.parameters, noise=estimate.noise, prior=estimate.prior, tracker=estimate.tracker,
        loss=estimate.loss,
    )  # fmt: skip


# --- input -------------------------------------------------------------------------------------------


def _read(mechanism: Mechanism, poses: Any) -> Readings:
    """Return the readings of a mapping or a CSV file (InputError)."""
    where = "calibrate: poses"
    if isinstance(poses, str | Path):
        where, poses = str(poses), read_csv(poses)
    require_table(poses, where, "a table of arrays by the names of readings, or the path of a CSV file")
    joints = [name for name in mechanism.coordinates if name not in mechanism.tree.free_coordinates]
    points = [f"{point}.{axis}" for point in mechanism.points for axis in AXES]
    columns: list[Array] = []
    for name, values in poses.items():
        if name not in joints and name not in points:
            there = ", ".join([*joints, *points])
            raise InputError(f"{where}: no reading {name!r}; there are {there}{suggest_name(name, [*joints, *points])}")
        try:
            column = np.array(values, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"{where}: {name}: expected numbers, one for each pose") from None
        if column.ndim != 1 or len(column) != len(columns[0] if columns else column) or np.isinf(column).any():
            raise InputError(
                f"{where}: {name}: expected finite numbers, one for each pose, as many as in other columns"
            )
        columns.append(column)
    if not columns or not len(columns[0]):
        raise InputError(f"{where}: there are no readings; give the readings of each pose by name")
    coordinate = np.array([mechanism.tree.index[name] if name in joints else -1 for name in poses], dtype=np.intp)
    component = np.array([-1 if name in joints else points.index(name) for name in poses], dtype=np.intp)
    in_metres = np.where(coordinate < 0, True, mechanism.tree.in_metres[coordinate])
    return Readings(tuple(poses), np.array(columns).T, coordinate, component, in_metres)


def _expand(mechanism: Mechanism, parameters: Any, readings: Readings) -> tuple[list[str], IntArray]:
    """Return the single geometric parameters, and the coordinates whose encoders have unknown offsets (InputError)."""
    patterns = [parameters] if isinstance(parameters, str) else parameters
    expected = 'names of parameters, as ["joint.*.xyz", "encoder.theta_1.offset"]'
    require_type(patterns, Sequence, "calibrate: parameters", expected)
    if not patterns:
        raise InputError("calibrate: parameters: there is nothing to calibrate; name at least one parameter")
    values = values_of(mechanism.spec, mechanism.urdf)
    geometric = {name: x for name, x in values.items() if _is_geometric(name)}
    single = list(dict.fromkeys(part for name in geometric for part in parts_of(name, geometric)))
    encoders = {
        f"encoder.{name}.offset": k for name, k in zip(readings.names, readings.coordinate, strict=True) if k >= 0
    }
    names: dict[str, None] = {}
    for pattern in patterns:
        require_type(pattern, str, "calibrate: parameters", expected)
        if pattern in with_components(values) and not _is_geometric(split_component(pattern)[0]):
            raise InputError(f"calibrate: parameters: {pattern} has no influence on positions; leave it out")
        names |= dict.fromkeys(match_names(pattern, (*single, *encoders), "calibrate: parameters"))
    chosen = [k for name, k in encoders.items() if name in names]
    return [name for name in names if name not in encoders], np.array(chosen, dtype=np.intp)


def _is_geometric(name: str) -> bool:
    root, _, key = split_name(name)
    return root in ("joint", "loop", "coupling") and (key.startswith("joints.") or key.rpartition(".")[2] in GEOMETRIC)


def _by_name(values: Any, names: Sequence[str], key: str) -> Array:
    """Return positive numbers by name or pattern as an array, infinite for other names (InputError)."""
    require_table(values, f"calibrate: {key}", "a table of standard deviations by name")
    array = np.full(len(names), np.inf)
    for pattern, value in values.items():
        matches = match_names(pattern, names, f"calibrate: {key}")
        if not is_number(value) or not 0 < value < np.inf:
            raise InputError(f"calibrate: {key}: {pattern} = {value!r:.80}: expected a positive number")
        array[[name in matches for name in names]] = value
    return array


def _require_enough(mechanism: Mechanism, readings: Readings, unknown: int, tracker: str) -> None:
    """Refuse fewer readings than unknowns (InputError)."""
    (count, per_pose), d = readings.values.shape, mechanism.d
    if per_pose <= d:
        raise InputError(
            f"calibrate: poses: {per_pose} readings of each pose ({', '.join(readings.names)}), but {mechanism.name} "
            f"has {d} freedoms; measure more than {d} coordinates or components of a point"
        )
    present = int(np.isfinite(readings.values).sum())
    if present < count * d + unknown:
        more = -(-unknown // (per_pose - d))
        raise InputError(
            f"calibrate: poses: {present} readings of {count} poses are fewer than the unknowns, {d} of each pose and "
            f"{unknown} parameters; measure at least {more} poses, or name fewer parameters"
        )
    if tracker == "unknown":
        if (readings.component < 0).all():
            raise InputError('calibrate: tracker = "unknown" needs readings of a point')
        if np.count_nonzero(readings.coordinate >= 0) < d:
            raise InputError(
                f'calibrate: tracker = "unknown" needs encoders that determine each pose, at least {d}, to begin with'
            )


def _require_radians(fit: Fit, readings: Readings, make_fit: Callable[[Readings], Fit]) -> None:
    """Refuse encoders in degrees (InputError)."""
    is_angle, miss = ~readings.in_metres, float(np.median(fit.misses()))
    if miss > MAX_MISS and is_angle.any():
        converted = np.where(is_angle, np.radians(readings.values), readings.values)
        other = make_fit(
            Readings(readings.names, converted, readings.coordinate, readings.component, readings.in_metres)
        )
        other.place_poses()
        if np.median(other.misses()) < miss / DEGREES_RATIO:
            named = ", ".join(name for name, angle in zip(readings.names, is_angle, strict=True) if angle)
            raise InputError(f"calibrate: poses: {named} look like degrees; angles are in radians: convert them first")


def _require_follows(fit: Fit) -> None:
    """Refuse readings that the mechanism cannot follow (InputError)."""
    misses = fit.misses()
    if np.median(misses) > MAX_MISS:
        worst = int(np.argmax(misses))
        raise InputError(
            f"calibrate: the mechanism cannot follow the readings: they differ by {np.median(misses):.2g} rad, or of "
            f"its size, in the median of the poses, by {misses[worst]:.2g} in pose {worst}; they may belong to another "
            "assembly branch (choose it by q_guess), or an encoder turns the other way or has an unknown offset"
        )
