"""Reference of the stiff flyball governor: slider, rods' common angle, and spin from the conserved momentum."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

G = 9.81
ROD, ENDS, SLIDER = 0.3, 5.0, 3.0  # kg: each rod, the mass at its end, the slider
ACROSS = 1e-4 / 6  # m^2: a bar's inertia about itself, by its mass
HINGE, TOP, HALF_SLIDER = 0.05, 1.0, 0.05  # m: the rods' hinges, from the axis and above the ground
STIFFNESS, DAMPING, REST = 8e5, 4e4, 0.5  # N/m, N s/m, m

ABOUT_HINGE = ROD * (1 / 3 + 1e-4 / 12) + ENDS


def about_shaft(angle: float) -> tuple[float, float]:
    """Return the inertia about the shaft, kg m^2, and its derivative with respect to the rods' angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    along, upright = ROD * ACROSS, ROD * (1 + 1e-4) / 12  # of a rod about its centre
    reach = [(ROD, HINGE + cos / 2, -sin / 2), (ENDS, HINGE + cos, -sin)]
    inertia = 0.3 * ACROSS + SLIDER * 0.01 / 6 + 2 * (along * sin**2 + upright * cos**2)
    inertia += 2 * sum(mass * x**2 for mass, x, _ in reach)
    slope = 4 * (along - upright) * sin * cos + 4 * sum(mass * x * dx for mass, x, dx in reach)
    return inertia, slope


def governor(t_end: float, rtol: float) -> dict[str, float]:
    """Return the coordinates at t_end from 30 degrees, with the slider at 0.5 m and one turn a second."""
    start = np.array([0.5, np.pi / 6, 0.0, 0.0, 0.0])
    momentum = about_shaft(start[1])[0] * 2 * np.pi

    def f(t: float, y: NDArray[Any]) -> list[float]:
        z, angle, _, z_dot, angle_dot = y
        cos, sin = np.cos(angle), np.sin(angle)
        middle, up = np.array([HINGE + cos / 2, TOP - sin / 2]), np.array([-sin / 2, -cos / 2])
        gap = middle - [HALF_SLIDER, z]
        length = np.hypot(*gap)
        along = gap / length
        rate = along @ (up * angle_dot - [0.0, z_dot])
        pull = STIFFNESS * (length - REST) + DAMPING * rate  # on the slider along `along`, on the rod against it
        inertia, slope = about_shaft(angle)
        spin = momentum / inertia
        z_ddot = 2 * pull * along[1] / SLIDER - G
        torque = slope * spin**2 / 4 + (ROD / 2 + ENDS) * G * cos - pull * (along @ up)  # of one rod
        return [z_dot, angle_dot, spin, z_ddot, torque / ABOUT_HINGE]

    result = solve_ivp(f, (0.0, t_end), start, "LSODA", rtol=rtol, atol=rtol)
    z, angle, shaft = result.y[:3, -1]
    return {"shaft": shaft, "slider": z, "rod_1": angle, "rod_2": angle}
