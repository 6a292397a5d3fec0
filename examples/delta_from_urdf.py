"""A delta robot from a URDF.

The tree has three arms and six rods. It is cut open at the ball joints of the plate, and closed again by six loops of
three rows each. The plate follows a horizontal circle; exact inverse kinematics gives the arms' angles.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

CIRCLE = {"point": "plate", "circle": {"centre": [0.0, 0.0, -0.38], "radius": 0.08, "frequency": 4.0}}


@figure_style()
def main():
    report = ckc_pin.check("delta")
    print(f"{report.d} freedoms, {report.rows} rows of which {len(report.redundant)} are redundant")
    assert report.d == 3

    forces = ckc_pin.inverse_dynamics("delta/circle", {"controller.desired": CIRCLE, "t_end": 2 * np.pi / 4.0})
    delta = ckc_pin.load("delta")
    point = ckc_pin.Point(delta, "plate")
    plate = np.array([point.position(delta.tree.from_coordinates(q)) for q in forces.q_tree])
    assert np.abs(np.linalg.norm(plate[:, :2], axis=1) - 0.08).max() < 1e-9

    figure, (path, torque) = plt.subplots(1, 2, figsize=(7.0, 3.2), width_ratios=(1, 1.4))
    path.plot(plate[:, 0], plate[:, 1], "k")
    path.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Path of the plate")
    torque.plot(forces.t, forces.tau, label=[name.replace("_", " ") for name in forces.actuated])
    torque.set(xlabel="t (s)", ylabel="torque (N m)", title="What the motors must bear, one round")
    figure.legend(loc="outside lower right", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("delta_from_urdf.png")
