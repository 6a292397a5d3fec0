"""Section III-C: "the more exact reduced model periodically sees some deviations": what makes a tracking run deviate.

With w(0) = 0 the SPF and the reduced model are the same system, and its error q - q_d falls with e^-t. So a
deviation is numerical. Three ways to one are measured: a loose tolerance of the integrator; a sigma that is solved
loosely, the same z in plant and controller; and a controller that solves sigma loosely by itself, from its last
solution, while the plant has its own z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ckc_pin.control.controllers import Controller
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.sigma import newton
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import load_scene
from ckc_pin.simulation.systems.level_set import LevelSet

__all__ = ["PERIOD", "Deviation", "FromLast", "OwnSigma", "Track", "deviation", "instants", "track"]

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
        return newton(self._last.moved(step), 0.0, self._tolerance).at

    def keep(self, q: Array) -> Kinematics:
        """Return the configuration at the q of an accepted step: where the next ones start."""
        self._last = self.at(q)
        return self._last


class OwnSigma:
    """A controller whose z is its own, not the plant's: the inner controller gets the terms there."""

    def __init__(self, inner: Controller, sigma: FromLast) -> None:
        self.inner, self.sigma = inner, sigma

    def u(self, t: float, terms: Terms) -> Array:
        """Return the inner controller's force with this controller's z."""
        at = self.sigma.at(terms.q)
        return self.inner.u(t, Terms(terms.mechanism, at, at.rho @ terms.q_dot))


@dataclass
class Loose(LevelSet):
    """The reduced model whose z, the controller's as well, is solved `FromLast`."""

    sigma: FromLast | None = None

    def _close(self, t: float, numbers: Array, w: Array, tolerance: float) -> Kinematics:
        return super()._close(t, numbers, w, tolerance) if self.sigma is None else self.sigma.at(numbers)


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


def track(
    scene: str, changes: Mapping[str, Any], times: Array, *, tolerance: float | None = None, own: float | None = None
) -> Track:
    """Run a scene with a controller and return its q at increasing times.

    Parameters
    ----------
    scene : str
    changes : mapping
        Values of the scene by dotted key.
    times : (m,) array
        From 0 on; the run ends with the last.
    tolerance : float, optional
        Largest |phi| that the reduced model's sigma takes for closed, solved `FromLast`, m.
    own : float, optional
        The same of a sigma that the controller solves by itself.

    Raises
    ------
    NumericalError
        The run does not get there.
    """
    loaded = load_scene(scene, {**changes, "solver.backend": "python", "t_end": float(times[-1])})
    prepared, sigma = prepare(loaded), None
    if own is not None:
        if prepared.plant.controller is None:
            raise InputError(f"{loaded.name}: a scene with a controller is needed")
        sigma = FromLast(prepared.mechanism, prepared.start.at, own)
        prepared = prepare(loaded, OwnSigma(prepared.plant.controller, sigma))
    system = prepared.system
    if tolerance is not None:
        assert isinstance(system, LevelSet)
        sigma = FromLast(prepared.mechanism, prepared.start.at, tolerance)
        system = Loose(**{x.name: getattr(system, x.name) for x in fields(system)}, sigma=sigma)
    stepper = Stepper(system, prepared.method, loaded.spec.solver, float(times[-1]))
    first = system.terms(0.0, stepper.y)
    q, opened = [first.q], np.abs(first.phi)
    while stepper.solver.status == "running":
        step = stepper.step()
        while len(q) < len(times) and times[len(q)] <= step.t:
            at = system.terms(float(times[len(q)]), step.interpolant(float(times[len(q)])))
            q.append(at.q)
            opened = np.maximum(np.abs(at.phi), opened)
        if sigma is not None:
            kept = sigma.keep(system.terms(step.t, stepper.solver.y).q)
            opened = np.maximum(np.abs(kept.phi), opened)
    return Track(np.array(q), float(opened.max()))


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
