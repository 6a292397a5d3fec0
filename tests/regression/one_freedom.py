"""Conservative mechanisms of one freedom theta, in numpy alone: T = M(theta) theta_dot^2 / 2, V(theta).

Where theta keeps turning the same way, theta_dot = sqrt(2 (E - V) / M) is all there is to integrate: no Lagrangian,
no constraint, no acceleration. Velocities per unit of theta_dot come from complex steps, exact to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import ellipk

G = 9.81
STEP = 1e-30


@dataclass(frozen=True)
class State:
    """M (kg m^2), V (J) and the slider's position (m) at one theta."""

    M: float
    V: float
    slider: float


Mechanism = Callable[[float], State]


def _with_rate(place: Callable[[complex], NDArray[np.complex128]], theta: float) -> tuple[NDArray, NDArray]:
    moved = place(theta + 1j * STEP)
    return moved.real, moved.imag / STEP


def slider_crank(theta: float) -> State:
    """Crank 0.1 m, 0.4 kg, 20 mm square; rod 0.3 m, 0.6 kg, 20 mm square; slider 1 kg on the x-axis; g along -y."""
    crank, rod = 0.1, 0.3

    def place(th: complex) -> NDArray[np.complex128]:
        pin = crank * np.array([np.cos(th), np.sin(th)])
        tilt = -np.arcsin(pin[1] / rod)
        return np.array([*(pin + rod / 2 * np.array([np.cos(tilt), np.sin(tilt)])), tilt, pin[0] + rod * np.cos(tilt)])

    (_, y, _, x), (vx, vy, spin, slide) = _with_rate(place, theta)
    about_pin = 0.4 * (crank**2 + 0.02**2) / 12 + 0.4 * (crank / 2) ** 2
    about_centre = 0.6 * (rod**2 + 0.02**2) / 12
    M = about_pin + 0.6 * (vx**2 + vy**2) + about_centre * spin**2 + 1.0 * slide**2
    return State(M, 0.4 * G * crank / 2 * np.sin(theta) + 0.6 * G * y, x)


def slider_crank_spatial(theta: float) -> State:
    """Haug's mechanism, see slider_crank_spatial.urdf. The rod's spin follows from its universal joint."""
    along, across = 4e-4, 4e-3

    def place(th: complex) -> NDArray[np.complex128]:
        pin = np.array([0.0, 0.1 - 0.08 * np.sin(th), 0.12 + 0.08 * np.cos(th)])
        x = np.sqrt(0.3**2 - pin[1] ** 2 - pin[2] ** 2)
        slider = np.array([x, 0.0, 0.0])
        e = (slider - pin) / 0.3  # the rod's own x-axis
        return np.array([x, *((slider + pin) / 2), *e])

    values, rates = _with_rate(place, theta)
    e, e_dot = values[4:], rates[4:]
    yaw_dot = (e[0] * e_dot[1] - e[1] * e_dot[0]) / (e[0] ** 2 + e[1] ** 2)
    spin = yaw_dot * e[2]  # pitch turns across the rod
    M = 1e-4 + 2.0 * rates[0] ** 2 + 0.5 * rates[1:4] @ rates[1:4] + across * e_dot @ e_dot + along * spin**2
    return State(M, 0.5 * G * values[3], values[0])


def turning(mechanism: Mechanism, theta: float, theta_dot: float, t: NDArray) -> tuple[NDArray, NDArray]:
    """Return theta and its rate at instants t, from a start with enough energy for full turns."""
    start = mechanism(theta)
    energy = start.M * theta_dot**2 / 2 + start.V

    def rate(_: float, y: NDArray) -> list[float]:
        state = mechanism(float(y[0]))
        return [np.sqrt(2 * (energy - state.V) / state.M)]

    motion = solve_ivp(rate, (t[0], t[-1]), [theta], "DOP853", t_eval=t, rtol=1e-12, atol=1e-13)
    thetas = motion.y[0]
    return thetas, np.array([rate(0.0, np.array([x]))[0] for x in thetas])


def pendulum_period(angle: float) -> float:
    """Return the period of a 1 m pendulum released from rest at an angle from +x, g along -y."""
    amplitude = angle + np.pi / 2
    return 4 * np.sqrt(1.0 / G) * float(ellipk(np.sin(amplitude / 2) ** 2))
