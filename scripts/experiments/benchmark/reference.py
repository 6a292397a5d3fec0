"""Reference solutions: a closed form, or two formulations at a tight tolerance, whose difference is the accuracy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import NumericalError
from ckc_pin.run.simulate import simulate
from scripts.experiments.benchmark.mechanisms import pendulum
from scripts.experiments.benchmark.work import Work

__all__ = ["Reference", "reference"]

GRAVITY = 9.81
ROUNDING = 1e-13  # rounding error of the elliptic functions over a few turns


@dataclass(frozen=True)
class Reference:
    """Reference solution of a work at its instants.

    Attributes
    ----------
    values : (INSTANTS + 1, k) array
        As returned by `Work.observed`.
    accuracy : float
        Error bound of the values; smaller errors of runs cannot be distinguished.
    how : str
        How it was computed, a sentence.
    """

    values: Array
    accuracy: float
    how: str


def reference(work: Work) -> Reference:
    """Compute a work's reference.

    Raises
    ------
    NumericalError
        A run at the tight tolerance stopped.
    """
    if work.scene == "n_four_bar":
        return _row_of_squares(work)
    if work.scene is pendulum:
        return _pendulum(work)
    first = _tight(work, "dae", "DOP853")
    # Without loops all formulations are one system, so that another method tells the accuracy.
    second = _tight(work, "reduced", "DOP853") if work.mechanism.spec.loop else _tight(work, "dae", "Radau")
    difference = float(np.abs(first - second).max())
    published_error, where = _published(work, first)
    other = "the reduced model" if work.mechanism.spec.loop else "Radau"
    how = f"DAE at {work.tight:.0e}; {other} at {work.tight:.0e} agrees to {difference:.1e}{where}"
    return Reference(first, max(difference, published_error), how)


def _tight(work: Work, formulation: str, method: str) -> Array:
    run = simulate(
        work.load(formulation=formulation, solver__method=method, solver__rtol=work.tight, solver__terms="pinocchio")
    )
    if run.status != "done":
        raise NumericalError(f"{work.key}: no reference, the {formulation} {run.message}", run=run)
    return work.observed(run.q_tree)


def _row_of_squares(work: Work) -> Reference:
    """Return the closed form of N squares in a row by elliptic functions, a pendulum: theta_ddot = -k cos(theta).

    With chi = (pi/2 - theta) / 2, chi_dot = sqrt(1 + 4 k sin(chi)^2) / 2, so that chi = am(t / 2, -4 k).
    """
    from scipy.special import ellipj, ellipk

    N = int(work.overrides["mechanism.N"])
    k = GRAVITY * 3 * (3 * N + 1) / (2 * (4 * N + 1))
    stretch = np.sqrt(1 + 4 * k)
    m = 4 * k / (1 + 4 * k)  # Jacobi's imaginary transformation of -4 k
    chi = np.pi / 2 - ellipj(ellipk(m) - work.instants * stretch / 2, m)[3]
    values = np.column_stack([np.sin(2 * chi), np.cos(2 * chi), np.zeros_like(chi)])
    return Reference(values, ROUNDING, "closed form, elliptic functions")


def _pendulum(work: Work) -> Reference:
    """Return the closed form of a pendulum of 1 m that is released horizontal, at an angle theta = pi from +x."""
    from scipy.special import ellipj, ellipk

    m = 0.5  # sin(pi/4)^2, half the amplitude
    theta = 1.5 * np.pi - 2 * np.arcsin(np.sqrt(m) * ellipj(ellipk(m) - np.sqrt(GRAVITY) * work.instants, m)[0])
    values = np.column_stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)])
    return Reference(values, ROUNDING, "closed form, elliptic functions")


# Andrews' squeezer at 0.03 s in the order beta, theta, gamma, phi, delta, omega, eps: the published solution.
ANDREWS = {
    "beta": 15.81077119515370,
    "theta": -15.75637105841184,
    "gamma": 0.04082224011964587,
    "phi": -0.5347301163226948,
    "delta": 0.5244099658799541,
    "omega": 0.5347301163226948,
    "eps": 1.048080741041938,
}


def _andrews(work: Work, values: Array) -> tuple[float, str]:
    at = int(np.argmin(np.abs(work.instants - 0.03)))
    published = np.array([ANDREWS[name] for name in work.mechanism.coordinates])
    off = float(np.abs(values[at] - published).max())
    return off, f"; at 0.03 s {off:.1e} from the published solution"


def _bricard(work: Work, values: Array) -> tuple[float, str]:
    at = int(np.argmin(np.abs(work.instants - 1.0)))
    tree = work.mechanism.tree
    point = work.mechanism.point_positions(tree.from_coordinates(values[at]))["P3"]
    off = float(np.abs(point - [0.27448132, -0.88670794, -0.46233000]).max())
    return 0.0, f"; P3 at 1 s is {off:.0e} from the published one, which has eight digits"


# The flyball governor at 10 s by equations of motion written by hand: slider in m, rods and shaft in rad.
FLYBALL = {"slider": 0.61962292, "rod_1": 0.39007370, "rod_2": 0.39007370, "shaft": 55.93540991}


def _flyball(work: Work, values: Array) -> tuple[float, str]:
    by_hand = np.array([FLYBALL[name] for name in work.mechanism.coordinates])
    off = float(np.abs(values[-1] - by_hand).max())
    return 0.0, f"; at 10 s {off:.0e} from equations written by hand, whose values have eight digits"


PUBLISHED: dict[str, Callable[[Work, Array], tuple[float, str]]] = {
    "andrews": _andrews,
    "bricard": _bricard,
    "flyball": _flyball,
}


def _published(work: Work, values: Array) -> tuple[float, str]:
    """Return the difference from published values and a sentence on it, (0, "") without published values."""
    return PUBLISHED[work.key](work, values) if work.key in PUBLISHED else (0.0, "")
