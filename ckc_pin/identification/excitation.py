"""Motions that make parameters known: the best periodic motion of a mechanism within limits, beside random ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.tables import to_csv_text, to_data_frame
from ckc_pin.base.validation import is_number, match_names, require_table
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.identification.excitation_problem import (
    Criterion,
    ExcitationProblem,
    Instants,
    Limits,
    fourier,
    singular_values,
)
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.columns import list_quantities
from ckc_pin.scene.scene import Scene

if TYPE_CHECKING:
    import pandas

    from ckc_pin.view.inline import Figures

__all__ = ["Excitation", "excite"]

DEFAULT_RANGE = 1.0  # rad or sizes of the mechanism, to both sides of the start, of coordinates without limits
ACTIVE = 0.02  # of a limit: a quantity that comes closer makes it active
MAX_BASIS_MOTIONS = 10  # random motions that tell which directions of the unknowns can be determined
MAX_RUN_IN_DOUBLINGS = 4
MAX_SAMPLES = 1_000_000  # of a table
GAIN = 10.0  # bandwidth of the scene's controller, in units of the highest frequency


@dataclass(frozen=True)
class RandomMotions:
    """Random motions within the same limits, each with the largest amplitude that they allow.

    Attributes
    ----------
    count : int
        Drawn.
    feasible : int
        Of these, motions within the limits.
    condition, log_det : pair of float
        The best of them and their median.
    """

    count: int
    feasible: int
    condition: tuple[float, float]
    log_det: tuple[float, float]


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(HasSummary):
    """A periodic motion of the independent coordinates that makes parameters known.

    Attributes
    ----------
    mechanism : Mechanism
    parameters : tuple of str
        Names as given.
    period : float
        s.
    coefficients : (d, 1 + 2 harmonics) array
        Offset, sines and cosines of each independent coordinate, rad or m.
    condition : float
        Condition number of the regressor in the directions of the base parameters. Its columns are in typical sizes of
        the unknowns, its rows in standard deviations of the torques.
    log_det : float
        Logarithm of the determinant of the information in these directions, by instant.
    rank, unknowns : int
        Number of base parameters, and of unknowns.
    random : RandomMotions
    limits : Limits
    extremes : (2, k) array
        Smallest and largest value of each quantity of `limits`.
    active : tuple of str
        Quantities that reach their limits.
    margin : float
        Smallest singular value of phi_z and of the motors' transmission to the freedoms, relative to the assembled
        configuration.
    run_in : float
        Time from rest to the full speed along the motion, s.
    warnings : tuple of str
    """

    mechanism: Mechanism
    parameters: tuple[str, ...]
    period: float
    coefficients: Array
    condition: float
    log_det: float
    rank: int
    unknowns: int
    random: RandomMotions
    limits: Limits
    extremes: Array
    active: tuple[str, ...]
    margin: float
    run_in: float
    warnings: tuple[str, ...]
    _problem: ExcitationProblem
    _q_tree: Array  # on a grid over the period

    @property
    def harmonics(self) -> dict[str, dict[str, Any]]:
        """By independent coordinate, offset and ``[amplitude, frequency, phase]``, as in ``[controller.desired]``."""
        count = (self.coefficients.shape[1] - 1) // 2
        w = 2 * np.pi / self.period * np.arange(1, count + 1)
        desired: dict[str, dict[str, Any]] = {}
        for name, x in zip(self.mechanism.independent, self.coefficients, strict=True):
            sine, cosine = x[1 : 1 + count], x[1 + count :]
            waves = np.array([np.hypot(sine, cosine), w, np.arctan2(cosine, sine)]).T
            desired[name] = {"offset": float(x[0]), "harmonics": waves.tolist()}
        return desired

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations (m, d) of the independent coordinates at times t.

        The run-in starts at rest at t = 0 and goes along the motion, slowly at first; the period follows.
        """
        u = np.clip(t / self.run_in, 0.0, 1.0)
        speed, change = u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2 / self.run_in
        waves = fourier(self._phase(t), self.period, (self.coefficients.shape[1] - 1) // 2)
        q, v, a = np.einsum("smc,dc->smd", waves, self.coefficients)
        return q, v * speed[:, None], a * speed[:, None] ** 2 + v * change[:, None]

    def _phase(self, t: Array) -> Array:
        """Return the times of the periodic motion whose configurations are passed at times t, zero after the run-in."""
        u = np.clip(t / self.run_in, 0.0, 1.0)
        return self.run_in * (u**4 * (2.5 - 3 * u + u**2) - 0.5) + np.maximum(t - self.run_in, 0.0)

    def quantities(self, t: Array) -> dict[str, Array]:
        """Return coordinates, rates, accelerations and motor torques by name at times t, of run-in and motion."""
        columns = dict(zip(self.limits.names, self._instants(t).quantities.T, strict=True))
        return {name: x for name, x in columns.items() if not name.startswith(("speed.", "sigma_min"))}

    def _instants(self, t: Array) -> Instants:
        count = len(self._q_tree)
        nearest = self._q_tree[np.round(self._phase(t) / self.period * count).astype(int) % count]
        q, v, a = self.motion(t)
        with one_blas_thread():
            return self._problem.instants(self._problem.follow(nearest, q), q, v, a, smooth=False)

    def scene(self, *, output_dt: float = 0.01) -> Scene:
        """Return a scene that tracks the periodic motion for one period, from a start on it."""
        mechanism = self.mechanism
        at = mechanism.kinematics(self._q_tree[0])
        inertia = np.diag(Terms(mechanism, at, np.zeros(mechanism.n)).D)
        bandwidth = GAIN * np.pi * (self.coefficients.shape[1] - 1) / self.period
        _, rates, _ = self.motion(np.array([self.run_in]))
        return Scene(
            mechanism, t_end=self.period, solver={"output_dt": output_dt}, name=f"{mechanism.name}, excitation",
            initial={"q": mechanism.tree.to_coordinates(at.q_tree), "q_dot": rates[0]},
            controller={"type": "tracking", "Lambda": bandwidth, "desired": self.harmonics,
                        "K_D": dict(zip(mechanism.independent, (bandwidth * inertia).tolist(), strict=True))},
        )  # fmt: skip

    def sample_times(self, rate: float = 100.0) -> Array:
        """Return the instants of run-in and one period at a rate, 1/s (InputError)."""
        duration = self.run_in + self.period
        if not (is_number(rate) and 0 < rate * duration < MAX_SAMPLES):
            raise InputError(
                f"excite: rate: expected a number above 0 and below {MAX_SAMPLES / duration:g} 1/s, got {rate}"
            )
        return np.arange(int(duration * rate * (1 + 1e-12)) + 1) / rate

    def to_csv(self, path: str | Path, rate: float = 100.0) -> Path:
        """Write t and the `quantities` of run-in and one period for a robot, at a rate in 1/s (InputError)."""
        t = self.sample_times(rate)
        write_atomic(Path(path), to_csv_text("t", t, self.quantities(t)))
        return Path(path)

    def to_pandas(self, rate: float = 100.0) -> pandas.DataFrame:
        """Return the table of `to_csv` (needs the extra `data`)."""
        t = self.sample_times(rate)
        return to_data_frame("t", t, self.quantities(t))

    def plot(self) -> Figures:
        """Draw motion and motor torques with their limits. A notebook shows the figure and `save(folder)` writes it."""
        import ckc_pin

        return ckc_pin.plot(self)

    def save(self, folder: str | Path, rate: float = 100.0, *, overwrite: bool = False) -> list[Path]:
        """Write excite.scene.toml with its mechanism, and excite.csv, into a folder (InputError)."""
        t = self.sample_times(rate)
        scene = self.scene(output_dt=float(t[1])).save(folder, "excite", overwrite=overwrite)
        return [scene, self.to_csv(Path(folder) / "excite.csv", rate)]

    def summary(self) -> Summary:
        """Return condition number beside that of random motions, coefficients, largest values and active limits."""
        random, units = self.random, list_quantities(self.mechanism)
        largest = [f"{name} {size:.4g} {units[name].unit}" for name, size in self.largest().items()]
        rows: list[Row] = [
            ("base", f"{self.rank} combinations of {self.unknowns} unknowns"),
            ("condition", f"{self.condition:.4g}; random motions: best {random.condition[0]:.4g}, "
             f"median {random.condition[1]:.4g}"),
            ("log det", f"{self.log_det:.4g}; random motions: best {random.log_det[0]:.4g}, "
             f"median {random.log_det[1]:.4g}"),
            ("random motions", f"{random.feasible} of {random.count} within the limits"),
            ("largest", largest),
            ("active limits", list(self.active) or "none"),
            ("sigma_min", f"at least {self.margin:.3g} of the start's"),
            ("run-in", f"{self.run_in:g} s from rest"),
        ]  # fmt: skip
        for name, wave in self.harmonics.items():
            sizes = "  ".join(f"{amplitude:.4g}" for amplitude, _, _ in wave["harmonics"])
            rows.append((name, f"{wave['offset']:.4g} {units[name].unit}, amplitudes {sizes}"))
        rows += [("warning", warning) for warning in self.warnings]
        return Summary(f"Excitation of {self.mechanism.name}, period {self.period:g} s", rows)

    def largest(self) -> dict[str, float]:
        """Return the largest size of rates and accelerations of the independent coordinates and of motor torques."""
        shown = [f"{order}{name}" for order in ("v.", "a.") for name in self.mechanism.independent]
        shown += [f"tau.{name}" for name in self.mechanism.motors.names]
        sizes = dict(zip(self.limits.names, np.abs(self.extremes).max(axis=0).tolist(), strict=True))
        return {name: sizes[name] for name in shown}

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON-ready data."""
        limits = {
            name: {"lower": lower, "upper": upper, "smallest": smallest, "largest": largest}
            for name, lower, upper, smallest, largest, used in zip(
                self.limits.names, self.limits.lower.tolist(), self.limits.upper.tolist(), *self.extremes.tolist(),
                self.limits.used.tolist(), strict=True,
            ) if used
        }  # fmt: skip
        random = self.random
        return {
            "name": self.mechanism.name,
            "parameters": list(self.parameters),
            "period": self.period,
            "condition": self.condition,
            "log_det": self.log_det,
            "rank": self.rank,
            "unknowns": self.unknowns,
            "random": {
                "count": random.count,
                "feasible": random.feasible,
                "condition": {"best": random.condition[0], "median": random.condition[1]},
                "log_det": {"best": random.log_det[0], "median": random.log_det[1]},
            },
            "motion": self.harmonics,
            "largest": self.largest(),
            "limits": limits,
            "active": list(self.active),
            "margin": self.margin,
            "run_in": self.run_in,
            "warnings": list(self.warnings),
        }


def excite(
    mechanism: Mechanism | str | Path,
    parameters: Sequence[str] = ("link.*.inertial",),
    *,
    period: float = 10.0,
    harmonics: int = 5,
    limits: Mapping[str, float | Sequence[float]] | None = None,
    margin: float = 0.3,
    criterion: Criterion = "condition",
    noise: Mapping[str, float] | None = None,
    random: int = 50,
    iterations: int = 30,
    seed: int = 0,
    progress: Callable[[float, float], None] | None = None,
) -> Excitation:
    """Find a periodic motion of the independent coordinates that makes parameters best known.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
        Its parameters are the start values, by which torques are computed.
    parameters : sequence of str
        As for `identify`, with wildcards: ``["link.*.inertial", "joint.*.damping"]``.
    period : float
        s.
    harmonics : int
        Number of waves of each coordinate: the frequencies are multiples of 1 / period.
    limits : mapping, optional
        By quantity, with wildcards: ``{"theta_1": [-2.0, -1.0], "v.*": 3.0, "a.*": 20.0, "tau.*": 5.0}``. A number is a
        limit of the size. They add to joint limits, and to the motors' limits of torque and speed. Independent
        coordinates without limits stay within 1 rad, or the mechanism's size, of the assembled configuration.
    margin : float
        Smallest singular values of phi_z, and of the motors' transmission to the freedoms, relative to the assembled
        configuration.
    criterion : "condition" or "log_det"
        Make the condition number small, or the determinant of the information large.
    noise : mapping, optional
        Standard deviations of measured torques by ``tau.MOTOR``; default: equal ones.
    random : int
        Random motions to start from and to compare with.
    iterations : int
        Of the optimizer, at each of two sharpnesses of the smoothed criterion.
    seed : int
        Of the random motions.
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    InputError, MechanismError
        Unknown names, nothing to identify, too few motors, or limits that no motion fulfils.

    Notes
    -----
    Sequential quadratic programming (SciPy's SLSQP) from the best random motion. The limits hold on a grid of
    80 instants for each harmonic, five times finer than the one that is optimized.
    """
    mechanism = as_mechanism(mechanism, "excite")
    mechanism.refuse_prescribed_joints("excite")
    _require_driven(mechanism)
    _require_numbers(period, harmonics, margin, criterion, random, iterations, seed)
    require_table(limits or {}, "excite: limits", 'a table by quantity, as {"tau.*": 5.0}')
    require_table(noise or {}, "excite: noise", 'a table by motor, as {"tau.theta_1": 0.1}')
    parameters = (parameters,) if isinstance(parameters, str) else parameters
    try:
        regressor = TorqueRegressor(mechanism, parameters)
    except InputError as error:
        raise InputError(str(error).replace("identify:", "excite:", 1)) from None
    if not regressor.unknowns:
        raise InputError('excite: parameters: nothing to identify; give names, such as "link.*.inertial"')
    bounds = _make_limits(mechanism, limits or {}, margin)
    problem = ExcitationProblem(regressor, float(period), harmonics, bounds, _noise(mechanism, noise or {}), criterion)
    with one_blas_thread():
        return _search(problem, tuple(parameters), random, iterations, seed, progress or (lambda done, total: None))


def _search(
    problem: ExcitationProblem, parameters: tuple[str, ...], count: int, iterations: int, seed: int,
    progress: Callable[[float, float], None],
) -> Excitation:  # fmt: skip
    rng, limits, total = np.random.default_rng(seed), problem.limits, count + 2 * iterations
    waiting, values = list[tuple[Array, Instants]](), list[tuple[float, float]]()
    best: tuple[float, Array, Instants] | None = None
    closest = np.full(len(limits.names), np.inf)
    for k in range(count):
        motions, violation = problem.random_motion(rng)
        waiting += motions
        closest = violation if violation.max() < closest.max() else closest
        if waiting and (values or len(waiting) == MAX_BASIS_MOTIONS or k == count - 1):
            if not values:
                problem.set_basis([instants.regressor for _, instants in waiting])
                if not problem.basis.shape[1]:
                    names = ", ".join(parameters)
                    raise InputError(f"excite: parameters: nothing to identify; no motion shows {names} in the torques")
            values += [problem.values(instants.regressor) for _, instants in waiting]
            ranked = [(problem.score(instants.regressor), x, instants) for x, instants in waiting]
            best = min(ranked if best is None else [best, *ranked], key=lambda entry: entry[0])
            waiting.clear()
        progress(k + 1, total)
    if best is None:
        excess = zip(limits.names, closest * limits.scale, strict=True)
        exceeded = ", ".join(f"{name} by {x:.3g}" for name, x in excess if x > 0)
        which = f"the closest one exceeds {exceeded}" if np.isfinite(closest.max()) else "the loops do not close"
        raise InputError(f"excite: limits: none of {count} random motions is within them; {which}")
    score, x, start = best
    condition, log_det = np.array(values).T
    done = iter(range(count, 10**9))
    x, fine = problem.optimize(x, start, iterations, lambda: progress(min(next(done) + 1, total), total))
    is_better = problem.score(fine.regressor) < score
    stuck = () if is_better else ("the search found nothing better than a random motion",)
    return _result(problem, parameters, x, fine, stuck, RandomMotions(
        count, len(values), (float(condition.min()), float(np.median(condition))),
        (float(log_det.max()), float(np.median(log_det)))))  # fmt: skip


def _result(
    problem: ExcitationProblem, parameters: tuple[str, ...], x: Array, fine: Instants, warnings: tuple[str, ...],
    random: RandomMotions,
) -> Excitation:  # fmt: skip
    limits, mechanism = problem.limits, problem.mechanism
    worst = limits.worst(fine.quantities)
    active = tuple(name for name, over in zip(limits.names, worst, strict=True) if over > -ACTIVE)
    condition, log_det = problem.values(fine.regressor)
    extremes = np.array([fine.quantities.min(axis=0), fine.quantities.max(axis=0)])
    relative = fine.quantities[:, -2:].min(axis=0) / limits.scale[-2:]
    result = Excitation(
        mechanism, parameters, problem.period, x, condition, log_det, problem.basis.shape[1],
        len(problem.regressor.unknowns), random, limits, extremes, active, float(relative.min()), problem.period,
        warnings, problem, fine.motion.q_tree,
    )  # fmt: skip
    for k in range(MAX_RUN_IN_DOUBLINGS):
        run_in = problem.period * 2**k
        result = replace(result, run_in=run_in)
        t = np.arange(0.0, run_in, problem.period / len(fine.quantities))
        worst = limits.worst(result._instants(t).quantities)
        if worst.max() <= 0:
            return result
    exceeded = ", ".join(name for name, over in zip(limits.names, worst, strict=True) if over > 0)
    message = f"the run-in of {run_in:g} s exceeds the limits of {exceeded}"
    return replace(result, warnings=(*warnings, message))


def _require_driven(mechanism: Mechanism) -> None:
    """Refuse mechanisms whose motors do not determine the motion, and free roots."""
    if not mechanism.d:
        raise InputError(f"excite: {mechanism.name} has no freedoms, so that nothing moves")
    if not mechanism.motors.names:
        raise InputError(f"excite: {mechanism.name} has no motors, whose torques would be measured; add [[motor]]")
    driven = np.linalg.matrix_rank(mechanism.motors.transmission @ mechanism.assembled.rho)
    if driven < mechanism.d:
        raise InputError(
            f"excite: the motors {', '.join(mechanism.motors.names)} drive {driven} of {mechanism.d} freedoms; "
            "no torques follow a prescribed motion"
        )
    of_root = [name for name in mechanism.independent if name in mechanism.tree.free_coordinates]
    if of_root:
        raise InputError(f"excite: {of_root[0]} belongs to a free root; choose independent coordinates of joints")


def _require_numbers(
    period: float, harmonics: int, margin: float, criterion: str, random: int, iterations: int, seed: int
) -> None:
    if not (is_number(period) and np.isfinite(period) and period > 0):
        raise InputError(f"excite: period: expected a number of seconds above zero, got {period!r:.40}")
    if not (is_number(margin) and 0 <= margin < 1):
        raise InputError(f"excite: margin: expected a number from 0 to below 1, got {margin!r:.40}")
    for name, value, lower, upper in (("harmonics", harmonics, 1, 50), ("random", random, 1, 100_000),
                                     ("iterations", iterations, 1, 100_000), ("seed", seed, 0, 2**63 - 1)):  # fmt: skip
        if type(value) is not int or not lower <= value <= upper:
            raise InputError(f"excite: {name}: expected an integer from {lower} to {upper}, got {value!r:.40}")
    if criterion not in get_args(Criterion):
        raise InputError(f"excite: criterion: expected {' or '.join(get_args(Criterion))}, got {criterion!r:.40}")


def _noise(mechanism: Mechanism, noise: Mapping[str, float]) -> Array:
    """Return standard deviations of the motors' torques, 1 if none are given (InputError)."""
    values = {name.removeprefix("tau."): value for name, value in noise.items()}
    std = mechanism.motors.vector(values, "excite: noise", fill=None if noise else 1.0)
    if not np.all((std > 0) & np.isfinite(std)):
        raise InputError(f"excite: noise: expected numbers above zero, got {dict(noise)!r:.80}")
    return std


def _make_limits(mechanism: Mechanism, table: Mapping[str, float | Sequence[float]], margin: float) -> Limits:
    """Return the limits of all quantities: those of joints and motors, given ones, and default ranges (InputError)."""
    coordinates, motors, tree = mechanism.coordinates, mechanism.motors, mechanism.tree
    names = (*coordinates, *(f"v.{x}" for x in coordinates), *(f"a.{x}" for x in coordinates),
             *(f"speed.{x}" for x in motors.names), *(f"tau.{x}" for x in motors.names), "sigma_min.phi_z",
             "sigma_min.motors")  # fmt: skip
    assembled, free = mechanism.assembled, np.full(2 * tree.n, np.inf)
    (singular,), _ = singular_values(mechanism, assembled.q_tree[None], assembled.rho[None])
    low, high = tree.limits()
    lower = np.concatenate([low, -free, -motors.speed_limit, motors.torque_limit[0], margin * singular])
    upper = np.concatenate([high, free, motors.speed_limit, motors.torque_limit[1], [np.inf, np.inf]])
    choices = names[:-2]
    for pattern, limit in table.items():
        where = f"excite: limits: {pattern}"
        matches = [choices.index(name) for name in match_names(pattern, choices, "excite: limits")]
        is_pair = isinstance(limit, Sequence) and len(limit) == 2 and all(map(is_number, limit))
        is_coordinate = matches[0] < len(coordinates)
        if not is_pair and (is_coordinate or not is_number(limit) or limit <= 0):  # type: ignore[operator]
            size = "" if is_coordinate else " or a number above zero"
            raise InputError(f"{where}: expected [lower, upper]{size}, got {limit!r:.40}")
        pair = limit if is_pair else (-limit, limit)  # type: ignore[operator]
        lower[matches] = np.maximum(lower[matches], pair[0])  # type: ignore[index]
        upper[matches] = np.minimum(upper[matches], pair[1])  # type: ignore[index]
    at = mechanism.partition.q
    start, reach = tree.to_coordinates(assembled.q_tree)[at], DEFAULT_RANGE * tree.step_scale[at]
    lower[at] = np.where(np.isfinite(lower[at]), lower[at], np.minimum(start, upper[at]) - reach)
    upper[at] = np.where(np.isfinite(upper[at]), upper[at], np.maximum(start, lower[at]) + reach)
    empty = next((name for name, a, b in zip(names, lower, upper, strict=True) if not a < b), None)
    if empty is not None:
        k = names.index(empty)
        raise InputError(f"excite: limits: {empty}: no value is between {lower[k]:g} and {upper[k]:g}")
    both = np.isfinite(lower) & np.isfinite(upper)
    one = np.where(np.isfinite(upper), np.abs(upper), np.where(np.isfinite(lower), np.abs(lower), 1.0))
    one = np.where(one > 0, one, 1.0)
    scale = np.where(both, (np.where(both, upper, 1.0) - np.where(both, lower, 0.0)) / 2, one)
    scale[-2:] = singular
    return Limits(names, lower, upper, scale)
