"""A table that hangs on two equal rods, as a user's folder, and the equivalent pendulum.

The table moves without turning, so one angle is enough: alpha = gamma = -beta = theta, with
(2 (I + m l^2 / 4) + M l^2) theta_ddot = -(m + M) g l sin(theta).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

LENGTH, ROD, ROD_INERTIA, TABLE, GRAVITY = 1.0, 1.2, 0.15, 2.5, 9.81
START = 0.9  # rad

ROD_LINK = f"""<inertial><origin xyz="0 0 {-LENGTH / 2}"/><mass value="{ROD}"/>
    <inertia ixx="0.15" iyy="{ROD_INERTIA}" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>"""
URDF = f"""
<robot name="table">
  <link name="base"/>
  <link name="left">{ROD_LINK}</link>
  <link name="right">{ROD_LINK}</link>
  <link name="table"><inertial><origin xyz="0.7 0 0"/><mass value="{TABLE}"/>
    <inertia ixx="0.1" iyy="0.4" izz="0.4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="alpha" type="continuous"><parent link="base"/><child link="left"/><axis xyz="0 1 0"/></joint>
  <joint name="beta" type="continuous"><parent link="left"/><child link="table"/>
    <origin xyz="0 0 {-LENGTH}"/><axis xyz="0 1 0"/></joint>
  <joint name="gamma" type="continuous"><parent link="base"/><child link="right"/>
    <origin xyz="1.5 0 0"/><axis xyz="0 1 0"/></joint>
</robot>
"""
MECHANISM = f"""
name = "table"
urdf = "table.urdf"
independent = ["alpha"]
[q_guess]
alpha = {START}
beta = {-START}
gamma = {START}
[[loop]]
name = "hook"
type = "point_2d"
frame_a = {{link = "table", xyz = [1.5, 0.0, 0.0]}}
frame_b = {{link = "right", xyz = [0.0, 0.0, {-LENGTH}]}}
axis_a = [0.0, 1.0, 0.0]
"""
SCENE = f"""
mechanism = "mechanism.toml"
formulation = "reduced"
t_end = 1.5
[initial.q]
alpha = {START}
"""


def write_table(folder: Path, scene: str = SCENE) -> Path:
    """Write the mechanism and its default scene; return the folder."""
    folder.mkdir()
    for name, text in {"table.urdf": URDF, "mechanism.toml": MECHANISM, "default.scene.toml": scene}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def pendulum(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return q_tree and v_tree (alpha, beta, gamma) at instants, from the equation of one angle."""
    stiffness = (ROD + TABLE) * GRAVITY * LENGTH
    inertia = 2 * (ROD_INERTIA + ROD * LENGTH**2 / 4) + TABLE * LENGTH**2

    def f(_: float, y: NDArray[np.float64]) -> list[float]:
        return [y[1], -stiffness / inertia * np.sin(y[0])]

    solution = solve_ivp(f, (0.0, t[-1]), [START, 0.0], "DOP853", t_eval=t, rtol=3e-14, atol=1e-15)
    signs = np.array([1.0, -1.0, 1.0])
    return np.outer(solution.y[0], signs), np.outer(solution.y[1], signs)
