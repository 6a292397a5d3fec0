"""A linear-quadratic regulator.

The regulator is designed on the linear model of the five-bar, and tested on the nonlinear one. The tip stands above
the base, where gravity makes the mechanism fall to one side; the motors hold it there. SciPy solves the Riccati
equation with A and B of the operating point. The regulator then acts on the full closed chain, which starts off that
point.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import solve_continuous_are

import ckc_pin
from ckc_pin.view.style import figure_style

POINT = {"theta_1": 1.9, "theta_3": 1.2}
OFFSET = {"theta_1": 0.08, "theta_3": -0.05}  # rad, at the start
Q, R = np.diag([100.0, 100.0, 1.0, 1.0]), np.diag([5.0, 5.0])


class Regulator:
    """tau = tau_0 - K (x - x_0)."""

    def __init__(self, model: ckc_pin.LinearModel) -> None:
        S = solve_continuous_are(model.A, model.B, Q, R)
        self.K = np.linalg.solve(R, model.B.T @ S)
        at = dict(zip(model.coordinates, model.q_tree, strict=True))
        self.x_0 = np.array([*(at[name] for name in POINT), 0.0, 0.0])
        self.tau_0 = model.tau

    def tau(self, t: float, terms: ckc_pin.Terms) -> np.ndarray:
        """Return the motors' torques at time t (s), N m."""
        return self.tau_0 - self.K @ (np.concatenate([terms.q, terms.q_dot]) - self.x_0)


def design() -> tuple[ckc_pin.LinearModel, Regulator]:
    """Return the linear model about the point, and the regulator."""
    model = ckc_pin.linearize("five_bar", POINT)
    return model, Regulator(model)


def hold(regulator: Regulator | None) -> ckc_pin.Run:
    """Run the five-bar from a start off the point. Without a regulator, the constant torques of the point act."""
    start = {name: POINT[name] + OFFSET[name] for name in POINT}
    overrides = {"formulation": "reduced", "t_end": 4.0, "controller": None, "initial": {"q": start}}
    return ckc_pin.simulate("five_bar/swing", overrides, controller=regulator)


@figure_style()
def main() -> Figure:
    """Design the regulator, run with and without it, and plot the errors."""
    model, regulator = design()
    print(model)
    closed = model.A - model.B @ regulator.K
    print("with the regulator:", np.round(np.linalg.eigvals(closed), 3))
    run = hold(regulator)
    alone = hold(None)
    error, without = (np.abs(r.q_tree[:, [0, 2]] - regulator.x_0[:2]).max(axis=1) for r in (run, alone))
    for t in (0.0, 0.5, 1.0, 2.0, 4.0):
        print(f"t = {t:3.1f} s: {error[run.at(t)]:.2e} rad off")
    assert np.all(np.linalg.eigvals(closed).real < 0)
    assert error[-1] < 1e-4 < 0.5 < without.max()
    figure, ax = plt.subplots()
    ax.semilogy(alone.t, without, label="torques of the point alone")
    ax.semilogy(run.t, error, label="with the regulator")
    ax.set(xlabel="t (s)", ylabel="largest error of θ₁, θ₃ (rad)", title="Started 0.08 rad off an unstable equilibrium")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("lqr.png")
