"""Sensitivities against extrapolated differences of tight runs of files that say other numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.sensitivity.changed import NUMBERS, TIGHT, differentiated, written
from tests.sensitivity.spatial import tethered

CLOSE = 1e-8  # of the largest
STARTS = ["initial.q.a", "initial.q_dot.a"]
OF_STOPS = ["joint.c.lower", "joint.c.upper", "joint.c.restitution", "joint.a.friction"]
PLAIN = [name for name in NUMBERS if not name.startswith("controller") and name not in OF_STOPS]
SOME = ["link.crank.mass", "loop.knee.frame_a.xyz.x", "joint.c.xyz.x", "spring.0.stiffness", *STARTS]


def agree(found: Sensitivities, names: list[str], folder: Path, tolerance: float = CLOSE, **kind: Any) -> None:
    assert found.run.status == "done"
    overrides = {**NUMBERS, **kind.get("overrides", {})}
    for k, name in enumerate(names):
        wanted = differentiated(folder, name, 1e-3 * max(0.3, abs(overrides[name])), **kind)
        ours = np.stack([found.q_tree[:, :, k], found.v_tree[:, :, k]])
        assert np.abs(wanted).max() > 1e-4, name  # it matters
        assert np.abs(ours - wanted).max() <= tolerance * np.abs(wanted).max(), name


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_of_every_kind_of_parameter(formulation: str, tmp_path: Path) -> None:
    scene = written(tmp_path / "x", formulation=formulation)
    found, plain = sensitivities(scene, PLAIN, TIGHT), simulate(scene, TIGHT)
    assert np.abs(found.run.q_tree - plain.q_tree).max() < 1e-9
    assert found.run.stats["rhs"] <= 2 * plain.stats["rhs"]  # where (1 + parameters) times as many are allowed
    agree(found, PLAIN, tmp_path / "y", formulation=formulation)


def test_of_gains_and_of_what_a_controller_compensates(tmp_path: Path) -> None:
    names = [*SOME, "gravity.y", "controller.K_P", "controller.K_V"]
    scene = written(tmp_path / "x", controlled=True, formulation="reduced")
    agree(sensitivities(scene, names, TIGHT), names, tmp_path / "y", controlled=True, formulation="reduced")


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_through_an_impact(formulation: str, tmp_path: Path) -> None:
    names, overrides = [*SOME, "joint.c.restitution", "joint.c.upper"], {"joint.c.upper": 1.9}
    kind: dict[str, Any] = {"stop": True, "formulation": formulation}
    found = sensitivities(written(tmp_path / "x", overrides, **kind), names, TIGHT)
    assert any("bounces" in event["name"] for event in found.run.events)
    agree(found, names, tmp_path / "y", overrides=overrides, **kind)


def test_through_an_impact_that_ends_at_the_stop(tmp_path: Path) -> None:
    """Held there for a while, then let go."""
    names, overrides = [*SOME, "joint.c.upper"], {"joint.c.upper": 1.9, "joint.c.restitution": 0.0}
    found = sensitivities(written(tmp_path / "x", overrides, stop=True), names, TIGHT)
    assert any("touches" in event["name"] for event in found.run.events)
    agree(found, names, tmp_path / "y", tolerance=5e-8, overrides=overrides, stop=True)


@pytest.mark.parametrize("friction", [0.8, 3.0])
def test_through_slipping_and_sticking(friction: float, tmp_path: Path) -> None:
    names, overrides = [*SOME, "joint.a.friction"], {"joint.a.friction": friction}
    found = sensitivities(written(tmp_path / "x", overrides, t_end=2.0), names, TIGHT)
    assert any("slides" in event["name"] or "sticks" in event["name"] for event in found.run.events)
    agree(found, names, tmp_path / "y", tolerance=5e-8, overrides=overrides, t_end=2.0)


def test_of_the_time_at_which_an_event_ends_a_run(tmp_path: Path) -> None:
    event = '\n[[event]]\ncoordinate = "b"\nof = "q"\nvalue = 1.3\nstop = true\n'
    found = sensitivities(written(tmp_path / "x", more=event), SOME, TIGHT)
    assert found.end_time is not None
    for k, name in enumerate(SOME):
        step = 1e-3 * max(0.3, abs(NUMBERS[name]))
        wanted = differentiated(tmp_path / "y", name, step, read=lambda run: run.t[-1], more=event)
        # events are located to 1e-12 s
        assert found.end_time[k] == pytest.approx(wanted, abs=CLOSE * np.abs(found.end_time).max())


def test_through_changes_of_partition(tmp_path: Path) -> None:
    """The crank turns all the way round: what serves as q changes, the derivative does not."""
    overrides = {"formulation": "reduced", "initial.q_dot.crank": 12.0, "t_end": 1.0, **TIGHT}
    names = ["link.coupler_link.mass", "initial.q_dot.crank"]
    dae = sensitivities("four_bar/turning", names, {**overrides, "formulation": "dae"})
    reduced = sensitivities("four_bar/turning", names, overrides)
    assert np.abs(dae.q_tree - reduced.q_tree).max() <= CLOSE * np.abs(dae.q_tree).max()


@pytest.mark.parametrize("kind", ["dae", "reduced", "free root"])
def test_where_the_motion_is_stiff(kind: str, tmp_path: Path) -> None:
    """Implicit steps solve for the motion and for each parameter by itself: not much more of them is needed."""
    if kind == "free root":
        scene, names = tethered(tmp_path), ["link.body.mass", "gravity.x", "initial.q.root.z"]
    else:
        scene, names = written(tmp_path, formulation=kind), ["spring.0.damping", *STARTS]
    overrides = {**TIGHT, "solver.method": "Radau", "solver.rtol": 1e-9, "solver.atol": 1e-11}
    implicit, explicit = (sensitivities(scene, names, x) for x in (overrides, TIGHT))
    assert implicit.run.stats["method"] == "Radau"
    assert implicit.run.stats["differences"] == 0
    assert np.abs(implicit.q_tree - explicit.q_tree).max() <= 1e-6 * np.abs(explicit.q_tree).max()
    plain = simulate(scene, overrides).stats
    assert implicit.run.stats["rhs"] <= 2 * plain["rhs"]
    assert implicit.run.stats["jacobians"] <= 2 * plain["jacobians"]


def test_what_is_no_parameter_is_refused_with_those_there_are(tmp_path: Path) -> None:
    scene = written(tmp_path)
    for name, says in [
        ("link.crank.weight", r"there are link\.crank\.mass, link\.crank\.com, link\.crank\.com\.x"),
        ("link.rod.mass", r"there are link\.crank, link\.coupler, link\.rocker"),
        ("nothing", "names begin with gravity, link, joint, .*, controller, initial"),
        ("controller.K_P", "nothing of this scene is a controller"),
    ]:
        with pytest.raises(InputError, match=says):
            sensitivities(scene, [name])
    with pytest.raises(InputError, match="twice"):
        sensitivities(scene, ["gravity", "gravity.x"])
    with pytest.raises(InputError, match="at least one"):
        sensitivities(scene, [])


@pytest.mark.parametrize(
    ("scene", "overrides", "says"),
    [
        ("five_bar/set_point", {"controller.sample_time": 0.01, "controller.sensor": {"resolution": 0.01}}, "sensor"),
        ("five_bar/swing", {"formulation": "spf", "spf_coordinates": "z"}, "eq. 8 as printed"),
        ("five_bar/swing", {"formulation": "spf", "initial.w": [0.01, 0.0]}, r"initial\.w"),
        ("five_bar/swing", {"solver.projection": False}, "projection"),
        ("five_bar/tracking", {}, "controller.model"),
    ],
)
def test_motions_without_known_derivatives_are_refused(scene: str, overrides: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        sensitivities(scene, ["link.link_1.mass"], overrides)


@pytest.mark.parametrize("terms", ["pinocchio", "generated"])
def test_of_the_start_under_tracking_control(terms: str) -> None:
    """By the exact derivatives of eq. 16, on the paper's five-bar."""
    overrides = {**TIGHT, "formulation": "reduced", "t_end": 1.0, "solver.terms": terms}
    found = sensitivities("five_bar/tracking", ["initial.q_dot.theta_1"], overrides)

    def ended(h: float) -> Any:
        run = simulate("five_bar/tracking", {**overrides, "initial.q_dot.theta_1": h})
        return np.hstack([run.q_tree, run.v_tree, run.u])

    one, two, four = ((ended(h) - ended(-h)) / (2 * h) for h in (4e-3, 2e-3, 1e-3))
    wanted = (16 * (4 * four - two) - (4 * two - one)) / 45
    ours = np.hstack([found.q_tree[:, :, 0], found.v_tree[:, :, 0], found.u[:, :, 0]])
    for part in (slice(8), slice(8, 10)):  # the motion, and what moves it
        assert np.abs(ours - wanted)[:, part].max() <= CLOSE * np.abs(wanted[:, part]).max()
    assert np.array_equal(found.tau, found.u)


def test_of_a_start_at_the_equilibrium(tmp_path: Path) -> None:
    """Which moves with the mechanism: without control nothing else happens."""

    def rest(overrides: dict[str, float], folder: str) -> str:
        text = written(tmp_path / folder, overrides)
        path = tmp_path / folder / "bars.scene.toml"
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("initial")]
        path.write_text("\n".join(['initial.at = "equilibrium"', *lines]) + "\n", encoding="utf-8")
        return text

    names = ["link.crank.mass", "spring.0.stiffness", "joint.c.xyz.x", "loop.knee.frame_a.xyz.x"]
    found = sensitivities(rest({}, "x"), names, {**TIGHT, "t_end": 0.1})
    for k, name in enumerate(names):
        h = 1e-3

        def at(x: float, name: str = name) -> Any:
            overrides = {**TIGHT, "t_end": 0.1}
            return simulate(rest({name: NUMBERS[name] + x}, "y"), overrides).q_tree[0]

        one, two, four = ((at(x) - at(-x)) / (2 * x) for x in (h, h / 2, h / 4))
        wanted = (16 * (4 * four - two) - (4 * two - one)) / 45
        assert np.abs(found.q_tree[0, :, k] - wanted).max() <= 1e-7 * np.abs(wanted).max(), name
        assert np.abs(found.q_tree[-1, :, k] - wanted).max() <= 1e-7 * np.abs(wanted).max(), name
