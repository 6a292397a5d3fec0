"""Sampled controllers compared with a NumPy and SciPy loop, and with continuous control for small sample times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, NumericalError, Sampled, Terms, simulate
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from tests.analytic.five_bar import FIVE_BAR, Array, Q, set_point, tracking
from tests.conftest import assert_close, remember
from tests.contract.helpers.bad import Bad, expect

pytestmark = pytest.mark.usefixtures("either_terms")

FORMULATIONS = ["reduced", "spf", "dae"]
TARGET = np.full(2, np.pi / 4)
LAWS = {"set_point": set_point(FIVE_BAR, TARGET), "tracking": tracking(FIVE_BAR)}
START = FIVE_BAR.equilibrium()[Q]


@remember
def loop(scene: str, period: float, delay: float, t_end: float) -> tuple[Array, Array, Array]:
    """Return instants at which u changes or is computed, (q, q_dot) there, and the u applied from then on.

    u acts at t with the newest k for which k period + delay <= t.
    """
    samples = [k * period for k in range(round(t_end / period) + 1)]
    instants = sorted({round(t, 12) for t in [*samples, *(t + delay for t in samples)] if t < t_end + 1e-12})
    computed: list[Array] = []
    y, states, acts = np.concatenate([START, np.zeros(2)]), [], []
    for k, t in enumerate(instants):
        q_tree = FIVE_BAR.sigma(y[:2])
        if len(computed) * period <= t + 1e-12:
            computed.append(LAWS[scene](t, q_tree, y[2:]))
        newest = int(np.floor((t - delay) / period + 1e-6))
        u = computed[newest] if newest >= 0 else np.zeros(2)
        states.append(y)
        acts.append(u)
        if k + 1 < len(instants):

            def rate(t: float, y: Array, u: Array = u) -> Array:
                return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], u)])

            y = solve_ivp(rate, (t, instants[k + 1]), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return np.array(instants), np.array(states), np.array(acts)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    ("scene", "period", "delay"),
    [
        ("set_point", 0.002, 0.0),
        ("set_point", 0.002, 0.0005),
        ("set_point", 0.002, 0.002),
        ("set_point", 0.002, 0.005),
        ("tracking", 0.0005, 0.00025),
    ],
)
def test_sampled_control_agrees_with_numpy(scene: str, period: float, delay: float, formulation: str) -> None:
    t_end = 15 * period
    instants, states, acts = loop(scene, period, delay, t_end)
    overrides = {
        "formulation": formulation,
        "t_end": t_end,
        "solver.rtol": 1e-11,
        "solver.output_dt": period / 4,
        "controller.sample_time": period,
        "controller.delay": delay,
    }
    run = simulate(f"five_bar/{scene}", overrides)
    assert run.status == "done", run.message
    rows = [run.at(t) for t in instants]
    assert_close(run.t[rows], instants, 1e-12)
    assert_close(run.q_tree[rows][:, Q], states[:, :2], 1e-9)
    assert_close(run.v_tree[rows][:, Q], states[:, 2:], 1e-7)
    # u at output instants is its limit from the right
    newest = np.searchsorted(instants, run.t + 1e-9) - 1
    assert_close(run.u, acts[newest], 1e-6)
    assert np.array_equal(run.u, run.tau)
    before = run.t < delay - 1e-9
    assert not run.u[before].any()
    assert np.abs(run.u[~before]).min(axis=0).max() > 0.1


@pytest.mark.parametrize("scene", ["set_point", "tracking"])
def test_sampled_control_converges_to_continuous_control(scene: str) -> None:
    """First order: half the sample time and delay give half the difference."""
    t_end = 0.04 if scene == "set_point" else 0.02
    overrides = {"formulation": "reduced", "t_end": t_end, "solver.rtol": 1e-9, "solver.output_dt": 0.01}
    exact = simulate(f"five_bar/{scene}", overrides)
    periods = np.array([1e-3, 5e-4, 2.5e-4]) / (1 if scene == "set_point" else 2)
    gaps = []
    for period in periods:
        sampled = {"controller.sample_time": period, "controller.delay": period}
        gaps.append(np.abs(simulate(f"five_bar/{scene}", {**overrides, **sampled}).q_tree - exact.q_tree).max())
    orders = np.log2(np.array(gaps[:-1]) / np.array(gaps[1:]))
    assert gaps[-1] > 1e-6
    assert abs(orders[-1] - 1) < 0.15
    assert np.all(np.abs(orders - 1) < 0.3)


def test_a_sampled_controller_from_python() -> None:
    overrides = {"formulation": "reduced", "t_end": 0.01}
    scene = load_scene("five_bar/tracking")
    inner = build_scene_controller(scene, load_scene_mechanism(scene))
    assert inner is not None
    sampled = Sampled(inner, 5e-4, 2e-4)
    shipped = simulate("five_bar/tracking", {**overrides, "controller.sample_time": 5e-4, "controller.delay": 2e-4})
    for _ in range(2):  # a second run gives the same
        run = simulate("five_bar/tracking", overrides, controller=sampled)
        assert_close(run.q_tree, shipped.q_tree, 1e-9)
        assert_close(run.u, shipped.u, 1e-6)
        assert run.lyapunov is not None
        assert shipped.lyapunov is not None
        assert_close(run.lyapunov, shipped.lyapunov, 1e-6)


def test_sampled_controller_is_called_at_its_instants_only() -> None:
    asked: list[float] = []

    class Counting:
        def u(self, t: float, terms: Terms) -> Array:
            asked.append(t)
            return np.zeros(2)

    run = simulate("five_bar/swing", {"t_end": 0.05}, controller=Sampled(Counting(), 0.01))
    assert_close(asked, 0.01 * np.arange(6), 1e-15)
    assert_close(run.q_tree, simulate("five_bar/swing", {"t_end": 0.05}).q_tree, 1e-9)


def test_sampled_nan_stops_the_run_at_its_instant() -> None:
    class Fails:
        def __init__(self, after: float) -> None:
            self.after = after

        def u(self, t: float, terms: Terms) -> Array:
            return np.array([0.0, np.nan if t > self.after else 0.0])

    run = simulate("five_bar/swing", {"t_end": 0.5}, controller=Sampled(Fails(0.195), 0.01))
    assert run.status == "stopped"
    assert run.t[-1] == pytest.approx(0.2, abs=1e-12)
    assert run.message.endswith("the controller's u is not finite: [0.0, nan]")
    with pytest.raises(NumericalError, match="not finite"):
        simulate("five_bar/swing", controller=Sampled(Fails(-1.0), 0.01))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((0.0,), "sample_time = 0.0: expected a number greater than 0"),
        ((-0.1,), "sample_time = -0.1"),
        ((np.nan,), "sample_time = nan"),
        (("1",), "sample_time = '1'"),
        ((0.1, -1.0), "delay = -1.0: expected a number of at least 0"),
        ((0.1, np.inf), "delay = inf"),
    ],
)
def test_invalid_sampling_is_rejected(arguments: tuple[Any, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Sampled(LAWS, *arguments)  # type: ignore[arg-type]


BAD = [
    (("sample_time=0",), "controller.sample_time = 0: expected a number greater than 0"),
    (("sample_time=-.1",), "controller.sample_time = -0.1: expected a number greater than 0"),
    (("sample_time=fast",), "controller.sample_time = 'fast': expected a number, got a string"),
    (("sample_time=.1", "delay=-1"), "controller.delay = -1: expected a number of at least 0"),
    (("delay=.1",), "controller.delay: it needs a sampled controller; give controller.sample_time too"),
    (("sample_time=1e-300",), "sample_time = 1e-300 gives more than 10000000 samples in 9.5 s"),
]


@pytest.mark.parametrize(("overrides", "says"), BAD, ids=[" ".join(overrides) for overrides, _ in BAD])
def test_invalid_sampling_of_a_scene_is_rejected(overrides: tuple[str, ...], says: str, bar: Path) -> None:
    words = [word for change in overrides for word in ("--set", f"controller.{change}")]
    expect(Bad("clock", ("run", "bar/tracking.scene.toml", *words), [says]), bar)
