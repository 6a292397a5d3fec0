"""Sensitivities of a joint that comes to rest on its stop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.sensitivity.sensitivities import sensitivities

LINK = """<link name="{name}"><inertial><origin xyz="{x} 0 0"/><mass value="{m}"/>
<inertia ixx="1e-4" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
URDF = """<robot name="held"><link name="ground"/>{links}
<joint name="a" type="continuous"><parent link="ground"/><child link="crank"/><axis xyz="0 0 1"/></joint>
<joint name="b" type="continuous"><parent link="crank"/><child link="rod"/><origin xyz="0.2 0 0"/><axis xyz="0 0 1"/>
</joint><joint name="c" type="revolute"><parent link="ground"/><child link="rocker"/><origin xyz="0.5 0 0"/>
<axis xyz="0 0 1"/><limit lower="1.0" upper="1.6" effort="1" velocity="1"/></joint></robot>"""
MECHANISM = """name = "held"
urdf = "held.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["a"]
q_guess = { a = 1.2, c = 1.3 }
[[loop]]
name = "knee"
type = "point_2d"
frame_a = { link = "rod", xyz = [0.6, 0.0, 0.0] }
frame_b = { link = "rocker", xyz = [0.4, 0.0, 0.0] }
[[joint]]
name = "c"
stops = true
"""
SCENE = """mechanism = "held.toml"
formulation = "dae"
t_end = 1.0
initial.q.a = 1.2
solver.output_dt = 0.5
"""


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-11])
def test_positions_at_rest_depend_on_the_stop_only(formulation: str, rtol: float, tmp_path: Path) -> None:
    """The loop has one freedom, so its configuration at rest follows from the stop."""
    links = [LINK.format(name=name, x=x, m=m, i=i) for name, x, m, i in
             (("crank", 0.1, 0.5, 2e-3), ("rod", 0.3, 1.0, 3e-2), ("rocker", 0.2, 1.0, 1e-2))]  # fmt: skip
    (tmp_path / "held.urdf").write_text(URDF.format(links="".join(links)), encoding="utf-8")
    (tmp_path / "held.toml").write_text(MECHANISM, encoding="utf-8")
    path = tmp_path / "held.scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    overrides = {"formulation": formulation, "solver.rtol": rtol}
    names = ["gravity.y", "initial.q.a", "joint.c.lower"]
    result, plain = sensitivities(path, names, overrides), simulate(path, overrides)
    assert result.run.status == plain.status == "done"
    assert [event["name"] for event in result.run.events] == [event["name"] for event in plain.events] == ["c touches"]
    a, b, c = plain.q_tree[-1]
    crank = 0.2 * np.array([-np.sin(a), np.cos(a)])
    rod, rocker = (x * np.array([-np.sin(at), np.cos(at)]) for x, at in ((0.6, a + b), (0.4, c)))
    rates = np.linalg.solve(np.column_stack([crank + rod, rod]), rocker)
    expected = np.column_stack([np.zeros((3, 2)), [*rates, 1.0]])
    assert np.abs(result.q_tree[-1] - expected).max() <= 100 * rtol + 1e-10
