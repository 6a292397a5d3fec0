"""Events: all crossings within a step are located, compared with NumPy and SciPy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ckc_pin import Event, InputError, Run, Simulator, Terms, load, load_scene, simulate
from ckc_pin.native import _core
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc

pytestmark = pytest.mark.usefixtures("either_terms")

Array = NDArray[np.float64]
FORMULATIONS = ["reduced", "spf", "dae"]
TIGHT = {"solver.rtol": 1e-11}
T_END = 0.6


# --- within a step -------------------------------------------------------------------------------


def _sign_changes(function: Callable[[float], float], sign: int = 0, start: float = 0.0, end: float = 1.0) -> Any:
    """(found, the sign at the end, whether the end is on zero)."""
    return _core.find_sign_changes(function, start, end, sign=sign)


R = 1e-4  # half the distance of two roots


@pytest.mark.parametrize(
    ("function", "roots"),
    [
        (lambda t: t - 0.3, [(0.3, 1)]),
        (lambda t: 0.3 - t, [(0.3, -1)]),
        (lambda t: (t - 0.3) ** 2 - R**2, [(0.3 - R, -1), (0.3 + R, 1)]),
        (lambda t: R**2 - (t - 0.7) ** 2, [(0.7 - R, 1), (0.7 + R, -1)]),
        (lambda t: (t - 0.002) ** 2 - 1e-6, [(0.001, -1), (0.003, 1)]),
        (lambda t: (t - 0.998) ** 2 - 1e-6, [(0.997, -1), (0.999, 1)]),
        (lambda t: abs(t - 0.441) - R, [(0.441 - R, -1), (0.441 + R, 1)]),
        (lambda t: max(R - abs(t - 0.62), -0.2), [(0.62 - R, 1), (0.62 + R, -1)]),
        (lambda t: float(np.sin(9.4 * t + 0.3)), [((k * np.pi - 0.3) / 9.4, (-1) ** k) for k in (1, 2, 3)]),
        (lambda t: 1e-9 * (t - 0.5) ** 3, [(0.5, 1)]),
        (lambda t: 1.0 if t > 0.25 else -1.0, [(0.25, 1)]),
        (lambda t: (t - 0.3) ** 2, []),
        (lambda t: (t - 0.5) ** 2, []),
        (lambda t: (t - 0.3) ** 2 + R**2, []),
        (lambda t: 5.0, []),
        (lambda t: 0.0, []),
    ],
    ids=["rising", "falling", "dip", "bump", "near the start", "near the end", "kink", "clipped tip", "three", "flat",
         "jump", "touch", "touch at a node", "miss", "constant", "zero"],
)  # fmt: skip
def test_sign_changes_within_a_step(function: Callable[[float], float], roots: list[tuple[float, int]]) -> None:
    roots_found, _, _ = _sign_changes(function)
    assert [direction for _, direction in roots_found] == [direction for _, direction in roots]
    # Near a double root, rounding moves the root by 1e-16 over the slope.
    assert_close([t for t, _ in roots_found], [t for t, _ in roots], 2e-12)


@pytest.mark.parametrize("sign", [-1, 0, 1])
def test_start_on_zero_counts_if_it_came_from_the_other_side(sign: int) -> None:
    assert _sign_changes(lambda t: t, sign) == ([(0.0, 1)] if sign == -1 else [], 1, False)


def test_end_on_zero_is_decided_by_the_next_step() -> None:
    assert _sign_changes(lambda t: t - 1.0) == ([], -1, True)
    assert _sign_changes(lambda t: t - 1.0, -1, 1.0, 2.0)[0] == [(1.0, 1)]
    assert _sign_changes(lambda t: 1.0 - t, -1, 1.0, 2.0)[0] == []


@pytest.mark.parametrize(("root", "slope"), [(0.3, 1.0), (0.3, -40.0), (0.0007, 1.0), (0.9995, 3.0)])
def test_root_search_uses_the_cheap_function_first(root: float, slope: float) -> None:
    """The root of a function with an error of 1e-7 is refined with the exact function in few evaluations."""
    asked: list[float] = []

    def exact(t: float) -> float:
        asked.append(t)
        return float(slope * np.sinh(t - root))

    roots_found, _, _ = _core.find_sign_changes(
        lambda t: float(slope * np.sinh(t - root) + 1e-7 * np.cos(5 * t)), 0.0, 1.0, exact=exact
    )
    assert_close([t for t, _ in roots_found], [root], 2e-12)
    assert len(asked) <= 2


@pytest.mark.parametrize("off", [1e-7, -1e-7])
def test_exact_function_decides_between_nearly_equal_roots(off: float) -> None:
    """The cheap function has two roots where the exact one has none, or vice versa."""
    for depth in (0.5e-7, -0.5e-7):
        roots_found, _, _ = _core.find_sign_changes(
            lambda t, depth=depth: (t - 0.3) ** 2 - depth + off, 0.0, 1.0,
            exact=lambda t, depth=depth: (t - 0.3) ** 2 - depth,
        )  # fmt: skip
        assert [direction for _, direction in roots_found] == ([-1, 1] if depth > 0 else [])
        if depth > 0:
            assert_close([t for t, _ in roots_found], [0.3 - np.sqrt(depth), 0.3 + np.sqrt(depth)], 1e-8)


# --- against numpy and SciPy ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def motion() -> Callable[[float], Array]:
    """(q', v') of `swing` at any time, accurate to about 1e-13."""
    start = load_scene("five_bar/swing").spec.initial.q

    def rate(t: float, y: Array) -> Array:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    y = [start["theta_1"], start["theta_3"], 0.0, 0.0]
    dense = solve_ivp(rate, (0, T_END), y, "DOP853", rtol=3e-14, atol=1e-15, max_step=0.01, dense_output=True).sol

    def at(t: float) -> Array:
        q_tree = FIVE_BAR.sigma(dense(t)[:2])
        return np.concatenate([q_tree, FIVE_BAR.rho(q_tree) @ dense(t)[2:]])

    return at


def _roots(function: Callable[[float], float]) -> list[float]:
    """Sign changes on a fine grid, refined by bisection."""
    grid = np.linspace(1e-4, T_END, 301)
    values = np.array([function(t) for t in grid])
    roots = []
    for k in np.flatnonzero(values[:-1] * values[1:] < 0):
        low, high = grid[k], grid[k + 1]
        for _ in range(45):
            middle = (low + high) / 2
            low, high = (middle, high) if values[k] * function(middle) > 0 else (low, middle)
        roots.append(float(low))
    return roots


def _times(run: Run, **label: Any) -> list[float]:
    return [event["t"] for event in run.events if all(event[key] == value for key, value in label.items())]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_two_crossings_in_one_step(formulation: str, motion: Callable[[float], Array]) -> None:
    """theta_2 reverses just beyond the value, so large steps contain both crossings."""
    turn = next(t for t in _roots(lambda t: float(motion(t)[5])) if t > 0.05)
    value = float(motion(turn)[1]) - np.sign(motion(turn)[1] - motion(turn - 0.02)[1]) * 2e-4
    expected = [t for t in _roots(lambda t: float(motion(t)[1] - value)) if abs(t - turn) < 0.02]
    assert len(expected) == 2
    overrides = {"formulation": formulation, "t_end": T_END, "event": [{"coordinate": "theta_2", "value": value}]}
    loose = simulate("five_bar/swing", {**overrides, "solver.rtol": 1e-5, "solver.output_dt": T_END})
    assert T_END / loose.stats["steps"] > 2 * (expected[1] - expected[0])
    assert len([t for t in _times(loose) if abs(t - turn) < 0.02]) == 2
    tight = simulate("five_bar/swing", {**overrides, **TIGHT})
    assert_close([t for t in _times(tight) if abs(t - turn) < 0.02], expected, 1e-9)  # 0.01 of slope: 1e-11 rad


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_singular_value_and_function_events_are_located(formulation: str, motion: Callable[[float], Array]) -> None:
    def margin(t: float) -> float:
        return float(np.linalg.svd(FIVE_BAR.phi_z(motion(t)[:4]), compute_uv=False)[-1])

    def margin_of_j(t: float) -> float:
        return float(np.linalg.svd(FIVE_BAR.J(motion(t)[:4]), compute_uv=False)[-1])

    def energy(t: float) -> float:
        y = motion(t)
        return float(FIVE_BAR.potential_energy(y[:4]))

    values = [float(np.median([f(t) for t in np.linspace(0, T_END, 50)])) for f in (margin, margin_of_j, energy)]
    overrides = {
        **TIGHT,
        "formulation": formulation,
        "t_end": T_END,
        "event": [{"of": "sigma_min_phi_z", "value": values[0]}, {"of": "sigma_min_J", "value": values[1]}],
    }
    offset = FIVE_BAR.potential_energy(motion(0.0)[:4])

    def fallen(t: float, terms: Terms) -> float:
        return terms.potential_energy - start - (values[2] - offset)

    start = load("five_bar").kinematics(simulate("five_bar/swing", {"t_end": 1e-6}).q_tree[0])
    start = Terms(load("five_bar"), start, np.zeros(4)).potential_energy
    run = simulate("five_bar/swing", overrides, events=[Event(fallen), Event(lambda t, terms: t - 0.25, name="clock")])
    for of, function, value in zip(
        ("sigma_min_phi_z", "sigma_min_J", "function"), (margin, margin_of_j, energy), values, strict=True
    ):
        expected = _roots(lambda t, f=function, v=value: f(t) - v)
        assert expected, of
        assert_close([t for t in _times(run, of=of) if t not in _times(run, name="clock")], expected, 1e-10)
    assert _times(run, name="clock") == [pytest.approx(0.25, abs=1e-12)]
    assert {event["name"] for event in run.events} >= {"fallen", "clock", f"sigma_min_J = {values[1]:g}"}
    assert [event["t"] for event in run.events] == sorted(event["t"] for event in run.events)


def test_events_do_not_change_the_motion() -> None:
    plain = simulate("five_bar/swing", {"t_end": 0.3})
    observed = simulate("five_bar/swing", {"t_end": 0.3, "event": [{"coordinate": "theta_2", "value": 0.5}]})
    assert observed.events
    assert observed.stats["steps"] == plain.stats["steps"]
    assert_close(observed.q_tree, plain.q_tree, 1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_distant_events_cost_no_evaluations(formulation: str, either_terms: str) -> None:
    """The step's own data exclude a crossing, so no intermediate state is projected after the first."""
    overrides: dict[str, Any] = {"formulation": formulation, "t_end": 1.0, "solver.output_dt": 1.0}
    plain = simulate("five_bar/swing", overrides, profile=True)
    far = [{"coordinate": "theta_2", "value": 50.0}, {"coordinate": "theta_1", "of": "q_dot", "value": 1e3}]
    observed = simulate("five_bar/swing", {**overrides, "event": far}, profile=True)
    assert observed.events == []
    placed = {"pinocchio": "J", "generated": "phi"}[either_terms]  # compiled terms compute phi together with J
    assert observed.profile[placed]["calls"] < 1.1 * plain.profile[placed]["calls"]


# --- limits --------------------------------------------------------------------------------------


def _limit(bar: Path, joint: str, lower: float, upper: float) -> None:
    path = bar / "five_bar.urdf"
    head, tail = path.read_text(encoding="utf-8").split(f'<joint name="{joint}" type="continuous">', 1)
    limit = f'<limit lower="{lower!r}" upper="{upper!r}" effort="1" velocity="1"/>'
    path.write_text(f'{head}<joint name="{joint}" type="revolute">{limit}{tail}', encoding="utf-8")


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_joint_limits_are_events_without_contact(formulation: str, bar: Path, motion: Callable[[float], Array]) -> None:
    _limit(bar, "theta_2", -3.0, 0.5)
    _limit(bar, "theta_3", -1.4, 3.0)
    beyond = {"theta_2": lambda t: float(motion(t)[1] - 0.5), "theta_3": lambda t: float(-1.4 - motion(t)[2])}
    scene = bar / "swing.scene.toml"
    run = simulate(scene, {**TIGHT, "formulation": formulation, "t_end": T_END, "event": [{"of": "limit"}]})
    assert run.status == "done"
    for name, function in beyond.items():
        expected = _roots(function)
        assert expected, name
        assert_close(_times(run, coordinate=name), expected, 1e-10)
        for event in run.events:
            if event["coordinate"] == name:
                assert event["of"] == "limit"
                assert event["value"] == (0.5 if name == "theta_2" else -1.4)
                assert event["direction"] == np.sign(function(event["t"] + 1e-3)), "1 is leaving"
    leaving = [{"of": "limit", "coordinate": "theta_3", "direction": 1, "stop": True}]
    first = next(t for t in _roots(beyond["theta_3"]) if beyond["theta_3"](t + 1e-3) > 0)
    stopped = simulate(scene, {**TIGHT, "formulation": formulation, "t_end": T_END, "event": leaving})
    assert stopped.t[-1] == pytest.approx(first, abs=1e-10)
    assert stopped.message.endswith("s: theta_3 at its lower limit")


def test_event_of_missing_limits_is_rejected(bar: Path) -> None:
    scene = bar / "swing.scene.toml"
    with pytest.raises(InputError, match=r"event\[0\]: no joint of five_bar has limits in its URDF"):
        simulate(scene, {"event": [{"of": "limit"}]})
    _limit(bar, "theta_2", -3.0, 0.5)
    with pytest.raises(InputError, match=r"event\[0\]: theta_1 has no limits in its URDF; theta_2 have"):
        simulate(scene, {"event": [{"of": "limit", "coordinate": "theta_1"}]})


# --- start, end, graze, order --------------------------------------------------------------------


def test_start_on_the_value_is_no_event() -> None:
    """The run starts at rest and theta_1 starts on the value, which it crosses once per swing."""
    start = load_scene("five_bar/swing").spec.initial.q
    observed = [{"coordinate": c, "of": "q_dot"} for c in ("theta_1", "theta_2")]
    run = simulate(
        "five_bar/swing", {"t_end": 0.1, "event": [*observed, {"coordinate": "theta_1", "value": start["theta_1"]}]}
    )
    assert run.events == []


def test_value_reached_at_the_end_is_an_event() -> None:
    run = simulate("five_bar/swing", {"t_end": 0.25}, events=[Event(lambda t, terms: t - 0.25, stop=True, name="bell")])
    assert [(event["t"], event["name"], event["direction"]) for event in run.events] == [(0.25, "bell", 1)]
    assert run.t[-1] == 0.25
    assert simulate("five_bar/swing", {"t_end": 0.25}, events=[Event(lambda t, terms: t - 0.26)]).events == []


def test_touching_the_value_is_no_event() -> None:
    run = simulate("five_bar/swing", {"t_end": 0.5}, events=[Event(lambda t, terms: (t - 0.2) ** 2)])
    assert run.events == []


def test_events_have_directions_and_are_ordered() -> None:
    def wave(t: float, terms: Terms) -> float:
        return float(np.sin(20 * t + 0.1))

    both = [(k * np.pi - 0.1) / 20 for k in range(1, 4)]
    for direction, expected in ((0, both), (1, both[1::2]), (-1, both[::2])):
        run = simulate("five_bar/swing", {"t_end": 0.5, "formulation": "reduced"}, events=[Event(wave, direction)])
        assert_close(_times(run), expected, 1e-11)
    stopping = [Event(wave, name="a"), Event(wave, -1, True, "b"), Event(wave, name="c")]
    run = simulate("five_bar/swing", {"t_end": 0.5, "formulation": "reduced"}, events=stopping)
    assert [event["name"] for event in run.events] == ["a", "b", "c"], "all that happen at the instant of the stop"
    assert run.t[-1] == run.events[0]["t"]
    assert run.message.endswith("s: b")


# --- in files and on the command line ------------------------------------------------------------


def test_events_are_in_json_and_in_the_run_file(tmp_path: Path) -> None:
    words = ("run", "five_bar/swing", "--set", "t_end=.3", "--set", 'event=[{coordinate="theta_2", value=.5}]')
    bad = ckc(*words, "--json")
    assert bad.code == 2, "a table's numbers are TOML"
    answer = ckc(*words[:-1], 'event=[{coordinate="theta_2", value=0.5}]', "--json")
    assert answer.code == 0
    (event, *_) = answer.json["events"]
    assert event == {
        "t": pytest.approx(0.21412, abs=1e-4),
        "name": "theta_2 = 0.5",
        "of": "q",
        "coordinate": "theta_2",
        "value": 0.5,
        "direction": event["direction"],
        "stop": False,
    }
    assert event["direction"] in (-1, 1)
    run = simulate("five_bar/swing", {"t_end": 0.3, "event": [{"coordinate": "theta_2", "value": 0.5}]})
    assert Run.load(run.save(tmp_path / "run.npz")).events == answer.json["events"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_simulator_reports_events_within_its_steps(formulation: str) -> None:
    """A stopping event ends the step early and is not repeated at once."""
    overrides = {
        "solver.rtol": 1e-10,
        "formulation": formulation,
        "t_end": 0.5,
        "event": [{"coordinate": "theta_2", "value": 0.5}],
    }
    bell = Event(lambda t, terms: t - 0.1, stop=True, name="bell")
    expected = simulate("five_bar/swing", overrides, events=[Event(lambda t, terms: t - 0.1)]).events
    simulator = Simulator("five_bar/swing", overrides, events=[bell])
    stops = []
    while simulator.state.t < 0.5:
        end = min(simulator.state.t + 0.03, 0.5)
        if simulator.step(None, 0.03).t < end - 1e-9:
            stops.append(simulator.state.t)
    assert stops == [pytest.approx(0.1, abs=1e-11)]
    assert_close([event["t"] for event in simulator.events][: len(expected)], [event["t"] for event in expected], 1e-8)
    simulator.reset()
    assert simulator.events == []
    assert simulator.step(None, 0.2).t == pytest.approx(0.1, abs=1e-11)
