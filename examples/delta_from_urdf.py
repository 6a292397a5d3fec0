"""A delta robot from a URDF.

A tree of three arms and six rods, cut open at the balls of the plate and closed again by six loops of three rows. The
plate goes round a level circle, prescribed as a circle: exact inverse kinematics gives the arms' angles.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.canvas import look

CIRCLE = {"point": "plate", "circle": {"centre": [0.0, 0.0, -0.38], "radius": 0.08, "frequency": 4.0}}


@look()
def main():
    found = ckc_pin.check("delta")
    print(f"{found.d} freedoms, {found.rows} rows of which {len(found.redundant)} are redundant")
    assert found.d == 3

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
