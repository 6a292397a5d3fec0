"""Sampled control.

The set-point controller as a computer runs it: samples, a delay, encoders of 4096 counts, rates by differences, a
filter. The error that remains is what an encoder's step leaves open.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin

SENSOR = {"resolution": 2 * np.pi / 4096, "rate": "difference", "filter": 0.002}


def main():
    figure, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    ends = []
    for sample_time in (None, 0.001, 0.004):
        sampled = {} if sample_time is None else {
            "controller.sample_time": sample_time, "controller.delay": sample_time / 2, "controller.sensor": SENSOR,
        }  # fmt: skip
        run = ckc_pin.simulate("five_bar/set_point", {"formulation": "reduced", "t_end": 1.5, **sampled})
        error = run.q_tree[:, run.column("theta_1")] - np.pi / 4
        ax.semilogy(
            run.t, np.abs(error), label="continuous" if sample_time is None else f"every {1e3 * sample_time:g} ms"
        )
        ends.append(np.abs(error[run.t > 1.2]).max())
    ax.set(xlabel="t / s", ylabel="|error of θ₁| / rad")
    ax.legend()
    print("largest error after 1.2 s:", *(f"{end:.1e}" for end in ends))
    assert ends[0] < 1e-5 < ends[1]  # the encoders' step remains
    return figure


if __name__ == "__main__":
    main().savefig("sampled_control.png")
