"""A leg linkage.

Two motors on one axis drive four links that meet at the foot. The foot follows a circle. The mechanism is three files
in `examples/leg`. Tracking control drives it through gears with ratio 10, and inverse dynamics gives the torques that
the motors need.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

SCENE = Path(__file__).parent / "leg" / "step.scene.toml"


@figure_style()
def main():
    run = ckc_pin.simulate(SCENE)
    foot = run.points["foot"]
    late = run.t > 1.0
    off = np.linalg.norm(foot[late, :2] - [0.0, -0.22], axis=1) - 0.03
    print(f"the foot is off its circle by {np.abs(off).max():.1e} m from t = 1 s on")
    assert np.abs(off).max() < 1e-4
    forces = ckc_pin.inverse_dynamics(SCENE)
    assert not forces.exceeded  # 0.3 N m is enough

    figure, (path, torque) = plt.subplots(1, 2, figsize=(7.0, 3.2), width_ratios=(1, 1.4))
    path.plot(foot[:, 0], foot[:, 1], "k")
    path.plot(*foot[0, :2], "ko", label="the foot's start")
    path.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Path of the foot")
    torque.plot(forces.t, 1e3 * forces.tau, label=[f"{name} motor" for name in forces.actuated])
    torque.set(xlabel="t (s)", ylabel="torque (N mm)", title="On the circle: motors, before their gears")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("leg_linkage.png")
