"""Results of a calibration: what the readings determine, and the accuracy of points that it buys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.tables import to_data_frame
from ckc_pin.base.toml_writer import write_toml
from ckc_pin.base.validation import require_path
from ckc_pin.identification.calibration_fit import RANK_TOLERANCE, Fit
from ckc_pin.identification.estimates import (
    BY_PRIOR,
    IDENTIFIED,
    IN_COMBINATION,
    NOT_IDENTIFIABLE,
    PRIOR_ONLY,
    UNCHANGED,
    Combination,
    Estimate,
)
from ckc_pin.mechanism.parameters import ROOTS

if TYPE_CHECKING:
    import pandas

__all__ = ["Calibration", "make_calibration"]

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
            "parameters": {
                name: {"value": x.value, "std": x.std, "start": x.start, "verdict": x.verdict}
                for name, x in self.parameters.items()
            },
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


def make_calibration(fit: Fit, names: Sequence[str], converged: bool, iterations: int) -> Calibration:
    """Return what a fit says about the parameters of these names."""
    linear, redundancy, readings = fit.linear, fit.redundancy(), fit.readings
    weights = fit.present / fit.sigma
    by_data = _row_space(linear.reduce(weights)[1] * fit.scale)
    matrix = fit.equations(linear, weights)[1] * fit.scale
    space = _row_space(matrix)
    covariance = fit.scale[:, None] * space.covariance * fit.scale
    if fit.huber:  # small outliers remain, which the readings' standard deviations do not contain
        covariance *= max(1.0, float(np.sum((weights * linear.residual) ** 2) / max(redundancy.sum(), 1e-12)))
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
        std = float(np.sqrt(covariance[k, k]))
        by_prior = PRIOR_ONLY if std >= UNCHANGED * fit.prior[k] else BY_PRIOR
        return Estimate(float(fit.values[k]), std, start, IDENTIFIED if k in by_data.single else by_prior)
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
