"""Two spatial arms that a loop of any type connects, with a gear and fixed joints, and a body on a spring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from scripts.experiments.mechanism_files import closing_frame, toml_value

ARM = """
  <link name="{s}0">{body}</link><link name="{s}1">{body}</link><link name="{s}bend">{body}</link>
  <link name="{s}2">{body}</link><link name="{s}tip">{body}</link><link name="{s}hand">{body}</link>
  <joint name="{s}a" type="continuous"><parent link="base"/><child link="{s}0"/>
    <origin xyz="{x} 0.1 0.2" rpy="0.2 -0.1 0.3"/><axis xyz="0 0.6 0.8"/></joint>
  <joint name="{s}b" type="continuous"><parent link="{s}0"/><child link="{s}1"/>
    <origin xyz="0.3 0.05 0.1" rpy="-0.3 0.2 0.1"/><axis xyz="1 0 0"/></joint>
  <joint name="{s}fix" type="fixed"><parent link="{s}1"/><child link="{s}bend"/>
    <origin xyz="0.1 0.2 -0.05" rpy="0.4 0.3 -0.2"/></joint>
  <joint name="{s}c" type="continuous"><parent link="{s}bend"/><child link="{s}2"/>
    <origin xyz="0.2 0 0.1" rpy="0.1 0.5 0.2"/><axis xyz="0 1 0"/><dynamics damping="0.05"/></joint>
  <joint name="{s}d" type="continuous"><parent link="{s}2"/><child link="{s}tip"/>
    <origin xyz="0.25 0.1 0" rpy="0 0.3 0.4"/><axis xyz="0 0 1"/></joint>
  <joint name="{s}end" type="fixed"><parent link="{s}tip"/><child link="{s}hand"/>
    <origin xyz="0.1 0 0.05" rpy="0.2 0 0.1"/></joint>"""

BODY = """<inertial><origin xyz="0.1 0.02 -0.03" rpy="0.3 0.2 0.1"/><mass value="0.7"/>
  <inertia ixx="0.011" ixy="0.001" ixz="-0.002" iyy="0.014" iyz="0.0015" izz="0.017"/></inertial>"""

WHEEL = """
  <link name="wheel">{body}</link>
  <joint name="w" type="continuous"><parent link="base"/><child link="wheel"/><origin xyz="0 -0.5 0" rpy="0.5 0 0"/>
    <axis xyz="0 0 1"/></joint>"""

MECHANISM = """name = "arms"
urdf = "arms.urdf"
gravity = [0.5, 0.3, -9.81]
independent = [{independent}]
q_guess = {{ {guess} }}
[[loop]]
name = "hold"
type = "{type}"
frame_a = {{ link = "lhand", xyz = [0.1, 0.05, 0.02], rpy = [0.2, 0.1, -0.3] }}
frame_b = {{ link = "rtip", xyz = {xyz}, rpy = {rpy} }}
axis_a = [0.0, 0.6, 0.8]
axis_b = {axis_b}
[[coupling]]
joint = "w"
other = "la"
ratio = -0.7
offset = 0.2
[[spring]]
frame_a = {{ link = "lbend", xyz = [0.1, 0.0, 0.1] }}
frame_b = {{ link = "world", xyz = [0.4, 0.4, 0.5] }}
stiffness = 30.0
rest_length = 0.4
damping = 0.3
[[joint]]
name = "rb"
armature = 0.02
"""

SCENE = """mechanism = "arms.toml"
formulation = "{formulation}"
t_end = 0.4
initial.q = {{ {start} }}
initial.q_dot = {{ {first} = 0.9 }}
solver.output_dt = 0.1
"""

Q = {"la": 0.3, "lb": -0.4, "lc": 0.5, "ld": 0.2, "ra": 0.6, "rb": -0.3, "rc": -0.2, "rd": 0.4}
INDEPENDENT = {  # independent coordinates by type of loop
    "weld": ["lb", "lc"],
    "prismatic": ["ra", "rb", "la"],
    "hinge": ["ra", "rb", "la"],
    "universal": ["ra", "rb", "la", "lb"],
    "point": ["ra", "rb", "la", "lb", "rd"],
}


def write_arms(folder: Path, kind: str, formulation: str = "dae", more: str = "") -> str:
    """Write the files of two arms whose loop is closed at Q; return the scene's path."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = "".join(ARM.format(s=s, x=x, body=BODY) for s, x in (("l", -0.3), ("r", 0.3)))
    urdf = f'<robot name="arms"><link name="base"/>{parts}{WHEEL.format(body=BODY)}</robot>'.replace(
        "continuous", "revolute"
    )
    limited = urdf.replace('type="revolute">', 'type="revolute"><limit lower="-9" upper="9" effort="1" velocity="1"/>')
    (folder / "arms.urdf").write_text(limited, encoding="utf-8")
    model = pin.buildModelFromXML(limited)
    data, q = model.createData(), np.zeros(model.nq)
    for name, value in {**Q, "w": 0.2 - 0.7 * Q["la"]}.items():
        q[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, q)
    hand, tip = (data.oMf[model.getFrameId(link)] for link in ("lhand", "rtip"))
    xyz, rpy = closing_frame(
        (hand.rotation, hand.translation),
        (tip.rotation, tip.translation),
        np.array([0.1, 0.05, 0.02]),
        pin.rpy.rpyToMatrix(0.2, 0.1, -0.3),
    )
    axis = np.array([0.0, 0.6, 0.8]) if kind != "universal" else np.array([1.0, 0.0, 0.0])
    names = INDEPENDENT[kind]
    (folder / "arms.toml").write_text(
        MECHANISM.format(
            type=kind, xyz=toml_value(xyz), rpy=toml_value(rpy),
            axis_b=toml_value(axis), independent=", ".join(f'"{x}"' for x in names),
            guess=", ".join(f"{k} = {x}" for k, x in Q.items()),
        ) + more,
        encoding="utf-8",
    )  # fmt: skip
    scene = SCENE.format(formulation=formulation, start=", ".join(f"{x} = {Q[x]}" for x in names), first=names[0])
    (folder / "arms.scene.toml").write_text(scene, encoding="utf-8")
    return str(folder / "arms.scene.toml")


def write_tethered_body(folder: Path) -> str:
    """Write the files of a free body on a spring; return the scene's path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "body.urdf").write_text(f'<robot name="body"><link name="body">{BODY}</link></robot>', encoding="utf-8")
    (folder / "body.toml").write_text(TETHERED, encoding="utf-8")
    names = ("x", "y", "z", "rx", "ry", "rz")
    start = ", ".join(f'"root.{name}" = {x}' for name, x in zip(names, (0.1, -0.2, 0.3, 0.3, 0.2, -0.4), strict=True))
    rates = ", ".join(f'"root.{name}" = {x}' for name, x in zip(names, (0.4, 0.3, 0.2, -0.5, 0.8, 0.6), strict=True))
    (folder / "body.scene.toml").write_text(
        f'mechanism = "body.toml"\nformulation = "dae"\nt_end = 0.5\ninitial.q = {{ {start} }}\n'
        f"initial.q_dot = {{ {rates} }}\nsolver.output_dt = 0.1\n",
        encoding="utf-8",
    )
    return str(folder / "body.scene.toml")


TETHERED = """name = "tethered"
[[tree]]
file = "body.urdf"
root = "free"
[[spring]]
frame_a = { link = "body", xyz = [-0.1, 0.1, 0.0] }
frame_b = { link = "world", xyz = [0.5, 0.2, 0.1] }
stiffness = 12.0
rest_length = 0.2
"""
