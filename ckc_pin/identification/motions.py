"""Parameters from measured motions: simulated runs are fitted to what was measured (output error).

Each record is simulated with its motor torques from a start that is estimated too. With the exact sensitivities of the
run, each step is a linear least-squares problem. The unknowns of the starts are eliminated from it by projection, so
what remains says what the data determine of the parameters, as for torques:

    minimize  |W (y - y(p, s) - J_p dp - J_s ds)|^2  =  |(1 - Q Q^T) W (y - y(p, s) - J_p dp)|^2,  W J_s = Q R.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.identification.fit import HUBER, LinearFit, Prior, fit_linear
from ckc_pin.identification.motion_runs import (
    MotionRun,
    MotionUnknowns,
    RecordedMotion,
    RunError,
    predict,
    read_motion,
    simulate_with_derivatives,
)
from ckc_pin.identification.physical import MIN_WEIGHT
from ckc_pin.identification.priors import make_prior
from ckc_pin.identification.records import Record
from ckc_pin.identification.regressor import TorqueRegressor, linear_parameters
from ckc_pin.identification.result import Identification, Prediction, make_result
from ckc_pin.identification.structure import MotionAdvice, structural_directions
from ckc_pin.identification.unknowns import INERTIAL, Unknown, expand_names, moment_unknowns, typical_size
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import ParameterMap
from ckc_pin.mechanism.parameters import with_components
from ckc_pin.mechanism.units import parameter_unit
from ckc_pin.run.columns import list_quantities

__all__ = ["identify_motion", "make_unknowns"]

COLUMN_TOLERANCE = 1e-7  # of the sensitivities' largest singular value: smaller ones are errors of the integration
LEAK_TOLERANCE = 1e-5  # part of a gradient in directions that are not determined
NOISE_FLOOR = 1e-9  # of the size of a coordinate: smaller residuals are errors of the integration
EXACT = 10.0  # residuals up to so many of these floors need no smaller ones
MAX_STEPS = 60
STEP_SIZES = 0.5 ** np.arange(11)  # parts of a Gauss-Newton step that are tried
COST_TOLERANCE = 1e-5  # relative: a smaller decrease of the cost ends the fit
FIRST_COST_TOLERANCE = 1e-2  # the same for the first parts of records, and for the first weights
# Of the distance of inertias from their start values, one after the other: steps that are far from the minimum would
# otherwise take directions that are hardly determined to absurd inertias.
PRIOR_WEIGHTS = (1e-1, MIN_WEIGHT)
PROMISING = 1e-3  # part of the cost by which the linear model says that it can still decrease
MEDIAN = 0.6745  # of the absolute value of a standard normal variable
HORIZONS = (0.1, 0.3)  # parts of the records that are fitted first, where runs from the start values leave the data
LOST = 0.5  # residual of such runs, in standard deviations of the measurements over time
SUSPICIOUS = 3.0  # residual in units of the noise of a quantity, by a smooth fit
SUSPICIOUS_RMS = 1e-5  # rad or m: the smallest residual that is worth a warning


def identify_motion(
    mechanism: Mechanism, records: Sequence[Record], parameters: Sequence[str], *, robust: bool,
    prior: Mapping[str, float | str],
) -> Identification:  # fmt: skip
    """Estimate parameters by fitting runs to measurements (InputError, NumericalError)."""
    warnings: list[str] = []
    with one_blas_thread(with_scipy=True):
        unknowns = make_unknowns(mechanism, parameters)
        motions = [read_motion(mechanism, record, warnings) for record in records]
        fitted = [x for x in motions if not x.record.validation]
        count = sum(int(np.sum(np.isfinite(x.values))) for x in fitted)
        needed = len(unknowns.names) + 2 * mechanism.d * len(fitted)
        if count < needed:
            raise InputError(
                f"identify: {count} measurements for {needed} unknowns; record a longer motion or estimate less"
            )
        none = np.zeros((len(unknowns.names), 0))
        prior_equations = make_prior(unknowns, prior)
        start = unknowns.nearest_physical(np.zeros(len(none)), none, np.zeros(0))
        fit = _Fit(unknowns, fitted, start, robust=robust, prior=prior_equations)
        fit.solve()
        others = [
            _Fit(unknowns, [x], fit.x, robust=robust, prior=prior_equations, starts_only=True)
            for x in motions if x.record.validation
        ]  # fmt: skip
        for other in others:
            other.solve()
        advice = _advise(unknowns, fitted[0], fit.runs[0])
    predictions = fit.predictions({})
    for prediction, motion in zip(predictions, fitted, strict=True):
        warnings += list(_misfits(prediction, motion))
    names = dict.fromkeys(name for x in predictions for name in x.quantities)
    noise = {
        name: float(np.mean([x.variances[name] for x in predictions if name in x.variances])) ** 0.5 for name in names
    }
    predictions += [x for other in others for x in other.predictions(noise)]
    return make_result(
        "motion", unknowns, fit.linear(), unknowns.start + unknowns.scale * fit.x, predictions, leak=LEAK_TOLERANCE,
        complete=True, instants=sum(int(np.isfinite(x.values).any(axis=1).sum()) for x in fitted), warnings=warnings,
        prior=prior_equations, advice=advice,
    )  # fmt: skip


def _misfits(prediction: Prediction, motion: RecordedMotion) -> Iterator[str]:
    """Yield warnings about residuals that are much larger than the noise by smooth fits."""
    for name, smooth in motion.fits.items():
        k = prediction.quantities.index(name)
        rms = float(_rms(prediction.measured - prediction.predicted)[k])
        noise = max(smooth.noise, NOISE_FLOOR)
        if rms > SUSPICIOUS * noise and rms > SUSPICIOUS_RMS:
            yield (
                f"{prediction.source}: the residual of {name} is {rms:.3g}, {rms / noise:.0f} times its noise; the "
                "model does not explain the motion, or the fit ended in a local minimum"
            )


def make_unknowns(mechanism: Mechanism, patterns: Sequence[str]) -> MotionUnknowns:
    """Return the unknowns of names with wildcards (InputError)."""
    parameters = ParameterMap(mechanism)
    values = with_components(parameters.values)
    moving = [name for name, frame in mechanism.frames.links.items() if frame.joint != 0]
    singles = [name for name, x in values.items() if not isinstance(x, tuple)]
    singles = [name for name in singles if not name.startswith("link.") or name.split(".")[1] in moving]
    inertial = [f"link.{name}.{INERTIAL}" for name in moving if f"link.{name}.mass" in values]
    names = expand_names([*inertial, *singles], patterns)
    links = [name.split(".")[1] for name in names if name.endswith(f".{INERTIAL}")]
    unknowns: list[Unknown] = []
    for name in names:
        if name.endswith(f".{INERTIAL}"):
            unknowns += moment_unknowns(mechanism, parameters, name.split(".")[1])
        else:
            scale = typical_size(mechanism, parameter_unit(mechanism, name))
            unknowns.append(Unknown(name, parameters.value_of(name), scale))
    directions = None
    if links and _is_linear(mechanism, names):
        directions = structural_directions(TorqueRegressor(mechanism, [f"link.{name}.{INERTIAL}" for name in links]))
    return MotionUnknowns(mechanism, unknowns, links, directions)


def _is_linear(mechanism: Mechanism, names: Sequence[str]) -> bool:
    """Whether torques are linear in parameters; with lengths, other combinations of inertias have no influence."""
    single = {name for name in names if not name.endswith(INERTIAL)}
    return single <= {*linear_parameters(mechanism, ParameterMap(mechanism))}


def _advise(unknowns: MotionUnknowns, motion: RecordedMotion, run: MotionRun) -> MotionAdvice | None:
    """Return what says which motions would determine parameters, if torques are linear in them."""
    mechanism = unknowns.mechanism
    names = [name for name in unknowns.names if ".moment." not in name and ".origin_inertia." not in name]
    names = [name for name in names if not name.startswith(tuple(f"link.{link}." for link in unknowns.links))]
    names += [f"link.{link}.{INERTIAL}" for link in unknowns.links]
    if not _is_linear(mechanism, names):
        return None
    q_tree = np.array([mechanism.tree.from_coordinates(q) for q in run.q])
    torques = [motion.record.values.get(f"tau.{motor}", np.zeros(1)) for motor in mechanism.motors.names]
    has_torques = any(np.any(np.nan_to_num(tau)) for tau in torques)
    regressor = TorqueRegressor(mechanism, names)
    return MotionAdvice(regressor, q_tree, unknowns.names, has_torques=has_torques)


def _rms(residual: Array) -> Array:
    """Return the root mean square of each column, leaving out NaN; 0 without values."""
    count = np.isfinite(residual).sum(axis=0)
    return np.sqrt(np.nansum(residual**2, axis=0) / np.maximum(count, 1))


# --- least squares ---------------------------------------------------------------------------------


class _Fit:
    """Fits runs of records to their measurements by Gauss-Newton steps.

    Parameters
    ----------
    unknowns : MotionUnknowns
    motions : sequence of RecordedMotion
    x : (p,) array
        Steps of the unknowns from their start, in typical sizes, to begin with.
    robust : bool
        Whether large residuals have less weight.
    prior : Prior
    starts_only : bool
        Whether x remains as it is.
    """

    def __init__(
        self, unknowns: MotionUnknowns, motions: Sequence[RecordedMotion], x: Array, *, robust: bool, prior: Prior,
        starts_only: bool = False,
    ) -> None:  # fmt: skip
        self.unknowns, self.motions, self.x, self.prior = unknowns, motions, x, prior
        self.robust, self.starts_only = robust, starts_only
        self.starts = [(motion.q, motion.q_dot) for motion in motions]
        self.runs: list[MotionRun] = []
        self.weight = PRIOR_WEIGHTS[0]  # of the distance of inertias from their start values
        self.rank = 0  # number of combinations of the unknowns that the data determine
        mechanism, quantities = unknowns.mechanism, list_quantities(unknowns.mechanism)
        self.at = mechanism.tree.indices(mechanism.independent, "identify")
        self.floors = [
            NOISE_FLOOR * np.array([typical_size(mechanism, quantities[name].unit) for name in motion.names])
            for motion in motions
        ]

    def solve(self) -> None:
        """Fit all motions (InputError, NumericalError).

        If runs from the start values leave the data, the first parts of the records are fitted before.
        """
        whole = self.motions
        error = self._begin()
        if error is not None or self._is_lost():
            for part in HORIZONS:
                self.motions = [motion.until(part) for motion in whole]
                error = self._begin()
                if error is not None:
                    break
                self._iterate(FIRST_COST_TOLERANCE)
            self.motions = whole
            error = error or self._begin()
        if error is not None:
            cause = error.__cause__
            if isinstance(cause, InputError):
                raise cause
            raise NumericalError(
                f"identify: {whole[0].record.source}: no run from the start values reaches the last measurement: "
                f"{error}; give better start values, or a shorter span"
            )
        if reason := self._fit_whole():
            raise NumericalError(
                f"identify: the fit of runs did not converge: {reason}; the rms residuals are {self._rms_residuals()}; "
                "give better start values, or a shorter span"
            )

    def _begin(self) -> RunError | None:
        try:
            self.runs = self._simulate(self.x, self.starts)
        except RunError as error:
            return error
        return None

    def _simulate(self, x: Array, starts: Sequence[tuple[Array, Array]]) -> list[MotionRun]:
        return [
            simulate_with_derivatives(self.unknowns, motion, x, *start)
            for motion, start in zip(self.motions, starts, strict=True)
        ]

    def _predict(self, x: Array, starts: Sequence[tuple[Array, Array]]) -> list[Array]:
        return [predict(self.unknowns, motion, x, *start) for motion, start in zip(self.motions, starts, strict=True)]

    def _is_lost(self) -> bool:
        for motion, run in zip(self.motions, self.runs, strict=True):
            rms = _rms(motion.values - run.predicted)
            if np.any(rms > LOST * np.nanstd(motion.values, axis=0)):
                return True
        return False

    def _fit_whole(self) -> str:
        """Fit the whole records, with less and less weight of the start values; return why that failed, or ""."""
        reason = ""
        for self.weight in PRIOR_WEIGHTS:
            reason = self._iterate(COST_TOLERANCE if self.weight == PRIOR_WEIGHTS[-1] else FIRST_COST_TOLERANCE)
        return reason

    def _iterate(self, tolerance: float) -> str:
        """Take steps until the cost no longer decreases, and return why it is no minimum, "" if it is one."""
        for _ in range(MAX_STEPS):
            stds = [self._stds(k, self.runs[k]) for k in range(len(self.motions))]
            dx, start_steps = self._step(stds)
            cost, decrease, reason = self._cost([run.predicted for run in self.runs], stds, self.x), 0.0, ""
            promised = cost - self._linear_cost(stds, dx, start_steps)
            is_last = promised <= tolerance * cost or self._is_exact()
            for size in (1.0,) if is_last else STEP_SIZES:
                x = self.x + size * dx
                starts = [self._moved(run, size * step) for run, step in zip(self.runs, start_steps, strict=True)]
                try:  # derivatives cost much more than a run, so they are computed for accepted steps only
                    if self._cost(self._predict(x, starts), stds, x) >= cost:
                        continue
                    runs = self._simulate(x, starts)
                except RunError as error:
                    reason = str(error)
                    continue
                if (decrease := cost - self._cost([run.predicted for run in runs], stds, x)) > 0:
                    self.x, self.starts, self.runs = x, starts, runs
                    break
            if is_last or decrease <= tolerance * cost:
                return (
                    "" if promised <= PROMISING * cost or is_last else reason or "no step makes the residuals smaller"
                )
        return f"{MAX_STEPS} steps were not enough"

    def _moved(self, run: MotionRun, start_step: Array) -> tuple[Array, Array]:
        d = len(self.at)
        q = run.q[0].copy()
        q[self.at] += start_step[:d]
        return q, run.q_dot + start_step[d:]

    def _linear_cost(self, stds: Sequence[Array], dx: Array, start_steps: Sequence[Array]) -> float:
        """Return the cost after a step by the linear model."""
        predicted = [
            run.predicted + run.by_unknown @ dx + run.by_start @ step
            for run, step in zip(self.runs, start_steps, strict=True)
        ]
        return self._cost(predicted, stds, self.x + dx)

    def _is_exact(self) -> bool:
        """Whether the residuals are errors of the integration."""
        parts = zip(self.motions, self.runs, self.floors, strict=True)
        return all(np.nanmax(np.abs(motion.values - run.predicted) / floor) <= EXACT for motion, run, floor in parts)

    def _rms_residuals(self) -> str:
        texts = []
        for motion, run in zip(self.motions, self.runs, strict=True):
            rms = _rms(motion.values - run.predicted)
            texts += [f"{name} {x:.3g}" for name, x in zip(motion.names, rms, strict=True)]
        return ", ".join(texts)

    def _stds(self, k: int, run: MotionRun) -> Array:
        """Return the standard deviations by which a record's residuals are divided, (quantities,)."""
        motion = self.motions[k]
        residual = motion.values - run.predicted
        count = np.isfinite(residual).sum(axis=0)
        used = 2 * len(self.at) + self.rank / len(self.motions)
        free = max(1 - used / count.sum(), 1 / count.sum())
        estimate = _rms(residual) / free**0.5
        if self.robust:
            estimate = (
                np.array([np.median(np.abs(x[np.isfinite(x)])) if np.isfinite(x).any() else 0.0 for x in residual.T])
                / MEDIAN
            )
        noise = [motion.record.noise.get(name, 0.0) for name in motion.names]
        return np.maximum(np.maximum(estimate, noise), self.floors[k])

    def _cost(self, predicted: Sequence[Array], stds: Sequence[Array], x: Array) -> float:
        rows, target = self.prior
        of_prior = float(np.sum((rows @ x - target) ** 2))
        return of_prior + sum(self._cost_of(*parts) for parts in zip(self.motions, predicted, stds, strict=True))

    def _cost_of(self, motion: RecordedMotion, predicted: Array, stds: Array) -> float:
        sizes = np.abs(motion.values - predicted) / stds
        if self.robust:
            sizes = np.sqrt(np.where(sizes > HUBER, 2 * HUBER * sizes - HUBER**2, sizes**2))
        cost = float(np.nansum(sizes**2))
        return cost if np.isfinite(cost) else np.inf

    def _equations(self, k: int, stds: Array) -> tuple[Array, Array, Array]:
        """Return weighted derivatives by unknown and by start, and residuals, ordered by quantity and time."""
        motion, run = self.motions[k], self.runs[k]
        residual = motion.values - run.predicted
        weight = np.ones_like(residual)
        if self.robust:
            weight = np.sqrt(np.minimum(1.0, HUBER * stds / np.maximum(np.abs(residual), 1e-300)))
        weight = weight / stds
        measured = np.isfinite(residual).T
        parts = (run.by_unknown * weight[:, :, None], run.by_start * weight[:, :, None], residual * weight)
        by_unknown, by_start, right = (part.swapaxes(0, 1)[measured] for part in parts)
        return by_unknown, by_start, right

    def linear(self, stds: Sequence[Array] | None = None) -> LinearFit:
        """Solve the linear problem at the present values for the unknowns."""
        columns, rights, largest = [], [], 0.0
        for k in range(len(self.motions)):
            by_unknown, by_start, right = self._equations(k, self._stds(k, self.runs[k]) if stds is None else stds[k])
            largest = max(largest, float(np.linalg.norm(by_unknown, 2)))
            Q = np.linalg.qr(by_start / np.maximum(np.linalg.norm(by_start, axis=0), 1e-300))[0]
            columns.append(by_unknown - Q @ (Q.T @ by_unknown))
            rights.append(right - Q @ (Q.T @ right))
        A, b = np.concatenate(columns)[:, None], np.concatenate(rights)[:, None]
        rows, target = self.prior
        remaining = rows, target - rows @ self.x
        return fit_linear(A, b, remaining, noise=np.ones((len(A), 1, 1)), smallest=COLUMN_TOLERANCE * largest)

    def _step(self, stds: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the steps of the unknowns and of the start of each record."""
        dx: Array = np.zeros(len(self.x))
        if not self.starts_only:
            fit = self.linear(stds)
            self.rank = fit.determined.shape[1]
            x = self.unknowns.nearest_physical(self.x + fit.x, fit.determined, fit.information, self.weight)
            dx = x - self.x
        start_steps: list[Array] = []
        for k, std in enumerate(stds):
            by_unknown, by_start, right = self._equations(k, std)
            start_steps.append(
                np.asarray(np.linalg.lstsq(by_start, right - by_unknown @ dx, rcond=1e-12)[0], dtype=float)
            )
        return dx, start_steps

    def predictions(self, expected: Mapping[str, float]) -> list[Prediction]:
        """Return measured and predicted quantities, with the noise of the record, as expected, or of the residuals."""
        predictions = []
        for k, (motion, run) in enumerate(zip(self.motions, self.runs, strict=True)):
            stds = dict(zip(motion.names, self._stds(k, run).tolist(), strict=True))
            noise = {**stds, **expected, **motion.record.noise}
            predictions.append(
                Prediction(
                    motion.record.source, motion.record.validation, tuple(motion.names), motion.record.t, motion.values,
                    np.where(np.isfinite(motion.values), run.predicted, np.nan),
                    {name: noise[name] ** 2 for name in motion.names},
                )
            )  # fmt: skip
        return predictions
