"""Sensitivities against extrapolated differences of runs whose files have other numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.sensitivity.four_bar import NUMBERS, TIGHT, finite_difference, write_four_bar
from tests.sensitivity.spatial import write_tethered_body

TOLERANCE = 1e-8  # relative to the largest
STARTS = ["initial.q.a", "initial.q_dot.a"]
OF_STOPS = ["joint.c.lower", "joint.c.upper", "joint.c.restitution", "joint.a.friction"]
SMOOTH = [name for name in NUMBERS if not name.startswith("controller") and name not in OF_STOPS]
SOME = ["link.crank.mass", "loop.knee.frame_a.xyz.x", "joint.c.xyz.x", "spring.0.stiffness", *STARTS]


def agree(result: Sensitivities, names: list[str], folder: Path, tolerance: float = TOLERANCE, **kind: Any) -> None:
    assert result.run.status == "done"
    overrides = {**NUMBERS, **kind.get("overrides", {})}
    for k, name in enumerate(names):
        expected = finite_difference(folder, name, 1e-3 * max(0.3, abs(overrides[name])), **kind)
        ours = np.stack([result.q_tree[:, :, k], result.v_tree[:, :, k]])
        assert np.abs(expected).max() > 1e-4, name  # the parameter has an effect
        assert np.abs(ours - expected).max() <= tolerance * np.abs(expected).max(), name


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_all_kinds_of_parameters(formulation: str, tmp_path: Path) -> None:
    scene = write_four_bar(tmp_path / "x", formulation=formulation)
    result, plain = sensitivities(scene, SMOOTH, TIGHT), simulate(scene, TIGHT)
    assert np.abs(result.run.q_tree - plain.q_tree).max() < 1e-9
    assert result.run.stats["rhs"] <= 2 * plain.stats["rhs"]  # finite differences would need 1 + p times as many
    agree(result, SMOOTH, tmp_path / "y", formulation=formulation)


def test_gains_and_compensated_terms(tmp_path: Path) -> None:
    names = [*SOME, "gravity.y", "controller.K_P", "controller.K_V"]
    scene = write_four_bar(tmp_path / "x", controlled=True, formulation="reduced")
    agree(sensitivities(scene, names, TIGHT), names, tmp_path / "y", controlled=True, formulation="reduced")


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_an_impact(formulation: str, tmp_path: Path) -> None:
    names, overrides = [*SOME, "joint.c.restitution", "joint.c.upper"], {"joint.c.upper": 1.9}
    kind: dict[str, Any] = {"stop": True, "formulation": formulation}
    result = sensitivities(write_four_bar(tmp_path / "x", overrides, **kind), names, TIGHT)
    assert any("bounces" in event["name"] for event in result.run.events)
    agree(result, names, tmp_path / "y", overrides=overrides, **kind)


def test_an_inelastic_impact(tmp_path: Path) -> None:
    """The joint rests at its stop for a while, then leaves it."""
    names, overrides = [*SOME, "joint.c.upper"], {"joint.c.upper": 1.9, "joint.c.restitution": 0.0}
    result = sensitivities(write_four_bar(tmp_path / "x", overrides, stop=True), names, TIGHT)
    assert any("touches" in event["name"] for event in result.run.events)
    agree(result, names, tmp_path / "y", tolerance=5e-8, overrides=overrides, stop=True)


@pytest.mark.parametrize("friction", [0.8, 3.0])
def test_sliding_and_sticking(friction: float, tmp_path: Path) -> None:
    names, overrides = [*SOME, "joint.a.friction"], {"joint.a.friction": friction}
    result = sensitivities(write_four_bar(tmp_path / "x", overrides, t_end=2.0), names, TIGHT)
    assert any("slides" in event["name"] or "sticks" in event["name"] for event in result.run.events)
    # Differences of runs divide the errors of the times at which the joint sticks: up to 7e-8.
    agree(result, names, tmp_path / "y", tolerance=1e-7, overrides=overrides, t_end=2.0)


def test_the_time_of_the_event_that_ends_a_run(tmp_path: Path) -> None:
    event = '\n[[event]]\ncoordinate = "b"\nof = "q"\nvalue = 1.3\nstop = true\n'
    result = sensitivities(write_four_bar(tmp_path / "x", more=event), SOME, TIGHT)
    assert result.end_time is not None
    for k, name in enumerate(SOME):
        step = 1e-3 * max(0.3, abs(NUMBERS[name]))
        expected = finite_difference(tmp_path / "y", name, step, read=lambda run: run.t[-1], more=event)
        # events are located to 1e-12 s
        assert result.end_time[k] == pytest.approx(expected, abs=TOLERANCE * np.abs(result.end_time).max())


def test_a_change_of_partition(tmp_path: Path) -> None:
    """The crank makes full turns. The choice of q changes, but not the derivative."""
    overrides = {"formulation": "reduced", "initial.q_dot.crank": 12.0, "t_end": 1.0, **TIGHT}
    names = ["link.coupler_link.mass", "initial.q_dot.crank"]
    dae = sensitivities("four_bar/turning", names, {**overrides, "formulation": "dae"})
    reduced = sensitivities("four_bar/turning", names, overrides)
    assert np.abs(dae.q_tree - reduced.q_tree).max() <= TOLERANCE * np.abs(dae.q_tree).max()


@pytest.mark.parametrize("kind", ["dae", "reduced", "free root"])
def test_a_stiff_motion(kind: str, tmp_path: Path) -> None:
    """Implicit steps solve for the motion and for each parameter separately, with few additional steps."""
    if kind == "free root":
        scene, names = write_tethered_body(tmp_path), ["link.body.mass", "gravity.x", "initial.q.root.z"]
    else:
        scene, names = write_four_bar(tmp_path, formulation=kind), ["spring.0.damping", *STARTS]
    overrides = {**TIGHT, "solver.method": "Radau", "solver.rtol": 1e-9, "solver.atol": 1e-11}
    implicit, explicit = (sensitivities(scene, names, x) for x in (overrides, TIGHT))
    assert implicit.run.stats["method"] == "Radau"
    assert implicit.run.stats["differences"] == 0
    assert np.abs(implicit.q_tree - explicit.q_tree).max() <= 1e-6 * np.abs(explicit.q_tree).max()
    plain = simulate(scene, overrides).stats
    assert implicit.run.stats["rhs"] <= 2 * plain["rhs"]
    assert implicit.run.stats["jacobians"] <= 2 * plain["jacobians"]


def test_unknown_parameters_are_rejected_with_the_valid_ones(tmp_path: Path) -> None:
    scene = write_four_bar(tmp_path)
    for name, message in [
        ("link.crank.weight", r"there are link\.crank\.mass, link\.crank\.com, link\.crank\.com\.x"),
        ("link.rod.mass", r"there are link\.crank, link\.coupler, link\.rocker"),
        ("nothing", "names begin with gravity, link, joint, .*, controller, initial"),
        ("controller.K_P", "nothing of this scene is a controller"),
    ]:
        with pytest.raises(InputError, match=message):
            sensitivities(scene, [name])
    with pytest.raises(InputError, match=r"a parameter is repeated in gravity, gravity\.x"):
        sensitivities(scene, ["gravity", "gravity.x"])
    with pytest.raises(InputError, match="at least one"):
        sensitivities(scene, [])


@pytest.mark.parametrize(
    ("scene", "overrides", "message"),
    [
        ("five_bar/set_point", {"controller.sample_time": 0.01, "controller.sensor": {"resolution": 0.01}}, "sensor"),
        ("five_bar/swing", {"formulation": "spf", "spf_coordinates": "z"}, 'spf_coordinates = "w" only'),
        ("five_bar/swing", {"formulation": "spf", "initial.w": [0.01, 0.0]}, r"initial\.w"),
        ("five_bar/swing", {"solver.projection": False}, "projection"),
        ("five_bar/tracking", {}, "controller.model"),
    ],
)
def test_unsupported_scenes_are_rejected(scene: str, overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        sensitivities(scene, ["link.link_1.mass"], overrides)


@pytest.mark.parametrize("terms", ["pinocchio", "generated"])
def test_the_start_of_tracking(terms: str) -> None:
    """With the derivatives of eq. 16, on the paper's five-bar."""
    overrides = {**TIGHT, "formulation": "reduced", "t_end": 1.0, "solver.terms": terms}
    result = sensitivities("five_bar/tracking", ["initial.q_dot.theta_1"], overrides)

    def ended(h: float) -> Any:
        run = simulate("five_bar/tracking", {**overrides, "initial.q_dot.theta_1": h})
        return np.hstack([run.q_tree, run.v_tree, run.u])

    one, two, four = ((ended(h) - ended(-h)) / (2 * h) for h in (4e-3, 2e-3, 1e-3))
    expected = (16 * (4 * four - two) - (4 * two - one)) / 45
    ours = np.hstack([result.q_tree[:, :, 0], result.v_tree[:, :, 0], result.u[:, :, 0]])
    for part in (slice(8), slice(8, 10)):  # the motion and u
        assert np.abs(ours - expected)[:, part].max() <= TOLERANCE * np.abs(expected[:, part]).max()
    assert np.array_equal(result.tau, result.u)


def test_a_start_at_the_equilibrium(tmp_path: Path) -> None:
    """The equilibrium depends on the mechanism's parameters, and the mechanism stays there."""

    def rest(overrides: dict[str, float], folder: str) -> str:
        text = write_four_bar(tmp_path / folder, overrides)
        path = tmp_path / folder / "bars.scene.toml"
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("initial")]
        path.write_text("\n".join(['initial.at = "equilibrium"', *lines]) + "\n", encoding="utf-8")
        return text

    names = ["link.crank.mass", "spring.0.stiffness", "joint.c.xyz.x", "loop.knee.frame_a.xyz.x"]
    result = sensitivities(rest({}, "x"), names, {**TIGHT, "t_end": 0.1})
    for k, name in enumerate(names):
        h = 1e-3

        def at(x: float, name: str = name) -> Any:
            overrides = {**TIGHT, "t_end": 0.1}
            return simulate(rest({name: NUMBERS[name] + x}, "y"), overrides).q_tree[0]

        one, two, four = ((at(x) - at(-x)) / (2 * x) for x in (h, h / 2, h / 4))
        expected = (16 * (4 * four - two) - (4 * two - one)) / 45
        assert np.abs(result.q_tree[0, :, k] - expected).max() <= 1e-7 * np.abs(expected).max(), name
        assert np.abs(result.q_tree[-1, :, k] - expected).max() <= 1e-7 * np.abs(expected).max(), name


def test_output_instants_of_the_caller(tmp_path: Path) -> None:
    scene = write_four_bar(tmp_path / "x", formulation="dae")
    all_instants = sensitivities(scene, SOME, TIGHT)
    some = [0, 3, 4, 9]
    result = sensitivities(scene, SOME, TIGHT, instants=all_instants.t[some])
    assert np.array_equal(result.t, all_instants.t[some])
    assert np.abs(result.q_tree - all_instants.q_tree[some]).max() <= 1e-12
    for instants in ([], [0.1, 0.2], [0.0, 0.2, 0.2], [0.0, 1e9], [0.0, np.nan]):
        with pytest.raises(InputError, match="instants: expected increasing times from 0 to at most t_end"):
            sensitivities(scene, SOME, TIGHT, instants=instants)
