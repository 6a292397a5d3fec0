"""Forces and moments on links: the five-bar with the equations of its appendix, a closed form, and tables over time."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ckc_pin
from ckc_pin import Force, InputError, Run, Simulator, inverse_dynamics, load, simulate
from ckc_pin.errors import CkcError
from ckc_pin.native import _core
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import load_scene
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import assert_close

FORMULATIONS = ["dae", "reduced", "spf"]
START = {"theta_1": -1.2, "theta_3": -1.9}
WORLD = {"frame": "link_2", "force": [0.3, 0.5, 0.0], "moment": [0.0, 0.0, 0.2], "name": "wind"}
FOLLOWER = {"frame": {"link": "link_4", "xyz": [0.1, 0.05, 0.0], "rpy": [0.0, 0.0, 0.4]}, "axes": "frame",
            "force": [0.3, -0.6, 0.0], "moment": [0.0, 0.0, 0.1]}  # fmt: skip

Wrench = Callable[[float, Array], tuple[Array, float]]  # force in the world and moment at (t, q')


def scene(**overrides: Any) -> dict[str, Any]:
    return {
        "formulation": "dae",
        "t_end": 1.5,
        "initial": {"q": START, "q_dot": {"theta_1": 0.4}},
        "solver": {"rtol": 1e-11, "output_dt": 0.05},
        **overrides,
    }


def turned(angle: Any, x: Array) -> Array:
    return np.array([np.cos(angle) * x[0] - np.sin(angle) * x[1], np.sin(angle) * x[0] + np.cos(angle) * x[1]])


def origin(link: int, offset: tuple[float, float], q_tree: Array) -> Array:
    """Position of a point of distal link 2 (index 1) or 4 (index 3) in the plane."""
    proximal = link - 1
    base = np.array([0.0 if proximal == 0 else FIVE_BAR.base, 0.0])
    elbow = base + FIVE_BAR.l[proximal] * np.array([np.cos(q_tree[proximal]), np.sin(q_tree[proximal])])
    return elbow + turned(q_tree[proximal] + q_tree[link], np.array(offset))


def generalized(link: int, offset: tuple[float, float], wrench: Wrench, t: float, q_tree: Array) -> Array:
    """u' by virtual work: the complex-step derivative of the point, and the angle of the link."""
    force, moment = wrench(t, q_tree)
    step = 1e-30
    result = np.zeros(4)
    for k in range(4):
        moved = q_tree.astype(complex)
        moved[k] += 1j * step
        result[k] = origin(link, offset, moved).imag @ force / step
    result[[link - 1, link]] += moment
    return result


def initial_state() -> Array:
    q_tree = FIVE_BAR.sigma(np.array([START["theta_1"], START["theta_3"]]))
    return np.concatenate([q_tree, FIVE_BAR.rho(q_tree) @ np.array([0.4, 0.0])])


def integrate(
    times: Array, forces: list[tuple[int, tuple[float, float], Wrench]], start: Array | None = None
) -> tuple[Array, Array]:
    """q' and v' by eq. 1 of the appendix."""
    start = initial_state() if start is None else start

    def rate(t: float, y: Array) -> Array:
        q_tree, v_tree = y[:4], y[4:]
        J = FIVE_BAR.J(q_tree)
        force = -FIVE_BAR.C_tree(q_tree, v_tree) @ v_tree - FIVE_BAR.h_tree(q_tree)
        force += sum(generalized(*one, t, q_tree) for one in forces)
        matrix = np.block([[FIVE_BAR.D_tree(q_tree), -J.T], [J, np.zeros((2, 2))]])
        right = np.concatenate([force, -FIVE_BAR.J_dot(q_tree, v_tree) @ v_tree])
        return np.concatenate([v_tree, np.linalg.solve(matrix, right)[:4]])

    solution = solve_ivp(rate, times[[0, -1]], start, "DOP853", times, rtol=1e-12, atol=1e-13)
    return solution.y[:4].T, solution.y[4:].T


@cache
def with_both_forces() -> tuple[Array, Array]:
    return integrate(np.linspace(0.0, 1.5, 31), [(1, (0.0, 0.0), of_world), (3, (0.1, 0.05), of_follower)])


def of_world(t: float, q_tree: Array) -> tuple[Array, float]:
    return np.array([0.3, 0.5]), 0.2


def of_follower(t: float, q_tree: Array) -> tuple[Array, float]:
    return turned(q_tree[2] + q_tree[3] + 0.4, np.array([0.3, -0.6])), 0.1


@pytest.mark.usefixtures("either_terms")
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_constant_forces_agree_with_the_appendix(formulation: str, method: str) -> None:
    solver = {"rtol": 1e-11, "output_dt": 0.05, "method": method}
    run = simulate("five_bar/swing", scene(formulation=formulation, force=[WORLD, FOLLOWER], solver=solver))
    q_tree, v_tree = with_both_forces()
    assert run.status == "done"
    assert_close(run.q_tree, q_tree, 1e-9)
    assert_close(run.v_tree, v_tree, 1e-8)
    assert run.stats["python_calls"] == 0


@pytest.mark.usefixtures("either_terms")
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_jacobian_with_forces_agrees_with_differences(formulation: str) -> None:
    prepared = prepare(load_scene("five_bar/swing", scene(formulation=formulation, force=[WORLD, FOLLOWER])))
    prepared.begin()
    loop: _core.Loop = prepared.loop
    y = loop.y
    jacobian = loop.jacobian(0.0, y)
    assert jacobian is not None
    step = 1e-6
    for k in range(len(y)):
        rates = [loop.rhs(0.0, y + sign * step * np.eye(len(y))[k]) for sign in (1, -1)]
        assert rates[0] is not None
        assert rates[1] is not None
        assert_close(jacobian[:, k], (rates[0] - rates[1]) / (2 * step), 2e-5)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_functions_of_the_state_agree_with_the_appendix(formulation: str) -> None:
    def drag(t: float, terms: ckc_pin.Terms) -> list[float]:
        return [-0.2 * terms.v_tree[0], 0.3 * math.sin(4 * t), 0.0]

    def wrench(t: float, q_tree: Array, v_1: float) -> tuple[Array, float]:
        return np.array([-0.2 * v_1, 0.3 * math.sin(4 * t)]), 0.0

    run = simulate("five_bar/swing", scene(formulation=formulation), forces=[Force("link_2", drag)])
    start = run.v_tree[0]

    def rate(t: float, y: Array) -> Array:
        q_tree, v_tree = y[:4], y[4:]
        J = FIVE_BAR.J(q_tree)
        force = -FIVE_BAR.C_tree(q_tree, v_tree) @ v_tree - FIVE_BAR.h_tree(q_tree)
        force += generalized(1, (0.0, 0.0), lambda t, q: wrench(t, q, v_tree[0]), t, q_tree)
        matrix = np.block([[FIVE_BAR.D_tree(q_tree), -J.T], [J, np.zeros((2, 2))]])
        right = np.concatenate([force, -FIVE_BAR.J_dot(q_tree, v_tree) @ v_tree])
        return np.concatenate([v_tree, np.linalg.solve(matrix, right)[:4]])

    solution = solve_ivp(rate, (0.0, 1.5), [*run.q_tree[0], *start], "DOP853", run.t, rtol=1e-12, atol=1e-13)
    assert_close(run.q_tree, solution.y[:4].T, 1e-9)
    assert run.stats["python_calls"] > 0


OUTPUT = {"t_end": 5.0, "solver.output_dt": 0.5}
TABLE = "t,fx,mz\n0.0,0.0,0.3\n0.4,0.5,-0.2\n0.9,-0.3,0.1\n1.5,0.2,0.0\n"
TIMES = np.array([0.0, 0.4, 0.9, 1.5])
COLUMNS = np.array([[0.0, 0.3], [0.5, -0.2], [-0.3, 0.1], [0.2, 0.0]])


@cache
def with_table(interpolation: str) -> Array:
    """q' by eq. 1 of the appendix, one piece of the table after the other."""
    state, rows = initial_state(), [initial_state()[None, :4]]
    for k, (begin, end) in enumerate(pairwise(TIMES)):

        def wrench(t: float, q_tree: Array, k: int = k, begin: float = begin, end: float = end) -> tuple[Array, float]:
            part = (t - begin) / (end - begin) if interpolation == "linear" else 0.0
            fx, mz = (1 - part) * COLUMNS[k] + part * COLUMNS[k + 1]
            return np.array([fx, 0.0]), float(mz)

        times = np.arange(round(begin / 0.05), round(end / 0.05) + 1) * 0.05
        q_tree, v_tree = integrate(times, [(1, (0.0, 0.0), wrench)], state)
        state = np.concatenate([q_tree[-1], v_tree[-1]])
        rows.append(q_tree[1:])
    return np.concatenate(rows)


@pytest.mark.usefixtures("either_terms")
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_tables_over_time_agree_with_the_appendix(tmp_path: Path, formulation: str, interpolation: str) -> None:
    (tmp_path / "push.csv").write_text(TABLE)
    path = tmp_path / "push.scene.toml"
    text = (Path(ckc_pin.__file__).parent.parent / "urdf/five_bar/swing.scene.toml").read_text()
    path.write_text(text.replace('"mechanism.toml"', '"five_bar"'))
    force = [{"frame": "link_2", "file": "push.csv", "interpolation": interpolation}]
    run = simulate(path, scene(formulation=formulation, force=force))
    assert run.status == "done"
    assert_close(run.q_tree, with_table(interpolation), 1e-9)
    assert run.stats["rejected"] < 20
    assert run.force_values is not None
    assert_close(run.force_values[run.t == 0.4, 0], 0.5, 1e-12)


def test_a_force_on_a_free_body_moves_it_as_newton_says(tmp_path: Path) -> None:
    (tmp_path / "body.urdf").write_text(
        '<robot name="body"><link name="body"><inertial><mass value="2.0"/>'
        '<inertia ixx="0.1" iyy="0.2" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    (tmp_path / "mechanism.toml").write_text(
        'name = "body"\ngravity = [0.0, 0.0, 0.0]\n[[tree]]\nfile = "body.urdf"\nroot = "free"\n'
    )
    path = tmp_path / "push.scene.toml"
    path.write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 2.0\n[initial]\nat = "assembled"\n'
        '[[force]]\nframe = "body"\nforce = [3.0, 0.0, 0.0]\nmoment = [0.0, 0.0, 0.6]\n'
    )
    run = simulate(path, {"solver.rtol": 1e-11})
    x, angle = (run[name] for name in ("root.x", "root.rz"))
    assert_close(x, 0.75 * run.t**2, 1e-9)
    assert_close(angle[run.t < 1.5], run.t[run.t < 1.5] ** 2, 1e-9)
    turning = simulate(path, {"force": [{"frame": "body", "axes": "frame", "force": [3.0, 0.0, 0.0],
                                         "moment": [0.0, 0.0, 0.6]}], "solver.rtol": 1e-11})  # fmt: skip
    fresnel = solve_ivp(
        lambda t, y: [y[2], y[3], 1.5 * math.cos(t * t), 1.5 * math.sin(t * t)],
        (0.0, 2.0), [0.0] * 4, "DOP853", turning.t, rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    assert_close(np.column_stack([turning["root.x"], turning["root.y"]]), fresnel.y[:2].T, 1e-9)


def test_recorded_accelerations_and_joint_wrenches_contain_the_forces(tmp_path: Path) -> None:
    run = simulate(
        "five_bar/swing", scene(force=[WORLD, FOLLOWER], t_end=0.2, solver={"rtol": 1e-12, "output_dt": 1e-3})
    )
    smooth = (run.v_tree[2:] - run.v_tree[:-2]) / 2e-3
    assert_close(np.column_stack([run[f"a.{name}"] for name in run.coordinates])[1:-1], smooth, 2e-2)
    forces = inverse_dynamics(run)
    # The bodies that hang on theta_1 and theta_3: mass times acceleration of their centres, by differences of momentum.
    momentum = _momentum(run)
    rate = (momentum[2:] - momentum[:-2]) / 2e-3
    ground = sum(forces.joint_forces[name][:, :2] for name in ("theta_1", "theta_3"))
    applied = np.array([of_world(0.0, q)[0] + of_follower(0.0, q)[0] for q in run.q_tree])
    weight = np.array([0.0, -9.81 * sum(FIVE_BAR.m)])
    assert_close((ground + applied + weight)[1:-1], rate, 5e-3)
    saved = Run.load(run.save(tmp_path / "run.npz"))
    assert_close(saved["a.theta_1"], run["a.theta_1"], 1e-9)


def _momentum(run: Run) -> Array:
    """Linear momentum of the four links in the plane."""
    total = np.zeros((len(run.t), 2))
    for i, j in ((0, 1), (2, 3)):
        a_i, a_j = run.q_tree[:, i], run.q_tree[:, i] + run.q_tree[:, j]
        w_i, w_j = run.v_tree[:, i], run.v_tree[:, i] + run.v_tree[:, j]
        normal_i, normal_j = (np.column_stack([-np.sin(a), np.cos(a)]) for a in (a_i, a_j))
        elbow = FIVE_BAR.l[i] * w_i[:, None] * normal_i
        total += FIVE_BAR.m[i] * FIVE_BAR.c[i] * w_i[:, None] * normal_i
        total += FIVE_BAR.m[j] * (elbow + FIVE_BAR.c[j] * w_j[:, None] * normal_j)
    return total


def test_inverse_dynamics_of_a_desired_motion_balances_the_forces() -> None:
    """A load that hangs on the tip costs the torques that the transposed Jacobian of the tip gives."""
    load = {"force": [{"frame": "tip_left", "force": [0.0, -5.0, 0.0]}]}
    without, loaded = (inverse_dynamics("five_bar/tracking", overrides) for overrides in (OUTPUT, {**OUTPUT, **load}))
    for row, q_tree in enumerate(loaded.q_tree):
        jacobian = np.zeros((2, 4))
        for k in range(4):
            moved = q_tree.astype(complex)
            moved[k] += 1e-30j
            jacobian[:, k] = origin(1, (FIVE_BAR.l[1], 0.0), moved).imag / 1e-30
        expected = -(jacobian @ FIVE_BAR.rho(q_tree)).T @ [0.0, -5.0]
        assert_close(loaded.tau[row] - without.tau[row], expected, 1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_steps_agree_with_the_run(formulation: str) -> None:
    overrides = scene(formulation=formulation, force=[WORLD, FOLLOWER])
    run, simulator = simulate("five_bar/swing", overrides), Simulator("five_bar/swing", overrides)
    for k in range(1, len(run.t)):
        state = simulator.step(None, 0.05)
        assert_close(state.q_tree, run.q_tree[k], 1e-8)


def test_as_ivp_has_the_forces() -> None:
    problem = ckc_pin.as_ivp("five_bar/swing", scene(force=[WORLD, FOLLOWER]))
    solution = solve_ivp(problem.f, (0.0, 1.5), problem.y0, "DOP853", rtol=1e-11, atol=1e-13)
    run = simulate("five_bar/swing", scene(force=[WORLD, FOLLOWER]))
    assert_close(problem.terms(1.5, solution.y[:, -1]).q_tree, run.q_tree[-1], 1e-8)


def test_forces_of_a_scene_in_python_are_those_of_its_saved_files(tmp_path: Path) -> None:
    """Tables, columns, constant forces and functions; all but functions can be saved."""
    columns = {"t": [0.0, 0.4, 0.9], "fx": [0.0, 0.5, -0.3]}
    forces = [WORLD, Force(FOLLOWER["frame"], FOLLOWER["force"], FOLLOWER["moment"], "frame"),
              {"frame": "link_1", "file": columns, "interpolation": "linear"}]  # fmt: skip
    made = ckc_pin.Scene("five_bar", t_end=1.0, initial={"q": START}, forces=forces)
    run, saved = simulate(made), simulate(made.save(tmp_path))
    assert np.array_equal(run.q_tree, saved.q_tree)
    assert run.force_values is not None
    assert_close(run.force_values[run.t == 0.2, 12], 0.25, 1e-12)
    direct = simulate(load("five_bar"), t_end=1.0, initial={"q": START}, forces=forces)
    assert np.array_equal(direct.q_tree, run.q_tree)
    function = ckc_pin.Scene("five_bar", t_end=1.0, forces=[Force("link_2", lambda t, terms: [t, 0.0, 0.0])])
    with pytest.raises(InputError, match="the scene's force, a function of the state"):
        function.save(tmp_path / "function")
    with pytest.raises(InputError, match="the argument is called forces"):
        ckc_pin.Scene("five_bar", t_end=1.0, force=[WORLD])
    with pytest.raises(InputError, match=r"forces\[0\]: expected a Force, or a table"):
        simulate("five_bar/swing", forces=[3])  # type: ignore[list-item]


def test_a_scene_without_forces_costs_what_it_did() -> None:
    plain = simulate("five_bar/swing", scene())
    zero = simulate("five_bar/swing", scene(force=[{"frame": "link_2", "force": [0.0, 0.0, 0.0]}]))
    assert plain.stats["rhs"] == zero.stats["rhs"]
    assert plain.force_values is None


@pytest.mark.parametrize(
    ("force", "message"),
    [
        ({"frame": "nowhere", "force": [0, 0, 1]}, "force[0]: no link 'nowhere'"),
        ({"frame": "base", "force": [0, 0, 1]}, "'base' is fixed to the world and does not move"),
        ({"frame": "link_2"}, "give force, moment or both, or file"),
        ({"frame": "link_2", "force": [0, 1]}, "force"),
        ({"frame": "link_2", "force": [0, 0, 1], "file": "x.csv"}, "give either file, or force and moment"),
        ({"frame": "link_2", "force": [0, 0, 1], "interpolation": "hold"}, "interpolation belongs to file"),
        ({"frame": "link_2", "force": [0, 0, 1], "axis": "world"}, "did you mean 'axes'"),
    ],
)
def test_unusable_forces_are_refused_with_a_reason(force: dict[str, Any], message: str) -> None:
    with pytest.raises(CkcError, match=re.escape(message)):
        simulate("five_bar/swing", scene(force=[force]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give a force, a moment, or both"),
        ({"force": [1.0, 2.0]}, "expected 3 numbers"),
        ({"force": "up"}, "expected 3 numbers"),
        ({"force": lambda t: [0.0, 0.0, 0.0]}, "expected a function of (t, terms)"),
        ({"force": [0.0, 0.0, 1.0], "axes": "body"}, 'axes: expected "world" or "frame"'),
    ],
)
def test_wrong_arguments_of_force_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        Force("link_2", **arguments)


def test_a_function_that_returns_no_vector_is_refused_with_its_time() -> None:
    with pytest.raises(InputError, match="force 'link_2' at t = 0: expected 3 finite numbers"):
        simulate("five_bar/swing", scene(), forces=[Force("link_2", lambda t, terms: [math.nan, 0.0, 0.0])])


@pytest.mark.parametrize("function", ["sensitivities", "gain_locus", "floquet"])
def test_functions_that_do_not_know_forces_refuse_them(function: str) -> None:
    arguments: dict[str, tuple[Any, ...]] = {"sensitivities": (["link.link_2.mass"],), "floquet": (1.0,)}
    with pytest.raises(InputError, match=f"{function}: forces on links"):
        getattr(ckc_pin, function)("five_bar/set_point", *arguments.get(function, ()), overrides=scene(force=[WORLD]))


@pytest.mark.parametrize("force", [WORLD, Force("link_2", lambda t, terms: [t, 0.0, 0.0])])
def test_check_gives_no_verdict_on_stability_with_forces(force: Any) -> None:
    check = ckc_pin.check(ckc_pin.load_scene("five_bar/set_point").with_control(None, [], [force]))
    assert check.stability is not None
    assert check.stability.stable is None
    assert "no forces on links" in check.stability.reason


# --- linear models -------------------------------------------------------------------------------


def test_forces_are_inputs_of_a_linear_model_at_a_time() -> None:
    """A and the columns of B are differences of the acceleration of the appendix's eq. 1, at closed loops."""
    model = ckc_pin.linearize("five_bar/swing", 0.5, scene(force=[WORLD, FOLLOWER], formulation="reduced"))
    assert model.inputs[2:] == tuple(f"force.{name}.{x}" for name in ("wind", "link_4")
                                     for x in ("fx", "fy", "fz", "mx", "my", "mz"))  # fmt: skip
    q, q_dot = model.q_tree[[0, 2]], model.v_tree[[0, 2]]

    def acceleration(q: Array, q_dot: Array, extra: Array) -> Array:
        q_tree = FIVE_BAR.sigma(q)

        def world(t: float, q_tree: Array) -> tuple[Array, float]:
            force, moment = of_world(t, q_tree)
            return force + extra[:2], moment + extra[5]

        def follower(t: float, q_tree: Array) -> tuple[Array, float]:
            turn = q_tree[2] + q_tree[3] + 0.4
            return turned(turn, np.array([0.3, -0.6]) + extra[6:8]), 0.1 + extra[11]

        u_tree = generalized(1, (0.0, 0.0), world, 0.0, q_tree) + generalized(3, (0.1, 0.05), follower, 0.0, q_tree)
        return FIVE_BAR.acceleration(q_tree, q_dot, FIVE_BAR.rho(q_tree).T @ u_tree)

    step, none = 1e-5, np.zeros(12)
    for k in range(2):
        e = step * np.eye(2)[k]
        by_q = (acceleration(q + e, q_dot, none) - acceleration(q - e, q_dot, none)) / (2 * step)
        by_rate = (acceleration(q, q_dot + e, none) - acceleration(q, q_dot - e, none)) / (2 * step)
        assert_close(model.A[2:, k], by_q, 1e-6)
        assert_close(model.A[2:, 2 + k], by_rate, 1e-6)
    for k in range(12):
        e = step * np.eye(12)[k]
        by_force = (acceleration(q, q_dot, none + e) - acceleration(q, q_dot, none - e)) / (2 * step)
        assert_close(model.B[2:, 2 + k], by_force, 1e-7)


def test_forces_are_inputs_of_a_linear_model_at_rest_where_they_are_zero() -> None:
    model = ckc_pin.linearize("five_bar/swing", "equilibrium", scene(force=[WORLD]))
    plain = ckc_pin.linearize("five_bar/swing", "equilibrium", scene())
    assert np.array_equal(model.A, plain.A)
    assert np.array_equal(model.B[:, :2], plain.B)
    assert model.B.shape == (4, 8)
    assert "forces on links are inputs, zero at the state" in model.notes
    # a vertical force on the tip bends the pose as gravity on a point mass would
    assert np.abs(model.B[2:, 3]).max() > 0


def test_multipliers_of_a_linear_model_answer_to_forces() -> None:
    """The feedthrough of a force to the loop's multipliers, by differences of two runs' multipliers at the start."""
    model = ckc_pin.linearize("five_bar/swing", 0.0, scene(force=[WORLD]))
    step = 1e-4
    ends = []
    for sign in (1, -1):
        force = {**WORLD, "force": [0.3 + sign * step, 0.5, 0.0]}
        ends.append(simulate("five_bar/swing", scene(force=[force], t_end=0.01)).loop_forces()["elbow"][0])
    rows = [model.outputs.index(f"loop.elbow.{axis}") for axis in ("x", "y")]
    assert_close(model.D[rows, 2], (ends[0] - ends[1]) / (2 * step), 1e-7)
