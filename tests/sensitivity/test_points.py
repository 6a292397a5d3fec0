"""Sensitivities of points against extrapolated differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, simulate
from ckc_pin.mechanism.parameters import values_of, with_components
from tests.sensitivity.four_bar import TIGHT
from tests.sensitivity.spatial import write_arms, write_tethered_body

POINTS = """
[[point]]
name = "hand"
frame = { link = "lhand", xyz = [0.1, -0.05, 0.2] }
[[point]]
name = "bend"
frame = "lbend"
[[point]]
name = "right"
frame = { link = "r2", xyz = [0.0, 0.1, 0.05] }
[[point]]
name = "still"
frame = { link = "base", xyz = [0.3, 0.0, 0.0] }
"""
NAMES = ["joint.la.xyz.y", "joint.lb.rpy.z", "joint.lfix.xyz.x", "joint.lfix.rpy", "joint.lend.xyz.z", "joint.rb.xyz.x",
         "joint.lend.rpy.y", "joint.rfix.rpy.x", "loop.hold.frame_a.xyz.y", "link.r2.mass",
         "initial.q.ra"]  # fmt: skip


def agree(scene: str, names: list[str], *, h: float = 5e-4) -> None:
    result = ckc_pin.sensitivities(scene, names, TIGHT)
    loaded = ckc_pin.load_scene(scene)
    mechanism = ckc_pin.load(loaded.sources.folder / loaded.spec.mechanism)
    values = with_components(values_of(mechanism.spec, mechanism.urdf))
    values |= {f"initial.q.{name}": x for name, x in loaded.spec.initial.q.items()}
    for k, name in enumerate(result.parameters):
        runs = [[simulate(scene, {**TIGHT, name: values[name] + x}).points for x in (h / s, -h / s)] for s in (2, 4)]
        for point, derivative in result.points.items():
            one, two = ((more[point] - less[point]) / (2 * h / s) for (more, less), s in zip(runs, (2, 4), strict=True))
            expected = (4 * two - one) / 3
            assert np.abs(derivative[:, :, k] - expected).max() <= 1e-8 * max(1e-2, np.abs(expected).max()), (
                name,
                point,
            )
            assert np.array_equal(result.of(f"point:{point}.y", name), derivative[:, 1, k])


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_placements_of_joints_and_points(formulation: str, tmp_path: Path) -> None:
    """Of joints before and after fixed joints. A point on the base does not move."""
    scene = write_arms(tmp_path, "hinge", formulation, more=POINTS)
    agree(scene, NAMES)
    assert not ckc_pin.sensitivities(scene, NAMES, {"t_end": 0.1}).points["still"].any()


def test_points_on_a_free_root(tmp_path: Path) -> None:
    scene = write_tethered_body(tmp_path)
    more = '[[point]]\nname = "tip"\nframe = { link = "body", xyz = [0.2, 0.1, -0.3] }\n'
    path = tmp_path / "body.toml"
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    agree(scene, ["link.body.mass", "spring.0.frame_a.xyz.x", "gravity.z"])


def test_lengths_that_only_place_a_point_are_allowed_with_tracking(tmp_path: Path) -> None:
    """The motion does not depend on the placement of a fixed joint that only carries a point."""
    urdf = Path("urdf/five_bar/five_bar.urdf").read_text(encoding="utf-8")
    pen = '<link name="pen"/><joint name="grip" type="fixed"><parent link="link_2"/><child link="pen"/>' \
        '<origin xyz="0.1 0.2 0"/></joint></robot>'  # fmt: skip
    (tmp_path / "five_bar.urdf").write_text(urdf.replace("</robot>", pen), encoding="utf-8")
    text = Path("urdf/five_bar/mechanism.toml").read_text(encoding="utf-8")
    (tmp_path / "mechanism.toml").write_text(text.replace('frame = "tip_left"\n', 'frame = "pen"\n'), encoding="utf-8")
    scene = Path("urdf/five_bar/tracking.scene.toml").read_text(encoding="utf-8")
    (tmp_path / "tracking.scene.toml").write_text(scene, encoding="utf-8")
    result = ckc_pin.sensitivities(tmp_path / "tracking.scene.toml", ["joint.grip.xyz.x"], {"t_end": 0.5})
    assert not result.q_tree.any()
    angle = result.run["theta_1"] + result.run["theta_2"]
    expected = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    assert np.abs(result.points["tip"][:, :, 0] - expected).max() < 1e-12


def test_unknown_quantities_are_rejected(tmp_path: Path) -> None:
    result = ckc_pin.sensitivities("five_bar/swing", ["gravity.y"], {"t_end": 0.1})
    for name in ("tip", "point:tip", None):
        with pytest.raises(
            InputError, match=r"no such quantity; the nearest names are .*; there are the coordinates theta_1"
        ):
            result.of(name, "gravity.y")  # type: ignore[arg-type]


def test_derivatives_are_selected_by_name() -> None:
    result = ckc_pin.sensitivities("five_bar/set_point", ["link.link_2.mass", "gravity.y"], {"t_end": 0.1})
    assert np.array_equal(result["v.theta_2"], result.v_tree[:, 1])
    assert np.array_equal(result["tau.theta_3", "gravity.y"], result.tau[:, 1, 1])
    assert np.array_equal(result["tip.y", "gravity.y"], result.points["tip"][:, 1, 1])
    assert np.array_equal(result.of("point:tip.y", "gravity.y"), result["tip.y", "gravity.y"])
    with pytest.raises(InputError, match=r"sensitivities\['energy\.total'\]: this derivative is not computed"):
        result["energy.total"]
    with pytest.raises(InputError, match=r"no parameter 'gravity' among these; .*; did you mean 'gravity\.y'\?"):
        result["theta_1", "gravity"]
