"""A four-bar whose files are written from parameter values, and finite differences of its runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin import simulate

TIGHT = {"solver.rtol": 1e-12, "solver.atol": 1e-14, "solver.method": "DOP853"}

NUMBERS: dict[str, float] = {
    "link.crank.mass": 1.3,
    "link.coupler.com.x": 0.4,
    "link.coupler.com.y": 0.05,
    "link.rocker.inertia.izz": 0.09,
    "joint.b.xyz.x": 0.35,
    "joint.c.xyz.x": 0.8,
    "joint.c.xyz.y": 0.05,
    "joint.b.damping": 0.02,
    "joint.a.friction": 0.0,
    "joint.c.lower": -9.0,
    "joint.c.upper": 9.0,
    "joint.c.restitution": 0.5,
    "loop.knee.frame_a.xyz.x": 0.9,
    "loop.knee.frame_b.xyz.x": 0.6,
    "spring.0.stiffness": 12.0,
    "spring.0.rest_length": 0.5,
    "spring.0.damping": 0.1,
    "spring.0.frame_b.xyz.y": 0.3,
    "spring.1.stiffness": 2.0,
    "spring.1.rest": 0.4,
    "force.0.value": 0.3,
    "gravity.y": -9.81,
    "controller.K_P": 6.0,
    "controller.K_V": 0.7,
    "initial.q.a": 1.2,
    "initial.q_dot.a": 0.8,
}

URDF = """<robot name="bars">
  <link name="base"/>
  {links}
  <joint name="a" type="continuous"><parent link="base"/><child link="crank"/><axis xyz="0 0 1"/></joint>
  <joint name="b" type="continuous"><parent link="crank"/><child link="coupler"/>
  <origin xyz="{bx!r} 0 0"/><axis xyz="0 0 1"/><dynamics damping="{damping!r}"/></joint>
  <joint name="c" type="revolute"><parent link="base"/><child link="rocker"/><origin xyz="{cx!r} {cy!r} 0"/>
  <axis xyz="0 0 1"/><limit lower="{lower!r}" upper="{upper!r}" effort="1" velocity="1"/></joint>
</robot>"""

LINK = """<link name="{name}"><inertial><origin xyz="{x!r} {y!r} 0"/><mass value="{mass!r}"/>
  <inertia ixx="{i!r}" ixy="0" ixz="0" iyy="{i!r}" iyz="0" izz="{i!r}"/></inertial></link>"""

MECHANISM = """name = "bars"
urdf = "bars.urdf"
gravity = [0.0, {gravity!r}, 0.0]
independent = ["a"]
actuated = ["a"]
q_guess = {{ a = 1.2, b = -0.8, c = 1.4 }}
[[loop]]
name = "knee"
type = "point_2d"
frame_a = {{ link = "coupler", xyz = [{ax!r}, 0, 0] }}
frame_b = {{ link = "rocker", xyz = [{bx!r}, 0, 0] }}
[[spring]]
frame_a = {{ link = "coupler", xyz = [0.2, 0.1, 0] }}
frame_b = {{ link = "world", xyz = [0.5, {end!r}, 0] }}
stiffness = {stiffness!r}
rest_length = {rest_length!r}
damping = {damping!r}
[[spring]]
joint = "c"
stiffness = {joint_stiffness!r}
rest = {rest!r}
[[force]]
joint = "b"
value = {force!r}
[[joint]]
name = "a"
friction = {friction!r}
{stop}
"""

SCENE = """mechanism = "bars.toml"
formulation = "{formulation}"
t_end = {t_end!r}
initial.q.a = {q!r}
initial.q_dot.a = {q_dot!r}
solver.output_dt = {output_dt!r}
solver.terms = "pinocchio"
{more}
"""


def write_four_bar(
    folder: Path,
    overrides: dict[str, float] | None = None,
    *,
    stop: bool = False,
    controlled: bool = False,
    formulation: str = "dae",
    t_end: float = 1.0,
    more: str = "",
) -> str:
    """Write the files for some parameter values; return the scene's path."""
    x = {**NUMBERS, **(overrides or {})}
    mass, inertia = x["link.crank.mass"], 0.03 * x["link.crank.mass"] / NUMBERS["link.crank.mass"]  # a constant density
    links = [
        LINK.format(name="crank", x=0.2, y=0.01, mass=mass, i=inertia),
        LINK.format(name="coupler", x=x["link.coupler.com.x"], y=x["link.coupler.com.y"], mass=0.9, i=0.07),
        LINK.format(name="rocker", x=0.25, y=-0.02, mass=1.1, i=x["link.rocker.inertia.izz"]),
    ]
    urdf = URDF.format(
        links="\n  ".join(links), bx=x["joint.b.xyz.x"], cx=x["joint.c.xyz.x"], cy=x["joint.c.xyz.y"],
        damping=x["joint.b.damping"], lower=x["joint.c.lower"], upper=x["joint.c.upper"],
    )  # fmt: skip
    stop_table = f'[[joint]]\nname = "c"\nstops = true\nrestitution = {x["joint.c.restitution"]!r}' if stop else ""
    mechanism = MECHANISM.format(
        gravity=x["gravity.y"], ax=x["loop.knee.frame_a.xyz.x"], bx=x["loop.knee.frame_b.xyz.x"],
        end=x["spring.0.frame_b.xyz.y"], stiffness=x["spring.0.stiffness"], rest_length=x["spring.0.rest_length"],
        damping=x["spring.0.damping"], joint_stiffness=x["spring.1.stiffness"], rest=x["spring.1.rest"],
        force=x["force.0.value"], friction=x["joint.a.friction"], stop=stop_table,
    )  # fmt: skip
    if controlled:
        more += f'\n[controller]\ntype = "set_point"\nK_P = {x["controller.K_P"]!r}\nK_V = {x["controller.K_V"]!r}\n'
        more += "q_d = { a = 0.9 }\n"
    scene = SCENE.format(
        formulation=formulation,
        t_end=t_end,
        q=x["initial.q.a"],
        q_dot=x["initial.q_dot.a"],
        output_dt=t_end / 10,
        more=more,
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bars.urdf").write_text(urdf, encoding="utf-8")
    (folder / "bars.toml").write_text(mechanism, encoding="utf-8")
    (folder / "bars.scene.toml").write_text(scene, encoding="utf-8")
    return str(folder / "bars.scene.toml")


def finite_difference(folder: Path, name: str, h: float, read: Any = None, **kind: Any) -> Any:
    """Derivative of runs with respect to one parameter, by Richardson extrapolation of central differences."""

    def value(x: float) -> Any:
        run = simulate(write_four_bar(folder, {**kind.get("overrides", {}), name: x}, **rest), TIGHT)
        return np.stack([run.q_tree, run.v_tree]) if read is None else read(run)

    rest = {key: x for key, x in kind.items() if key != "overrides"}
    at = {**NUMBERS, **kind.get("overrides", {})}[name]
    one, two, four = ((value(at + x) - value(at - x)) / (2 * x) for x in (h, h / 2, h / 4))
    first, second = (4 * two - one) / 3, (4 * four - two) / 3
    return (16 * second - first) / 15
