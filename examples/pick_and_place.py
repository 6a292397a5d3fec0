"""The fastest pick-and-place motion of a delta robot.

The plate goes up, across and down within motor torques of 5 N m. Trapezoidal speed profiles stop at both corners, and
reach the largest torque at one place only. `optimize` rounds the corners by 1 cm and finds the fastest motion along the
path: at each instant a motor is at its limit.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import brentq

import ckc_pin
from ckc_pin.view.style import figure_style

LIMIT = 5.0  # N m
PLACES = np.array([[0.0, 0.0, -0.29], [0.0, 0.0, -0.27], [0.1, 0.0, -0.27], [0.1, 0.0, -0.29]])  # m
INSTANTS = 300


def torques_of_trapezoids(duration):
    """Return the times and motor torques of motions with a third each of acceleration, constant speed and braking."""
    lengths = np.linalg.norm(np.diff(PLACES, axis=0), axis=1)
    times = np.concatenate([[0.0], np.cumsum(duration * np.sqrt(lengths) / np.sqrt(lengths).sum())])
    acceleration = 4.5 * lengths[0] / times[1] ** 2  # the same on all lines
    desired = {
        "point": "plate", "waypoints": [[t, place.tolist()] for t, place in zip(times, PLACES, strict=True)],
        "profile": "trapezoidal", "max_acceleration": acceleration * (1 + 1e-9), "max_rate": 100.0,
    }  # fmt: skip
    law = {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": desired}
    scene = ckc_pin.Scene("delta", t_end=duration, controller=law, solver={"output_dt": duration / INSTANTS})
    forces = ckc_pin.inverse_dynamics(scene)
    return forces.t, forces.tau


def fastest_trapezoids():
    """Return the shortest duration within the limit, with times and torques. Without dampers, tau = a + b / T^2."""
    (_, tau_1), (_, tau_2) = torques_of_trapezoids(1.0), torques_of_trapezoids(0.5)
    b = (tau_2 - tau_1) / 3
    duration = brentq(lambda T: np.abs(tau_1 + b * (1 / T**2 - 1)).max() - LIMIT, 0.05, 2.0)
    return duration, *torques_of_trapezoids(duration)


def plan_fastest() -> ckc_pin.Plan:
    """Plan the fastest motion."""
    path = {"point": {"plate": PLACES.tolist()}, "shape": "lines", "rounding": 0.01}
    return ckc_pin.optimize("delta", path=path, limits={"torque": LIMIT})


@figure_style()
def main():
    plan = plan_fastest()
    usual, t, tau = fastest_trapezoids()
    print(f"trapezoidal speeds {1e3 * usual:.0f} ms, fastest {1e3 * plan.t_end:.0f} ms: {usual / plan.t_end:.2f} times")
    assert np.abs(tau).max() <= LIMIT * (1 + 1e-3)
    assert plan.replay.error < 1e-6
    assert plan.replay.max_tau <= LIMIT
    assert plan.t_end < 0.8 * usual

    figure, axes = plt.subplots(2, sharex=True, sharey=True, layout="constrained")
    for ax, title, x, y in (
        (axes[0], f"trapezoidal speeds: {1e3 * usual:.0f} ms", t, tau),
        (axes[1], f"fastest: {1e3 * plan.t_end:.0f} ms", plan.torque_t, plan.torque),
    ):
        ax.plot(1e3 * x, y)
        for limit in (-LIMIT, LIMIT):
            ax.axhline(limit, color="black", lw=0.8, ls="--")
        ax.set(ylabel="torque (N m)", title=title)
    axes[1].set(xlabel="t (ms)")
    figure.legend(axes[0].lines[:3], plan.mechanism.motors.names, loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("pick_and_place.png")
