"""Sensitivities of motions with couplings of several joints, polynomials and tables, against differences of runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from ckc_pin import sensitivities
from tests.sensitivity.spatial import BODY, MECHANISM, WHEEL, write_arms
from tests.sensitivity.test_named_parameters import TIGHT, agree

GEAR = MECHANISM[MECHANISM.index("[[coupling]]") : MECHANISM.index("[[spring]]")]
FORMS = {
    "joints": '[[coupling]]\nname = "sum"\njoints = { w = 1.0, la = 0.7, ra = -0.4, lb = 0.2 }\noffset = 0.3\n',
    "polynomial": '[[coupling]]\njoint = "w"\nother = "la"\npolynomial = [0.1, -0.7, 0.4, 0.3]\noffset = 0.2\n',
    "table": '[[coupling]]\nname = "cam"\njoint = "w"\nother = "la"\noffset = 0.2\n'
    "table = [[-3.0, 1.0], [-1.0, 0.6], [-0.2, 0.3], [0.1, 0.1], [0.25, -0.1], [0.5, 0.2], [1.5, 0.3], [4.0, 2.0]]\n",
}
NAMES = {
    "joints": ["coupling.sum.joints.la", "coupling.sum.joints.w", "coupling.sum.joints.lb", "coupling.sum.offset"],
    "polynomial": ["coupling.0.offset"],
    "table": ["coupling.cam.offset"],
}


LIMB = """<link name="{name}_link">{body}</link><joint name="{name}" type="revolute"><parent link="{parent}"/>
  <child link="{name}_link"/><origin xyz="0.3 0.05 0.1" rpy="0.2 -0.1 0.3"/><axis xyz="0 0.6 0.8"/>
  <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>"""
LIMBS = "".join(
    ['<robot name="limbs"><link name="base"/>', WHEEL.format(body=BODY)]
    + [LIMB.format(name=name, parent=parent, body=BODY)
       for name, parent in (("la", "base"), ("lb", "la_link"), ("ra", "base"))]
    + ["</robot>"]
)  # fmt: skip
SCENE = """mechanism = "limbs.toml"
formulation = "dae"
t_end = 0.4
initial.q = { la = 0.3, lb = -0.4, ra = 0.6 }
initial.q_dot = { la = 0.9, lb = 0.3, ra = -0.5 }
solver.output_dt = 0.1
"""


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
@pytest.mark.parametrize("form", list(FORMS))
def test_sensitivities_with_couplings(form: str, formulation: str, tmp_path: Path) -> None:
    """The parameters of the coupling, and others whose derivatives involve the curvature of the coupling."""
    scene = write_arms(tmp_path, "point", formulation)
    file = tmp_path / "arms.toml"
    # The wheel's eccentric mass makes its position matter, not only its rate.
    file.write_text(file.read_text(encoding="utf-8").replace(GEAR, FORMS[form]), encoding="utf-8")
    names = [*NAMES[form], "joint.w.rpy.x", "link.wheel.mass"]
    result = sensitivities(scene, names, TIGHT)
    agree(result, scene, TIGHT, h=4e-3, tolerance=5e-8)


@pytest.mark.parametrize("form", list(FORMS))
def test_compiled_terms_have_the_same_sensitivities(form: str, tmp_path: Path) -> None:
    """Without the arms' loop and outer joints, whose compiled terms test_compiled_terms.py compares."""
    (tmp_path / "limbs.urdf").write_text(LIMBS, encoding="utf-8")
    (tmp_path / "limbs.toml").write_text(
        f'name = "limbs"\nurdf = "limbs.urdf"\nindependent = ["la", "lb", "ra"]\n{FORMS[form]}', encoding="utf-8"
    )
    scene = str(tmp_path / "limbs.scene.toml")
    Path(scene).write_text(SCENE, encoding="utf-8")
    names = [*NAMES[form], "link.wheel.com.y"]
    compiled = {**TIGHT, "solver.terms": "generated"}
    result, other = (
        sensitivities(scene, names, overrides) for overrides in (compiled, TIGHT | {"solver.terms": "pinocchio"})
    )
    assert result.run.stats["terms"] == "generated"
    assert abs(result.q_tree - other.q_tree).max() < 1e-7 * abs(other.q_tree).max()
