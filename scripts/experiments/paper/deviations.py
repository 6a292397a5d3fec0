"""Section III-C, "the more exact reduced model periodically sees some deviations": sources of tracking deviations.

With w(0) = 0 the SPF and the reduced model are the same system, and its error q - q_d decays with e^-t. So any
deviation is numerical. Three sources are measured:

- a loose tolerance of the integrator;
- a sigma that is solved loosely, with the same z in plant and controller;
- a controller that solves its own sigma loosely, from its last solution, while the plant's z is accurate.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import newton
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.ivp import Force, Ivp, LevelSet
from ckc_pin.scene.scene import load_scene
from scripts.experiments.paper.experiment import Problem, between, march

__all__ = ["PERIOD", "Deviation", "FromLast", "OwnSigma", "Setting", "Track", "deviation", "instants", "track"]

PERIOD = 2 * np.pi  # s, period of eq. 21
SAMPLES = 128  # per period
SETTLED = 1  # number of periods after which the start has no influence


class FromLast:
    """Solve sigma from its solution at the last accepted step, to a given tolerance.

    Parameters
    ----------
    mechanism : Mechanism
    start : Kinematics
    tolerance : float
        Largest |phi| that counts as closed, m.
    """

    def __init__(self, mechanism: Mechanism, start: Kinematics, tolerance: float) -> None:
        self._mechanism, self._last, self._tolerance = mechanism, start, tolerance

    def at(self, q: Array) -> Kinematics:
        """Return the configuration at q, shape (d,)."""
        step = np.zeros(self._mechanism.n)
        step[self._last.partition.q] = q - self._mechanism.independent_part(self._last.q_tree)
        return newton(self._last.integrate(step), 0.0, self._tolerance).at

    def accept_step(self, q: Array) -> Kinematics:
        """Return the configuration at the q of an accepted step and make it the next initial guess."""
        self._last = self.at(q)
        return self._last


class OwnSigma:
    """Force of a controller that solves z by its own sigma."""

    def __init__(self, force: Force, sigma: FromLast) -> None:
        self.force, self.sigma = force, sigma

    def __call__(self, t: float, terms: Terms) -> Array:
        """Return u' with the controller's z."""
        at = self.sigma.at(terms.q)
        return self.force(t, Terms(terms.mechanism, at, at.rho @ terms.q_dot))


@dataclass
class Loose(LevelSet):
    """The reduced model with z solved by `FromLast`, in plant and controller."""

    sigma: FromLast = field(kw_only=True)

    def close(self, t: float, numbers: Array) -> Kinematics:
        return self.sigma.at(numbers)


@dataclass(frozen=True)
class Setting:
    """Integrator and solution of sigma in a tracking run.

    Attributes
    ----------
    model : "reduced" or "eq. 8"
    method : str
        A class of `scipy.integrate`.
    rtol : float
    tolerance : float or None
        Tolerance of `FromLast` for the reduced model's sigma, m.
    controller_tolerance : float or None
        Tolerance of `FromLast` for the controller's own sigma, m.
    """

    model: Literal["reduced", "eq. 8"]
    method: str
    rtol: float
    tolerance: float | None = None
    controller_tolerance: float | None = None


@dataclass(frozen=True)
class Track:
    """A run, sampled at given times.

    Attributes
    ----------
    q : (m, d) array
        rad or m.
    open : float
        Largest |phi| of the plant's z and of the controller's own z, m.
    """

    q: Array
    open: float


def track(scene: str, setting: Setting, times: Array) -> Track:
    """Run a scene with a controller and return its q at increasing times from 0.

    Raises
    ------
    NumericalError
        The run stops before the last time.
    """
    loaded = load_scene(scene)
    if loaded.spec.controller is None:
        raise InputError(f"{loaded.name}: a scene with a controller is needed")
    problem, sigma = Problem.of_scene(loaded), None
    if setting.controller_tolerance is not None:
        sigma = FromLast(problem.mechanism, problem.at, setting.controller_tolerance)
        problem = replace(problem, force=OwnSigma(problem.force, sigma))
    ivp: Ivp = problem.reduced() if setting.model == "reduced" else problem.printed_spf(loaded.spec.epsilon)
    if setting.tolerance is not None:
        sigma = FromLast(problem.mechanism, problem.at, setting.tolerance)
        ivp = Loose(problem.mechanism, problem.at, problem.q_dot, problem.force, ivp.t_span, sigma=sigma)
    first = ivp.terms(0.0, ivp.y0)
    q, opened = [first.q], [first.phi]

    def note(solver: Any) -> None:
        for t, y in between(solver, times):
            at = ivp.terms(t, y)
            q.append(at.q)
            opened.append(at.phi)
        if sigma is not None:
            opened.append(sigma.accept_step(ivp.terms(solver.t, solver.y).q).phi)

    outcome = march(ivp, setting.method, setting.rtol, float(times[-1]), on_step=note)
    if outcome.stopped:
        raise NumericalError(outcome.stopped)
    return Track(np.array(q), float(np.abs(opened).max()))


@dataclass(frozen=True)
class Deviation:
    """Difference of a run from the exact one, and whether it repeats with the desired trajectory's period.

    Attributes
    ----------
    size : (m,) array
        Largest |q - q_exact| of the coordinates, rad or m, at SAMPLES instants per period.
    largest : float
        Largest size after the first period.
    repeats : float
        Share of the variance over time that is common to all periods: near 1 for a periodic deviation, about
        1 / (number of periods) for an irregular one.
    period : float
        Period of the strongest Fourier component, s.
    open : float
        Largest |phi|, m.
    """

    size: Array
    largest: float
    repeats: float
    period: float
    open: float


def deviation(run: Track, exact: Track) -> Deviation:
    """Compare a run with the exact one, both at `instants`."""
    size = np.abs(run.q - exact.q).max(axis=1)
    settled = size[SETTLED * SAMPLES : -1]
    periods = settled.reshape(-1, SAMPLES)
    strength = np.abs(np.fft.rfft((settled - settled.mean()) * np.hanning(len(settled))))
    strongest = 1 + int(np.argmax(strength[1:]))
    return Deviation(
        size=size,
        largest=float(settled.max()),
        repeats=float(periods.mean(axis=0).var() / settled.var()),
        period=PERIOD * len(periods) / strongest,
        open=run.open,
    )


def instants(periods: int) -> Array:
    """Return the instants of at least two whole periods from 0, SAMPLES per period and the last end, s."""
    return np.linspace(0.0, periods * PERIOD, periods * SAMPLES + 1)
