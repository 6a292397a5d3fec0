"""Sensors and drives of sampled controllers compared with a NumPy and SciPy loop of the appendix's five-bar."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, NumericalError, Run, Sampled, Terms, simulate
from tests.analytic.five_bar import FIVE_BAR, Array, Q, set_point, tracking
from tests.conftest import assert_close, remember
from tests.contract.helpers.bad import Bad, expect

pytestmark = pytest.mark.usefixtures("either_terms")

FORMULATIONS = ["reduced", "spf", "dae"]
LAWS = {"set_point": set_point(FIVE_BAR, np.full(2, np.pi / 4)), "tracking": tracking(FIVE_BAR)}
START = FIVE_BAR.equilibrium()[Q]
MASK = 2**64 - 1


# --- what is measured and sent, once more ----------------------------------------------------------


def uniforms(seed: int) -> Iterator[float]:
    """The SplitMix64 generator."""
    state = seed
    while True:
        state = (state + 0x9E3779B97F4A7C15) & MASK
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        yield (((z ^ (z >> 31)) >> 11) + 0.5) / 2**53


def normals(seed: int) -> Iterator[float]:
    """Normal numbers by the polar method; the first of each pair."""
    draw = uniforms(seed)
    while True:
        x, y = 2 * next(draw) - 1, 2 * next(draw) - 1
        s = x * x + y * y
        if 0 < s < 1:
            yield x * math.sqrt(-2 * math.log(s) / s)


class Seen:
    """The signals of a sensor, sample by sample."""

    def __init__(self, period: float, **keys: Any) -> None:
        self.period, self.keys = period, keys
        self.draw = normals(keys.get("seed", 0))
        self.before: tuple[Array, Array] | None = None

    def __call__(self, q: Array, q_dot: Array) -> tuple[Array, Array]:
        get = self.keys.get
        noise = np.array([next(self.draw) for _ in range(4)])
        measured = q + np.multiply(get("q_noise", 0.0), noise[:2])
        step = get("resolution", 0.0)
        if np.any(step):
            measured = np.floor(measured / step + 0.5) * step
        rate = q_dot + np.multiply(get("q_dot_noise", 0.0), noise[2:])
        if get("rate") == "difference":
            rate = np.zeros(2) if self.before is None else (measured - self.before[0]) / self.period
        if self.before is not None and "filter" in self.keys:
            share = math.exp(-self.period / self.keys["filter"])
            rate = share * self.before[1] + (1 - share) * rate
        self.before = measured, rate
        return measured, rate


def sent(tau: Array, last: Array, largest: Any, step: Any) -> tuple[Array, Array]:
    """Return (quantized torques, torques before quantization)."""
    last = last + np.clip(tau - last, np.negative(largest), largest)
    return (np.floor(last / step + 0.5) * step if np.any(step) else last), last


Law = Callable[[float, Array, Array], Array]


def loop(
    law: Law, seen: Seen, count: int, late: int = 0, largest: Any = np.inf, step: Any = 0.0
) -> tuple[Array, Array]:
    """Return (q, q_dot) and the applied torque at `count` instants, four per period; `late` is the delay."""
    y, last, waiting, acts = np.concatenate([START, np.zeros(2)]), np.zeros(2), [], np.zeros(2)
    states, torques = [], []
    quarter = seen.period / 4
    for k in range(count):
        if k % 4 == 0:
            q, q_dot = seen(y[:2], y[2:])
            tau, last = sent(law(k * quarter, FIVE_BAR.sigma(q), q_dot), last, np.multiply(largest, seen.period), step)
            waiting.append((k + late, tau))
        if waiting and waiting[0][0] == k:
            acts = waiting.pop(0)[1]
        states.append(y)
        torques.append(acts)

        def rate(t: float, y: Array, u: Array = acts) -> Array:
            return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], u)])

        y = solve_ivp(rate, (0.0, quarter), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return np.array(states), np.array(torques)


@remember
def shipped_loop(
    scene: str, period: float, keys: dict[str, Any], count: int, late: int = 0, largest: Any = np.inf, step: Any = 0.0
) -> tuple[Array, Array]:
    """Return `loop` with the controller of a scene and a sensor with these keys."""
    return loop(LAWS[scene], Seen(period, **keys), count, late, largest, step)


def assert_is(run: Run, states: Array, torques: Array) -> None:
    assert run.status == "done", run.message
    assert len(run.t) == len(states)
    assert_close(run.q_tree[:, Q], states[:, :2], 1e-9)
    assert_close(run.v_tree[:, Q], states[:, 2:], 1e-7)
    assert_close(run.tau[:-1], torques[:-1], 1e-6)
    assert_close([FIVE_BAR.phi(q_tree) for q_tree in run.q_tree], 0.0, 1e-12)


def table(keys: dict[str, Any], coordinates: tuple[str, str] = ("theta_1", "theta_3")) -> dict[str, Any]:
    """Return arrays as tables by coordinate."""
    return {k: dict(zip(coordinates, x, strict=True)) if isinstance(x, tuple) else x for k, x in keys.items()}


SENSORS: dict[str, dict[str, Any]] = {
    "encoders": {"resolution": 2e-3},
    "encoders that differ": {"resolution": (1e-3, 5e-3)},
    "differences": {"resolution": 1e-4, "rate": "difference"},
    "filtered differences": {"resolution": 1e-3, "rate": "difference", "filter": 0.004},
    "a filtered rate": {"filter": 0.01},
    "noise": {"q_noise": 1e-3, "q_dot_noise": (0.02, 0.0), "seed": 7},
    "everything": {"q_noise": (1e-3, 0.0), "resolution": 1e-3, "rate": "difference", "filter": 0.01, "seed": 2**62 + 5},
}


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("scene", ["set_point", "tracking"])
def test_sensors_agree_with_numpy(scene: str, name: str) -> None:
    """Both control laws use measured values; terms are evaluated at the configuration that closes the loops there."""
    keys, formulation = SENSORS[name], FORMULATIONS[len(name) % 3]
    period = 0.002 if scene == "set_point" else 0.0005
    overrides = {
        "formulation": formulation,
        "t_end": 8 * period,
        "solver.rtol": 1e-11,
        "solver.output_dt": period / 4,
        "controller.sample_time": period,
        "controller.sensor": table(keys),
    }
    run = simulate(f"five_bar/{scene}", overrides)
    assert_is(run, *shipped_loop(scene, period, keys, 33))
    exact = simulate(f"five_bar/{scene}", {**overrides, "controller.sensor": None})
    assert np.abs(run.tau - exact.tau).max() > 1e-3
    assert run.stats["python_calls"] == 0


DRIVES: dict[str, dict[str, Any]] = {
    "steps": {"torque_resolution": 0.05},
    "rates": {"torque_rate": (500.0, 900.0)},
    "both": {"torque_resolution": (0.5, 0.0), "torque_rate": 700.0},
}


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("name", DRIVES)
def test_drives_agree_with_numpy(formulation: str, name: str) -> None:
    keys, period = DRIVES[name], 0.002
    values = {k: {m: x for m, x in v.items() if x} if isinstance(v, dict) else v for k, v in table(keys).items()}
    overrides = {
        "formulation": formulation,
        "t_end": 10 * period,
        "solver.rtol": 1e-11,
        "solver.output_dt": period / 4,
        "controller.sample_time": period,
        "controller.delay": period / 2,
        "controller.drive": values,
        "controller.sensor": {"resolution": 1e-3},
    }
    run = simulate("five_bar/set_point", overrides)
    rate, step = keys.get("torque_rate", np.inf), np.array(keys.get("torque_resolution", 0.0))
    step = np.where(step > 0, step, 1e-300)  # floor(x / 1e-300) overflows nothing here, and changes nothing
    if np.all(step == 1e-300):
        step = 0.0
    states, torques = shipped_loop("set_point", period, {"resolution": 1e-3}, 41, 2, rate, step)
    assert_is(run, states, torques)
    assert np.abs(run.tau).max() > 1.0


class CustomController:
    """A controller that uses terms: gravity compensation at the measured configuration, and damping."""

    def u(self, t: float, terms: Terms) -> Array:
        return terms.h - terms.D @ (40.0 * (terms.q - START - 0.1) + 5.0 * terms.q_dot)

    @staticmethod
    def of(t: float, q_tree: Array, q_dot: Array) -> Array:
        D = FIVE_BAR.rho(q_tree).T @ FIVE_BAR.D_tree(q_tree) @ FIVE_BAR.rho(q_tree)
        return FIVE_BAR.h(q_tree) - D @ (40.0 * (q_tree[Q] - START - 0.1) + 5.0 * q_dot)


class OwnTorques:
    """The same controller with torques by motor."""

    def tau(self, t: float, terms: Terms) -> Array:
        return CustomController().u(t, terms)


@pytest.mark.parametrize("controller", [CustomController(), OwnTorques()], ids=["u", "tau"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_callers_controller_gets_measured_terms(formulation: str, controller: Any) -> None:
    keys = {"resolution": 1e-3, "rate": "difference", "filter": 0.003}
    period = 0.002
    sampled = Sampled(controller, period, period / 4, keys, {"torque_resolution": 1e-3})
    overrides = {
        "formulation": formulation,
        "t_end": 8 * period,
        "solver.rtol": 1e-11,
        "solver.output_dt": period / 4,
        "initial.q": {"theta_1": float(START[0]), "theta_3": float(START[1])},
        "initial.q_dot": {},
        "initial.at": None,
    }
    states, torques = loop(CustomController.of, Seen(period, **keys), 33, 1, step=1e-3)
    for _ in range(2):  # a run leaves nothing behind
        assert_is(simulate("five_bar/swing", overrides, controller=sampled), states, torques)


@pytest.mark.parametrize("convention", ["rho", "actual"])
def test_controllers_own_model_gets_measured_terms(tmp_path: Path, convention: str) -> None:
    """Eq. 16 with a too heavy model, at values of coarse encoders."""
    from tests.regression.test_control import heavy_model

    period, keys = 0.0005, {"resolution": 5e-3, "rate": "difference"}
    overrides = {
        "t_end": 8 * period,
        "solver.rtol": 1e-11,
        "solver.output_dt": period / 4,
        "coriolis_velocity": convention,
        "controller.sample_time": period,
        "controller.sensor": keys,
        "controller.model": heavy_model(tmp_path, "value|i[xyz][xyz]"),
    }
    law = tracking(FIVE_BAR.heavier(1.2, 1.2))
    assert_is(simulate("five_bar/tracking", overrides), *loop(law, Seen(period, **keys), 33))


def test_noise_is_normal_and_reproducible() -> None:
    """Measured values at rest have the right mean, deviation and fourth moment, and are uncorrelated."""

    class Reads:
        def __init__(self) -> None:
            self.read: list[Array] = []

        def u(self, t: float, terms: Terms) -> Array:
            self.read.append(np.concatenate([terms.q, terms.q_dot]))
            return np.zeros(2)

    def noise(seed: int) -> Array:
        reads = Reads()
        sensor = {"q_noise": {"theta_1": 1e-3, "theta_3": 2e-3}, "q_dot_noise": 0.5, "seed": seed}
        simulate(
            "five_bar/swing",
            {"initial": {"at": "equilibrium"}, "t_end": 4.0, "formulation": "reduced"},
            controller=Sampled(reads, 1e-3, sensor=sensor),
        )
        return (np.array(reads.read) - np.concatenate([START, np.zeros(2)])) / [1e-3, 2e-3, 0.5, 0.5]

    result, draw = noise(3), normals(3)
    assert_close(result[:50].ravel(), [next(draw) for _ in range(200)], 1e-6)
    count = len(result)
    assert count == 4001
    assert_close(result.mean(axis=0), 0.0, 4 / np.sqrt(count))
    assert_close((result**2).mean(axis=0), 1.0, 4 * np.sqrt(2 / count))
    assert_close((result**4).mean(axis=0), 3.0, 4 * np.sqrt(96 / count))
    assert_close(result.T @ result / count - np.eye(4), 0.0, 6 / np.sqrt(count))
    assert_close((result[1:] * result[:-1]).mean(axis=0), 0.0, 4 / np.sqrt(count))
    assert np.array_equal(result, noise(3))
    assert np.abs(result - noise(4)).max() > 1.0


def test_empty_sensor_table_is_ignored() -> None:
    """An empty table gives the same results with the same number of right-hand sides."""
    overrides = {"t_end": 0.02, "controller.sample_time": 0.001}
    plain = simulate("five_bar/set_point", overrides)
    empty = simulate("five_bar/set_point", {**overrides, "controller.sensor": {}, "controller.drive": {}})
    assert np.array_equal(plain.q_tree, empty.q_tree)
    assert plain.stats["rhs"] == empty.stats["rhs"]


def test_measurement_out_of_reach_stops_the_run() -> None:
    overrides = {"t_end": 0.05, "controller.sample_time": 0.001, "controller.sensor": {"q_noise": 30.0}}
    with pytest.raises(NumericalError, match="the loops cannot be closed at the measured q"):
        simulate("five_bar/tracking", overrides)


def _set(*overrides: str) -> tuple[str, ...]:
    clock = ("--set", "controller.sample_time=0.001")
    return ("run", "bar/tracking.scene.toml", *clock, *(w for c in overrides for w in ("--set", f"controller.{c}")))


JOINTS = "theta_1, theta_3"
BAD = [
    (_set("sensor.resolution=-1"), "controller.sensor.resolution = -1: expected a number of at least 0"),
    (_set("sensor.resolution={theta_2=0.1}"), "controller.sensor.resolution: 'theta_2' follows from the loops"),
    (_set("sensor.q_noise={x=0.1}"), f"controller.sensor.q_noise: no coordinate 'x' here; there are {JOINTS}"),
    (_set("sensor.rate=fast"), "controller.sensor.rate = 'fast'; valid: 'difference', 'exact'"),
    (_set("sensor.filter=0"), "controller.sensor.filter = 0: expected a number greater than 0"),
    (_set("sensor.seed=-1"), "controller.sensor.seed = -1: expected an integer of at least 0"),
    (_set("sensor.seed=1.5"), "controller.sensor.seed = 1.5"),
    (_set("sensor.steps=1"), "controller.sensor: unknown key 'steps'; valid: resolution, rate, filter"),
    (
        _set("sensor.rate=difference", "sensor.q_dot_noise=1"),
        'q_dot_noise: with rate = "difference" no rate is measured',
    ),
    (_set("drive.torque_resolution=0"), "controller.drive.torque_resolution = 0: expected a number greater than 0"),
    (
        _set("drive.torque_rate={theta_2=1.0}"),
        f"controller.drive.torque_rate: no motor 'theta_2'; there are {JOINTS}",
    ),
]


@pytest.mark.parametrize(("words", "says"), BAD, ids=[" ".join(words[4:]) for words, _ in BAD])
def test_invalid_sensor_is_rejected(words: tuple[str, ...], says: str, bar: Path) -> None:
    expect(Bad("sensor", words, [says]), bar)


@pytest.mark.parametrize("key", ["sensor", "drive"])
def test_sensors_and_drives_need_a_sample_time(key: str, bar: Path) -> None:
    entry = {"sensor": "resolution=0.1", "drive": "torque_rate=1.0"}[key]
    words = ("run", "bar/tracking.scene.toml", "--set", f"controller.{key}.{entry}")
    expect(Bad("clock", words, [f"controller.{key}: it needs a sampled controller"]), bar)


def test_invalid_sensor_table_from_python_is_rejected() -> None:
    with pytest.raises(InputError, match="Sampled: sensor: unknown key 'steps'"):
        Sampled(CustomController(), 0.1, sensor={"steps": 1})
