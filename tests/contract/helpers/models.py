"""MuJoCo models that need its compiler: replicas, attached models, included files, meshes, classes."""

from __future__ import annotations

import struct
from pathlib import Path

from ckc_pin.formats.importing import Draft, read

WORKSHOP = """<mujoco model="workshop">
<compiler angle="degree" meshdir="meshes"/>
<include file="parts/classes.xml"/>
<asset><mesh name="wedge" file="wedge.stl" scale="0.2 0.3 0.1"/><model name="leg" file="leg.xml"/></asset>
<worldbody>
  <light pos="0 0 5"/>
  <body name="hub" pos="0 0 1" euler="10 20 30">
    <joint name="spin" axis="0.1 0.2 1" class="stiff"/>
    <geom type="mesh" mesh="wedge"/><camera name="eye"/>
    <site name="pull" pos="0.1 0 0.2"/>
    <replicate count="3" euler="0 0 120" sep="_">
      <body name="arm" pos="0.3 0 0">
        <joint name="swing" pos="0.02 0 0.01" class="stiff" ref="15"/><geom type="capsule" size="0.02 0.1"/>
        <site name="tip" pos="0.2 0 0"/>
      </body>
    </replicate>
    <frame pos="0 0 0.2" euler="0 30 0"><attach model="leg" body="thigh" prefix="left_"/></frame>
    <frame pos="0 0 -0.2"><attach model="leg" body="thigh" prefix="right_"/></frame>
  </body>
  <body name="drifter" pos="0.5 0.5 1" quat="0.9 0.1 0.2 0.3">
    <freejoint name="drift"/><geom type="mesh" mesh="wedge" density="300"/><geom type="ellipsoid" size="0.1 0.2 0.3"/>
    <site name="hook" pos="0 0.1 0"/>
  </body>
</worldbody>
<tendon>
  <spatial name="elastic" stiffness="35" springlength="0.15" damping="1.5">
    <site site="pull"/><site site="tip_1"/></spatial>
  <spatial name="cord" stiffness="20"><site site="hook"/><site site="tip_2"/></spatial>
  <spatial name="dashpot" damping="4"><site site="hook"/><site site="pull"/></spatial>
  <spatial name="rod"><site site="hook"/><site site="tip_0"/></spatial>
  <fixed name="belt"><joint joint="swing_1" coef="2"/><joint joint="swing_2" coef="-0.5"/></fixed>
</tendon>
<equality>
  <connect name="pinned" body1="arm_0" body2="drifter" anchor="0.1 0.2 0.3"/>
  <weld name="glued" body1="left_shank" body2="right_shank" relpose="0.1 0 0.2 0.9 0.1 -0.3 0.2" anchor="0 0.02 0.01"/>
  <tendon name="rod" tendon1="rod" polycoef="0.07 0 0 0 0"/>
  <tendon name="swing_1 by swing_2" tendon1="belt" polycoef="0.1 0 0 0 0"/>
</equality>
</mujoco>"""

LEG = """<mujoco model="leg"><compiler angle="radian"/>
<default><geom density="400"/><joint damping="0.3" armature="0.02"/></default>
<asset><mesh name="foot" file="foot.stl" inertia="exact"/></asset>
<worldbody><body name="thigh">
  <joint name="hip" axis="0 1 0" range="-1.2 1.4"/><geom type="box" size="0.02 0.03 0.2"/>
  <body name="shank" pos="0 0 -0.4"><joint name="knee" axis="0 1 0" pos="0 0.01 0.02" springref="0.4" stiffness="6"/>
    <geom type="mesh" mesh="foot" pos="0.1 0 0"/><geom type="cylinder" size="0.02 0.2"/></body>
</body></worldbody>
<actuator><general name="motor" joint="knee" gear="3" armature="0.01" damping="0.2"/></actuator></mujoco>"""

CLASSES = """<mujocoinclude><default><geom density="500"/>
<default class="stiff"><joint axis="0 1 0" stiffness="12" springref="20" damping="0.4" frictionloss="0.1"/></default>
</default></mujocoinclude>"""

TWO_ARMS = """
<body name="left"><joint name="a" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
  <body name="rod" pos="1 0 .5"><joint name="b" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
    <site name="s1" pos="1 0 -.5"/><site name="s2" pos="1 .1 -.5"/></body></body>
<body name="right" pos="2 0 -1"><joint name="c" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
  <site name="t1" pos="0 0 1"/><site name="t2" pos="0 .1 1"/><site name="t3" pos="0 .2 1"/></body>
"""

CORNERS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]


def tetrahedron(size: float = 1.0) -> bytes:
    """Return a binary STL."""
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    corners = [[size * x for k in face for x in CORNERS[k]] for face in faces]
    triangles = (struct.pack("<12fH", 0.0, 0.0, 0.0, *flat, 0) for flat in corners)
    return bytes(80) + struct.pack("<I", len(faces)) + b"".join(triangles)


def write_workshop(folder: Path) -> Path:
    """Write the model with the files that it names; return its path."""
    files: dict[str, bytes] = {
        "workshop.xml": WORKSHOP.encode(),
        "leg.xml": LEG.encode(),
        "parts/classes.xml": CLASSES.encode(),
        "meshes/wedge.stl": tetrahedron(),
        "foot.stl": tetrahedron(0.2),
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder / "workshop.xml"


def model(tmp_path: Path, bodies: str, rest: str = "", name: str = "thing.xml") -> Draft:
    """Import a MuJoCo model with some bodies."""
    path = tmp_path / name
    path.write_text(f"<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody>{rest}</mujoco>", "utf-8")
    return read(path)


def has_note(notes: list[str], *fragments: str) -> bool:
    """Whether one note contains all fragments."""
    return any(all(fragment in note for fragment in fragments) for note in notes)
