"""Model-predictive control.

Every 20 ms, a `Planner` computes the torques of the next 0.3 s from the measured state of the five-bar, within
the motors' limits. A push that it does not foresee throws the arms off their way. The replanned torques bring them
back. The torques of the first plan, whose last ones are held, do not.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import COLOURS, figure_style

TARGET = {"theta_1": -1.0, "theta_3": -1.9}
TORQUE, PERIOD, T_END = 2.0, 0.02, 1.0  # N m, s, s
PUSH, PUSHED = [30.0, 0.0, 0.0], (0.4, 0.44)  # N, s


def make_planner():
    """Return a planner of the squared distance from the target, with a small weight of the torques."""
    desired = {name: {"offset": value} for name, value in TARGET.items()}
    return ckc_pin.Planner(
        "five_bar", horizon=0.3, minimize={"tracking": 1.0, "effort": 1e-3}, limits={"torque": TORQUE}, desired=desired
    )


def follow(planner, *, replan):
    """Return times, states and torques, and the times that the solutions took."""
    push = ckc_pin.Force("link_2", [0.0, 0.0, 0.0], name="push")
    simulator = ckc_pin.Simulator("five_bar/swing", {"initial": {"at": "equilibrium"}}, forces=[push])
    rows, taken, plan = [], [], None
    while (state := simulator.state).t < T_END - 1e-9:
        if plan is None or replan:
            plan = planner.solve(state)
            taken.append(plan.wall_s)
        tau = plan.tau(state.t + PERIOD / 2)
        rows.append([state.t, *state.q, *tau])
        pushes = PUSHED[0] - 1e-9 < state.t < PUSHED[1] - 1e-9
        simulator.step(tau=dict(zip(simulator.mechanism.actuated, tau.tolist(), strict=True)), dt=PERIOD,
                       wrenches={"push": PUSH if pushes else [0.0, 0.0, 0.0]})  # fmt: skip
    return np.array(rows), np.array(taken)


@figure_style()
def main():
    planner = make_planner()
    closed, taken = follow(planner, replan=True)
    target = np.array(list(TARGET.values()))
    error = np.abs(closed[-1, 1:3] - target).max()
    warm = taken[1:]
    print(f"{error:.1e} rad from the target at the end; a solution took {1e3 * np.median(warm):.0f} ms (median), "
          f"{1 / np.median(warm):.0f} Hz")  # fmt: skip
    opened, _ = follow(make_planner(), replan=False)
    assert error < 0.02
    assert np.abs(opened[-1, 1:3] - target).max() > 10 * error
    assert np.abs(closed[:, 3:]).max() <= TORQUE * (1 + 1e-9)

    figure, (above, below) = plt.subplots(2, 1, figsize=(5.2, 4.2), sharex=True)
    for k, name in enumerate(["θ₁", "θ₃"]):
        above.plot(closed[:, 0], closed[:, 1 + k], color=COLOURS[k], label=f"{name}, replanned")
        above.plot(opened[:, 0], opened[:, 1 + k], ":", color=COLOURS[k], label=f"{name}, first plan alone")
        above.axhline(target[k], color=COLOURS[k], lw=0.8, ls="--")
        below.step(closed[:, 0], closed[:, 3 + k], where="post", color=COLOURS[k])
    for ax in (above, below):
        ax.axvspan(*PUSHED, color="0.85")
    low, high = closed[:, 1:3].min() - 0.5, closed[:, 1:3].max() + 0.5
    above.set(ylabel="angle (rad)", ylim=(low, high), title="A push, and torques planned every 20 ms")
    below.set(xlabel="t (s)", ylabel="torque (N m)")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("receding_horizon.png")
