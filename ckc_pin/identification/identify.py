"""Parameters from measured coordinates and motor torques."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.validation import require_path
from ckc_pin.errors import InputError
from ckc_pin.identification.fit import LinearFit, fit_linear
from ckc_pin.identification.measured_motion import MeasuredMotion, SplineFit, estimate_motion, fit_spline
from ckc_pin.identification.physical import nearest_physical
from ckc_pin.identification.pseudo_inertia import MOMENTS, pseudo_inertia
from ckc_pin.identification.records import Record, read_record
from ckc_pin.identification.regressor import TorqueRegressor, link_inertial_axes
from ckc_pin.identification.spec import IdentifySpec, read_identify
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.library import is_path
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import INERTIA_ENTRIES

if TYPE_CHECKING:
    from ckc_pin.view.inline import Figures

__all__ = ["Combination", "Estimate", "Identification", "Prediction", "Residual", "identify", "identify_file"]

MAX_INSTANTS = 20_000  # of one record; evenly spaced ones are used of more
MAX_DELAY, DELAY_GRID, MAX_DELAY_INSTANTS = 0.05, 21, 1000  # s; delays that are tried, with so many instants
IDENTIFIED, IN_COMBINATION, NOT_IDENTIFIABLE = "identified", "only in a combination", "not identifiable"
LEAK_TOLERANCE = 1e-6  # part of a gradient in directions that are not determined
SATURATED = 0.999  # of a torque limit
MAX_SATURATED = 0.5  # share of instants
LINK_VALUES = ("mass", "com.x", "com.y", "com.z", *(f"inertia.{entry}" for entry in INERTIA_ENTRIES))


@dataclass(frozen=True)
class Estimate:
    """An estimated parameter.

    Attributes
    ----------
    value, std : float or None
        None if the data do not determine it.
    start : float
        Value in the mechanism's files.
    verdict : str
        "identified", "only in a combination" or "not identifiable".
    """

    value: float | None
    std: float | None
    start: float
    verdict: str


@dataclass(frozen=True)
class Combination:
    """A linear combination of unknowns that the data determine.

    Attributes
    ----------
    combination : str
    coefficients : mapping of str to float
    value, std : float
    """

    combination: str
    coefficients: Mapping[str, float]
    value: float
    std: float


@dataclass(frozen=True)
class Residual:
    """Difference between a measured quantity and what the fit predicts.

    Attributes
    ----------
    rms : float
    expected : float
        From the noise that was given, or estimated from the fit.
    autocorrelation : float
        Of neighbouring instants, 0 for independent residuals.
    """

    rms: float
    expected: float
    autocorrelation: float


@dataclass(frozen=True, eq=False)
class Prediction(Immutable):
    """Measured and predicted torques along one record.

    Attributes
    ----------
    source : str
    validation : bool
    t : (m,) array
        s.
    measured, predicted : (m, motors) arrays
    """

    source: str
    validation: bool
    t: Array
    measured: Array
    predicted: Array


@dataclass(frozen=True, eq=False, repr=False)
class Identification(HasSummary):
    """Parameters of a mechanism that measured torques determine.

    Attributes
    ----------
    mechanism : Mechanism
        With its start values.
    parameters : mapping of str to Estimate
    base : tuple of Combination
        Independent combinations, as many as the data determine.
    condition : float
        Of the regressor in typical sizes of the unknowns.
    residuals, validation : mapping of str to Residual
        By ``tau.MOTOR``, of the fitted and of the other records.
    physical : bool
        Whether the inertias are those of bodies that can exist.
    values : mapping of str to float
        A complete set of parameter values: measured ones, and for the rest those closest to the start values.
    covariance : (k, k) array
        Of the k parameters that are identified, in their order.
    instants : int
    warnings : tuple of str
    motions : tuple of Prediction
        Measured and predicted torques of each record.
    """

    mechanism: Mechanism
    parameters: Mapping[str, Estimate]
    base: tuple[Combination, ...]
    condition: float
    residuals: Mapping[str, Residual]
    validation: Mapping[str, Residual]
    physical: bool
    values: Mapping[str, float]
    covariance: Array
    instants: int
    warnings: tuple[str, ...]
    motions: tuple[Prediction, ...]

    @property
    def identified(self) -> list[str]:
        """Names of the parameters that the data determine."""
        return [name for name, x in self.parameters.items() if x.verdict == IDENTIFIED]

    def plot(self) -> Figures:
        """Draw measured and predicted torques, residuals, and the correlation of the parameters."""
        import ckc_pin

        return ckc_pin.plot(self)

    def save(self, path: str | Path) -> Path:
        """Write a complete set of parameter values as the table ``[parameters]`` of a scene (TOML).

        Raises
        ------
        InputError
            The file cannot be written, or the inertias were not required to be physical.
        """
        require_path(path, "Identification.save: path")
        if not self.values:
            raise InputError(
                "Identification.save: only physical parameters are a mechanism; identify with physical = true"
            )
        lines = [
            f"# Parameters of {self.mechanism.name} from {self.instants} instants of measured torques.",
            "# A line without a standard deviation is no measurement: the value is the one closest to the start value.",
            "[parameters]",
        ]
        offsets = [name for name in self.values if name.endswith(".offset")]
        for name, value in self.values.items():
            if name not in offsets:
                estimate = self.parameters[name]
                note = f"  # std {estimate.std:.3g}" if estimate.std is not None else f"  # {estimate.verdict}"
                lines.append(f'"{name}" = {value!r}{note}')
        lines += [
            f"# {name} = {self.values[name]!r}, of the measurement, no parameter of the mechanism" for name in offsets
        ]
        write_atomic(Path(path), "\n".join(lines) + "\n")
        return Path(path)

    def summary(self) -> Summary:
        """Return what was identified, with standard deviations, and the residuals."""
        rows: list[Row] = []
        for verdict in (IDENTIFIED, IN_COMBINATION, NOT_IDENTIFIABLE):
            names = [_describe(name, x) for name, x in self.parameters.items() if x.verdict == verdict]
            rows += [(verdict, names)] if names else []
        rows.append(("base", f"{len(self.base)} combinations, condition number {self.condition:.3g}"))
        for label, residuals in (("residuals", self.residuals), ("validation", self.validation)):
            texts = [f"{name}: rms {x.rms:.3g}, expected {x.expected:.3g}" for name, x in residuals.items()]
            rows += [(label, texts)] if texts else []
        rows += [("warning", warning) for warning in self.warnings]
        return Summary(f"Identification of {self.mechanism.name} from {self.instants} instants", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON-ready data."""
        return {
            "name": self.mechanism.name,
            "parameters": {
                name: {"value": x.value, "std": x.std, "start": x.start, "verdict": x.verdict}
                for name, x in self.parameters.items()
            },
            "base": [{"combination": x.combination, "value": x.value, "std": x.std} for x in self.base],
            "condition": self.condition,
            "residuals": {name: {"rms": x.rms, "expected": x.expected} for name, x in self.residuals.items()},
            "validation": {name: {"rms": x.rms, "expected": x.expected} for name, x in self.validation.items()},
            "physical": self.physical,
            "values": dict(self.values),
            "instants": self.instants,
            "warnings": list(self.warnings),
        }


def identify(
    mechanism: str | Path | Mechanism,
    data: Any,
    parameters: Sequence[str],
    *,
    noise: Mapping[str, float] | None = None,
    validation: Any = (),
    physical: bool = True,
    robust: bool = False,
) -> Identification:
    """Estimate parameters from measured coordinates and motor torques.

    Eq. 1 along the motions that the loops allow is linear in inertias, friction, damping, rotor inertias, stiffnesses
    and offsets. The other coordinates, rates and accelerations follow from the loops and from splines of what was
    measured.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
    data : path, Run, mapping of arrays or DataFrame, or a list of these
        ``t``, at least d coordinates, and ``tau.MOTOR`` of all motors, in SI units.
    parameters : sequence of str
        With wildcards: ``["link.*.inertial", "joint.*.friction"]``.
    noise : mapping, optional
        Standard deviations by quantity; estimated for the others.
    validation : as `data`, optional
        Motions that are not fitted, which the fit is compared with.
    physical : bool
        Whether inertias have to be those of a body that can exist.
    robust : bool
        Whether instants with large residuals have less weight (Huber).

    Raises
    ------
    InputError
        Missing quantities, fewer data than unknowns, parameters in which torques are not linear, or measurements that
        the mechanism cannot follow.
    """
    mechanism = mechanism if isinstance(mechanism, Mechanism) else load(mechanism)
    records = [
        Record(x.source, x.t, x.values, {**(noise or {}), **x.noise}, x.delay, for_validation)
        for group, for_validation in ((data, False), (validation, True))
        for x in (read_record(part, mechanism) for part in _as_list(group))
    ]
    return _identify(mechanism, records, parameters, physical=physical, robust=robust)


def identify_file(path: str | Path) -> Identification:
    """Run the identification that a file describes (InputError)."""
    spec, _ = read_identify(path)
    mechanism, records = load_task(spec, Path(path).parent)
    estimate = spec.estimate
    return _identify(mechanism, records, estimate.parameters, physical=estimate.physical, robust=estimate.robust)


def load_task(spec: IdentifySpec, folder: Path) -> tuple[Mechanism, list[Record]]:
    """Load the mechanism and the records that a file names (InputError)."""
    name = folder / spec.mechanism if is_path(spec.mechanism) else spec.mechanism
    overrides = {key: tuple(x) if isinstance(x, list) else x for key, x in spec.parameters.items()}
    mechanism = load(name, overrides or None)  # type: ignore[arg-type]
    return mechanism, [read_record(entry.file, mechanism, entry, folder) for entry in spec.data]


def _as_list(data: Any) -> list[Any]:
    return list(data) if isinstance(data, list | tuple) else [data]


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
    fits : mapping of str to SplineFit
        By measured coordinate.
    """

    record: Record
    motion: MeasuredMotion
    columns: Array
    right: Array
    to_motors: Array
    tau: Array
    fits: Mapping[str, SplineFit]


def _identify(
    mechanism: Mechanism, records: Sequence[Record], parameters: Sequence[str], *, physical: bool, robust: bool
) -> Identification:
    regressor = TorqueRegressor(mechanism, parameters)
    warnings: list[str] = []
    with one_blas_thread(with_scipy=True):
        records = [_with_delay(mechanism, regressor, record, warnings) for record in records]
        equations = [_equations(mechanism, regressor, record, warnings) for record in records]
        fitted = [x for x in equations if not x.record.validation]
        if not fitted:
            raise InputError("identify: data: every record is for validation; at least one has to be fitted")
        columns, right = (np.concatenate([getattr(x, key) for x in fitted]) for key in ("columns", "right"))
        if right.size < columns.shape[2]:
            raise InputError(
                f"identify: {right.size} equations for {columns.shape[2]} unknowns; record a longer motion or estimate "
                "less"
            )
        fit = fit_linear(columns, right, robust=robust)
        parts = np.split(fit.influence, np.cumsum([len(x.right) for x in fitted])[:-1])
        fit = fit.with_errors(
            [e for x, part in zip(fitted, parts, strict=True) for e in _motion_errors(mechanism, x, part)]
        )
        step = fit.x
        if physical:
            step = _physical_step(regressor, fit)
    return _result(mechanism, regressor, equations, fit, step, physical, warnings)


def _equations(
    mechanism: Mechanism,
    regressor: TorqueRegressor,
    record: Record,
    warnings: list[str],
    max_instants: int = MAX_INSTANTS,
) -> _Equations:
    """Estimate the motion of a record, and set up its equations."""
    names = [name for name in mechanism.coordinates if name in record.values]
    torques = [f"tau.{motor}" for motor in mechanism.motors.names]
    missing = [name for name in torques if name not in record.values]
    if len(names) < mechanism.d or missing:
        required = missing or list(mechanism.independent)
        raise InputError(
            f"identify: {record.source}: no column {', '.join(required)}; {mechanism.d} coordinates and the torque of "
            f"every motor are needed, there are {', '.join(record.values) or 'none'}"
        )
    _require_radians(mechanism, record, names)
    fits = {name: fit_spline(record.times(name), record.values[name], record.noise.get(name)) for name in names}
    tau = np.array([record.values[name] for name in torques]).T.reshape(-1, len(torques))
    times = record.times(torques[0]) if torques else record.t
    used = np.all(np.isfinite(tau), axis=1)
    limit = mechanism.motors.torque_limit
    saturated = np.any((tau <= SATURATED * limit[0]) | (tau >= SATURATED * limit[1]), axis=1) & used
    if saturated.sum() > MAX_SATURATED * used.sum():
        raise InputError(
            f"identify: {record.source}: a motor is at its torque limit most of the time; record a slower motion"
        )
    if saturated.any():
        warnings.append(f"{record.source}: {saturated.sum()} instants with a motor at its torque limit are left out")
    at = np.flatnonzero(used & ~saturated)
    at = at[:: max(1, -(-len(at) // max_instants))]
    first, last = max(record.times(name)[0] for name in names), min(record.times(name)[-1] for name in names)
    motion, _ = estimate_motion(mechanism, np.array([first, last]), fits, times[at])
    tau = tau[at][np.isin(times[at], motion.t)]
    columns, force = regressor.rows(motion)
    to_forces = np.einsum("knd,mn->kdm", motion.rho, mechanism.motors.transmission)
    right = np.einsum("kdm,km->kd", to_forces, tau) - force
    return _Equations(record, motion, columns * regressor.scale, right, np.linalg.pinv(to_forces), tau, fits)


def _with_delay(mechanism: Mechanism, regressor: TorqueRegressor, record: Record, warnings: list[str]) -> Record:
    """Return the record with the delay of its torques that leaves the smallest residual, if it is to be estimated."""
    from scipy.optimize import minimize_scalar

    torques = [f"tau.{motor}" for motor in mechanism.motors.names]
    if not any(isinstance(record.delay.get(name), str) for name in torques):
        return record

    def delayed(delay: float) -> Record:
        return replace(record, delay={**record.delay, **dict.fromkeys(torques, delay)})

    def residual(delay: float) -> float:
        equations = _equations(mechanism, regressor, delayed(delay), [], MAX_DELAY_INSTANTS)
        off = fit_linear(equations.columns, equations.right).residual
        return float(np.log(np.mean(off**2, axis=0) + 1e-300).sum())

    grid = np.linspace(-MAX_DELAY, MAX_DELAY, DELAY_GRID)
    best = grid[int(np.argmin([residual(delay) for delay in grid]))]
    step = grid[1] - grid[0]
    minimum = minimize_scalar(residual, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-6})
    warnings.append(f"{record.source}: the torques are {1e3 * minimum.x:.4g} ms late, estimated from their residuals")
    return delayed(float(minimum.x))


def _motion_errors(mechanism: Mechanism, equations: _Equations, influence: Array) -> list[Array]:
    """Return the steps of the solution (r, any) that errors of the accelerations cause, of unit variance each.

    They are correlated over a knot interval and too small beside the noise of torques to show in the residuals. The
    inertia that turns them into torques is that of the start values.
    """
    motion = equations.motion
    at = mechanism.tree.indices(tuple(equations.fits), "identify")
    D_tree = np.array([mechanism.tree.mass_matrix(q) for q in motion.q_tree])
    by_coordinate = D_tree @ motion.rho @ np.linalg.pinv(motion.rho[:, at])
    steps = influence @ (motion.rho.swapaxes(1, 2) @ by_coordinate)  # (m, r, coordinates)
    return [fit.acceleration_errors(motion.t, steps[:, :, k]) for k, fit in enumerate(equations.fits.values())]


def _require_radians(mechanism: Mechanism, record: Record, names: Sequence[str]) -> None:
    """Refuse readings of hinges that are degrees by their size."""
    lower, upper = mechanism.tree.limits()
    for name in names:
        k = mechanism.tree.index[name]
        x = record.values[name]
        largest = float(np.nanmax(np.abs(x), initial=0.0))
        bound = max(abs(lower[k]), abs(upper[k]))
        if not mechanism.tree.in_metres[k] and largest > (1.5 * bound if np.isfinite(bound) else 50.0):
            raise InputError(
                f"identify: {record.source}: {name} reaches {largest:.4g} rad; if these are degrees, give "
                f'units = {{{name} = "deg"}}'
            )


def _physical_step(regressor: TorqueRegressor, fit: LinearFit) -> Array:
    """Return steps of all unknowns to inertias that some body can have."""
    names = [unknown.name for unknown in regressor.unknowns]
    bodies = [np.array([names.index(f"link.{link}.{number}") for number in MOMENTS]) for link in regressor.links]
    in_bodies = {int(k) for at in bodies for k in at}
    positive = [k for k, name in enumerate(names) if k not in in_bodies and not name.endswith((".offset", ".value"))]
    return nearest_physical(
        fit.x,
        fit.determined,
        fit.information,
        regressor.start,
        regressor.scale,
        bodies,
        np.array(positive, dtype=np.intp),
    )  # fmt: skip


def _result(
    mechanism: Mechanism, regressor: TorqueRegressor, equations: Sequence[_Equations], fit: LinearFit, step: Array,
    physical: bool, warnings: list[str],
) -> Identification:  # fmt: skip
    names, scale = [unknown.name for unknown in regressor.unknowns], regressor.scale
    unknowns = regressor.start + scale * step
    covariance = fit.covariance * np.outer(scale, scale)
    determined = fit.determined
    estimates: dict[str, Estimate] = {}
    values: dict[str, float] = {}
    slopes: list[Array] = []
    for name, value, start, gradient in _parameters(regressor, unknowns):
        inside = determined @ (determined.T @ (gradient * scale))
        outside = np.linalg.norm(gradient * scale - inside)
        whole = max(float(np.linalg.norm(gradient * scale)), 1e-300)
        values[name] = value
        if outside <= LEAK_TOLERANCE * whole:
            std = max(float(gradient @ covariance @ gradient), 0.0) ** 0.5
            estimates[name] = Estimate(value, std, start, IDENTIFIED)
            slopes.append(gradient)
        else:
            verdict = IN_COMBINATION if np.linalg.norm(inside) > LEAK_TOLERANCE * whole else NOT_IDENTIFIABLE
            estimates[name] = Estimate(None, None, start, verdict)
    gradients = np.reshape(slopes, (len(slopes), len(names)))
    residuals = _residuals([x for x in equations if not x.record.validation], mechanism.motors.names, step, fit)
    validation = _residuals([x for x in equations if x.record.validation], mechanism.motors.names, step, fit)
    motions = tuple(
        Prediction(x.record.source, x.record.validation, x.motion.t, x.tau, x.tau - _torque_residual(x, step))
        for x in equations
    )
    is_physical = all(
        np.linalg.eigvalsh(pseudo_inertia(unknowns[[names.index(f"link.{link}.{k}") for k in MOMENTS]]))[0] > 0
        for link in regressor.links
    )
    return Identification(
        mechanism, estimates, _combinations(names, fit, step, regressor), fit.condition, residuals, validation,
        is_physical, values if physical else {}, gradients @ covariance @ gradients.T,
        sum(len(x.right) for x in equations if not x.record.validation),
        tuple(warnings), motions,
    )  # fmt: skip


def _parameters(regressor: TorqueRegressor, unknowns: Array) -> list[tuple[str, float, float, Array]]:
    """Return name, value, start value and gradient by the unknowns of each parameter."""
    names = [unknown.name for unknown in regressor.unknowns]
    parameters = []
    in_links: set[int] = set()
    for link in regressor.links:
        at = np.array([names.index(f"link.{link}.{number}") for number in MOMENTS])
        in_links.update(at.tolist())
        axes = link_inertial_axes(regressor.mechanism, link)
        values, start = (_link_values(x[at], axes) for x in (unknowns, regressor.start))
        for k, name in enumerate(LINK_VALUES):
            gradient = np.zeros(len(names))
            for i, j in enumerate(at):
                moved = unknowns[at].astype(complex)
                moved[i] += 1e-200j
                gradient[j] = _link_values(moved, axes)[k].imag / 1e-200
            parameters.append((f"link.{link}.{name}", float(values[k]), float(start[k]), gradient))
    for k, name in enumerate(names):
        if k not in in_links:
            unit = np.eye(len(names))[k]
            parameters.append((name, float(unknowns[k]), float(regressor.start[k]), unit))
    return parameters


def _link_values(moments: Any, axes: Array) -> Any:
    """Return mass, centre of mass and inertia about it, in the axes of the file, of ten inertial numbers."""
    mass, moment = moments[0], moments[1:4]
    xx, xy, yy, xz, yz, zz = moments[4:]
    centre = moment / (mass if mass != 0 else 1.0)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    inertia = inertia - mass * ((centre @ centre) * np.eye(3) - np.outer(centre, centre))
    inertia = axes.T @ inertia @ axes
    return np.array([mass, *centre, *(inertia[at] for at in INERTIA_ENTRIES.values())])


def _combinations(
    names: Sequence[str], fit: LinearFit, step: Array, regressor: TorqueRegressor
) -> tuple[Combination, ...]:
    chosen, coefficients = fit.combinations()
    scale, combinations = regressor.scale, []
    for k, row in zip(chosen, coefficients, strict=True):
        factors = row / scale * scale[k]  # in SI units, 1 for the chosen unknown
        std = float(np.sqrt(row @ fit.covariance @ row)) * scale[k]
        terms = [int(k), *(int(i) for i in np.flatnonzero(factors) if i != k)]
        text = " ".join(_term(float(factors[i]), names[i], first=not number) for number, i in enumerate(terms))
        value = float(factors @ (regressor.start + scale * step))
        combinations.append(Combination(text, {names[i]: float(factors[i]) for i in terms}, value, std))
    return tuple(combinations)


def _term(coefficient: float, name: str, *, first: bool) -> str:
    sign = "-" if coefficient < 0 else "" if first else "+"
    size = "" if abs(abs(coefficient) - 1) < 1e-9 else f"{abs(coefficient):.6g} "
    return f"{sign}{'' if first or not sign else ' '}{size}{name}"


def _torque_residual(equations: _Equations, step: Array) -> Array:
    """Return measured less predicted motor torques, shape (m, motors)."""
    return np.einsum("kmd,kd->km", equations.to_motors, equations.right - equations.columns @ step)


def _residuals(
    equations: Sequence[_Equations], motors: Sequence[str], step: Array, fit: LinearFit
) -> dict[str, Residual]:
    residuals = {}
    for k, name in enumerate(f"tau.{motor}" for motor in (motors if equations else ())):
        parts = [_torque_residual(x, step)[:, k] for x in equations]
        power = float(sum(np.sum(x**2) for x in parts))
        neighbours = float(sum(np.sum(x[1:] * x[:-1]) for x in parts))
        count = sum(map(len, parts))
        variances = [_expected_variance(x, k, name, fit) for x in equations]
        expected = np.sqrt(sum(len(x) * variance for x, variance in zip(parts, variances, strict=True)) / count)
        correlation = neighbours / power if power > 0 else 0.0
        residuals[name] = Residual(float(np.sqrt(power / count)), float(expected), correlation)
    return residuals


def _expected_variance(equations: _Equations, k: int, name: str, fit: LinearFit) -> float:
    """Return the variance of a motor's torque residual: as given, or as the fit estimated it."""
    std = equations.record.noise.get(name)
    if std is not None:
        return std**2
    to_motor = equations.to_motors[:, k]
    return float(np.mean(np.einsum("kd,de,ke->k", to_motor, fit.noise, to_motor)))


def _describe(name: str, estimate: Estimate) -> str:
    if estimate.value is None or estimate.std is None:
        return name
    return f"{name} = {estimate.value:.5g} ± {estimate.std:.2g}"
