"""The payload of a delta.

A delta moves loads of unknown mass. Its motor torques during one second tell the mass of plate and load, although no
sensor is at the plate. Where on the plate the load lies cannot be known from them: the plate only translates, so that
the place of the load changes the forces in the rods, but no torque.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

LOADS = [0.0, 0.1, 0.25, 0.5]  # kg
ENCODER, TORQUE = 1e-4, 0.02  # standard deviations, rad and N m
WAVES = {
    f"arm_{k}": {"offset": 0.3, "harmonics": [[0.3, 3.0 + k, 0.7 * k], [0.1, 9.0 - k, k], [0.05, 14.0, 2.0 * k]]}
    for k in (1, 2, 3)
}


def measure(plate_mass, seed):
    """Return noisy encoder and torque readings of one second, with a plate of this mass."""
    controller = {"type": "tracking", "Lambda": 1.0, "K_D": 10.0, "desired": WAVES}
    scene = ckc_pin.Scene("delta", t_end=1.0, controller=controller, parameters={"link.plate.mass": plate_mass})
    motion = ckc_pin.inverse_dynamics(scene, {"solver.output_dt": 0.004})
    random = np.random.default_rng(seed)
    readings = {"t": motion.t}
    for k, name in enumerate(motion.mechanism.motors.names):
        at = motion.mechanism.coordinates.index(name)
        readings[name] = motion.q_tree[:, at] + ENCODER * random.normal(size=len(motion.t))
        readings[f"tau.{name}"] = motion.tau[:, k] + TORQUE * random.normal(size=len(motion.t))
    return readings


@figure_style()
def main():
    empty = ckc_pin.load("delta")
    plate_mass = empty.tree.model.inertias[int(empty.frames.links["plate"].joint)].mass
    estimates = []
    for seed, load in enumerate(LOADS):
        result = ckc_pin.identify(empty, measure(plate_mass + load, seed), ["link.plate.inertial"])
        mass, place = (result.parameters[f"link.plate.{name}"] for name in ("mass", "com.x"))
        print(
            f"load {load} kg: plate and load {mass.value:.4f} ± {mass.std:.4f} kg; place of the load: {place.verdict}"
        )
        assert abs(mass.value - plate_mass - load) < 4 * mass.std
        assert place.value is None
        estimates.append((mass.value - plate_mass, mass.std))
    mass, std = np.array(estimates).T

    figure, ax = plt.subplots(figsize=(5.0, 3.6), layout="constrained")
    ax.errorbar(LOADS, 1e3 * (mass - LOADS), yerr=2e3 * std, fmt="o", capsize=3)
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set(xlabel="load (kg)", ylabel="error (g)", title="mass of the load, ± 2 standard deviations")
    return figure


if __name__ == "__main__":
    main().savefig("delta_payload.png")
