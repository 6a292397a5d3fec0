"""Shipped mechanisms: freedoms, start of every scene, and energy conservation."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, Run, check, load, simulate
from ckc_pin.dynamics import Terms, h_gradient, stable_equilibrium
from ckc_pin.mechanism.library import library, shipped
from ckc_pin.scene.names import list_catalogue, list_scene_names

# coordinates, freedoms, closure rows, rank, from the literature or by counting
MOBILITY = {
    "andrews": (7, 1, 6, 6),
    "bricard": (5, 1, 5, 4),  # overconstrained: counting rows would give no freedom
    "delta": (21, 3, 18, 18),
    "five_bar": (4, 2, 2, 2),
    "five_bar_as_printed": (4, 2, 2, 2),
    "flyball": (4, 4, 0, 0),  # a tree
    "four_bar": (3, 1, 2, 2),
    "n_four_bar": (9, 1, 8, 8),  # N = 4
    "slider_crank": (3, 1, 2, 2),
    "slider_crank_spatial": (4, 1, 3, 3),
    "stewart": (24, 6, 18, 18),
    "talos": (38, 26, 12, 12),
    "three_rrr": (7, 3, 4, 4),
    "two_ur5": (18, 6, 12, 12),
}
# mechanisms without damping and motors, and the duration of the test's run (s)
FREE = {
    "andrews": 0.03,
    "bricard": 5.0,
    "delta": 1.5,
    "four_bar": 5.0,
    "n_four_bar": 0.6,
    "slider_crank": 2.0,
    "slider_crank_spatial": 2.0,
    "stewart": 1.0,
    "three_rrr": 5.0,
    "two_ur5": 0.6,
}
SLIDER_CRANK = library() / "slider_crank"
OF_OTHERS = ("talos", "two_ur5")  # links drawn by the robots' own meshes
SCENES = [f"{name}/{scene}" for name in shipped() for scene in list_scene_names(name)]


@cache
def mechanism(name: str) -> Mechanism:
    return load(name)


def test_all_shipped_mechanisms_are_covered() -> None:
    assert shipped() == sorted(MOBILITY)


@pytest.mark.parametrize("name", MOBILITY)
def test_number_of_freedoms_is_correct(name: str) -> None:
    result = check(mechanism(name))
    assert (result.n, result.d, result.rows, result.rank) == MOBILITY[name]
    assert len(result.redundant) == result.rows - result.rank
    assert result.cond_phi_z < 100
    assert not mechanism(name).freedoms.singular
    assert mechanism(name).residual <= 1e-10


@pytest.mark.parametrize("name", sorted(set(MOBILITY) - set(OF_OTHERS)))
def test_shipped_mechanisms_have_no_warnings(name: str) -> None:
    assert check(mechanism(name)).warnings == ()


def test_shipped_files_have_descriptions() -> None:
    for name, about, scenes in list_catalogue():
        assert len(about.split()) > 5, name
        assert "default" in scenes, name
        assert all(scenes.values()), name


@pytest.mark.parametrize("name", sorted(set(shipped()) - {"n_four_bar"}))
def test_moving_links_have_visible_shapes(name: str) -> None:
    for file in (library() / name).glob("*.urdf"):
        for link in ElementTree.parse(file).getroot().findall("link"):
            if link.find("inertial") is not None:
                assert link.find("visual/geometry") is not None, f"{file}: {link.get('name')}"


@pytest.mark.parametrize("scene", SCENES)
def test_shipped_scene_runs(scene: str) -> None:
    run = simulate(scene, {"t_end": 0.01, "solver.output_dt": None})
    assert run.status == "done", run.message
    assert run.max_phi <= 1e-10


# --- energy --------------------------------------------------------------------------------------


def drift(run: Run) -> float:
    """Largest change of the energy, relative to the largest kinetic energy and the range of the potential energy."""
    model = run.mechanism
    potential = np.array(
        [
            Terms(model, model.kinematics(model.tree.from_coordinates(q)), v).potential_energy
            for q, v in zip(run.q_tree, run.v_tree, strict=True)
        ]
    )
    scale = (run.energy - potential).max() + np.ptp(potential)
    return float(np.abs(run.energy - run.energy[0]).max() / scale)


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("name", FREE)
def test_energy_is_conserved_without_control(name: str, formulation: str) -> None:
    t_end = FREE[name]
    overrides = {"formulation": formulation, "t_end": t_end, "solver.rtol": 1e-9, "solver.output_dt": t_end / 100}
    run = simulate(name, overrides)
    assert run.status == "done", run.message
    assert drift(run) <= (1e-7 if name == "bricard" else 3e-8)  # Bricard's phi_z comes nearest to singular
    assert run.max_phi <= 1e-10
    assert np.ptp(run.q_tree, axis=0).max() > 0.01  # the mechanism has moved


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_talos_energy_equals_work_of_dampers_and_friction(formulation: str) -> None:
    run = simulate("talos", {"formulation": formulation, "t_end": 0.1, "solver.output_dt": 1e-4})
    power = np.sum(run.mechanism.springs.joint_damping * run.v_tree**2, axis=1)
    assert len(power) % 2 == 1
    dissipated = 1e-4 / 3 * (power[0] + 4 * power[1::2].sum() + 2 * power[2:-1:2].sum() + power[-1])
    assert run.dissipated is not None
    rubbed = run.dissipated[-1]
    lost = run.energy[0] - run.energy[-1] - rubbed
    assert min(rubbed, lost) > 0.003
    assert lost == pytest.approx(dissipated, rel=1e-6)


# --- equilibria ----------------------------------------------------------------------------------

# Equilibria under gravity and springs, by symmetry. q_guess of both slider-cranks is balanced upright.
RESTS = {
    "bricard": {"hinge_1": np.pi / 2},
    "slider_crank": {"crank": 3 * np.pi / 2},
    "slider_crank_spatial": {"crank": np.pi},
    "stewart": {"plate_place.x": 0.0, "plate_place.y": 0.0, "plate_place.rz": 0.0},
    "delta": {"plate_place.x": 0.0, "plate_place.y": 0.0, "plate_place.rz": 0.0},
    "four_bar": {},
    "andrews": {},
}


@pytest.mark.parametrize("name", RESTS)
def test_equilibrium_is_stable(name: str) -> None:
    model = mechanism(name)
    at = stable_equilibrium(model)
    q = model.tree.named(model.tree.to_coordinates(at.q_tree))
    assert {key: q[key] for key in RESTS[name]} == pytest.approx(RESTS[name], abs=1e-7)
    assert np.abs(Terms(model, at, np.zeros(model.n)).h).max() <= 1e-9
    assert np.linalg.eigvalsh(h_gradient(model, at))[0] > 0


# --- the same mechanism, cut open elsewhere ------------------------------------------------------

RAIL = """
name = "slider_crank"
urdf = "slider_crank.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["crank"]
[q_guess]
crank = 1.5707963267948966
rod = -1.9
pin = 0.33
[[loop]]
name = "rail"
type = "{type}"
frame_a = "{a}"
frame_b = "{b}"
axis_a = [1.0, 0.0, 0.0]
axis_b = [1.0, 0.0, 0.0]
"""


@cache
def crank_angle(scene: str | Path, formulation: str) -> float:
    """Angle of the crank after most of a turn."""
    run = simulate(scene, {"formulation": formulation, "t_end": 0.5, "solver.rtol": 1e-11, "solver.output_dt": 0.5})
    angle = float(run.q_tree[-1, run.column("crank")])
    assert angle > 3.0
    return angle


def assert_same_motion(folder: Path) -> None:
    """Check that the crank of a slider-crank in a folder moves like the shipped one's."""
    scene = folder / "default.scene.toml"
    scene.write_text((SLIDER_CRANK / scene.name).read_text())
    for formulation in ("dae", "reduced"):
        assert crank_angle(scene, formulation) == pytest.approx(crank_angle("slider_crank", formulation), abs=1e-9)


@pytest.mark.parametrize("ends", [("world", "slider_link"), ("slider_link", "world")], ids=" to ".join)
@pytest.mark.parametrize(("kind", "rows"), [("prismatic", 5), ("cylindrical", 4)])
def test_loop_cut_at_the_rail_gives_the_same_motion(
    tmp_path: Path, kind: str, rows: int, ends: tuple[str, str]
) -> None:
    """The slider is attached to the rod in the tree and the rail is a loop with redundant rows."""
    tree = ElementTree.parse(SLIDER_CRANK / "slider_crank.urdf")
    joint = next(j for j in tree.getroot().findall("joint") if j.get("name") == "slider")
    joint.set("name", "pin")
    joint.set("type", "continuous")
    for tag, key, value in (("parent", "link", "rod_link"), ("origin", "xyz", "0.3 0 0"), ("axis", "xyz", "0 0 1")):
        element = joint.find(tag)
        assert element is not None
        element.set(key, value)
    tree.write(tmp_path / "slider_crank.urdf")
    (tmp_path / "mechanism.toml").write_text(RAIL.format(type=kind, a=ends[0], b=ends[1]))
    result = check(tmp_path / "mechanism.toml")
    assert (result.n, result.d, result.rows, result.rank) == (3, 1, rows, 2)
    assert_same_motion(tmp_path)


OTHER_PINS = {
    "point": ('type = "point"', 3),
    "hinge": ('type = "hinge"', 5),
    "universal": ('type = "universal"\naxis_b = [0.0, 1.0, 0.0]', 4),
}


@pytest.mark.parametrize(("loop", "rows"), OTHER_PINS.values(), ids=OTHER_PINS)
def test_redundant_loop_types_give_the_same_motion(tmp_path: Path, loop: str, rows: int) -> None:
    """A planar pin closed by a point, a hinge or a universal joint."""
    (tmp_path / "slider_crank.urdf").write_text((SLIDER_CRANK / "slider_crank.urdf").read_text())
    text = (SLIDER_CRANK / "mechanism.toml").read_text()
    (tmp_path / "mechanism.toml").write_text(text.replace('type = "point_2d"', loop))
    result = check(tmp_path / "mechanism.toml")
    assert (result.n, result.d, result.rows, result.rank) == (3, 1, rows, 2)
    assert_same_motion(tmp_path)


# --- unsupported combinations are rejected --------------------------------------------------------


@pytest.mark.parametrize("name", ["delta", "stewart", "talos", "two_ur5"])
def test_eq_8_as_printed_is_rejected_with_a_free_root(name: str) -> None:
    with pytest.raises(InputError, match="rotation of a free root has no such numbers"):
        simulate(name, {"formulation": "spf", "spf_coordinates": "z", "t_end": 0.01})
    assert simulate(name, {"formulation": "spf", "t_end": 0.01}).status == "done"


def test_contradictory_w_of_redundant_rows_is_rejected() -> None:
    """The five rows of Bricard's hinge have rank four."""
    overrides = {"formulation": "spf", "epsilon": 0.1, "t_end": 0.05}
    with pytest.raises(InputError, match=r"no configuration has phi = w.*follow from others \(hinge_4"):
        simulate("bricard", {**overrides, "initial.w": [1e-3] * 5})
    bricard, moves = mechanism("bricard"), np.array([1e-3, 0.0, 2e-3, 1e-3, 0.0])
    moves[bricard.partition.q] = 0.0  # keep q of the start
    off = bricard.assembled.integrate(moves)
    assert np.abs(off.phi).max() > 1e-4
    run = simulate("bricard", {**overrides, "initial.w": off.phi.tolist()})
    assert run.status == "done"
    assert np.abs(run.phi[0] - off.phi).max() <= 1e-12
    assert np.abs(run.phi[-1]).max() < 0.7 * np.abs(off.phi).max()
