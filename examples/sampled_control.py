"""Sampled control.

The set-point controller runs as on a computer: with samples, a delay, encoders of 4096 counts, rates by differences and
a filter. The remaining error is of the size of an encoder step.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

SENSOR = {"resolution": 2 * np.pi / 4096, "rate": "difference", "filter": 0.002}


@figure_style()
def main():
    figure, ax = plt.subplots()
    ends = []
    for sample_time in (None, 0.001, 0.004):
        sampled = {} if sample_time is None else {
            "controller.sample_time": sample_time, "controller.delay": sample_time / 2, "controller.sensor": SENSOR,
        }  # fmt: skip
        run = ckc_pin.simulate("five_bar/set_point", {"formulation": "reduced", "t_end": 1.5, **sampled})
        error = run.q_tree[:, run.column("theta_1")] - np.pi / 4
        name = "continuous" if sample_time is None else f"sampled every {1e3 * sample_time:g} ms"
        ax.semilogy(run.t, np.abs(error), label=name)
        ends.append(np.abs(error[run.t > 1.2]).max())
    ax.axhline(SENSOR["resolution"] / 2, color="black", lw=0.8, ls="--", label="half an encoder step")
    ax.set(xlabel="t (s)", ylabel="|error of θ₁| (rad)", title="Set-point control, sampled")
    figure.legend(loc="outside lower center", ncols=2)
    print("largest error after 1.2 s:", *(f"{end:.1e}" for end in ends))
    assert ends[0] < 1e-5 < ends[1]  # limited by the encoder's resolution
    return figure


if __name__ == "__main__":
    main().savefig("sampled_control.png")
