"""Geometric calibration: lengths, placements and encoder offsets from readings of many poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.linear_algebra import one_blas_thread, pivoted_columns
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.tables import to_data_frame
from ckc_pin.base.toml_writer import write_toml
from ckc_pin.base.validation import (
    describe_value,
    is_number,
    match_names,
    require_path,
    require_table,
    require_type,
    suggest_name,
)
from ckc_pin.errors import InputError
from ckc_pin.identification.calibration_fit import RANK_TOLERANCE, Fit, Readings
from ckc_pin.identification.calibration_geometry import Geometry
from ckc_pin.identification.estimates import (
    BY_PRIOR,
    IDENTIFIED,
    IN_COMBINATION,
    NOT_IDENTIFIABLE,
    Combination,
    Estimate,
)
from ckc_pin.identification.records import read_csv
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import AXES, ROOTS, parts_of, split_component, split_name, values_of, with_components

if TYPE_CHECKING:
    import pandas

__all__ = ["Calibration", "calibrate"]

GEOMETRIC = ("xyz", "rpy", "length", "ratio", "offset")  # ends of the names of parameters that move points or loops
TRACKER = tuple(f"tracker.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
MAX_MISS = 0.02  # rad, or mechanism sizes: median distance of a mechanism that can follow its readings
DEGREES_RATIO = 5.0  # readings are in degrees if converted ones are met so much better
MIN_COEFFICIENT = 1e-6  # of a combination, with parameters in radians and mechanism sizes
OUTLIER = 4.5  # standard deviations of a residual


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(HasSummary):
    """Geometric parameters of a mechanism from readings of its poses.

    Attributes
    ----------
    name : str
        Of the mechanism.
    parameters : dict of str to Estimate
    combinations : tuple of Combination
        What is known of parameters that are not identified one by one.
    covariance : (p, p) array
        Of the parameters in their order; NaN for those without a value.
    residuals : dict of str to dict
        By reading the root mean square ``rms`` of measured minus fitted values, and its ``expected`` value for errors
        of the standard deviation in `noise`.
    noise : dict of str to float
        Standard deviations of the readings' errors, as they were given or estimated.
    points : dict of str to dict
        Accuracy of named points whose position follows from the independent encoders, m, root mean square over the
        poses: ``before``, the error that the start values make; ``after``, the standard deviation that remains, None if
        it depends on unknown parameters.
    condition : float
        Condition number of the readings' derivatives, with columns of unit norm; of what is identified.
    poses : int
    outliers : tuple of (int, str, float)
        Pose, reading, and its residual in standard deviations, the largest first.
    coordinates : (poses, n) array
        Fitted coordinates of the tree.
    converged : bool
    message : str
    """

    name: str
    parameters: dict[str, Estimate]
    combinations: tuple[Combination, ...]
    covariance: Array
    residuals: dict[str, dict[str, float]]
    noise: dict[str, float]
    points: dict[str, dict[str, float | None]]
    condition: float
    poses: int
    outliers: tuple[tuple[int, str, float], ...]
    coordinates: Array
    converged: bool
    message: str

    @property
    def overrides(self) -> dict[str, float]:
        """The identified parameters of the mechanism, as `load`, `simulate` and scenes take them."""
        return {
            name: x.value
            for name, x in self.parameters.items()
            if x.value is not None and name.partition(".")[0] in ROOTS
        }

    def summary(self) -> Summary:
        """Return estimates, combinations, residuals, accuracy of points and outliers."""
        rows: list[Row] = [("status", self.message)]
        for name, x in self.parameters.items():
            number = "" if x.value is None else f"{x.value:.9g} ± {x.std:.2g}, "
            rows.append((name, f"{number}{x.verdict}; start {x.start:.9g}"))
        listed = [f"{x} = {x.value:.6g} ± {x.std:.2g}" for x in self.combinations]
        rows += [("combinations", listed)] if listed else []
        texts = [f"{name} {r['rms']:.2g} (expected {r['expected']:.2g})" for name, r in self.residuals.items()]
        rows += [("residuals, rms", texts), ("condition", f"{self.condition:.3g}")]
        for name, accuracy in self.points.items():
            after = "unknown" if accuracy["after"] is None else f"± {accuracy['after']:.2g} m"
            rows.append((f"accuracy of {name}", f"off by {accuracy['before']:.2g} m before, {after} after"))
        named = [f"pose {pose}: {name} by {size:.3g} σ" for pose, name, size in self.outliers]
        rows += [("outliers", named)] if named else []
        return Summary(f"Calibration of {self.name} from {self.poses} poses", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON-ready data."""
        return {
            "name": self.name,
            "status": "converged" if self.converged else "not converged",
            "message": self.message,
            "parameters": {name: asdict(x) for name, x in self.parameters.items()},
            "combinations": [x.to_dict() for x in self.combinations],
            "residuals": self.residuals,
            "noise": self.noise,
            "points": self.points,
            "condition": self.condition,
            "poses": self.poses,
            "outliers": [{"pose": k, "reading": name, "sigmas": size} for k, name, size in self.outliers],
        }

    def to_pandas(self) -> pandas.DataFrame:
        """Return the estimates as a pandas DataFrame with a row for each parameter (needs the extra `data`)."""
        columns = {
            key: np.array([getattr(x, key) for x in self.parameters.values()])
            for key in ("value", "std", "start", "verdict")
        }
        return to_data_frame("parameter", list(self.parameters), columns)

    def save(self, path: str | Path) -> Path:
        """Write `overrides` as the table ``[parameters]`` of a scene.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        require_path(path, "Calibration.save: path")
        write_atomic(Path(path), write_toml({"parameters": self.overrides}))
        return Path(path)


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
        Huber's loss finds outliers, which are then left out. Its standard deviations are 10 to 25 % too small.

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
        return _report(fit, all_names, converged, iterations)


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


# --- result ------------------------------------------------------------------------------------------


def _report(fit: Fit, names: Sequence[str], converged: bool, iterations: int) -> Calibration:
    linear, redundancy, readings = fit.linear, fit.redundancy(), fit.readings
    weights = fit.present / fit.sigma
    by_data = _row_space(linear.reduce(weights)[1] * fit.scale)
    matrix = fit.equations(linear, weights)[1] * fit.scale
    space = _row_space(matrix)
    covariance = fit.scale[:, None] * space.covariance * fit.scale
    combinations = tuple(_combine(fit, names, terms, covariance) for terms in space.rows if len(terms) > 1)
    has_value = np.where([k in space.single for k in range(len(names))], 1.0, np.nan)
    count = np.maximum(fit.present.sum(axis=0), 1)
    rms = np.sqrt((linear.residual**2).sum(axis=0) / count)
    expected = fit.sigma * np.sqrt(redundancy.sum(axis=0) / count)
    status = "converged" if converged else "not converged"
    return Calibration(
        name=fit.mechanism.name,
        parameters={name: _estimate(fit, k, space, by_data, covariance) for k, name in enumerate(names)},
        combinations=combinations,
        covariance=covariance * has_value * has_value[:, None],
        residuals={
            name: {"rms": float(a), "expected": float(b)}
            for name, a, b in zip(readings.names, rms, expected, strict=True)
        },
        noise=dict(zip(readings.names, fit.sigma.tolist(), strict=True)),
        points=_accuracy(fit, len(names), covariance, space.basis),
        condition=_condition(matrix),
        poses=len(fit.q_tree),
        outliers=tuple(_find_outliers(fit, redundancy)),
        coordinates=np.array([fit.geometry.tree.to_coordinates(q) for q in fit.q_tree]),
        converged=converged,
        message=f"{status} in {iterations} iterations",
    )


def _estimate(fit: Fit, k: int, space: _RowSpace, by_data: _RowSpace, covariance: Array) -> Estimate:
    start = float(fit.start[k])
    if k in space.single:
        verdict = IDENTIFIED if k in by_data.single else BY_PRIOR
        return Estimate(float(fit.values[k]), float(np.sqrt(covariance[k, k])), start, verdict)
    is_combined = any(k in terms for terms in space.rows)
    return Estimate(None, None, start, IN_COMBINATION if is_combined else NOT_IDENTIFIABLE)


def _combine(fit: Fit, names: Sequence[str], terms: Mapping[int, float], covariance: Array) -> Combination:
    """Return a combination of scaled parameters in their own units."""
    at, first = list(terms), next(iter(terms))
    coefficients = np.array(list(terms.values())) * fit.scale[first] / fit.scale[at]
    std = float(np.sqrt(coefficients @ covariance[np.ix_(at, at)] @ coefficients))
    named = {names[k]: float(c) for k, c in zip(at, coefficients, strict=True)}
    return Combination(named, float(coefficients @ fit.values[at]), std)


def _find_outliers(fit: Fit, redundancy: Array) -> Iterator[tuple[int, str, float]]:
    """Yield readings with large residuals, the largest first; all of the error of one that was left out is visible."""
    residual = np.nan_to_num(fit.readings.values - fit.predict(fit.values, fit.q_tree))
    visible = np.where(fit.present, np.maximum(redundancy, 1e-6), 1.0)
    sizes = np.abs(residual) / (fit.sigma * np.sqrt(visible))
    for k in np.argsort(-sizes, axis=None)[: np.count_nonzero(sizes > OUTLIER)]:
        pose, column = np.unravel_index(k, sizes.shape)
        yield int(pose), fit.readings.names[column], float(sizes[pose, column])


class _RowSpace(NamedTuple):
    """What equations determine of unknowns in radians and mechanism sizes, weighted by their errors.

    Attributes
    ----------
    rows : list of dict of int to float
        A basis of the linear combinations that are determined: coefficients by unknown, 1 for the first. An unknown
        that is determined itself is a combination of its own.
    single : set of int
        Unknowns that are determined themselves.
    basis : (rank, unknowns) array
        The same space, orthonormal.
    covariance : (unknowns, unknowns) array
        Of combinations that are determined.
    """

    rows: list[dict[int, float]]
    single: set[int]
    basis: Array
    covariance: Array


def _row_space(matrix: Array) -> _RowSpace:
    _, s, vt = np.linalg.svd(matrix, full_matrices=False)
    # A combination whose standard deviation is larger than a radian, or than the mechanism, is unknown.
    rank = int(np.sum(s > max(RANK_TOLERANCE * s.max(initial=0.0), 1.0)))
    basis = vt[:rank]
    pivots = np.sort(pivoted_columns(basis)[0][:rank])
    reduced = np.linalg.solve(basis[:, pivots], basis) if rank else basis
    rows = []
    for pivot, row in zip(pivots.tolist(), reduced, strict=True):
        others = {k: float(row[k]) for k in np.flatnonzero(np.abs(row) > MIN_COEFFICIENT).tolist() if k != pivot}
        rows.append({pivot: 1.0, **others})
    single = {k for terms in rows if len(terms) == 1 for k in terms}
    return _RowSpace(rows, single, basis, (basis.T / s[:rank] ** 2) @ basis)


def _condition(matrix: Array) -> float:
    norms = np.linalg.norm(matrix, axis=0)
    s = np.linalg.svd(matrix / np.where(norms > 0, norms, 1.0), compute_uv=False)
    s = s[s > RANK_TOLERANCE * s.max(initial=0.0)]
    return float(s[0] / s[-1]) if len(s) else float("nan")


def _accuracy(fit: Fit, p: int, covariance: Array, basis: Array) -> dict[str, dict[str, float | None]]:
    """Return the accuracy of named points, with the readings of the independent encoders as they are."""
    mechanism, geometry, g = fit.mechanism, fit.geometry, len(fit.geometry.names)
    phi_p, points_p = geometry.parameter_derivatives(fit.q_tree)
    jacobian, by_q = geometry.evaluate(fit.q_tree)[1], geometry.points(fit.q_tree)[1]
    z = mechanism.partition.z
    offset = np.zeros((mechanism.n, p))
    offset[fit.offsets, np.arange(g, g + len(fit.offsets))] = -1.0
    offset[z] = 0.0
    forced = jacobian @ offset
    forced[..., :g] += phi_p
    step = np.tile(offset, (len(jacobian), 1, 1))
    step[:, z] = -np.linalg.pinv(jacobian[:, :, z]) @ forced
    slopes = by_q @ step[:, None]
    slopes[..., :g] += points_p
    error = slopes @ (fit.values - fit.start)
    scaled = slopes * fit.scale
    unknown = scaled - scaled @ basis.T @ basis
    variance = np.einsum("kpai,ij,kpaj->kp", slopes, covariance, slopes)
    result = dict[str, dict[str, float | None]]()
    for j, name in enumerate(mechanism.points):
        is_known = np.abs(unknown[:, j]).max() <= MIN_COEFFICIENT * max(np.abs(scaled[:, j]).max(), mechanism.size)
        after = float(np.sqrt(variance[:, j].mean())) if is_known else None
        result[name] = {"before": float(np.sqrt((error[:, j] ** 2).sum(axis=1).mean())), "after": after}
    return result
