"""Section III-C: "the more exact reduced model periodically sees some deviations": what makes a tracking run deviate.

With w(0) = 0 the SPF and the reduced model are the same system, and its error q - q_d falls with e^-t. So a
deviation is numerical. Three ways to one are measured: a loose tolerance of the integrator; a sigma that is solved
loosely, the same z in plant and controller; and a controller that solves sigma loosely by itself, from its last
solution, while the plant has its own z.
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

PERIOD = 2 * np.pi  # s, of eq. 21
SAMPLES = 128  # in a period
SETTLED = 1  # period after which the start is forgotten


class FromLast:
    """sigma solved from its solution at the last accepted step, and only to a tolerance.

    Parameters
    ----------
    mechanism : Mechanism
    start : Kinematics
    tolerance : float
        Largest |phi| that is taken for closed, m.
    """

    def __init__(self, mechanism: Mechanism, start: Kinematics, tolerance: float) -> None:
        self._mechanism, self._last, self._tolerance = mechanism, start, tolerance

    def at(self, q: Array) -> Kinematics:
        """Return the configuration at q, shape (d,)."""
        step = np.zeros(self._mechanism.n)
        step[self._last.partition.q] = q - self._mechanism.independent_part(self._last.q_tree)
        return newton(self._last.integrate(step), 0.0, self._tolerance).at

    def keep(self, q: Array) -> Kinematics:
        """Return the configuration at the q of an accepted step: where the next ones start."""
        self._last = self.at(q)
        return self._last


class OwnSigma:
    """The force of a controller whose z is its own, not the plant's."""

    def __init__(self, force: Force, sigma: FromLast) -> None:
        self.force, self.sigma = force, sigma

    def __call__(self, t: float, terms: Terms) -> Array:
        """Return u' with the controller's z."""
        at = self.sigma.at(terms.q)
        return self.force(t, Terms(terms.mechanism, at, at.rho @ terms.q_dot))


@dataclass
class Loose(LevelSet):
    """The reduced model whose z, the controller's as well, is solved `FromLast`."""

    sigma: FromLast = field(kw_only=True)

    def close(self, t: float, numbers: Array) -> Kinematics:
        return self.sigma.at(numbers)


@dataclass(frozen=True)
class Setting:
    """How a tracking run is integrated, and how sigma is solved.

    Attributes
    ----------
    model : "reduced" or "eq. 8"
    method : str
        A class of `scipy.integrate`.
    rtol : float
    tolerance : float or None
        Largest |phi| that the reduced model's sigma takes for closed, solved `FromLast`, m.
    own : float or None
        The same of a sigma that the controller solves by itself.
    """

    model: Literal["reduced", "eq. 8"]
    method: str
    rtol: float
    tolerance: float | None = None
    own: float | None = None


@dataclass(frozen=True)
class Track:
    """A run at given times.

    Attributes
    ----------
    q : (m, d) array
        rad or m.
    open : float
        Largest |phi| there of the z that the plant has, and the controller where it has its own, m.
    """

    q: Array
    open: float


def track(scene: str, setting: Setting, times: Array) -> Track:
    """Run a scene with a controller and return its q at increasing times, from 0 on.

    Raises
    ------
    NumericalError
        The run does not get to the last one.
    """
    loaded = load_scene(scene)
    if loaded.spec.controller is None:
        raise InputError(f"{loaded.name}: a scene with a controller is needed")
    problem, sigma = Problem.of_scene(loaded), None
    if setting.own is not None:
        sigma = FromLast(problem.mechanism, problem.at, setting.own)
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
            opened.append(sigma.keep(ivp.terms(solver.t, solver.y).q).phi)

    outcome = march(ivp, setting.method, setting.rtol, float(times[-1]), on_step=note)
    if outcome.stopped:
        raise NumericalError(outcome.stopped)
    return Track(np.array(q), float(np.abs(opened).max()))


@dataclass(frozen=True)
class Deviation:
    """How far a run is from the exact one, and whether that repeats with the desired trajectory's period.

    Attributes
    ----------
    size : (m,) array
        Largest |q - q_exact| of the coordinates, rad or m, at instants SAMPLES to a period.
    largest : float
        Of size, after the first period.
    repeats : float
        The share of its variance over time that every period shows alike: near 1 for a periodic deviation, about
        1 / (number of periods) for an irregular one.
    period : float
        The strongest period in it, s.
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
    """Return whole periods from 0, SAMPLES instants to each and the last one's end, s; at least two."""
    return np.linspace(0.0, periods * PERIOD, periods * SAMPLES + 1)
