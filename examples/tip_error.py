"""Which length matters to the tip.

The five-bar tracks its desired angles. Its controller uses the lengths of the drawing, but the links are 0.1 mm too
long. One run with sensitivities tells how far each length moves the tip at each instant, to first order. A run of a
five-bar with all four errors shows that the first order is enough.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

LENGTHS = {
    "joint.theta_2.xyz.x": "left proximal",
    "joint.tip_left_fixed.xyz.x": "left distal",
    "joint.theta_4.xyz.x": "right proximal",
    "joint.tip_right_fixed.xyz.x": "right distal",
}
DRAWN = np.array([0.2794, 0.3048, 0.2794, 0.3048])  # m
ERROR = 1e-4  # m, of each length
SETTINGS = {"formulation": "reduced", "controller.model": "mechanism.toml", "solver.rtol": 1e-10}


@figure_style()
def main():
    result = ckc_pin.sensitivities("five_bar/tracking", list(LENGTHS), SETTINGS)
    moved = ERROR * result.points["tip"]  # by instant, axis and length
    lengths = dict(zip(LENGTHS, DRAWN + ERROR, strict=True))
    perturbed = ckc_pin.simulate("five_bar/tracking", SETTINGS | lengths)
    error = np.linalg.norm(perturbed.points["tip"] - result.run.points["tip"], axis=1)
    predicted = np.linalg.norm(moved.sum(axis=2), axis=1)
    each = np.linalg.norm(moved, axis=1)
    for name, largest in zip(LENGTHS.values(), each.max(axis=0), strict=True):
        print(f"{name:14s} 0.1 mm longer: the tip moves by up to {1e6 * largest:.0f} µm")
    print(f"all of them: {1e6 * error.max():.1f} µm; to first order {1e6 * predicted.max():.1f} µm")
    assert np.abs(error - predicted).max() < 0.005 * error.max()

    figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
    for k, name in enumerate(LENGTHS.values()):
        ax.plot(result.t, 1e6 * each[:, k], label=name)
    ax.plot(result.t, 1e6 * predicted, color="black", linewidth=1, label="all four")
    ax.plot(perturbed.t[::20], 1e6 * error[::20], "o", color="black", markersize=3, label="a run with all four")
    ax.set(xlabel="t (s)", ylabel="the tip is off by (µm)", ylim=(0, None), title="links 0.1 mm too long")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("tip_error.png")
