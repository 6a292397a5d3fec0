"""Table I of the paper, found again.

The five-bar tracks a motion of several frequencies. Encoders and torque sensors are noisy, and the start values are
wrong by up to 40 %. Which masses and inertias do the torques determine, and how well? Single masses of a planar
five-bar cannot be known, but eleven combinations of them can. They are compared with those of Table I.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

WAVES = {
    "theta_1": {"harmonics": [[0.5, 2.5, 0.0], [0.2, 7.5, 1.0], [0.1, 12.5, 2.0]]},
    "theta_3": {"offset": 0.785, "harmonics": [[0.4, 5.0, 0.5], [0.3, 7.5, -1.0], [0.08, 10.0, 0.3]]},
}
WRONG = {"link.link_1.mass": 0.3, "link.link_2.mass": 0.2, "link.link_3.mass": 0.3, "link.link_4.mass": 0.33}
ENCODER, TORQUE = 1e-4, 0.01  # standard deviations, rad and N m


def measure(run, seed):
    """Return noisy encoder and torque readings of a run, from when it has reached the desired motion."""
    random = np.random.default_rng(seed)
    tracks = run.t > 1.0
    readings = {"t": run.t[tracks]}
    for name in run.mechanism.independent:
        readings[name] = run[name][tracks] + ENCODER * random.normal(size=tracks.sum())
        readings[f"tau.{name}"] = run[f"tau.{name}"][tracks] + TORQUE * random.normal(size=tracks.sum())
    return readings


def value_of(combination, mechanism):
    """Return the value that a combination of moments and inertias about the joints has in a mechanism."""
    total = 0.0
    for name, factor in combination.coefficients.items():
        _, link, number = name.split(".", 2)
        body = mechanism.tree.model.inertias[int(link[-1])]
        moments = {"mass": body.mass, "moment.x": body.mass * body.lever[0], "moment.y": body.mass * body.lever[1],
                   "origin_inertia.izz": body.toDynamicParameters()[9]}  # fmt: skip
        total += factor * moments[number]
    return total


@figure_style()
def main():
    scene = {"controller.desired": WAVES, "formulation": "reduced", "t_end": 7.0, "solver.output_dt": 0.002}
    run = ckc_pin.simulate("five_bar/tracking", {**scene, "initial": {"q": {"theta_1": 0.2, "theta_3": 0.6}}})
    start = ckc_pin.load("five_bar", WRONG)
    result = ckc_pin.identify(start, measure(run, 0), ["link.*.inertial"], validation=measure(run, 1))
    errors = np.array([x.value - value_of(x, run.mechanism) for x in result.base])
    std = np.array([x.std for x in result.base])
    for x, error in zip(result.base, errors, strict=True):
        print(f"{x.value:10.6f} ± {x.std:.6f}, off by {error:9.6f}: {x}")
    assert np.all(np.abs(errors) < 4 * std)
    assert all(x.rms < 1.05 * TORQUE for x in result.validation.values())
    assert result.parameters["link.link_1.mass"].value is None

    figure, (torque, combinations) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    motion = result.motions[-1]
    torque.plot(motion.t, motion.measured[:, 0], color="0.6", linewidth=2.5, label="measured")
    torque.plot(motion.t, motion.predicted[:, 0], linewidth=1.0, label="predicted")
    torque.set(xlabel="t (s)", ylabel="torque of motor 1 (N m)", title="a recording that was not fitted")
    torque.legend(loc="upper right")
    combinations.errorbar(range(len(std)), errors / std, yerr=2.0, fmt="o", capsize=3)
    combinations.axhline(0.0, color="black", linewidth=0.8)
    combinations.set(xlabel="combination", ylabel="error (standard deviations)", title="against Table I")
    return figure


if __name__ == "__main__":
    main().savefig("identify_five_bar.png")
