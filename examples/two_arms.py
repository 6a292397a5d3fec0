"""Two arms on one load.

Two UR5 hold one bar: a closed chain with twelve motors and six freedoms. The motors share the work by minimum norm, and
inverse dynamics gives the forces in the grips.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import COLOURS, figure_style


@figure_style()
def main():
    run = ckc_pin.simulate("two_ur5/lift", {"formulation": "reduced", "t_end": 2.0})
    assert run.status == "done"
    assert run.max_phi < 1e-8  # m, rad: both grips stay closed
    forces = ckc_pin.inverse_dynamics(run)

    figure, (torque, grip) = plt.subplots(1, 2, figsize=(7.0, 3.2))
    for arm, line, colour in (("left", "-", COLOURS[0]), ("right", "--", COLOURS[1])):
        motors = [k for k, name in enumerate(run.actuated) if name.startswith(arm)]
        torque.plot(run.t, run.tau[:, motors], line, color=colour)
        wrench = forces.loop_wrenches[f"{arm}_grip"]
        grip.plot(forces.t, np.linalg.norm(wrench[:, :3], axis=1), line, color=colour, label=f"{arm} arm")
    torque.set(xlabel="t (s)", ylabel="torque (N m)", title="Six motors an arm")
    grip.set(xlabel="t (s)", ylabel="force (N)", title="Force in its grip")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("two_arms.png")
