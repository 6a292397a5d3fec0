"""Parameters from measured torques: eq. 1 along the measured motion, linear in the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.errors import InputError
from ckc_pin.identification.fit import fit_linear, no_prior
from ckc_pin.identification.measured_motion import MeasuredMotion, estimate_motion, shift_motion
from ckc_pin.identification.priors import make_prior
from ckc_pin.identification.records import Record, describe_missing, require_radians
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.result import Identification, Prediction, make_result
from ckc_pin.identification.smooth_fit import SmoothFit
from ckc_pin.identification.smoothing import fit_record
from ckc_pin.identification.structure import MotionAdvice
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["identify_torques"]

MAX_INSTANTS = 20_000  # of one record; evenly spaced ones are used of more
MAX_DELAY, DELAY_GRID, MAX_DELAY_INSTANTS = 0.05, 21, 1000  # s; delays that are tried, with so many instants
MAX_DIFFERENTIATED, MAX_COMPARED = 400, 50  # instants at which equations are differentiated, and errors compared
MIN_SHIFT = 1e-6  # of a coordinate, rad or sizes of the mechanism, for a difference
LEAK_TOLERANCE = 1e-6  # part of a gradient in directions that are not determined
SATURATED = 0.999  # of a torque limit
MAX_SATURATED = 0.5  # share of instants


@dataclass(frozen=True, eq=False)
class _Equations:
    """The equations of one record.

    Attributes
    ----------
    columns : (m, d, p) array
        In typical sizes of the unknowns.
    right : (m, d) array
    to_motors : (m, motors, d) array
        Torques that give generalized forces, least-squares.
    tau : (m, motors) array
    fits : mapping of str to SmoothFit
        By measured coordinate.
    """

    record: Record
    motion: MeasuredMotion
    columns: Array
    right: Array
    to_motors: Array
    tau: Array
    fits: Mapping[str, SmoothFit]


def identify_torques(
    mechanism: Mechanism, records: Sequence[Record], parameters: Sequence[str], *, physical: bool, robust: bool,
    prior: Mapping[str, float | str],
) -> Identification:  # fmt: skip
    """Estimate parameters in which torques are linear (InputError)."""
    regressor = TorqueRegressor(mechanism, parameters)
    prior_equations = make_prior(regressor, prior)
    warnings: list[str] = []
    with one_blas_thread(with_scipy=True):
        equations = []
        for record in records:
            fits = _fit_coordinates(mechanism, record)
            delayed = _with_delay(mechanism, regressor, record, fits, warnings)
            equations.append(_equations(mechanism, regressor, delayed, fits, warnings))
        fitted = [x for x in equations if not x.record.validation]
        columns, right = (np.concatenate([getattr(x, key) for x in fitted]) for key in ("columns", "right"))
        if right.size + len(prior_equations[0]) < columns.shape[2]:
            raise InputError(
                f"identify: {right.size} equations for {columns.shape[2]} unknowns; record a longer motion or estimate "
                "less"
            )
        fit = fit_linear(columns, right, prior_equations, robust=robust)
        parts = np.split(fit.influence, np.cumsum([len(x.right) for x in fitted])[:-1])
        errors_of_motion = [_MotionErrors.of(mechanism, regressor, x, fit.x) for x in equations]
        of_fitted = [x for x in errors_of_motion if not x.validation]

        def covariance(lag: int) -> Array:
            return np.average([x.covariance(lag) for x in of_fitted], axis=0, weights=[len(x.t) for x in of_fitted])

        fit = fit.with_errors([e for x, part in zip(of_fitted, parts, strict=True) for e in x.steps(part)], covariance)
        noise_of_torques = _positive_part(fit.noise - covariance(0))
        step = fit.x
        if physical:
            step = regressor.nearest_physical(fit.x, fit.determined, fit.information)
        advice = MotionAdvice(regressor, fitted[0].motion.q_tree, regressor.names, has_torques=True)
    motions = [
        _prediction(x, mechanism.motors.names, step, noise_of_torques, errors.covariance(0), fit.covariance)
        for x, errors in zip(equations, errors_of_motion, strict=True)
    ]
    return make_result(
        "torques", regressor, fit, regressor.start + regressor.scale * step, motions, leak=LEAK_TOLERANCE,
        complete=physical, instants=len(right), warnings=warnings, prior=prior_equations, advice=advice,
    )  # fmt: skip


def _fit_coordinates(mechanism: Mechanism, record: Record) -> dict[str, SmoothFit]:
    """Fit smooth functions to the measured coordinates of a record, after checking that nothing is missing."""
    names = [name for name in mechanism.coordinates if name in record.values]
    torques = [f"tau.{motor}" for motor in mechanism.motors.names]
    required = [*torques, *(mechanism.independent if len(names) < mechanism.d else ())]
    missing = [name for name in required if name not in record.values]
    if missing:
        needed = f"{mechanism.d} coordinates and the torque of every motor"
        raise InputError(describe_missing(record, missing, needed))
    require_radians(mechanism, record, names)
    return fit_record(record, names)


def _equations(
    mechanism: Mechanism,
    regressor: TorqueRegressor,
    record: Record,
    fits: Mapping[str, SmoothFit],
    warnings: list[str],
    max_instants: int = MAX_INSTANTS,
) -> _Equations:
    """Estimate the motion of a record from the fits of its coordinates, and set up its equations."""
    torques = [f"tau.{motor}" for motor in mechanism.motors.names]
    tau = np.array([record.values[name] for name in torques]).T.reshape(-1, len(torques))
    times = record.times(torques[0]) if torques else record.t
    used = np.all(np.isfinite(tau), axis=1)
    limit = mechanism.motors.torque_limit
    at_limit = (tau <= SATURATED * limit[0]) | (tau >= SATURATED * limit[1])
    saturated = np.any(at_limit, axis=1) & used
    if saturated.sum() > MAX_SATURATED * used.sum():
        k = int(np.argmax(np.sum(at_limit, axis=0)))
        raise InputError(
            f"identify: {record.source}: {torques[k]} is at its limit, {limit[0, k]:.4g} to {limit[1, k]:.4g}, most of "
            "the time, and may be wrong there; record a slower motion, or correct torque_limit"
        )
    source = f"{record.source} (validation)" if record.validation else record.source
    if saturated.any():
        warnings.append(f"{source}: {saturated.sum()} instants with a motor at its torque limit are left out")
    at = np.flatnonzero(used & ~saturated)
    at = at[:: max(1, -(-len(at) // max_instants))]
    motion = estimate_motion(mechanism, fits, times[at])
    reversals = motion.near_reversals(regressor.has_friction)
    if reversals.any():
        warnings.append(
            f"{source}: {reversals.sum()} instants near reversals are left out, where the direction of friction "
            "is uncertain"
        )
        motion = motion.at(~reversals)
    tau = tau[at][np.isin(times[at], motion.t)]
    columns, force = regressor.rows(motion)
    to_motors = np.linalg.pinv(_to_forces(mechanism, motion)).astype(float)
    right = _generalized(mechanism, motion, tau) - force
    return _Equations(record, motion, columns * regressor.scale, right, to_motors, tau, fits)


def _to_forces(mechanism: Mechanism, motion: MeasuredMotion) -> Array:
    """Return the matrices (m, d, motors) that give generalized forces from motor torques."""
    return np.einsum("knd,mn->kdm", motion.rho, mechanism.motors.transmission)


def _generalized(mechanism: Mechanism, motion: MeasuredMotion, tau: Array) -> Array:
    """Return the generalized forces (m, d) of motor torques (m, motors)."""
    return np.einsum("kdm,km->kd", _to_forces(mechanism, motion), tau)


def _with_delay(
    mechanism: Mechanism, regressor: TorqueRegressor, record: Record, fits: Mapping[str, SmoothFit], warnings: list[str]
) -> Record:
    """Return the record with the delay of its torques that leaves the smallest residual, if it is to be estimated."""
    from scipy.optimize import minimize_scalar

    torques = [f"tau.{motor}" for motor in mechanism.motors.names]
    if not any(isinstance(record.delay.get(name), str) for name in torques):
        return record

    def delayed(delay: float) -> Record:
        return replace(record, delay={**record.delay, **dict.fromkeys(torques, delay)})

    def residual(delay: float) -> float:
        equations = _equations(mechanism, regressor, delayed(delay), fits, [], MAX_DELAY_INSTANTS)
        off = fit_linear(equations.columns, equations.right, no_prior(len(regressor.names))).residual
        return float(np.log(np.mean(off**2, axis=0) + 1e-300).sum())

    grid = np.linspace(-MAX_DELAY, MAX_DELAY, DELAY_GRID)
    best = grid[int(np.argmin([residual(delay) for delay in grid]))]
    step = grid[1] - grid[0]
    minimum = minimize_scalar(residual, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-6})
    warnings.append(f"{record.source}: the torques are {1e3 * minimum.x:.4g} ms late, estimated from their residuals")
    return delayed(float(minimum.x))


@dataclass(frozen=True, eq=False)
class _MotionErrors:
    """Errors of the equations of a record that errors of its fitted coordinates cause.

    They are correlated over some instants, and may be too small beside the noise of torques to show in the residuals.

    Attributes
    ----------
    gains : (3, m, d, coordinates) array
        Derivatives of the residuals with respect to values, rates and accelerations of the measured coordinates.
    """

    t: Array
    gains: Array
    fits: Sequence[SmoothFit]
    validation: bool

    @classmethod
    def of(cls, mechanism: Mechanism, regressor: TorqueRegressor, equations: _Equations, x: Array) -> _MotionErrors:
        """Differentiate the equations with unknowns x at some instants, and interpolate between them."""
        some = np.unique(np.linspace(0, len(equations.motion.t) - 1, MAX_DIFFERENTIATED).astype(int))
        full, tau = equations.motion, equations.tau[some]
        motion = full.at(some)

        def residual(at: MeasuredMotion) -> Array:
            columns, force = regressor.rows(at)
            return _generalized(mechanism, at, tau) - force - columns @ (regressor.scale * x)

        before = residual(motion)
        gains = np.zeros((3, len(full.t), before.shape[1], len(equations.fits)))
        for k, (name, fit) in enumerate(equations.fits.items()):
            smallest = MIN_SHIFT * mechanism.tree.step_scale[mechanism.tree.index[name]]
            for order in range(3):
                shift = max(fit.std[order], smallest / fit.interval**order)
                shifted = residual(shift_motion(mechanism, motion, equations.fits, order, name, shift))
                for i, column in enumerate((shifted - before).T / shift):
                    gains[order, :, i, k] = np.interp(full.t, motion.t, column)
        return cls(full.t, gains, list(equations.fits.values()), equations.record.validation)

    def steps(self, influence: Array) -> list[Array]:
        """Return the steps (r, any) of a solution with such influence (m, r, d), of unit variance each."""
        return [
            fit.errors(self.t, np.einsum("krd,okd->okr", influence, self.gains[..., k]))
            for k, fit in enumerate(self.fits)
        ]

    def covariance(self, lag: int) -> Array:
        """Return the mean covariance (d, d) at two instants that are `lag` apart."""
        first = np.unique(np.linspace(0, len(self.t) - 1 - lag, MAX_COMPARED).astype(int))
        total = np.zeros((self.gains.shape[2],) * 2)
        for k, fit in enumerate(self.fits):
            one, other = (self._at(at, k, fit) for at in (first, first + lag))
            total += np.einsum("kic,kjc->ij", one, other) / len(first)
        return (total + total.T) / 2

    def _at(self, at: Array, k: int, fit: SmoothFit) -> Array:
        """Return the errors (instants, d, any) that errors of one coordinate cause at some instants."""
        gains = self.gains[..., k][:, at]
        apart = np.einsum("okd,kl->okld", gains, np.eye(len(at))).reshape(3, len(at), -1)
        return fit.errors(self.t[at], apart).reshape(len(at), gains.shape[2], -1)


def _positive_part(covariance: Array) -> Array:
    """Return a symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.maximum(values, 0.0) @ vectors.T)


def _prediction(
    equations: _Equations, motors: Sequence[str], step: Array, noise_of_torques: Array, errors_of_motion: Array,
    errors_of_step: Array,
) -> Prediction:  # fmt: skip
    """Return measured and predicted motor torques, and the variances of their difference.

    These are the sums of those of the torques' noise, as given or as the fit estimated it, of the errors of the
    record's motion, and, if the record was not fitted, of the errors of the step. The first two are covariances of the
    equations, (d, d), and the last one is that of the unknowns, (p, p).
    """
    residual = np.einsum("kmd,kd->km", equations.to_motors, equations.right - equations.columns @ step)
    names = tuple(f"tau.{motor}" for motor in motors)
    record, tau = equations.record, equations.tau

    def of_motors(covariance: Array) -> Array:
        return np.einsum("kmd,de,kme->m", equations.to_motors, covariance, equations.to_motors) / len(tau)

    noise = dict(zip(names, of_motors(noise_of_torques), strict=True)) | {
        name: std**2 for name, std in record.noise.items() if name in names
    }
    errors = of_motors(errors_of_motion)
    if record.validation:
        by_unknown = np.einsum("kmd,kdp->kmp", equations.to_motors, equations.columns)
        errors += np.mean(np.sum((by_unknown @ errors_of_step) * by_unknown, axis=2), axis=0)
    variances = {name: float(noise[name] + x) for name, x in zip(names, errors, strict=True)}
    return Prediction(record.source, record.validation, names, equations.motion.t, tau, tau - residual, variances)
