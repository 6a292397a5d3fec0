"""The DAE kept on its closure in three ways: projected, by Baumgarte's terms, by IDA's own iteration (GGL)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Run, simulate
from ckc_pin.errors import InputError
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import load_scene
from tests.regression.reference import trajectory


def _flat(t: float, y: Any) -> float:
    return float(y[0])


TOLS = tuple(10.0**-k for k in range(6, 12))

# --- IDA, independent of every step of ours ---------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "t_end", "q_error", "rate_error"),
    [
        ("five_bar/swing", 0.5, 1e-8, 1e-6),
        ("four_bar", 0.5, 1e-7, 1e-6),
        ("five_bar/tracking", 0.2, 1e-8, 1e-6),
        ("bricard", 1.0, 1e-8, 1e-6),  # redundant rows
    ],
)
def test_ida_agrees_with_the_projected_dae(scene: str, t_end: float, q_error: float, rate_error: float) -> None:
    changes = {"formulation": "dae", "t_end": t_end, "solver.output_dt": t_end / 7}
    ours = simulate(scene, {**changes, "solver.rtol": 1e-11})
    theirs = simulate(scene, {**changes, "solver.rtol": 1e-10, "solver.method": "IDA"})
    assert theirs.status == "done", theirs.message
    np.testing.assert_allclose(theirs.q_tree, ours.q_tree, rtol=0, atol=q_error)
    np.testing.assert_allclose(theirs.v_tree, ours.v_tree, rtol=0, atol=rate_error)
    assert theirs.max_phi <= 1e-10  # by its Newton iteration alone
    assert theirs.stats["method"] == "IDA"
    assert theirs.stats["jacobians"] > 0


def test_ida_against_an_integration_in_numpy(run: Callable[..., Run]) -> None:
    exact = trajectory("swing")
    ours = run("five_bar/swing", formulation="dae", t_end=0.5, solver__method="IDA", solver__rtol=1e-10)
    assert exact.t[0] == 0.5
    np.testing.assert_allclose(ours.q_tree[-1], exact.q_tree[0], rtol=0, atol=1e-8)


def test_idas_error_falls_with_its_tolerance(run: Callable[..., Run]) -> None:
    exact = trajectory("swing").q_tree[0]
    changes = {"formulation": "dae", "t_end": 0.5, "solver__method": "IDA"}
    errors = [np.abs(run("five_bar/swing", solver__rtol=rtol, **changes).q_tree[-1] - exact).max() for rtol in TOLS]
    assert np.all(np.array(errors) <= 1e2 * np.array(TOLS))
    assert np.polyfit(np.log(TOLS), np.log(errors), 1)[0] > 0.5


def test_ida_meets_events_and_budgets() -> None:
    changes = {"formulation": "dae", "t_end": 0.5, "solver.rtol": 1e-9}
    halfway = float(simulate("five_bar/swing", {**changes, "t_end": 0.25}).q_tree[-1, 0])
    event = [{"coordinate": "theta_1", "value": halfway}]
    found = simulate("five_bar/swing", {**changes, "event": event, "solver.method": "IDA"}).events
    known = simulate("five_bar/swing", {**changes, "event": event}).events
    assert known[0]["t"] == pytest.approx(0.25, abs=1e-8)
    assert [e["t"] for e in found] == pytest.approx([e["t"] for e in known], abs=1e-7)
    stopped = simulate("five_bar/swing", {**changes, "solver.method": "IDA", "solver.max_rhs": 200})
    assert stopped.status == "stopped"
    assert "max_rhs = 200" in stopped.message
    assert stopped.stats["rhs"] == 200


@pytest.mark.parametrize(("N", "rtol"), [(1, 1e-8), (4, 1e-10), (4, 1e-12)])
def test_ida_stops_where_J_loses_rank(N: int, rtol: float) -> None:
    """Also where its steps become so short that t does not change any more."""
    changes = {"mechanism.N": N, "solver.method": "IDA", "solver.rtol": rtol, "t_end": 1.0}
    run = simulate("n_four_bar", {**changes, "solver.output_dt": 0.1})
    k = 9.81 * 3 * (3 * N + 1) / (2 * (4 * N + 1))
    flat = solve_ivp(lambda t, y: [y[1], -k * np.cos(y[0])], (0, 1), [np.pi / 2, -1.0], rtol=1e-10, events=_flat)
    assert run.status == "stopped"
    assert run.t[-1] == pytest.approx(flat.t_events[0][0], abs=0.02)
    assert run.message.startswith("stopped at t = 0.7")


def test_without_sundials_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sksundae.ida", None)
    with pytest.raises(InputError, match="install scikit-sundae"):
        simulate("five_bar/swing", {"formulation": "dae", "solver.method": "IDA"})


def test_a_free_root_is_refused() -> None:
    with pytest.raises(InputError, match="free root"):
        simulate("stewart", {"formulation": "dae", "solver.method": "IDA"})


# --- Baumgarte --------------------------------------------------------------------------------------


def test_what_drifts_is_held_by_baumgarte_and_closed_by_projection(run: Callable[..., Run]) -> None:
    def swing(**solver: object) -> Run:
        return run("five_bar/swing", formulation="dae", t_end=5.0, solver__rtol=1e-6, **solver)

    free, projected = swing(solver__projection=False), swing()
    held = swing(solver__projection=False, solver__baumgarte=[50.0, 50.0])
    drift = np.abs(free.phi).max(axis=1)
    assert drift[-100:].max() > 3 * drift[:100].max() > 0  # it grows
    assert free.max_phi > 50 * held.max_phi
    assert held.max_phi > 1e3 * projected.max_phi  # what is off decays, while every step adds to it
    assert projected.max_phi <= 1e-12


def test_baumgarte_decays_as_it_says() -> None:
    """Off the closure by hand: phi follows phi_ddot + 2 alpha phi_dot + beta^2 phi = 0, critically damped."""
    changes = {"formulation": "dae", "solver.projection": False, "solver.baumgarte": [5.0, 5.0], "solver.rtol": 1e-11}
    scene = load_scene("five_bar/swing", changes)
    system = prepare(scene).system
    y = system.start()
    y[0] += 1e-4
    before = system.terms(0.0, y).phi.copy()
    system.start = lambda: y  # type: ignore[method-assign]
    stepper = Stepper(system, "DOP853", scene.spec.solver, 0.3)
    while stepper.solver.status == "running":
        stepper.step()
    decayed = before * (1 + 5.0 * 0.3) * np.exp(-5.0 * 0.3)
    np.testing.assert_allclose(system.terms(0.3, stepper.solver.y).phi, decayed, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"formulation": "reduced", "solver.method": "IDA"}, 'method IDA is for formulation = "dae"'),
        ({"formulation": "spf", "solver.baumgarte": [1.0, 1.0]}, 'baumgarte is for formulation = "dae"'),
        ({"formulation": "dae", "solver.baumgarte": [1.0, 1.0]}, "give projection = false"),
        ({"formulation": "dae", "solver.projection": False, "solver.baumgarte": [1.0]}, "baumgarte"),
        ({"formulation": "dae", "solver.projection": False, "solver.baumgarte": [1.0, -1.0]}, "baumgarte"),
    ],
)
def test_what_does_not_go_together(changes: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        simulate("five_bar/swing", changes)
