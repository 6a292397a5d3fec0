"""Closed loops: eigenvalues, the least K_P, growth along a motion; every shipped scene stable and long enough."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin import check, load_scene, simulate
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.library import shipped
from ckc_pin.simulation.closed_loop import ClosedLoop
from ckc_pin.simulation.prepare import scene_controller, scene_mechanism
from ckc_pin.simulation.scene import scene_names
from ckc_pin.simulation.stability import stability
from tests.analytic.five_bar import FIVE_BAR, Array, complex_step, set_point

TRACKING = ["five_bar/tracking", "stewart/wave", "delta/circle", "two_ur5/lift", "three_rrr/circle"]
LEAVES = {"five_bar_as_printed/tracking"}  # erratum 3: the motion leaves the workspace
CONTROLLED = [
    name
    for mechanism in shipped()
    for scene in scene_names(mechanism)
    if load_scene(name := f"{mechanism}/{scene}").spec.controller is not None and name not in LEAVES
]
LONG_ENOUGH = 4  # times the slowest decay: errors fall to a fiftieth


def controlled(name: str, changes: dict[str, Any] | None = None) -> tuple[Mechanism, Any]:
    scene = load_scene(name, changes)
    mechanism = scene_mechanism(scene)
    return mechanism, scene_controller(scene, mechanism)


def state_of(mechanism: Mechanism, law: Tracking, t: float, off: float) -> Terms:
    random = np.random.default_rng(0)
    q_d, q_d_dot, _ = law.desired(t)
    at = sigma(mechanism, q_d).at
    at = sigma(mechanism, q_d + off * random.uniform(-1, 1, mechanism.d), at).at
    return Terms(mechanism, at, at.rho @ (q_d_dot + 10 * off * random.uniform(-1, 1, mechanism.d)))


# --- exact ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRACKING)
def test_a_controllers_gradient_is_the_difference(name: str) -> None:
    mechanism, law = controlled(name)
    state, t = state_of(mechanism, law, 0.7, 0.02), 0.7

    def u(x: Array) -> Array:
        at = sigma(mechanism, state.q + x[: mechanism.d], state.at).at
        return law.u(t, Terms(mechanism, at, at.rho @ (state.q_dot + x[mechanism.d :])))

    step = np.random.default_rng(1).uniform(-1, 1, 2 * mechanism.d)
    one, two = ((u(h * step) - u(-h * step)) / (2 * h) for h in (2e-3, 1e-3))
    wanted = (4 * two - one) / 3
    assert np.abs(ClosedLoop(mechanism, law).at(t, state).K @ step - wanted).max() <= 1e-9 * np.abs(wanted).max()


@pytest.mark.parametrize("name", TRACKING)
def test_where_the_motion_is_as_desired_the_error_obeys_eq_16(name: str) -> None:
    """D r_dot + (C + K_D) r = 0 with r = e_dot + Lambda e, the plant's own terms in the controller."""
    mechanism, law = controlled(name)
    state = state_of(mechanism, law, 0.7, 0.0)
    G = np.linalg.solve(state.D, state.C + law.K_D)
    wanted = np.block([[np.zeros_like(G), np.eye(len(G))], [-G @ law.Lambda, -G - law.Lambda]])
    assert np.abs(ClosedLoop(mechanism, law).at(0.7, state).closed - wanted).max() <= 1e-10 * np.abs(wanted).max()


def test_the_set_points_eigenvalues_are_those_of_the_appendix() -> None:
    mechanism, law = controlled("five_bar/set_point")
    target = FIVE_BAR.sigma(law.q_d)
    u = set_point(FIVE_BAR, law.q_d, law.K_P[0, 0], law.K_V[0, 0])
    h_d = FIVE_BAR.h(target)

    def rate(x: Array) -> Array:
        moved = target + FIVE_BAR.rho(target) @ x[:2]
        force = h_d - law.K_P @ (moved[[0, 2]] - law.q_d) - law.K_V @ x[2:]
        return np.concatenate([x[2:], FIVE_BAR.acceleration(moved, x[2:], force)])

    assert np.abs(u(0.0, target, np.zeros(2)) - h_d).max() < 1e-12
    wanted = np.linalg.eigvals(complex_step(rate, np.zeros(4)))
    found = stability(mechanism, law, 1.0)
    assert found is not None
    assert np.abs(np.sort_complex(found.eigenvalues) - np.sort_complex(wanted)).max() <= 1e-8 * np.abs(wanted).max()
    assert found.slowest == pytest.approx(-1 / wanted.real.max())


@pytest.mark.parametrize("name", ["five_bar/set_point", "talos/squat"])
def test_the_least_gain_is_the_edge(name: str) -> None:
    found = check(name).stability
    assert found is not None
    assert found.least_K_P is not None
    least = float(found.least_K_P[0, 0])
    for factor, stable in ((1 + 1e-6, True), (1 - 1e-6, False)):
        at_edge = stability(*_with_gain(name, factor * least), 1.0)
        assert at_edge is not None
        assert at_edge.stable == stable
        assert (at_edge.least_eigenvalue > 0) == stable  # type: ignore[operator]
        assert (at_edge.eigenvalues.real.max() < 0) == stable


def _with_gain(name: str, gain: float) -> tuple[Mechanism, SetPoint]:
    mechanism, law = controlled(name, {"controller.K_P": gain})
    return mechanism, law


def test_growth_is_what_two_runs_do() -> None:
    """The nonlinear error of a run that starts a little off, over what it started with."""
    changes = {"formulation": "reduced", "solver.rtol": 1e-12, "t_end": 3.0}
    mechanism, law = controlled("five_bar/tracking")
    q_d, q_d_dot, _ = law.desired(0.0)
    ends = []
    for k in range(2):
        q = dict(zip(mechanism.independent, (q_d + 1e-6 * np.eye(2)[k]).tolist(), strict=True))
        rates = dict(zip(mechanism.independent, q_d_dot.tolist(), strict=True))
        run = simulate("five_bar/tracking", {**changes, "initial": {"q": q, "q_dot": rates}})
        ends.append((run.q_tree[-1][[0, 2]] - law.desired(3.0)[0]) / 1e-6)
    found = stability(mechanism, law, 3.0)
    assert found is not None
    assert found.growth == pytest.approx(np.linalg.norm(np.array(ends).T, 2), rel=2e-3)


# --- shipped scenes ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONTROLLED)
def test_shipped_controllers_are_stable_and_run_long_enough_to_show_it(name: str) -> None:
    found, t_end = check(name), load_scene(name).spec.t_end
    assert found.stability is not None
    assert found.stability.stable
    assert t_end >= LONG_ENOUGH * found.stability.slowest
    assert not [warning for warning in found.warnings if "closed loop" in warning]


@pytest.mark.parametrize("name", sorted(LEAVES))
def test_a_motion_that_cannot_be_followed_has_no_verdict(name: str) -> None:
    assert check(name).stability is None


def test_the_squat_stays_where_it_was_sent() -> None:
    """Up to what dry friction holds: 1e-3 rad."""
    run = simulate("talos/squat")
    _, law = controlled("talos/squat")
    error = np.abs(run.q_tree[:, run.mechanism.partition.q] - law.q_d).max(axis=1)
    assert error[run.at(3.0) :].max() < 1e-3


def test_of_an_unstable_set_point_the_check_says_what_would_do() -> None:
    """The squat's K_P of before: K_P + dh/dq has the eigenvalue -66."""
    scene = load_scene("talos/squat", {"controller.K_P": 1000.0})
    found = check(scene)
    assert found.stability is not None
    assert not found.stability.stable
    assert found.stability.least_eigenvalue == pytest.approx(-65.66, abs=0.01)
    assert found.stability.slowest == np.inf
    warning = next(x for x in found.warnings if "unstable" in x)
    assert "1065.66" in warning
    assert stability(*_with_gain("talos/squat", 1065.7), 1.0).stable  # type: ignore[union-attr]


def test_a_set_point_of_another_model_rests_elsewhere(tmp_path: Any) -> None:
    """Its gravity is not the plant's; about where the loop comes to rest, not about the target."""
    scene = load_scene("five_bar/set_point", {"controller.model": "five_bar_as_printed"})
    mechanism = scene_mechanism(scene)
    law = scene_controller(scene, mechanism)
    assert isinstance(law, SetPoint)
    found = stability(mechanism, law, 5.0)
    assert found is not None
    assert found.stable
    run = simulate("five_bar/set_point", {"controller.model": "five_bar_as_printed", "t_end": 5.0})
    off = np.abs(run.q_tree[-1][[0, 2]] - law.q_d).max()
    assert 1e-4 < off < 0.1
