"""Small mechanisms for tests of figures and playback, written into a folder as a user would."""

from __future__ import annotations

import struct
from pathlib import Path

INERTIAL = """<inertial><origin xyz="0.1 0 0"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>"""

# A spatial arm of two hinges and a slide.
ARM = f"""
<robot name="arm">
  <link name="base"/>
  <link name="a">{INERTIAL}</link>
  <link name="b">{INERTIAL}</link>
  <link name="c">{INERTIAL}</link>
  <joint name="turn" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
  <joint name="lift" type="continuous"><parent link="a"/><child link="b"/>
    <origin xyz="0.4 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="reach$/1" type="prismatic"><parent link="b"/><child link="c"/>
    <origin xyz="0.2 0 0"/><axis xyz="1 0 0"/></joint>
</robot>
"""

START_OF_ARM = '[initial.q]\nturn = 0.1\nlift = 0.1\n"reach$/1" = 0.1\n'

# A four-bar in the x-z plane: crank 0.2, coupler 0.5, rocker 0.4, base 0.5 m.
FOUR_BAR = f"""
<robot name="four_bar">
  <link name="base"/>
  <link name="crank">{INERTIAL}</link>
  <link name="coupler">{INERTIAL}</link>
  <link name="rocker">{INERTIAL}</link>
  <joint name="alpha" type="continuous"><parent link="base"/><child link="crank"/><axis xyz="0 1 0"/></joint>
  <joint name="beta" type="continuous"><parent link="crank"/><child link="coupler"/>
    <origin xyz="0.2 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="gamma" type="continuous"><parent link="base"/><child link="rocker"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 1 0"/></joint>
</robot>
"""
START_OF_FOUR_BAR = "[initial.q]\nalpha = -0.5\n"
FOUR_BAR_LOOP = """
independent = ["alpha"]
[q_guess]
alpha = -0.5
beta = 0.0
gamma = -1.5
[[loop]]
name = "joint"
type = "point_2d"
frame_a = {link = "coupler", xyz = [0.5, 0.0, 0.0]}
frame_b = {link = "rocker", xyz = [0.4, 0.0, 0.0]}
axis_a = [0.0, 1.0, 0.0]
"""


TETRAHEDRON = ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def tetrahedron(path: Path) -> None:
    """Write a tetrahedron in binary STL."""
    path.parent.mkdir(exist_ok=True)
    triangles = [struct.pack("<12fH", 0, 0, 0, *(x for k in face for x in TETRAHEDRON[k]), 0) for face in FACES]
    path.write_bytes(bytes(80) + struct.pack("<I", len(FACES)) + b"".join(triangles))


def write_scene(folder: Path, urdf: str, mechanism: str, scene: str, t_end: float = 0.5) -> Path:
    """Write a mechanism and a scene of it; `mechanism` and `scene` are added to their files."""
    folder.mkdir()
    (folder / "m.urdf").write_text(urdf)
    (folder / "mechanism.toml").write_text(f'name = "{folder.name}"\nurdf = "m.urdf"\n{mechanism}')
    path = folder / "default.scene.toml"
    path.write_text(f'mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = {t_end}\n{scene}')
    return path
