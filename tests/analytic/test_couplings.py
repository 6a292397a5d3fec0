"""Couplings of wheels: motion against equations written by hand and integrated by SciPy, and their parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

import ckc_pin
from ckc_pin import Mechanism, MechanismError, Scene, check, load, simulate
from ckc_pin.codegen.library import compile_terms
from ckc_pin.mechanism.rows import Curved
from tests.analytic.five_bar import Array

T_END = 0.6
G, MASS, ARM = 9.81, {"a": 0.8, "b": 0.5, "c": 0.3}, {"a": 0.1, "b": 0.2, "c": 0.15}
MOMENT = 0.004  # kg m^2, about each centre of mass
INERTIA = {name: MOMENT + MASS[name] * ARM[name] ** 2 for name in MASS}
WHEEL = """<link name="{name}_wheel"><inertial><origin xyz="{arm} 0 0"/><mass value="{mass}"/>
  <inertia ixx="0.004" iyy="0.004" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="{name}" type="continuous"><parent link="base"/><child link="{name}_wheel"/><axis xyz="0 0 1"/></joint>"""
TIGHT = {"solver.rtol": 1e-11, "solver.atol": 1e-13, "solver.output_dt": 0.1}
X = np.linspace(-5.0, 5.0, 33)
TABLE = [(float(x), float(0.4 * x + 0.3 * np.sin(x))) for x in X]
SPLINE = make_interp_spline(X, [y for _, y in TABLE], 5)
POLYNOMIAL = np.polynomial.Polynomial([0.1, 0.7, 0.25, -0.05])
Curves = tuple[dict[str, Any], list[Callable[[float], float]]]
CURVES: dict[str, Curves] = {  # the coupling, and a = p(b) with its first two derivatives
    "polynomial": ({"polynomial": POLYNOMIAL.coef.tolist()}, [POLYNOMIAL.deriv(k) for k in range(3)]),
    "table": ({"table": TABLE}, [lambda x, k=k: float(SPLINE(x, k)) for k in range(3)]),
    "ratio": ({"ratio": -2.5}, [lambda x: -2.5 * x, lambda x: -2.5, lambda x: 0.0]),
}


def wheels(*names: str, **more: Any) -> Mechanism:
    """Return eccentric wheels on the base; gravity acts along -y."""
    links = "".join(WHEEL.format(name=name, arm=ARM[name], mass=MASS[name]) for name in names)
    urdf = f'<robot name="wheels"><link name="base"/>{links}</robot>'
    return Mechanism.from_urdf(urdf, gravity=[0, -G, 0], **more)


def torque(name: str, angle: float) -> float:
    """Return the torque of gravity on a wheel."""
    return -MASS[name] * G * ARM[name] * float(np.cos(angle))


def solve_two(p: list[Callable[[float], float]], b: float, rate: float, t_end: float) -> Any:
    """Integrate (I_b + I_a p'^2) b'' + I_a p' p'' b'^2 = torque_b + p' torque_a."""

    def motion(t: float, x: Array) -> list[float]:
        a, slope, curvature = (f(x[0]) for f in p)
        force = torque("b", x[0]) + slope * torque("a", a) - INERTIA["a"] * slope * curvature * x[1] ** 2
        return [x[1], force / (INERTIA["b"] + INERTIA["a"] * slope**2)]

    def crosses(t: float, x: Array) -> float:
        return float(x[0]) - 0.3

    t = np.linspace(0, t_end, round(10 * t_end) + 1)
    return solve_ivp(motion, (0, t_end), [b, rate], "DOP853", t, events=crosses, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
@pytest.mark.parametrize("kind", list(CURVES))
def test_two_coupled_wheels_move_as_the_equation_says(kind: str, formulation: str) -> None:
    coupling, p = CURVES[kind]
    mechanism = wheels("a", "b", couplings=[{"joint": "a", "other": "b", **coupling}], independent=["b"])
    event = {"coordinate": "b", "of": "q", "value": 0.3, "direction": 0, "stop": False}
    start = {"q": {"b": 0.6}, "q_dot": {"b": 0.5}}
    scene = Scene(mechanism, formulation=formulation, initial=start, t_end=T_END, events=[event])
    reference = solve_two(p, 0.6, 0.5, T_END)
    for terms in ("pinocchio", "generated"):
        run = simulate(scene, {**TIGHT, "solver.terms": terms})
        assert run.status == "done"
        assert np.abs(run["b"] - reference.y[0]).max() < 2e-8
        assert np.abs(run["a"] - [p[0](x) for x in reference.y[0]]).max() < 2e-8
        times = [event["t"] for event in run.events]
        assert len(times) == len(reference.t_events[0]) > 0
        assert np.abs(np.array(times) - reference.t_events[0]).max() < 2e-8


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_three_coupled_wheels_move_as_the_equations_say(formulation: str) -> None:
    """With c = 0.2 - 0.29 a + 0.4 b, the mass matrix is D + I_c s s^T, where s = (-0.29, 0.4)."""
    s = np.array([-0.29, 0.4])
    joints = {"a": 0.29, "b": -0.4, "c": 1.0}
    mechanism = wheels("a", "b", "c", couplings=[{"joints": joints, "offset": 0.2}], independent=["a", "b"])
    D = np.diag([INERTIA["a"], INERTIA["b"]]) + INERTIA["c"] * np.outer(s, s)

    def motion(t: float, x: Array) -> Array:
        force = [torque("a", x[0]), torque("b", x[1])] + torque("c", 0.2 + s @ x[:2]) * s
        return np.concatenate([x[2:], np.linalg.solve(D, force)])

    start = {"q": {"a": 0.6, "b": -0.3}, "q_dot": {"a": 0.5, "b": 1.0}}
    t = np.arange(0, 1.55, 0.1)
    reference = solve_ivp(motion, (0, 1.5), [0.6, -0.3, 0.5, 1.0], "DOP853", t, rtol=1e-12, atol=1e-13)
    run = simulate(Scene(mechanism, formulation=formulation, initial=start, t_end=1.5), TIGHT)
    assert np.abs(run["a"] - reference.y[0]).max() < 2e-8
    assert np.abs(run["c"] - 0.2 - s @ reference.y[:2]).max() < 2e-8


def test_a_sampled_controller_drives_a_nonlinear_coupling() -> None:
    """Each sample holds u = -K_P e - K_V b' + compensation at the sample; SciPy integrates from sample to sample."""
    coupling, p = CURVES["polynomial"]
    mechanism = wheels("a", "b", couplings=[{"joint": "a", "other": "b", **coupling}], independent=["b"])
    law = {"type": "set_point", "K_P": 3.0, "K_V": 0.2, "q_d": {"b": -0.4}, "sample_time": 0.02}
    scene = Scene(mechanism, formulation="reduced", initial={"q": {"b": 0.6}}, controller=law, t_end=0.6)

    def force(x: float) -> float:
        return torque("b", x) + p[1](x) * torque("a", p[0](x))

    x = np.array([0.6, 0.0])
    for _ in range(30):
        u = -3.0 * (x[0] + 0.4) - 0.2 * x[1] - force(-0.4)

        def motion(t: float, x: Array, u: float = u) -> list[float]:
            slope, curvature = p[1](x[0]), p[2](x[0])
            inertia = INERTIA["b"] + INERTIA["a"] * slope**2
            return [x[1], (u + force(x[0]) - INERTIA["a"] * slope * curvature * x[1] ** 2) / inertia]

        x = solve_ivp(motion, (0, 0.02), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    run = simulate(scene, TIGHT)
    assert abs(run["b"][-1] - x[0]) < 1e-9
    assert abs(run["v.b"][-1] - x[1]) < 1e-8


def test_a_table_keeps_the_second_derivative_of_its_ends() -> None:
    coupling, _ = CURVES["table"]
    (group,) = wheels("a", "b", couplings=[{"joint": "a", "other": "b", **coupling}]).closure.groups
    assert isinstance(group, Curved)
    for end in X[[0, -1]]:
        for order in range(3):
            around = [float(group.curve(np.array([end + h]), order)[0]) for h in (-1e-9, 1e-9)]
            assert abs(around[0] - SPLINE(end, order)) < 1e-8
            assert abs(around[1] - around[0]) < 1e-8
        beyond = group.curve(np.array([[end + np.sign(end)], [end + 2 * np.sign(end)]]), 2)
        assert np.abs(beyond - SPLINE(end, 2)).max() < 1e-12


@pytest.mark.parametrize("count", [3, 4, 6, 7, 12])
def test_a_table_of_a_polynomial_is_the_polynomial(count: int) -> None:
    x = np.linspace(-0.4, 1.3, count)
    p = np.polynomial.Polynomial([0.3, -1.2, 0.7, 0.4, -0.5, 0.9][: min(count, 6)])
    table = np.column_stack([x, p(x)]).tolist()
    (group,) = wheels("a", "b", couplings=[{"joint": "a", "other": "b", "table": table}]).closure.groups
    assert isinstance(group, Curved)
    between = np.linspace(-0.4, 1.299, 50)
    for order in range(4):
        assert np.abs(group.curve(between[:, None], order)[:, 0] - p.deriv(order)(between)).max() < 1e-10


def test_the_guess_of_followers_satisfies_couplings() -> None:
    mechanism = wheels(
        "a", "b", "c", q_guess={"b": 0.5, "c": 0.2},
        couplings=[{"joints": {"a": 2.0, "b": 1.0, "c": -1.0}, "offset": 0.1, "name": "sum"}],
    )  # fmt: skip
    q = dict(zip(mechanism.coordinates, mechanism.q_tree, strict=True))
    assert q == pytest.approx({"a": -0.1, "b": 0.5, "c": 0.2}, abs=1e-15)
    assert "2 a + 1 b - 1 c = 0.1" in str(mechanism)


def test_parameters_of_couplings_have_names_and_units(tmp_path: Any) -> None:
    couplings = [
        {"joints": {"a": 2.0, "b": 1.0}, "offset": 0.1, "name": "sum"},
        {"joint": "c", "other": "b", "polynomial": [0.0, 1.0, 0.5]},
    ]
    mechanism = wheels("a", "b", "c", couplings=couplings)
    names = [
        name for name in ckc_pin.mechanism.parameters.values_of(mechanism.spec, mechanism.urdf) if "coupling" in name
    ]
    assert names == ["coupling.sum.offset", "coupling.sum.joints.a", "coupling.sum.joints.b", "coupling.1.offset"]
    path = mechanism.save(tmp_path)
    changed = load(path, {"coupling.sum.joints.a": 4.0, "coupling.1.offset": 0.3})
    assert changed.spec.coupling[0].joints == {"a": 4.0, "b": 1.0}
    assert changed.spec.coupling[1].offset == 0.3
    assert check(changed).to_dict()["d"] == 1
    with pytest.raises(ckc_pin.InputError, match=r"no 'coupling.1.polynomial'; there are coupling.1.offset"):
        load(path, {"coupling.1.polynomial": 1.0})
    with pytest.raises(MechanismError, match="all coefficients are zero"):
        load(path, {"coupling.sum.joints.a": 0.0, "coupling.sum.joints.b": 0.0})


def test_compiled_terms_are_of_the_curve() -> None:
    """Another polynomial needs other code, another offset does not."""

    def make(c: float, offset: float) -> Mechanism:
        return wheels("a", "b", couplings=[{"joint": "a", "other": "b", "polynomial": [0.0, 1.0, c], "offset": offset}])

    paths = [compile_terms(make(c, offset)).path for c, offset in ((0.5, 0.1), (0.5, 0.2), (0.6, 0.1))]
    assert paths[0] == paths[1] != paths[2]


def test_compiled_terms_of_a_number_that_an_override_sets_to_zero() -> None:
    """An armature and the rotor of a motor on two joints, which the files give."""
    motor = {"name": "m", "joints": {"a": 1.0, "b": -1.0}, "rotor_inertia": 0.01}
    mechanism = wheels("a", "b", joints=[{"name": "a", "armature": 0.1}], motors=[motor])
    scene = Scene(mechanism, formulation="dae", initial={"q": {"a": 0.6, "b": -0.3}}, t_end=0.2)
    overrides = {**TIGHT, "joint.a.armature": 0.0, "motor.m.rotor_inertia": 0.0}
    run, reference = (simulate(scene, {**overrides, "solver.terms": x}) for x in ("generated", "pinocchio"))
    assert np.abs(run.q_tree - reference.q_tree).max() < 1e-9
