"""Calibration of lengths.

The links of a five-bar differ from the drawing by a few tenths of a millimetre, and the zeros of its motors' encoders
are off. All four joints have encoders. The loop closes in every pose, and that tells the lengths. The calibrated
five-bar then knows where its tip is, from the motors' encoders alone.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

LENGTHS = {
    "joint.theta_2.xyz.x": 0.2794 + 0.4e-3,
    "joint.tip_left_fixed.xyz.x": 0.3048 - 0.3e-3,
    "joint.theta_4.xyz.x": 0.2794 - 0.5e-3,
    "joint.tip_right_fixed.xyz.x": 0.3048 + 0.2e-3,
}  # m; the distance of the motors is known
OFFSETS = {"theta_1": 3e-3, "theta_3": -2e-3}  # rad
NOISE = 1e-4  # rad, standard deviation of each encoder


def tip_at(mechanism, motors):
    """Return where a mechanism's tip is at these motor angles."""
    angles = [dict(zip(OFFSETS, row, strict=True)) for row in motors.tolist()]
    return np.array([mechanism.point_positions(ckc_pin.terms(mechanism, q).at.q_tree)["tip"] for q in angles])


@figure_style()
def main():
    run = ckc_pin.simulate("five_bar/tracking", {"formulation": "reduced", **LENGTHS})
    rng = np.random.default_rng(7)
    encoders = {
        name: run[name] + OFFSETS.get(name, 0.0) + NOISE * rng.standard_normal(len(run.t)) for name in run.coordinates
    }
    poses = {name: angles[:: len(run.t) // 40] for name, angles in encoders.items()}
    result = ckc_pin.calibrate("five_bar", poses, [*LENGTHS, "encoder.theta_1.offset", "encoder.theta_3.offset"])
    print(result)
    truth = LENGTHS | {f"encoder.{name}.offset": offset for name, offset in OFFSETS.items()}
    for name, estimate in result.parameters.items():
        assert abs(estimate.value - truth[name]) < 3 * estimate.std

    chosen = slice(None, None, 20)
    read = np.array([encoders[name][chosen] for name in OFFSETS]).T
    zeros = np.array([result.parameters[f"encoder.{name}.offset"].value for name in OFFSETS])
    tips = {  # from noisy readings
        "drawing": tip_at(ckc_pin.load("five_bar"), read),
        "calibrated": tip_at(ckc_pin.load("five_bar", result.overrides), read - zeros),
    }
    errors = {name: 1e3 * np.linalg.norm(tip - run.points["tip"][chosen], axis=1) for name, tip in tips.items()}
    for name, error in errors.items():
        print(f"{name:10s}: the tip is off by {error.mean():.3f} mm on average")
    assert errors["calibrated"].mean() < 0.2 * errors["drawing"].mean()

    figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
    for name, error in errors.items():
        ax.semilogy(run.t[chosen], error, label=name)
    after = 1e3 * result.points["tip"]["after"]
    ax.axhline(after, color="black", linewidth=1, label="predicted, without noise")
    ax.set(xlabel="t (s)", ylabel="the tip is off by (mm)", title="tip from the motors' encoders")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("calibrate_lengths.png")
