"""Runs of scenes: events, limits, trajectories, controllers in Python, progress and budgets."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ckc_pin import NumericalError, Run, Terms, load_scene, simulate
from ckc_pin.control import Tracking
from tests.analytic.five_bar import FIVE_BAR, desired
from tests.conftest import assert_close

Array = NDArray[np.float64]


# --- events ----------------------------------------------------------------------------------------

LEVEL = 0.5
EVENTS = [{"coordinate": "theta_2", "value": LEVEL}, {"coordinate": "theta_3", "of": "q_dot"}]


@pytest.fixture(scope="module")
def crossings() -> tuple[list[float], list[float]]:
    """Times at which theta_2 is LEVEL and theta_3 reverses in `swing`, by SciPy on the appendix in NumPy."""
    start = load_scene("five_bar/swing").spec.initial.q

    def rate(t: float, y: Array) -> Array:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    def level(t: float, y: Array) -> float:
        return float(FIVE_BAR.sigma(y[:2])[1] - LEVEL)

    def turning(t: float, y: Array) -> float:
        return float(y[3])

    y = [start["theta_1"], start["theta_3"], 0.0, 0.0]
    result = solve_ivp(rate, (0, 2), y, "DOP853", rtol=1e-13, atol=1e-14, max_step=0.01, events=[level, turning])
    assert result.status == 0
    return result.t_events[0].tolist(), [t for t in result.t_events[1].tolist() if t > 1e-6]


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_events_are_located(formulation: str, crossings: tuple[list[float], list[float]]) -> None:
    occurrences = simulate("five_bar/swing", {"formulation": formulation, "solver.rtol": 1e-11, "event": EVENTS}).events
    assert [event["t"] for event in occurrences] == sorted(event["t"] for event in occurrences)
    assert_close([event["t"] for event in occurrences if event["of"] == "q"], crossings[0], 1e-10)
    assert_close([event["t"] for event in occurrences if event["of"] == "q_dot"], crossings[1], 1e-10)
    assert {event["coordinate"]: event["value"] for event in occurrences} == {"theta_2": LEVEL, "theta_3": 0.0}


@pytest.mark.parametrize("direction", [-1, 1])
def test_events_of_one_direction(direction: int, crossings: tuple[list[float], list[float]]) -> None:
    """theta_2 oscillates through LEVEL, so every other crossing rises."""
    event = {"coordinate": "theta_2", "value": LEVEL, "direction": direction}
    result = simulate("five_bar/swing", {"event": [event]})
    first = simulate("five_bar/swing", {"t_end": crossings[0][0] + 0.01})
    rises_first = first.v_tree[-1, first.column("theta_2")] > 0
    expected = crossings[0][0 if rises_first == (direction > 0) else 1 :: 2]
    assert_close([event["t"] for event in result.events], expected, 1e-7)
    assert result.status == "done"
    assert result.t[-1] == 2.0, "an event that does not stop the run does not"


def test_stopping_event_is_the_last_instant(crossings: tuple[list[float], list[float]]) -> None:
    event = {"coordinate": "theta_2", "value": LEVEL, "stop": True}
    result = simulate("five_bar/swing", {"solver.rtol": 1e-11, "event": [*EVENTS, event]})
    assert result.status == "done"
    assert result.message.startswith("stopped by the event at t = 0.2141212")
    assert result.t[-1] == pytest.approx(crossings[0][0], abs=1e-10)
    assert result.q_tree[-1, result.column("theta_2")] == pytest.approx(LEVEL, abs=1e-11)
    assert [event["stop"] for event in result.events] == [False, True]
    assert np.all(np.diff(result.t) > 0)


# --- limits and actuators --------------------------------------------------------------------------


def test_torque_limit_clips_tau_and_u(run: Callable[..., Run]) -> None:
    free = run("five_bar/tracking", t_end=0.3)
    assert np.abs(free.tau).max() > 6
    limited = run("five_bar/tracking", t_end=0.3, controller__torque_limit=5.0)
    assert np.abs(limited.tau).max() == 5.0
    assert np.array_equal(limited.u, limited.tau), "the actuators are the independent joints"
    one = run("five_bar/tracking", t_end=0.3, controller__torque_limit={"theta_1": 3.0})
    assert np.abs(one.tau[:, 0]).max() <= 3.0
    assert np.abs(one.tau[:, 1]).max() > 3.0


def test_torque_limit_of_distal_motors(bar: Path) -> None:
    """With motors on the distal joints, u = rho^T tau with rho from the appendix."""
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    old = 'actuated = ["theta_1", "theta_3"]'
    assert old in text
    (bar / "mechanism.toml").write_text(text.replace(old, 'actuated = ["theta_4", "theta_2"]'), encoding="utf-8")
    overrides = {"t_end": 0.1, "controller.torque_limit": 4.0}
    result = simulate(bar / "tracking.scene.toml", overrides)
    assert np.abs(result.tau).max() == 4.0
    for k in range(len(result.t)):
        rho = FIVE_BAR.rho(result.q_tree[k])
        assert_close(result.u[k], rho[3] * result.tau[k, 0] + rho[1] * result.tau[k, 1], 1e-11)


# --- controllers and trajectories ------------------------------------------------------------------


class ByHand:
    """Eq. 14 with the h of the appendix."""

    def __init__(self, q_d: Array) -> None:
        self.q_d, self.h = q_d, FIVE_BAR.h(FIVE_BAR.sigma(q_d))

    def u(self, t: float, terms: Terms) -> Array:
        return -10.0 * (terms.q - self.q_d) - 1.0 * terms.q_dot + self.h


def test_python_controller_replaces_the_scenes_controller(run: Callable[..., Run]) -> None:
    q_d = np.full(2, np.pi / 4)
    shipped = run("five_bar/set_point", t_end=0.3)
    custom = simulate("five_bar/set_point", {"t_end": 0.3}, controller=ByHand(q_d))
    assert_close(custom.u, shipped.u, 1e-6)
    assert_close(custom.q_tree, shipped.q_tree, 1e-7)
    assert custom.lyapunov is None
    assert shipped.lyapunov is not None


def test_desired_trajectory_may_be_a_function(run: Callable[..., Run]) -> None:
    """Eq. 21 as a Python function compared with the scene's harmonics, with equal steps because Jacobians differ."""
    shipped = run("five_bar/tracking", t_end=0.3, solver__method="DOP853")
    law = Tracking(np.eye(2), 10.0 * np.eye(2), desired)
    custom = simulate("five_bar/tracking", {"t_end": 0.3, "solver.method": "DOP853"}, controller=law)
    assert_close(custom.q_tree, shipped.q_tree, 1e-9)
    assert_close(custom.u, shipped.u, 1e-9)


def test_trajectory_file_gives_the_same_run(bar: Path, run: Callable[..., Run]) -> None:
    """Eq. 21 sampled at 20 ms, with reordered columns, blank lines and spaces."""
    t = np.arange(0.0, 1.01, 0.02)
    rows = [f"{q[1]!r}, {x!r} ,{q[0]!r}" for x, q in ((float(x), desired(float(x))[0].tolist()) for x in t)]
    (bar / "way.csv").write_text("\n".join(["theta_3,t, theta_1", "", *rows, ""]), encoding="utf-8")
    sampled = simulate(bar / "tracking.scene.toml", {"t_end": 1.0, "controller.desired": {"file": "way.csv"}})
    exact = run("five_bar/tracking", t_end=1.0)
    assert_close(sampled.q_tree, exact.q_tree, 1e-6)
    assert_close(sampled.u, exact.u, 1e-4)


def test_controllers_exception_is_not_wrapped() -> None:
    class Broken:
        def u(self, t: float, terms: Terms) -> Array:
            raise ZeroDivisionError("a mistake in the controller")

    with pytest.raises(ZeroDivisionError, match="a mistake in the controller"):
        simulate("five_bar/swing", controller=Broken())


def test_nan_at_the_start_is_rejected() -> None:
    class Lost:
        def u(self, t: float, terms: Terms) -> Array:
            return np.full(2, np.nan)

    with pytest.raises(NumericalError, match="not finite"):
        simulate("five_bar/swing", controller=Lost())


# --- on the way ------------------------------------------------------------------------------------


def test_progress_is_reported() -> None:
    reports: list[tuple[float, float]] = []
    simulate(
        "five_bar/swing",
        {"t_end": 100.0, "solver.terms": "pinocchio"},
        progress=lambda t, t_end: reports.append((t, t_end)),
    )
    assert len(reports) > 2
    assert reports[-1] == (100.0, 100.0)
    assert all(before < after for (before, _), (after, _) in pairwise(reports))


@pytest.mark.parametrize(
    ("budget", "value", "says"),
    [("max_rhs", 200, "max_rhs = 200 right-hand sides"), ("max_wall_s", 0.25, "max_wall_s = 0.25 s")],
)
def test_exhausted_budget_keeps_results(budget: str, value: float, says: str, tmp_path: Path) -> None:
    result = simulate("five_bar/swing", {f"solver.{budget}": value, "t_end": 1000.0, "solver.output_dt": 0.001})
    assert result.status == "stopped"
    assert says in result.message
    assert result.message.startswith("stopped at t = ")
    assert len(result.t) > 10
    assert_close(np.diff(result.t)[:-1], 0.001, 1e-12)
    assert_close(result.energy, result.energy[0], 1e-6)
    assert Run.load(result.save(tmp_path / "run.npz")).message == result.message


def test_interrupt_in_a_controller_keeps_results() -> None:
    class Impatient:
        def u(self, t: float, terms: Terms) -> Array:
            if t > 0.2:
                raise KeyboardInterrupt
            return np.zeros(2)

    result = simulate("five_bar/swing", {"t_end": 1.0}, controller=Impatient())
    assert result.status == "interrupted"
    assert result.message.startswith("interrupted at t = 0.1") or result.message.startswith("interrupted at t = 0.2")
    assert 0.1 < result.t[-1] <= 0.2
    assert_close(result.energy, result.energy[0], 1e-7)


def test_overrides_accept_numpy_values() -> None:
    overrides = {
        "t_end": np.float64(0.5),
        "solver.max_rhs": np.int64(7),
        "controller.K_D": 2.0 * np.eye(2),
        "controller.Lambda": {"theta_1": np.float64(1.0), "theta_3": 1},
    }
    spec = load_scene("five_bar/tracking", overrides).spec
    assert (spec.t_end, spec.solver.max_rhs) == (0.5, 7)
    assert spec.controller is not None
    assert load_scene("five_bar/tracking", overrides).to_dict()["controller"]["K_D"] == [[2.0, 0.0], [0.0, 2.0]]


def test_overrides_of_a_scene_are_added_to_its_own() -> None:
    scene = load_scene("five_bar/swing", {"t_end": 0.01})
    assert simulate(scene).t[-1] == 0.01
    run = simulate(scene, {"solver.output_dt": 0.005})
    assert run.t.tolist() == [0.0, 0.005, 0.01]


@pytest.mark.parametrize("overrides", [{}, {"solver.output_dt": 0.3}, {"solver.output_dt": 7.0}, {"t_end": 1e-9}])
def test_output_instants(overrides: dict[str, Any]) -> None:
    result = simulate("five_bar/swing", {"t_end": 1.0, "formulation": "reduced", **overrides})
    t_end, dt = overrides.get("t_end", 1.0), overrides.get("solver.output_dt", 0.01)
    assert result.t[0] == 0.0
    assert result.t[-1] == t_end
    inner = result.t[:-1]
    assert_close(inner, dt * np.arange(len(inner)), 1e-15)
