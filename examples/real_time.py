"""A real-time loop.

A controller runs at 500 Hz against the clock, without ROS. Each cycle reads the plant's state, computes a torque, steps
the plant by 2 ms and sleeps until the next cycle is due. The example measures how late cycles begin, and how much of a
cycle the physics takes.

Measured on two cores that were busy with other work, 2000 cycles:

- Cycles began late by 97 µs in the median and 6.2 ms in the 99th percentile. The cause is the scheduler.
- The physics took 76 µs in the median and 194 µs at most.
"""

import time

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

PERIOD = 0.002  # s


@figure_style()
def main(seconds=0.5):
    plant = ckc_pin.Simulator("five_bar/swing", {"formulation": "dae", "solver.rtol": 1e-6})
    cycles = round(seconds / PERIOD)
    late, work = np.empty(cycles), np.empty(cycles)
    due = time.perf_counter()
    for k in range(cycles):
        start = time.perf_counter()
        late[k] = start - due
        plant.step(-0.5 * plant.state.q_dot, PERIOD)  # a damper in place of your controller
        work[k] = time.perf_counter() - start
        due += PERIOD
        time.sleep(max(0.0, due - time.perf_counter()))
    for what, x in (("late", late), ("at work", work)):
        print(f"{what}: median {1e6 * np.median(x):.0f} µs, 99th percentile {1e6 * np.quantile(x, 0.99):.0f} µs, "
              f"largest {1e6 * x.max():.0f} µs of {1e6 * PERIOD:.0f}")  # fmt: skip
    assert abs(plant.state.t - cycles * PERIOD) < 1e-9

    figure, ax = plt.subplots()
    edges = np.geomspace(5e-6, max(late.max(), work.max(), 1e-3), 60)
    ax.hist([np.maximum(late, 5e-6), work], edges, histtype="stepfilled", alpha=0.6, label=["late by", "at work for"])
    ax.axvline(PERIOD, color="black", ls="--", lw=0.8, label="a cycle, 2 ms")
    ax.set(xscale="log", xlabel="time (s)", ylabel="number of cycles", title=f"{cycles} cycles at 500 Hz")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main(10.0).savefig("real_time.png")
