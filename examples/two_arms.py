"""Two arms on one load.

Two UR5 hold one bar: a closed chain of twelve motors and six freedoms. The motors share the work by least norm, and
the run says what the grips bear.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin


def main():
    run = ckc_pin.simulate("two_ur5/lift", {"formulation": "reduced", "t_end": 2.0})
    assert run.status == "done"
    assert run.max_phi < 1e-8  # m, rad: the bar stays in both hands
    forces = ckc_pin.inverse_dynamics(run)

    figure, (torque, grip) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    left = [k for k, name in enumerate(run.actuated) if name.startswith("left")]
    right = [k for k, name in enumerate(run.actuated) if name.startswith("right")]
    torque.plot(run.t, run.tau[:, left], "-", color="tab:blue")
    torque.plot(run.t, run.tau[:, right], "--", color="tab:orange")
    torque.set(xlabel="t / s", ylabel="torque / N m", title="motors: left arm (blue), right arm (orange)")
    for name, wrench in forces.loop_wrenches.items():
        grip.plot(forces.t, np.linalg.norm(wrench[:, :3], axis=1), label=name)
    grip.set(xlabel="t / s", ylabel="force / N", title="force in the loop")
    grip.legend()
    return figure


if __name__ == "__main__":
    main().savefig("two_arms.png")
