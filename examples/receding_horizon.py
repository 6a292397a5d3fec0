"""Model-predictive control.

A planner brings the five-bar to its target as closely as its motors allow over the next 0.3 s, and plans again every
20 ms from the state that it finds. After 0.5 s the tip is pushed for 60 ms, of which the planner does not know.
With the first plan only, the arm falls after its end.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

TARGET = {"theta_1": -1.0, "theta_3": -1.9}
HORIZON, PERIOD, T_END = 0.3, 0.02, 1.4  # s
STEPS = 4  # of constant torque, between two plans
PUSH, BEGIN, DURATION = [8.0, 0.0, 0.0], 0.5, 0.06  # N, s, s
LIMIT = 2.0  # N m


def follow(replan):
    """Return the times, coordinates and torques of a run with plans from each state, or with the first plan only."""
    planner = ckc_pin.Planner(
        "five_bar", horizon=HORIZON, minimize={"tracking": 1.0, "effort": 1e-4}, limits={"torque": LIMIT},
        desired={name: {"offset": x} for name, x in TARGET.items()},
    )  # fmt: skip
    hand = {"name": "hand", "frame": "tip_left", "force": [0, 0, 0]}
    plant = ckc_pin.Simulator("five_bar/swing", {"force": [hand], "initial": {"at": "equilibrium"}})
    rows, times, plan = [], [], None
    while plant.state.t < T_END - 1e-9:
        if plan is None or replan:
            plan = planner.solve(plant.state)
            times.append(plan.wall_s)
        for _ in range(STEPS):
            t = plant.state.t
            tau = plan.tau(t + PERIOD / STEPS / 2)
            rows.append([t, *plant.state.q, *tau])
            is_pushed = BEGIN <= t + 1e-9 < BEGIN + DURATION
            plant.step(tau=tau, dt=PERIOD / STEPS, wrenches={"hand": PUSH if is_pushed else [0.0, 0.0, 0.0]})
    return np.array(rows), np.array(times)


@figure_style()
def main():
    (closed, times), (once, _) = follow(replan=True), follow(replan=False)
    target = np.array(list(TARGET.values()))
    error, error_of_one_plan = (np.abs(x[-1, 1:3] - target).max() for x in (closed, once))
    print(f"error at the end {error:.1e} rad; with the first plan only {error_of_one_plan:.2f} rad")
    print(f"a plan took {1e3 * np.median(times):.0f} ms in the median: {1 / np.median(times):.0f} plans per second")
    assert error < 1e-2 < error_of_one_plan
    assert np.abs(closed[:, 3:]).max() <= LIMIT

    figure, (angles, torques) = plt.subplots(2, sharex=True, layout="constrained")
    for k, name in enumerate(("θ₁", "θ₃")):
        (line,) = angles.plot(closed[:, 0], closed[:, 1 + k], label=f"{name}, planned every 20 ms")
        angles.plot(once[:, 0], once[:, 1 + k], ":", color=line.get_color(), label=f"{name}, first plan")
        angles.axhline(target[k], color="black", lw=0.8)
        torques.step(closed[:, 0], closed[:, 3 + k], where="post", color=line.get_color())
    for ax in (angles, torques):
        ax.axvspan(BEGIN, BEGIN + DURATION, color="0.9")
    angles.set(ylabel="angle (rad)", title="The tip is pushed while the grey band lasts")
    torques.set(xlabel="t (s)", ylabel="motor torques (N m)")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("receding_horizon.png")
