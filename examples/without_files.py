"""A mechanism without files.

Jansen's leg, made in Python from a URDF as text and three loops. Its crank turns at a constant speed: the motion of a
joint can be prescribed, and the run gives the torque that this takes. `save` writes the files that do the same.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin import Loop
from ckc_pin.view.style import figure_style

# Jansen's lengths, cm
a, b, c, d, e, f, g, h, i, j, k, l, m = 38, 41.5, 39.3, 40.1, 55.8, 39.4, 36.7, 65.7, 49, 50, 61.9, 7.8, 15
RATE = 5.0  # of the crank, rad/s


def third_corner(base, side, opposite):
    """Return the third corner of a triangle, from the first one and relative to the base."""
    x = (base**2 + side**2 - opposite**2) / (2 * base)
    return x, np.sqrt(side**2 - x**2)


upper, foot = third_corner(d, b, e) * np.array([1, -1]), np.array(third_corner(g, i, h))
BARS = {  # name: parent, place on it, length
    "crank": ("ground", 0, 0, m), "j": ("crank", m, 0, j), "k": ("crank", m, 0, k), "top": ("ground", -a, -l, d),
    "c": ("ground", -a, -l, c), "f": ("top", d, 0, f), "shank": ("c", c, 0, g),
}  # fmt: skip


def urdf():
    """Return the open chains as a URDF: uniform bars of 0.1 kg, joints named as the bars that they turn."""
    text = '<robot name="leg"><link name="ground"/>'
    for name, (parent, x, y, length) in BARS.items():
        inertia = 0.1 * (length / 100) ** 2 / 12
        text += f"""
          <link name="{name}_bar"><inertial><origin xyz="{length / 200} 0 0"/><mass value="0.1"/>
            <inertia ixx="1e-6" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>
          <joint name="{name}" type="continuous"><parent link="{parent if parent == "ground" else parent + "_bar"}"/>
            <child link="{name}_bar"/><origin xyz="{x / 100} {y / 100} 0"/><axis xyz="0 0 1"/></joint>"""
    return text + "</robot>"


def place(bar, x, y=0.0):
    return {"link": f"{bar}_bar", "xyz": [x / 100, y / 100, 0.0]}


def foot_position(theta):
    """Return the foot by intersecting circles, cm, without the package."""

    def meet(p, p_radius, q, q_radius):  # the intersection on the left of the way from p to q
        x, y = third_corner(np.linalg.norm(q - p), p_radius, q_radius)
        along = (q - p) / np.linalg.norm(q - p)
        return p + x * along + y * np.array([-along[1], along[0]])

    pin, tip = np.array([-a, -l]), m * np.array([np.cos(theta), np.sin(theta)])
    top = meet(pin, b, tip, j)
    knee, ankle = meet(pin, d, top, e), meet(tip, k, pin, c)
    shank = meet(ankle, g, knee, f)
    return meet(ankle, i, shank, h)


@figure_style()
def main():
    leg = ckc_pin.Mechanism.from_urdf(
        urdf(),
        gravity=[0, -9.81, 0],
        loops=[
            Loop("top", "point_2d", place("j", j), place("top", *upper)),
            Loop("ankle", "point_2d", place("k", k), place("c", c)),
            Loop("knee", "point_2d", place("f", f), place("shank", g)),
        ],
        points=[{"name": "foot", "frame": place("shank", *foot)}],
        q_guess={"j": 2.5, "k": -2.3, "top": 2.7, "c": -1.3, "f": 2.4, "shank": -2.3},
    )
    run = ckc_pin.simulate(leg, t_end=2 * np.pi / RATE, prescribed=[{"joint": "crank", "rate": RATE}])
    exact = np.array([foot_position(RATE * t) for t in run.t]) / 100
    error = np.abs(run.points["foot"][:, :2] - exact).max()
    print(f"the foot is off the intersections of circles by {error:.1e} m")
    assert error < 1e-10

    with tempfile.TemporaryDirectory() as folder:
        scene = ckc_pin.Scene(leg, t_end=2 * np.pi / RATE, prescribed=[{"joint": "crank", "rate": RATE}])
        again = ckc_pin.simulate(scene.save(folder))  # or in a terminal: ckc run FOLDER
    assert np.array_equal(again.q_tree, run.q_tree)

    figure, (path, torque) = plt.subplots(1, 2, figsize=(7.0, 3.0), width_ratios=(1.2, 1))
    path.plot(*run.points["foot"][:, :2].T, "k")
    path.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Path of the foot")
    torque.plot(run.t, run["tau.crank"])
    torque.set(xlabel="t (s)", ylabel="torque (N m)", title="Torque of the crank")
    return figure


if __name__ == "__main__":
    main().savefig("without_files.png")
