"""Motions that repeat: closed forms of rails, pendulums and oscillators, replays over several periods, and messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ellipk

import ckc_pin
from ckc_pin import InputError, Mechanism, NumericalError, Plan, optimize
from tests.optimization.small_models import GRAVITY, LENGTH, MASS, REPLAY, pendulum, require_replay, slider

FORCE = 3.0
STIFFNESS, DAMPING = 40.0, 3.0


def require_period(plan: Plan) -> None:
    """Require that the state at the end of a period is that at the start, up to whole turns."""
    q, rates, _ = plan.motion(np.array([0.0, plan.t_end]))
    assert plan.cycle is not None
    assert np.abs(q[1] - q[0] - plan.cycle.turns).max() < 1e-8
    assert np.abs(rates[1] - rates[0]).max() < 1e-7


def oscillator() -> Mechanism:
    """Return a mass on a rail with a spring and a damper."""
    spring = {"joint": "rail", "stiffness": STIFFNESS, "damping": DAMPING}
    return slider(springs=[spring])


def test_fastest_cycle_between_two_places_is_bang_bang() -> None:
    """The force changes its sign halfway between the places, where the mass turns back."""
    distance = 0.7
    plan = optimize(slider(), via=[{"q": {"rail": 0.0}}, {"q": {"rail": distance}}], periodic={},
                    limits={"torque": FORCE}, intervals=100)  # fmt: skip
    assert plan.t_end == pytest.approx(4 * np.sqrt(distance * MASS / FORCE), rel=1e-3)
    assert plan.via_t == pytest.approx((0.0, plan.t_end / 2), rel=1e-6)
    require_period(plan)
    require_replay(plan, FORCE)


def test_cycle_with_times_at_rest() -> None:
    distance, rest = 0.7, (0.1, 0.25)
    via = [{"q": {"rail": q}, "dwell": time} for q, time in zip((0.0, distance), rest, strict=True)]
    plan = optimize(slider(), via=via, periodic={}, limits={"torque": FORCE}, intervals=100)
    assert plan.t_end == pytest.approx(4 * np.sqrt(distance * MASS / FORCE) + sum(rest), rel=1e-3)
    assert np.all(np.diff(plan.t) > 0)
    require_period(plan)
    require_replay(plan, FORCE)


def test_cycle_with_a_load_on_the_way_there() -> None:
    """Each way is bang-bang with its own mass. The parts of three periods are run one after the other."""
    distance, load, rest = 0.7, 1.5, 0.1
    via = [{"q": {"rail": 0.0}, "dwell": rest, "parameters": {"link.cart.mass": MASS + load}},
           {"q": {"rail": distance}, "dwell": rest, "parameters": {"link.cart.mass": MASS}}]  # fmt: skip
    plan = optimize(slider(), via=via, periodic={}, limits={"torque": FORCE}, intervals=100)
    ways = [2 * np.sqrt(distance * mass / FORCE) for mass in (MASS + load, MASS)]
    assert plan.t_end == pytest.approx(sum(ways) + 2 * rest, rel=1e-3)
    assert plan.via_t == pytest.approx((0.0, ways[0]), rel=1e-3)
    require_period(plan)
    require_replay(plan, FORCE)


def test_least_effort_of_an_oscillator_has_the_fourier_series_of_two_places() -> None:
    """x has odd harmonics only. Their least effort with x(0) = A follows from one multiplier."""
    amplitude, period = 0.3, 1.2
    plan = optimize(
        oscillator(), start={"q": {"rail": amplitude}}, via=[{"q": {"rail": -amplitude}, "time": period / 2}],
        periodic={"time": period}, minimize={"effort": 1.0}, intervals=80,
    )  # fmt: skip
    n = np.arange(-20_001, 20_002, 2)
    omega = 2 * np.pi * n / period
    weight = np.abs(STIFFNESS - MASS * omega**2 + 1j * DAMPING * omega) ** 2
    assert plan.cost == pytest.approx(period * amplitude**2 / np.sum(1 / weight), rel=1e-6)
    x = np.real(np.exp(1j * np.outer(plan.t, omega)) @ (1 / weight)) * amplitude / np.sum(1 / weight)
    assert np.abs(plan.columns()["rail"] - x).max() < 1e-5 * amplitude
    require_period(plan)
    require_replay(plan, np.inf)


def test_a_pendulum_without_damping_turns_freely() -> None:
    """The rate where it hangs follows from the period by an elliptic integral."""
    period = 1.0
    plan = optimize(pendulum(), periodic={"turns": {"hinge": 1}, "time": period}, minimize={"effort": 1.0})
    assert plan.cost < 1e-12
    rate = float(plan.motion(np.zeros(1))[1][0, 0])
    inertia = MASS * LENGTH**2 + 1e-9
    square = 4 * MASS * GRAVITY * LENGTH / (inertia * rate**2)
    assert 4 / rate * ellipk(square) == pytest.approx(period, rel=1e-6)
    require_period(plan)
    require_replay(plan, np.inf)


def test_a_crank_turns_with_least_effort() -> None:
    """Nothing dissipates: the motor's work in a period is zero, though the limited rate needs a torque."""
    period = 0.8
    plan = optimize("slider_crank", periodic={"turns": {"crank": -1}, "time": period}, minimize={"effort": 1.0},
                    limits={"rate": {"crank": 9.0}})  # fmt: skip
    require_period(plan)
    require_replay(plan, np.inf)
    assert np.abs(plan.columns()["v.crank"]).max() < 9.0 * (1 + 2e-3)
    columns = plan.columns()
    power = columns["tau.crank"] * columns["v.crank"]
    assert abs(np.trapezoid(power, plan.t)) < 1e-3 * np.trapezoid(np.abs(power), plan.t)
    assert columns["crank"][-1] == pytest.approx(columns["crank"][0] - 2 * np.pi, abs=1e-8)


def test_a_delta_repeats_pick_and_place() -> None:
    def place(*position: float, **keys: Any) -> dict[str, Any]:
        return {"point": {"plate": list(position)}, **keys}

    via = [place(0.0, 0.0, -0.29, dwell=0.02), place(0.05, 0.0, -0.27), place(0.1, 0.0, -0.29, dwell=0.02),
           place(0.05, 0.0, -0.27)]  # fmt: skip
    plan = optimize("delta", via=via, periodic={}, limits={"torque": 5.0})
    require_period(plan)
    require_replay(plan, 5.0)


def test_a_motion_that_repeats_tracks_another_one() -> None:
    t = np.linspace(0.0, 1.0, 101)
    table = {"t": t, "theta_1": -1.434 + 0.1 * np.sin(2 * np.pi * t), "theta_3": -1.707 + 0.1 * np.cos(2 * np.pi * t)}
    plan = optimize("five_bar", periodic={}, minimize={"tracking": 1.0}, limits={"time": 1.0},
                    desired={"file": table})  # fmt: skip
    assert np.abs(plan.columns()["theta_1"] - (-1.434 + 0.1 * np.sin(2 * np.pi * plan.t))).max() < 1e-5
    require_period(plan)
    require_replay(plan, np.inf)


def test_scenes_have_several_periods(tmp_path: Path) -> None:
    plan = optimize(pendulum(), periodic={"turns": {"hinge": 1}}, limits={"torque": 9.0, "rate": 8.0})
    assert plan.t_end == pytest.approx(2 * np.pi / 8.0, rel=1e-5)
    plan.save(tmp_path)
    assert plan.to_dict()["periods"] == 3
    for name, tolerance in (("open", REPLAY), ("closed", 1e-2)):
        run = ckc_pin.simulate(tmp_path / f"{name}.scene.toml")
        assert run.t[-1] == pytest.approx(3 * plan.t_end)
        assert run["hinge"][-1] - run["hinge"][0] == pytest.approx(6 * np.pi, abs=tolerance)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, "periodic: a mechanism at rest is a solution; give turns, a second place"),
        ({"via": [{"q": {"rail": 0.2}}]}, "periodic: a mechanism at rest is a solution"),
        ({"via": [{"q": {"rail": 0.2}}, {"q": {"rail": 0.2}}]}, "via[1]: the same place as via[0]"),
        ({"to": {"q": {"rail": 0.2}}}, "to: a periodic motion ends where it begins"),
        ({"path": {"q": {"rail": [0.0, 0.2]}}}, "path: a periodic motion ends where it begins"),
        ({"periodic": {"turns": {"rail": 1}}}, "periodic.turns.rail: rail is a length, which does not turn"),
        ({"periodic": {"turns": {"rial": 1}}}, "periodic.turns.rial: no independent coordinate 'rial'"),
        ({"periodic": {"time": 1.0}, "via": [{"q": {"rail": 0.2}}, {"q": {"rail": 0.3}}]},
         "periodic.time: the period is given, which minimize.time does not change"),
        ({"periodic": {"time": 2.0}, "limits": {"time": 1.0}}, "periodic.time: 2 s is above limits.time = 1 s"),
        ({"via": [{"q": {"rail": 0.2}, "time": 0.1}, {"q": {"rail": 0.3}}]},
         "via[0].time: without `from`, the period begins at this place"),
    ],
)  # fmt: skip
def test_wrong_periods_are_explained(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        optimize(slider(), **{"periodic": {}, "limits": {"torque": FORCE}, **change})
    assert message in str(error.value)


def test_turns_that_the_loops_do_not_allow_are_refused() -> None:
    with pytest.raises(InputError, match=r"periodic\.turns: the loops do not close along these turns"):
        optimize("five_bar", periodic={"turns": {"theta_1": 1}}, limits={"torque": 2.0})


def test_a_period_that_becomes_arbitrarily_short_is_refused() -> None:
    with pytest.raises(NumericalError, match=r"unbounded: the motion from .* becomes arbitrarily short"):
        optimize(pendulum(), periodic={"turns": {"hinge": 1}}, limits={"torque": 9.0})
