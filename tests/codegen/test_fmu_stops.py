"""Stops in FMUs: impacts and contact against `simulate` and against Newton's law of impact with Pinocchio's inertia."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from ckc_pin import Scene, Simulator, load, load_scene, simulate
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.scene.parts import load_scene_mechanism
from tests.codegen.fmu_instance import Instance, write_fmu
from tests.codegen.test_export_c import SANITIZERS, WARNINGS, run

RTOL, SOLVER_TOLERANCE = 1e-11, 1e-10
EXACT = 1e-9  # relative: co-simulation against `simulate`
MAX_ERROR_FACTOR = 1e4  # in model exchange: CVode's errors grow over some tens of impacts
OUTPUT_DT = 0.01
FRICTIONLESS = {f"joint.theta_{k}.friction": 0.0 for k in (1, 2, 3, 4)}
DOWN = {"gravity": [-9.81, -3.0, 0.0]}  # presses both links on their stops
SCENES: dict[str, tuple[dict[str, Any], dict[str, Any], int]] = {  # parameters, other keys, least number of events
    "bounces": ({}, {"t_end": 3.0}, 6),
    "comes to rest": (DOWN, {"t_end": 1.0}, 60),
    "both stops at once": (
        {**DOWN, "joint.theta_3.restitution": 0.9},
        {"t_end": 0.5, "initial": {"q": {"theta_1": -1.45, "theta_3": -2.0}, "q_dot": {"theta_1": -1, "theta_3": -2}}},
        5,
    ),
}


def five_bar(case: str, **overrides: Any) -> Scene:
    parameters, more, _ = SCENES[case]
    keys = {
        "controller": None, "formulation": "reduced", "solver.rtol": RTOL, "solver.output_dt": OUTPUT_DT,
        "parameters": FRICTIONLESS | parameters, **more, **overrides,
    }  # fmt: skip
    return load_scene("five_bar/friction", keys)


def slider_crank(folder: Path, crank: float = -9.0, low: float = 0.22, high: float = 0.37, **keys: Any) -> Scene:
    """Return a slider-crank with stops. The slider is a dependent coordinate."""
    folder.mkdir()
    limits = {
        'name="crank" type="continuous">': f'name="crank" type="revolute"><limit lower="{crank!r}" upper="9"',
        'name="slider" type="prismatic">': f'name="slider" type="prismatic"><limit lower="{low!r}" upper="{high!r}"',
    }
    for file, text in load("slider_crank").sources.texts.items():
        for old, new in limits.items():
            text = text.replace(old, f'{new} effort="9" velocity="9"/>')
        stops = "".join(f'\n[[joint]]\nname = "{x}"\nstops = true\nrestitution = 0.5\n' for x in ("crank", "slider"))
        (folder / file).write_text(text + (stops if file == "mechanism.toml" else ""))
    solver = {"rtol": RTOL, "output_dt": OUTPUT_DT}
    initial = {"q": {"crank": 1.3}, "q_dot": {"crank": -1.0}}
    return Scene(folder, **{"formulation": "reduced", "solver": solver, "t_end": 2.0, "initial": initial, **keys})


@pytest.fixture(scope="module")
def fmu_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """Return the file of a case's FMU, which is written once."""

    @cache
    def exported(case: str, fmi: str) -> Path:
        return write_fmu(five_bar(case), tmp_path_factory.mktemp("fmu"), fmi)

    return exported


def compare(scene: Scene, path: Path, kind: str, least_events: int, tolerance: float = SOLVER_TOLERANCE) -> None:
    mechanism, ours = load_scene_mechanism(scene), simulate(scene)
    assert len(ours.events) >= least_events
    names = [f"{prefix}{x}" for prefix in ("", "v.") for x in mechanism.coordinates]
    is_exact = kind == "CoSimulation"
    theirs = fmpy.simulate_fmu(
        str(path), fmi_type=kind, stop_time=scene.spec.t_end, output_interval=OUTPUT_DT, output=names,
        relative_tolerance=RTOL if is_exact else tolerance, record_events=False,
    )  # fmt: skip
    np.testing.assert_allclose(theirs["time"], ours.t, atol=1e-9)
    for part in (names[: mechanism.n], names[mechanism.n :]):
        # At the start, FMPy records the motion after an impact, and the run before it.
        expected, actual = (np.array([run[name][1:] for name in part]) for run in (ours, theirs))
        limit = EXACT if is_exact else MAX_ERROR_FACTOR * tolerance
        assert np.abs(actual - expected).max() <= limit * np.abs(expected).max()


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize(("case", "fmi"), [("bounces", "2.0"), ("comes to rest", "3.0"), ("both stops at once", "2.0")])
def test_fmu_hits_stops_as_the_run_does(case: str, fmi: str, kind: str, fmu_of: Callable[[str, str], Path]) -> None:
    path = fmu_of(case, fmi)
    assert validate_fmu(str(path)) == []
    compare(five_bar(case), path, kind, SCENES[case][2])


def test_stops_hold_joints_at_a_loose_tolerance(fmu_of: Callable[[str, str], Path]) -> None:
    """CVode's errors are larger than the last bounces before the links come to rest."""
    path, names = fmu_of("comes to rest", "2.0"), ["theta_1", "theta_3"]
    result = fmpy.simulate_fmu(
        str(path), fmi_type="ModelExchange", stop_time=1.0, relative_tolerance=1e-6, output=names
    )
    assert len(result) < 1500  # a bounce that the solver does not resolve ends, instead of many events
    assert min((result["theta_1"] + 1.45).min(), (result["theta_3"] + 2.0).min()) >= -1e-6
    np.testing.assert_allclose([result[name][-1] for name in names], [-1.45, -2.0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_stop_of_a_dependent_coordinate(kind: str, tmp_path: Path) -> None:
    scene = slider_crank(tmp_path / "mechanism")
    compare(scene, write_fmu(scene, tmp_path, "3.0"), kind, 2)


def test_spf_hits_stops_as_the_reduced_model_does(tmp_path: Path) -> None:
    path = write_fmu(five_bar("comes to rest", formulation="spf", epsilon=1e-3), tmp_path, "2.0")
    compare(five_bar("comes to rest"), path, "ModelExchange", 60)


def test_torque_lifts_a_link_off_its_stop(fmu_of: Callable[[str, str], Path]) -> None:
    """The reference is a simulator that gets the same torques, constant in each step."""
    simulator, fmu = Simulator(five_bar("comes to rest")), Instance(fmu_of("comes to rest", "2.0"), "CoSimulation")
    lifted = 0.0
    for k in range(150):
        torque = 0.0 if k < 80 else 12.0 * np.sin(0.1 * (k - 80))
        expected = simulator.step(tau={"theta_1": torque, "theta_3": 0.0}, dt=OUTPUT_DT)
        fmu.set({"tau.theta_1": torque})
        fmu.fmu.doStep(OUTPUT_DT * k, OUTPUT_DT)
        actual = fmu.get(["theta_1", "theta_3", "v.theta_1", "v.theta_3"])
        np.testing.assert_allclose(actual, [*expected.q_tree[[0, 2]], *expected.q_dot], rtol=0, atol=1e-8)
        if k == 79:
            np.testing.assert_allclose(actual, [-1.45, -2.0, 0.0, 0.0], rtol=0, atol=1e-12)
        lifted = max(lifted, actual[0] + 1.45)
    assert lifted > 0.1


@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
def test_impact_obeys_newtons_law(fmi: str, fmu_of: Callable[[str, str], Path]) -> None:
    """The momentum D q_dot jumps in the direction of the stop, and the rate is reflected with restitution 0.4."""
    fmu, mechanism = Instance(fmu_of("bounces", fmi), "ModelExchange"), load_scene_mechanism(five_bar("bounces"))
    before = {"theta_1": -1.45, "theta_3": -1.3, "v.theta_1": -2.0, "v.theta_3": 0.7}
    fmu.set_states(np.array([before[x] for x in fmu.states]))
    fmu.fmu.enterEventMode()
    fmu.update_events()
    after = dict(zip(fmu.states, fmu.get_states(), strict=True))
    terms = Terms(mechanism, sigma(mechanism, np.array([-1.45, -1.3])).at, np.zeros(mechanism.n))
    jump = np.array([after[f"v.{x}"] - before[f"v.{x}"] for x in mechanism.independent])
    assert after["v.theta_1"] == pytest.approx(0.8, abs=1e-12)
    assert (terms.D @ jump)[1] == pytest.approx(0.0, abs=1e-12)


def test_start_beyond_a_stop_is_refused(fmu_of: Callable[[str, str], Path]) -> None:
    assert "a joint is beyond its stop: choose start values within the stops" in failing_messages(
        fmu_of("bounces", "2.0"), {"theta_1": -1.5}
    )


def failing_messages(path: Path, values: Mapping[str, float]) -> list[str]:
    """Return what the logger gets when an FMU cannot start."""
    messages: list[str] = []
    with pytest.raises(FMICallException):
        Instance(path, "ModelExchange", values, messages=messages)
    return messages


SLIDER = float(sigma(load("slider_crank"), np.array([1.3])).at.q_tree[2])  # while the crank is at 1.3


def test_joints_that_move_together_hit_their_stops_together(tmp_path: Path) -> None:
    scene = slider_crank(tmp_path / "mechanism", crank=1.3, high=SLIDER, t_end=0.2)
    compare(scene, write_fmu(scene, tmp_path, "2.0"), "CoSimulation", 2)


def test_stops_that_jam_a_mechanism_are_an_error(tmp_path: Path) -> None:
    """Neither the crank nor the slider can leave its stop."""
    scene = slider_crank(tmp_path / "mechanism", crank=1.3, low=SLIDER)
    (message,) = failing_messages(write_fmu(scene, tmp_path, "2.0"), {})
    assert message.startswith("joints that only move together touch several stops at once")


def test_fmu_has_no_warnings_and_no_undefined_behaviour(tmp_path: Path, fmu_of: Callable[[str, str], Path]) -> None:
    with ZipFile(fmu_of("comes to rest", "2.0")) as archive:
        archive.extractall(tmp_path)
    run("gcc", *WARNINGS, "-c", "sources/fmi2.c", "-o", "fmu.o", cwd=tmp_path)
    harness = Path(__file__).parent / "fmu_harness.c"
    run("gcc", *SANITIZERS, "-Isources", harness, "-lm", "-o", "checked", cwd=tmp_path)
    messages = run("./checked", cwd=tmp_path)
    assert messages.count("a value is not a finite number") == 4
    assert messages.count("epsilon must be positive") == 2
