"""How points move with parameters: with the motion, and with what places them; against extrapolated differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, simulate
from ckc_pin.mechanism.parameters import values_of, with_components
from tests.sensitivity.changed import TIGHT
from tests.sensitivity.spatial import arms, tethered

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
    found = ckc_pin.sensitivities(scene, names, TIGHT)
    loaded = ckc_pin.load_scene(scene)
    mechanism = ckc_pin.load(loaded.sources.folder / loaded.spec.mechanism)
    values = with_components(values_of(mechanism.spec, mechanism.urdf))
    values |= {f"initial.q.{name}": x for name, x in loaded.spec.initial.q.items()}
    for k, name in enumerate(found.parameters):
        runs = [[simulate(scene, {**TIGHT, name: values[name] + x}).points for x in (h / s, -h / s)] for s in (1, 2, 4)]
        for point, moved in found.points.items():
            one, two, four = (
                (more[point] - less[point]) / (2 * h / s) for (more, less), s in zip(runs, (1, 2, 4), strict=True)
            )
            wanted = (16 * (4 * four - two) - (4 * two - one)) / 45
            assert np.abs(moved[:, :, k] - wanted).max() <= 1e-8 * max(1e-2, np.abs(wanted).max()), (name, point)
            assert np.array_equal(found.of(f"point:{point}.y", name), moved[:, 1, k])


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_of_what_places_joints_and_points(formulation: str, tmp_path: Path) -> None:
    """Before and behind fixed joints; one on the base stays where it is."""
    scene = arms(tmp_path, "hinge", formulation, more=POINTS)
    agree(scene, NAMES)
    assert not ckc_pin.sensitivities(scene, NAMES, {"t_end": 0.1}).points["still"].any()


def test_of_a_free_root(tmp_path: Path) -> None:
    scene = tethered(tmp_path)
    more = '[[point]]\nname = "tip"\nframe = { link = "body", xyz = [0.2, 0.1, -0.3] }\n'
    path = tmp_path / "body.toml"
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    agree(scene, ["link.body.mass", "spring.0.frame_a.xyz.x", "gravity.z"])


def test_lengths_that_only_a_point_stands_on_are_no_shape(tmp_path: Path) -> None:
    """Where nothing else is behind a fixed joint the motion does not depend on it, even under tracking control."""
    urdf = Path("urdf/five_bar/five_bar.urdf").read_text(encoding="utf-8")
    pen = '<link name="pen"/><joint name="grip" type="fixed"><parent link="link_2"/><child link="pen"/>' \
        '<origin xyz="0.1 0.2 0"/></joint></robot>'  # fmt: skip
    (tmp_path / "five_bar.urdf").write_text(urdf.replace("</robot>", pen), encoding="utf-8")
    text = Path("urdf/five_bar/mechanism.toml").read_text(encoding="utf-8")
    (tmp_path / "mechanism.toml").write_text(text.replace('frame = "tip_left"\n', 'frame = "pen"\n'), encoding="utf-8")
    scene = Path("urdf/five_bar/tracking.scene.toml").read_text(encoding="utf-8")
    (tmp_path / "tracking.scene.toml").write_text(scene, encoding="utf-8")
    found = ckc_pin.sensitivities(tmp_path / "tracking.scene.toml", ["joint.grip.xyz.x"], {"t_end": 0.5})
    assert not found.q_tree.any()
    turn = found.run["theta_1"] + found.run["theta_2"]
    wanted = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    assert np.abs(found.points["tip"][:, :, 0] - wanted).max() < 1e-12


def test_what_is_no_quantity_is_refused(tmp_path: Path) -> None:
    found = ckc_pin.sensitivities("five_bar/swing", ["gravity.y"], {"t_end": 0.1})
    for name in ("tip", "point:tip", None):
        with pytest.raises(InputError, match=r"there are theta_1, .*, point:tip\.x, point:tip\.y, point:tip\.z"):
            found.of(name, "gravity.y")  # type: ignore[arg-type]
