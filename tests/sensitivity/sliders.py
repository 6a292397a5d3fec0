"""Two sliders on a line, side by side or the second on the first, whose motions have a closed form."""

from __future__ import annotations

from pathlib import Path

LINK = """<link name="{name}"><inertial><mass value="{mass!r}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="prismatic"><parent link="{on}"/><child link="{link}"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="{upper!r}" effort="1" velocity="1"/></joint>"""


def write_sliders(
    folder: Path,
    more: str,
    *,
    q: tuple[float, float] = (0.0, 0.0),
    q_dot: tuple[float, float] = (0.0, 0.0),
    masses: tuple[float, float] = (1.3, 0.7),
    upper: float = 9.0,
    on: str = "ground",
    scene: str = "",
) -> str:
    """Write the files, with `more` appended to the mechanism's; return the scene's path."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = [LINK.format(name=name, mass=mass) for name, mass in zip(("one", "two"), masses, strict=True)]
    parts += [JOINT.format(name="x", on="ground", link="one", upper=upper)]
    parts += [JOINT.format(name="y", on=on, link="two", upper=9.0)]
    (folder / "sliders.urdf").write_text(f'<robot name="sliders"><link name="ground"/>{"".join(parts)}</robot>')
    head = 'name = "sliders"\nurdf = "sliders.urdf"\ngravity = [0, 0, 0]\nindependent = ["x", "y"]\n'
    (folder / "sliders.toml").write_text(head + more)
    path = folder / "sliders.scene.toml"
    path.write_text(
        f"""mechanism = "sliders.toml"
formulation = "dae"
t_end = 1.0
initial.q = {{ x = {float(q[0])!r}, y = {float(q[1])!r} }}
initial.q_dot = {{ x = {float(q_dot[0])!r}, y = {float(q_dot[1])!r} }}
solver.output_dt = 0.5
{scene}
"""
    )
    return str(path)


def joint(name: str, *, friction: float = 0.0, restitution: float | None = None) -> str:
    stop = "" if restitution is None else f"stops = true\nrestitution = {restitution!r}\n"
    return f'[[joint]]\nname = "{name}"\nfriction = {friction!r}\n{stop}'


def force(name: str, value: float) -> str:
    return f'[[force]]\njoint = "{name}"\nvalue = {value!r}\n'
