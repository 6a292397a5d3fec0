"""The DAE with three stabilizations of its constraints: projection, Baumgarte, and IDA's iteration (GGL)."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sksundae.ida import IDA

from ckc_pin import Run, load, simulate
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.native import StopReason
from ckc_pin.run.ivp import Dae, as_ivp
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.initial import Start
from ckc_pin.scene.scene import load_scene
from scripts.experiments.benchmark.peers.ida import Stabilised
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.regression.reference import trajectory

# --- IDA, an independent integrator ------------------------------------------------------------------


def ida(scene: str, overrides: dict[str, Any], rtol: float, times: Array) -> tuple[Array, Array]:
    """(q', v') at times, by SUNDIALS IDA with the NumPy terms."""
    problem = as_ivp(scene, overrides)
    assert isinstance(problem, Dae)
    form = Stabilised(problem)
    form.begin(math.inf)
    solver = IDA(form.residual, **form.options(rtol))
    solution = solver.solve(times, *form.start)
    assert solution.success, solution.message
    n = problem.mechanism.n
    return solution.y[:, :n], solution.y[:, n : 2 * n]


@pytest.mark.parametrize(
    ("scene", "t_end", "q_error", "rate_error"),
    [
        ("five_bar/swing", 0.5, 1e-8, 1e-6),
        ("four_bar", 0.5, 1e-7, 1e-6),
        ("five_bar/tracking", 0.2, 1e-8, 1e-6),
        ("bricard", 1.0, 1e-8, 1e-6),  # redundant rows
    ],
)
def test_projected_dae_agrees_with_sundials_ida(scene: str, t_end: float, q_error: float, rate_error: float) -> None:
    overrides = {"formulation": "dae", "t_end": t_end, "solver.output_dt": t_end / 7}
    ours = simulate(scene, {**overrides, "solver.rtol": 1e-11})
    q_tree, v_tree = ida(scene, overrides, 1e-10, ours.t)
    np.testing.assert_allclose(q_tree, ours.q_tree, rtol=0, atol=q_error)
    np.testing.assert_allclose(v_tree, ours.v_tree, rtol=0, atol=rate_error)


def test_sundials_ida_agrees_with_the_numpy_reference() -> None:
    exact = trajectory("swing")
    assert exact.t[0] == 0.5
    q_tree, _ = ida("five_bar/swing", {"formulation": "dae"}, 1e-10, np.array([0.0, 0.5]))
    np.testing.assert_allclose(q_tree[-1], exact.q_tree[0], rtol=0, atol=1e-8)


# --- Baumgarte --------------------------------------------------------------------------------------


def test_baumgarte_damps_drift_and_projection_removes_it(run: Callable[..., Run]) -> None:
    def swing(**solver: object) -> Run:
        return run("five_bar/swing", formulation="dae", t_end=5.0, solver__rtol=1e-6, **solver)

    free, projected = swing(solver__projection=False), swing()
    damped = swing(solver__projection=False, solver__baumgarte=[50.0, 50.0])
    drift = np.abs(free.phi).max(axis=1)
    assert drift[-100:].max() > 3 * drift[:100].max() > 0  # it grows
    assert free.max_phi > 50 * damped.max_phi
    assert damped.max_phi > 1e3 * projected.max_phi  # the residual decays, while each step adds to it
    assert projected.max_phi <= 1e-12


def test_baumgarte_residual_decays_critically_damped() -> None:
    """An initial residual follows phi_ddot + 2 alpha phi_dot + beta^2 phi = 0, critically damped."""
    overrides = {"formulation": "dae", "solver.projection": False, "solver.baumgarte": [5.0, 5.0], "solver.rtol": 1e-11}
    ready = prepare(load_scene("five_bar/swing", overrides))
    q_tree = ready.start.at.q_tree + np.array([1e-4, 0.0, 0.0, 0.0])
    at = ready.mechanism.kinematics(q_tree)
    ready.begin(Start(at, np.zeros(2), np.zeros(2), np.zeros(4)))
    assert ready.loop.advance(0.3, final=True, pause=math.inf, budget=math.inf).reason == StopReason.END
    decayed = at.phi * (1 + 5.0 * 0.3) * np.exp(-5.0 * 0.3)
    np.testing.assert_allclose(FIVE_BAR.phi(ready.loop.y[:4]), decayed, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"formulation": "spf", "solver.baumgarte": [1.0, 1.0]}, 'baumgarte is for formulation = "dae"'),
        ({"formulation": "dae", "solver.baumgarte": [1.0, 1.0]}, "give solver.projection = false"),
        ({"formulation": "dae", "solver.projection": False, "solver.baumgarte": [1.0]}, "baumgarte"),
        ({"formulation": "dae", "solver.projection": False, "solver.baumgarte": [1.0, -1.0]}, "baumgarte"),
    ],
)
def test_incompatible_dae_settings_are_rejected(overrides: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        simulate("five_bar/swing", overrides)


@pytest.mark.parametrize(
    ("q", "q_dot"),
    [
        ((-0.93414013, -0.41820761), (7.45699329, 0.99570948)),
        ((0.69231067, -0.69793467), (7.95535897, 7.69336542)),
        ((-0.57268896, -1.80892173), (-6.54795127, 1.28531818)),
    ],
)
def test_energy_equals_work_of_constant_u_where_q_is_no_chart(
    q: tuple[float, float], q_dot: tuple[float, float]
) -> None:
    """phi_z passes through singular configurations, where z does not determine the velocity."""
    names = ("theta_1", "theta_3")
    overrides = {
        "formulation": "dae",
        "t_end": 1.0,
        "solver.output_dt": 1e-4,
        "solver.rtol": 1e-4,
        "solver.method": "RK45",
        "initial": {"q": dict(zip(names, q, strict=True)), "q_dot": dict(zip(names, q_dot, strict=True))},
        "controller": {"type": "set_point", "K_P": 0.1, "K_V": 0.01, "sample_time": 1.0,
                       "q_d": {"theta_1": -1.2, "theta_3": 1.9}},
    }  # fmt: skip
    run = simulate("five_bar/swing", overrides)
    assert run.status == "done"
    margin = [abs(FIVE_BAR.s(q_tree)) for q_tree in run.q_tree]
    assert min(margin) < 1e-3 < max(margin)
    moved = run.q_tree - run.q_tree[0]
    work = moved[:, [run.column(name) for name in run.independent]] @ run.u[0]
    gained = run.energy - run.energy[0]
    assert np.abs(gained - work).max() < 100 * 1e-4 * np.abs(run.energy).max()


# --- starts where q is no chart ---------------------------------------------------------------------


IN_LINE = {"crank": 0.0, "rod": 0.0, "slider": 0.4}


def by_slider(folder: Path, pin: str = 'type = "point_2d"\n') -> str:
    """The slider-crank with the slider as q, which is no chart where crank and rod are in line."""
    for name, text in load("slider_crank").sources.texts.items():
        by_slider = text.replace('["crank"]', '["slider"]')
        (folder / name).write_text(by_slider.replace('type = "point_2d"\n', pin))
    (folder / "s.scene.toml").write_text('mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 0.5\n')
    return str(folder / "s.scene.toml")


@pytest.mark.parametrize("off", [0.0, 3e-6])
@pytest.mark.parametrize(
    "pin", ['type = "point_2d"\n', 'type = "hinge"\naxis_a = [0.0, 0.0, 1.0]\n'], ids=["point", "hinge"]
)
def test_dae_starts_where_q_is_no_chart(tmp_path: Path, off: float, pin: str) -> None:
    """The start gives every coordinate. The motion is that in the crank's coordinate, also with redundant rows."""
    scene = by_slider(tmp_path, pin)
    overrides = {
        "initial": {"q": {**IN_LINE, "rod": off}},
        "solver.rtol": 1e-10,
        "t_end": 0.5,
        "solver.output_dt": 0.05,
    }
    ours, theirs = simulate(scene, overrides), simulate("slider_crank", {**overrides, "formulation": "dae"})
    assert ours.status == "done"
    assert np.ptp(ours["crank"]) > 0.5
    for name in IN_LINE:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=0, atol=max(1e-8, 10 * off))


@pytest.mark.parametrize(
    "more",
    [
        {"formulation": "reduced"},
        {"initial.q_dot": {"slider": 1.0}},
        {"controller": {"type": "set_point", "K_P": 4.0, "K_V": 1.0, "q_d": {"slider": 0.28}}},
    ],
)
def test_starts_that_need_q_are_rejected_where_q_is_no_chart(tmp_path: Path, more: dict[str, Any]) -> None:
    scene = by_slider(tmp_path)
    with pytest.raises(NumericalError, match="singular: slider do not determine crank, rod there"):
        simulate(scene, {"initial": {"q": IN_LINE}, **more})


def test_callers_controller_is_rejected_where_q_is_no_chart(tmp_path: Path) -> None:
    scene = by_slider(tmp_path)
    with pytest.raises(NumericalError, match="singular: slider do not determine crank, rod there"):
        simulate(scene, {"initial": {"q": IN_LINE}}, controller=lambda t, terms: np.zeros(1))
