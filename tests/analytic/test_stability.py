"""Stability of closed loops: eigenvalues, least K_P, growth of errors along a motion, and all shipped scenes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin import check, load_scene, simulate
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.spec import SetPointSpec, TrackingSpec
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import ClosedLoop
from ckc_pin.linear.stability import stability
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.library import shipped
from ckc_pin.scene.names import list_scene_names
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from tests.analytic.five_bar import FIVE_BAR, Array, complex_step, set_point

TRACKING = ["five_bar/tracking", "stewart/wave", "delta/circle", "two_ur5/lift", "three_rrr/circle"]
LEAVES = {"five_bar_as_printed/tracking"}  # erratum 3: the motion leaves the workspace
CONTROLLED = [
    name
    for mechanism in shipped()
    for scene in list_scene_names(mechanism)
    if isinstance(load_scene(name := f"{mechanism}/{scene}").spec.controller, SetPointSpec | TrackingSpec)
    and name not in LEAVES
]
MIN_TIME_CONSTANTS = 4  # duration of a shipped scene, in time constants of the slowest decay: errors fall to 2 %


def load_controlled(name: str, overrides: dict[str, Any] | None = None) -> tuple[Mechanism, Any]:
    scene = load_scene(name, overrides)
    mechanism = load_scene_mechanism(scene)
    return mechanism, build_scene_controller(scene, mechanism)


def state_of(mechanism: Mechanism, law: Tracking, t: float, off: float) -> Terms:
    random = np.random.default_rng(0)
    q_d, q_d_dot, _ = law.desired(t)
    at = sigma(mechanism, q_d).at
    at = sigma(mechanism, q_d + off * random.uniform(-1, 1, mechanism.d), at).at
    return Terms(mechanism, at, at.rho @ (q_d_dot + 10 * off * random.uniform(-1, 1, mechanism.d)))


# --- exact ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRACKING)
def test_controller_gain_matches_finite_differences(name: str) -> None:
    mechanism, law = load_controlled(name)
    state, t = state_of(mechanism, law, 0.7, 0.02), 0.7

    def u(x: Array) -> Array:
        at = sigma(mechanism, state.q + x[: mechanism.d], state.at).at
        return law.u(t, Terms(mechanism, at, at.rho @ (state.q_dot + x[mechanism.d :])))

    step = np.random.default_rng(1).uniform(-1, 1, 2 * mechanism.d)
    one, two = ((u(h * step) - u(-h * step)) / (2 * h) for h in (2e-3, 1e-3))
    expected = (4 * two - one) / 3
    assert (
        np.abs(ClosedLoop(mechanism, law).linearize(t, state).K @ step - expected).max()
        <= 1e-9 * np.abs(expected).max()
    )


@pytest.mark.parametrize("name", TRACKING)
def test_errors_about_the_desired_motion_obey_eq_16(name: str) -> None:
    """D r_dot + (C + K_D) r = 0 with r = e_dot + Lambda e, if the controller has the plant's terms."""
    mechanism, law = load_controlled(name)
    state = state_of(mechanism, law, 0.7, 0.0)
    G = np.linalg.solve(state.D, state.C + law.K_D)
    expected = np.block([[np.zeros_like(G), np.eye(len(G))], [-G @ law.Lambda, -G - law.Lambda]])
    assert (
        np.abs(ClosedLoop(mechanism, law).linearize(0.7, state).A_closed - expected).max()
        <= 1e-10 * np.abs(expected).max()
    )


def test_set_point_eigenvalues_match_the_appendix() -> None:
    mechanism, law = load_controlled("five_bar/set_point")
    target = FIVE_BAR.sigma(law.q_d)
    u = set_point(FIVE_BAR, law.q_d, law.K_P[0, 0], law.K_V[0, 0])
    h_d = FIVE_BAR.h(target)

    def rate(x: Array) -> Array:
        moved = target + FIVE_BAR.rho(target) @ x[:2]
        force = h_d - law.K_P @ (moved[[0, 2]] - law.q_d) - law.K_V @ x[2:]
        return np.concatenate([x[2:], FIVE_BAR.acceleration(moved, x[2:], force)])

    assert np.abs(u(0.0, target, np.zeros(2)) - h_d).max() < 1e-12
    expected = np.linalg.eigvals(complex_step(rate, np.zeros(4)))
    result = stability(mechanism, law, 1.0)
    assert result.eigenvalues is not None
    assert (
        np.abs(np.sort_complex(result.eigenvalues) - np.sort_complex(expected)).max() <= 1e-8 * np.abs(expected).max()
    )
    assert result.slowest == pytest.approx(-1 / expected.real.max())


@pytest.mark.parametrize("name", ["five_bar/set_point", "talos/squat"])
def test_smallest_stable_gain_is_the_stability_boundary(name: str) -> None:
    result = check(name).stability
    assert result is not None
    assert result.least_K_P is not None
    smallest_gain = float(result.least_K_P[0, 0])
    for factor, stable in ((1 + 1e-6, True), (1 - 1e-6, False)):
        at_boundary = stability(*_with_gain(name, factor * smallest_gain), 1.0)
        assert at_boundary.eigenvalues is not None
        assert at_boundary.stable == stable
        assert (at_boundary.least_eigenvalue > 0) == stable  # type: ignore[operator]
        assert (at_boundary.eigenvalues.real.max() < 0) == stable


def _with_gain(name: str, gain: float) -> tuple[Mechanism, SetPoint]:
    mechanism, law = load_controlled(name, {"controller.K_P": gain})
    return mechanism, law


def waves(frequency: float, amplitude: float = 0.2) -> dict[str, Any]:
    """Overrides that give the hanging five-bar a harmonic desired motion."""
    offset_and_phase = {"theta_1": (-1.2, 0.3), "theta_3": (-1.9, 1.1)}
    return {
        f"controller.desired.{name}": {"offset": offset, "harmonics": [[amplitude, frequency, phase]]}
        for name, (offset, phase) in offset_and_phase.items()
    }


def growth_by_runs(overrides: dict[str, Any], t_end: float, off: float = 1e-6) -> float:
    """Growth of the five-bar's tracking error over a run, measured by the square root of eq. 18's function."""
    mechanism, law = load_controlled("five_bar/tracking", overrides)
    start, names, ends = np.concatenate(law.desired(0.0)[:2]), mechanism.independent, []
    exact = {"formulation": "reduced", "solver.rtol": 1e-11, "solver.atol": 1e-14, "t_end": t_end}
    for step in np.vstack([np.zeros(4), off * np.eye(4)]):
        x = (start + step).tolist()
        at = {"q": dict(zip(names, x[:2], strict=True)), "q_dot": dict(zip(names, x[2:], strict=True))}
        run = simulate("five_bar/tracking", {**overrides, **exact, "initial": at, "solver.output_dt": t_end})
        ends.append(np.concatenate([run.q_tree[-1][[0, 2]], run.v_tree[-1][[0, 2]]]))
    motion = np.array([(end - ends[0]) / off for end in ends[1:]]).T
    roots = []
    for t in (0.0, t_end):
        state, r_of = state_of(mechanism, law, t, 0.0), np.hstack([law.Lambda, np.eye(2)])
        e_of = np.hstack([np.eye(2), np.zeros((2, 2))])
        V = r_of.T @ state.D @ r_of / 2 + e_of.T @ law.Lambda.T @ law.K_D @ e_of
        roots.append(np.linalg.cholesky(V).T)
    return float(np.linalg.norm(roots[1] @ motion @ np.linalg.inv(roots[0]), 2))


@pytest.mark.parametrize(
    ("overrides", "t_end"),
    [({}, 3.0), ({}, 2.2), (waves(2 * np.pi * 24), 2.0), (waves(37.0, 0.3) | {"controller.K_D": 2.0}, 1.7)],
)
def test_growth_matches_perturbed_runs(overrides: dict[str, Any], t_end: float) -> None:
    """Runs start slightly off the desired motion. One motion has 48 cycles."""
    result = stability(*load_controlled("five_bar/tracking", overrides), t_end)
    assert result.growth == pytest.approx(growth_by_runs(overrides, t_end), rel=6e-3)
    assert result.stable == (result.growth < 1)  # type: ignore[operator]


@pytest.mark.parametrize("t_end", [0.01, 0.31, 1.27])
def test_largest_growth_does_not_depend_on_the_duration(t_end: float) -> None:
    """Eq. 18's function decreases along eq. 16's closed loop, at any phase of the motion."""
    result = stability(*load_controlled("five_bar/tracking", waves(9.0, 0.3) | {"controller.Lambda": 20.0}), t_end)
    assert result.stable
    assert result.largest_growth == pytest.approx(1.0, abs=1e-3)


def test_a_long_motion_has_the_time_constant_of_its_slowest_decay() -> None:
    """The growth underflows to zero. The mechanism stands still, so its rates of decay are constant."""
    overrides = waves(0.0) | {"controller.Lambda": 3.0, "controller.K_D": 5.0}
    result = stability(*load_controlled("five_bar/tracking", overrides), 2000.0)
    assert result.growth == 0.0
    assert result.eigenvalues is not None
    assert result.slowest == pytest.approx(-1 / result.eigenvalues.real.max(), rel=5e-3)


def test_a_warning_reports_growth_that_overflows() -> None:
    result = check(load_scene("five_bar/tracking", {"controller.sample_time": 0.02, "t_end": 90.0}))
    assert result.stability is not None
    assert result.stability.stable is False
    assert any("may be more than 1e308 times as large at its end" in warning for warning in result.warnings)


def test_stability_of_a_motion_that_is_too_fast_is_unknown() -> None:
    result = stability(*load_controlled("five_bar/tracking", waves(1e5)), 3.0)
    assert result.stable is None
    assert "too fast to be analyzed for longer than" in str(result.reason)


# --- shipped scenes ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONTROLLED)
def test_shipped_controllers_are_stable_and_their_scenes_long_enough(name: str) -> None:
    result, t_end = check(name), load_scene(name).spec.t_end
    assert result.stability is not None
    assert result.stability.stable
    assert result.stability.slowest is not None
    assert t_end >= MIN_TIME_CONSTANTS * result.stability.slowest
    assert not [warning for warning in result.warnings if "closed loop" in warning]


@pytest.mark.parametrize("name", sorted(LEAVES))
def test_stability_of_a_motion_that_leaves_the_workspace_is_unknown(name: str) -> None:
    result = check(name)
    assert result.stability is not None
    assert result.stability.stable is None
    assert "leaves the workspace at t = 4.39313 s" in str(result.stability.reason)


def test_the_squat_stays_at_its_target() -> None:
    """Up to the error that dry friction holds, 1e-3 rad."""
    run = simulate("talos/squat")
    _, law = load_controlled("talos/squat")
    error = np.abs(run.q_tree[:, run.mechanism.partition.q] - law.q_d).max(axis=1)
    assert error[run.at(3.0) :].max() < 1e-3


def test_check_reports_the_least_gain_of_an_unstable_set_point() -> None:
    """With K_P = 1000 of the squat, K_P + dh/dq has the eigenvalue -66."""
    scene = load_scene("talos/squat", {"controller.K_P": 1000.0})
    result = check(scene)
    assert result.stability is not None
    assert not result.stability.stable
    assert result.stability.least_eigenvalue == pytest.approx(-65.66, abs=0.01)
    assert result.stability.slowest == np.inf
    warning = next(x for x in result.warnings if "unstable" in x)
    assert "1065.66" in warning
    assert stability(*_with_gain("talos/squat", 1065.7), 1.0).stable


def test_a_set_point_with_another_model_is_stable_off_its_target(tmp_path: Any) -> None:
    """The model's gravity is not the plant's. The loop is linearized about its position of rest, not its target."""
    scene = load_scene("five_bar/set_point", {"controller.model": "five_bar_as_printed"})
    mechanism = load_scene_mechanism(scene)
    law = build_scene_controller(scene, mechanism)
    assert isinstance(law, SetPoint)
    result = stability(mechanism, law, 5.0)
    assert result.stable
    run = simulate("five_bar/set_point", {"controller.model": "five_bar_as_printed", "t_end": 5.0})
    offset = np.abs(run.q_tree[-1][[0, 2]] - law.q_d).max()
    assert 1e-4 < offset < 0.1
