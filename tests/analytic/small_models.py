"""Small test mechanisms as files: a four-bar with springs between its links, a plate on springs, and a wheel."""

from __future__ import annotations

from pathlib import Path

from ckc_pin import Mechanism, load

LINK = """<link name="{name}"><inertial><origin xyz="{x} {y} 0.01"/><mass value="{m}"/>
<inertia ixx="{i}" iyy="{i}" izz="{j}" ixy="0.001" ixz="0" iyz="-0.0005"/></inertial></link>"""
TURNS = """<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/><dynamics damping="{c}"/></joint>"""

FOUR_BAR = """name = "coupled"
urdf = "it.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["crank"]
{actuated}
[q_guess]
crank = 1.1
coupler = -0.6
rocker = 1.4
[[loop]]
name = "pin"
type = "point_2d"
frame_a = {{link = "b", xyz = [0.7, 0.0, 0.0]}}
frame_b = {{link = "c", xyz = [0.5, 0.0, 0.0]}}
rows_in = "world"
[[spring]]
frame_a = {{link = "a", xyz = [0.2, 0.05, 0.0]}}
frame_b = {{link = "c", xyz = [0.3, 0.0, 0.0]}}
rest_length = 0.35
stiffness = 60.0
damping = 0.7
[[spring]]
joint = "coupler"
rest = -0.5
stiffness = 3.0
damping = 0.1
"""

PLATE = """name = "plate"
gravity = [0.3, -0.2, -9.81]
[[tree]]
file = "it.urdf"
root = "free"
[q_guess]
"root.z" = 0.8
"root.rx" = 0.1
{legs}{struts}"""


def coupled_four_bar(folder: Path, actuated: str = "") -> Mechanism:
    """Write a four-bar with a spring and damper from crank to rocker and another on the coupler's pin."""
    bars = [("a", 0.15, 0.8), ("b", 0.35, 1.3), ("c", 0.2, 1.0)]
    links = "".join(LINK.format(name=k, x=x, y=0.02, m=m, i=0.01, j=0.02 + x * m / 10) for k, x, m in bars)
    joints = "".join(
        TURNS.format(name=name, parent=parent, child=child, x=x, c=c)
        for name, parent, child, x, c in [
            ("crank", "ground", "a", 0, 0.05),
            ("coupler", "a", "b", 0.3, 0),
            ("rocker", "ground", "c", 0.6, 0.02),
        ]
    )
    return _write_and_load(folder, f'<link name="ground"/>{links}{joints}', FOUR_BAR.format(actuated=actuated))


def plate_on_springs(folder: Path) -> Mechanism:
    """Write a Stewart platform with four springs and dampers and two struts of constant length as legs."""
    corners = [(0.3, 0.1), (0.2, 0.25), (-0.25, 0.2), (-0.35, 0.0), (-0.1, -0.3), (0.2, -0.25)]
    feet = [(0.5, 0.3), (0.0, 0.6), (-0.3, 0.5), (-0.6, -0.2), (-0.3, -0.5), (0.4, -0.45)]
    ends = [
        f'frame_a = {{link = "plate", xyz = [{a}, {b}, -0.05]}}\nframe_b = {{link = "world", xyz = [{c}, {d}, 0.0]}}\n'
        for (a, b), (c, d) in zip(corners, feet, strict=True)
    ]
    legs = "".join(
        f"[[spring]]\n{x}rest_length = {0.9 + k / 50}\nstiffness = {150 + 40 * k}\ndamping = {3 + k}\n"
        for k, x in enumerate(ends[:4])
    )
    struts = "".join(
        f'[[loop]]\nname = "strut_{k}"\ntype = "distance"\n{x}length = {0.8 + k / 40}\n' for k, x in enumerate(ends[4:])
    )
    urdf = LINK.format(name="plate", x=0.02, y=-0.03, m=4.0, i=0.2, j=0.35)
    return _write_and_load(folder, urdf, PLATE.format(legs=legs, struts=struts))


def _write_and_load(folder: Path, body: str, text: str) -> Mechanism:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "it.urdf").write_text(f'<robot name="it">{body}</robot>')
    (folder / "mechanism.toml").write_text(text)
    return load(str(folder / "mechanism.toml"))


WHEEL_INERTIA = 0.3  # about its axle, kg m²


def wheel_urdf(damping: float = 0.0, friction: float = 0.0) -> str:
    """Return the URDF of a wheel on a joint called axle."""
    return (
        '<robot name="wheel"><link name="base"/><link name="disc"><inertial><mass value="1.0"/>'
        f'<inertia ixx="0.2" iyy="0.2" izz="{WHEEL_INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="axle" type="continuous"><parent link="base"/><child link="disc"/><axis xyz="0 0 1"/>'
        f'<dynamics damping="{damping}" friction="{friction}"/></joint></robot>'
    )
