"""Sensitivities of motions with couplings of several joints, polynomials and tables, against differences of runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from ckc_pin import sensitivities
from tests.sensitivity.spatial import MECHANISM, write_arms
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
    scene = write_arms(tmp_path, "point", "dae")
    file = tmp_path / "arms.toml"
    file.write_text(file.read_text(encoding="utf-8").replace(GEAR, FORMS[form]), encoding="utf-8")
    names = [*NAMES[form], "link.wheel.com.y"]
    compiled = {**TIGHT, "solver.terms": "generated"}
    result, other = (
        sensitivities(scene, names, overrides) for overrides in (compiled, TIGHT | {"solver.terms": "pinocchio"})
    )
    assert result.run.stats["terms"] == "generated"
    assert abs(result.q_tree - other.q_tree).max() < 1e-7 * abs(other.q_tree).max()
