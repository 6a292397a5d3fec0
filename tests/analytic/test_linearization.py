"""Linear models against the appendix, finite differences of eq. 6, and small motions of nonlinear runs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas
import pytest
from scipy.linalg import expm

from ckc_pin import InputError, Mechanism, linearize, load, simulate
from ckc_pin.dynamics import Terms, dae_acceleration, multipliers, reduced_acceleration
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.linear_model import linear_model
from ckc_pin.mechanism.library import shipped
from tests.analytic.five_bar import FIVE_BAR, Array, complex_step
from tests.analytic.small_models import coupled_four_bar


def linearize_appendix(q_tree: Array, q_dot: Array, tau: Array) -> tuple[Array, Array, Array, Array]:
    """A, B and the rows of C and D for the multipliers, from the appendix by complex steps along sigma."""

    def solution(x: Array) -> Array:
        """q_ddot and lambda at (dq, q_dot, tau). A complex step needs sigma to first order only."""
        moved = q_tree + FIVE_BAR.rho(q_tree) @ x[:2]
        v_tree = FIVE_BAR.rho(moved) @ x[2:4]
        a, forces = FIVE_BAR.acceleration_and_multipliers(moved, v_tree, x[4:])
        return np.concatenate([a[[0, 2]], forces])

    slopes = complex_step(solution, np.concatenate([np.zeros(2), q_dot, tau]))
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [slopes[:2, :4]]])
    return A, np.vstack([np.zeros((2, 2)), slopes[:2, 4:]]), slopes[2:, :4], slopes[2:, 4:]


def agree(ours: Array, theirs: Array, tolerance: float = 1e-11) -> None:
    assert np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max()


# --- the five-bar --------------------------------------------------------------------------------


def test_the_model_at_the_equilibrium_matches_the_appendix() -> None:
    model = linearize("five_bar")
    A, B, C, D = linearize_appendix(FIVE_BAR.equilibrium(), np.zeros(2), np.zeros(2))
    agree(model.A, A)
    agree(model.B, B)
    agree(model.C[-2:], C, 1e-9)
    agree(model.D[-2:], D)
    values = np.linalg.eigvals(A)
    agree(np.sort(np.abs(model.eigenvalues)), np.sort(np.abs(values)))
    assert [round(mode.frequency, 3) for mode in model.modes] == [1.133, 1.521]
    assert all(abs(mode.damping_ratio) < 1e-12 for mode in model.modes)


@pytest.mark.parametrize("seed", range(3))
def test_the_model_at_any_state_matches_the_appendix(seed: int) -> None:
    mechanism, random = load("five_bar"), np.random.default_rng(seed)
    q_dot, tau = random.uniform(-3, 3, 2), random.uniform(-1, 1, 2)
    at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.3, 0.3, 2)).at
    model = linear_model(Terms(mechanism, at, at.rho @ q_dot), tau, at="somewhere")
    A, B, C, D = linearize_appendix(at.q_tree, q_dot, tau)
    for ours, theirs in zip((model.A, model.B, model.C[-2:], model.D[-2:]), (A, B, C, D), strict=True):
        agree(ours, theirs, 1e-10)
    agree(model.C[:4, :2], FIVE_BAR.rho(at.q_tree))
    names = model.outputs.index("tip.x"), model.outputs.index("loop.elbow.x")
    assert names == (4, 7)


def test_states_inputs_and_outputs_have_names() -> None:
    model = linearize("five_bar")
    assert model.states == ("theta_1", "theta_3", "v.theta_1", "v.theta_3")
    assert model.inputs == ("tau.theta_1", "tau.theta_3")
    assert model.outputs[:4] == ("theta_1", "theta_2", "theta_3", "theta_4")
    assert model.outputs[4:] == ("tip.x", "tip.y", "tip.z", "loop.elbow.x", "loop.elbow.y")
    assert len(repr(model).splitlines()) == 5
    plant = model.to_statespace()
    assert plant.state_labels == ["theta_1", "theta_3", "v_theta_1", "v_theta_3"]
    assert plant.input_labels == ["tau_theta_1", "tau_theta_3"]
    assert plant.output_labels[-1] == "loop_elbow_y"
    agree(plant.A, model.A)
    agree(np.sort(plant.poles().imag), np.sort(model.eigenvalues.imag))


def test_table_of_matrices_has_a_name_for_each_row_and_column(tmp_path: Path) -> None:
    model = linearize("five_bar", {"theta_1": 1.9, "theta_3": 1.2})
    frame = model.to_pandas()
    assert list(frame.columns) == ["theta_1", "theta_3", "v.theta_1", "v.theta_3", "tau.theta_1", "tau.theta_3"]
    assert list(frame.index[:4]) == ["d/dt theta_1", "d/dt theta_3", "d/dt v.theta_1", "d/dt v.theta_3"]
    assert tuple(frame.index[4:]) == model.outputs
    A, B, C, D = linearize_appendix(model.q_tree, np.zeros(2), model.tau)
    accelerations, forces = ["d/dt v.theta_1", "d/dt v.theta_3"], ["loop.elbow.x", "loop.elbow.y"]
    states, inputs = list(model.states), list(model.inputs)
    agree(frame.loc[accelerations, states].to_numpy(), A[2:], 1e-9)
    agree(frame.loc[accelerations, inputs].to_numpy(), B[2:], 1e-9)
    agree(frame.loc[forces, states].to_numpy(), C, 1e-9)
    agree(frame.loc[forces, inputs].to_numpy(), D, 1e-9)
    file = pandas.read_csv(model.to_csv(tmp_path / "model.csv"), index_col="equation")
    assert file.equals(frame)
    assert repr(model.plot()) == "Figures(poles, modes)"


def test_names_for_python_control_are_distinct(tmp_path: Path) -> None:
    """One joint is called x_dot and another x, and two names differ in a dot only."""
    folder = tmp_path / "it"
    coupled_four_bar(folder)
    urdf = (folder / "it.urdf").read_text()
    names = {"crank": "x", "coupler": "x_dot", "rocker": "x.dot"}
    text = (folder / "mechanism.toml").read_text().replace('name = "coupled"', 'name = "it.is"')
    for old, new in names.items():
        urdf = urdf.replace(f'name="{old}"', f'name="{new}"')
        text = text.replace(f'"{old}"', f'"{new}"').replace(f"\n{old} =", f'\n"{new}" =')
    (folder / "it.urdf").write_text(urdf)
    (folder / "mechanism.toml").write_text(text)
    plant = linearize(load(str(folder / "mechanism.toml"))).to_statespace()
    assert plant.name == "it_is"
    assert plant.output_labels[:3] == ["x", "x_dot", "x_dot_2"]
    coupled_four_bar(tmp_path, actuated="actuated = []")
    with pytest.raises(InputError, match=r"coupled: to_statespace: python-control needs .* has no motors"):
        linearize(load(str(tmp_path / "mechanism.toml"))).to_statespace()


# --- other mechanisms ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", shipped())
def test_the_model_matches_finite_differences_of_the_reduced_model(name: str) -> None:
    """The model differentiates eq. 1; the reference is eq. 6 along sigma, with minimum-norm multipliers."""
    mechanism, random = load(name), np.random.default_rng(1)
    d, forces = mechanism.d, random.uniform(-1, 1, len(mechanism.actuated))
    start = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.03, 0.03, d)).at
    x = np.concatenate([mechanism.independent_part(start.q_tree), 0.3 * random.uniform(-1, 1, d), forces])

    def rate(x: Array) -> Array:
        at = sigma(mechanism, x[:d], start).at
        state, u_tree = Terms(mechanism, at, at.rho @ x[d : 2 * d]), mechanism.motors.force(x[2 * d :])
        loops = multipliers(state, u_tree, dae_acceleration(state, u_tree))
        return np.concatenate([reduced_acceleration(state, u_tree), loops])

    model = linear_model(Terms(mechanism, start, start.rho @ x[d : 2 * d]), forces, at="somewhere")
    step = random.uniform(-1, 1, len(x))
    slopes = [(rate(x + h * step) - rate(x - h * step)) / (2 * h) for h in (4e-4, 2e-4, 1e-4)]
    first, second = ((4 * fine - coarse) / 3 for coarse, fine in pairwise(slopes))
    assert model.states[:d] == mechanism.independent
    expected, rows = (16 * second - first) / 15, mechanism.closure.rows
    agree(np.hstack([model.A, model.B])[d:] @ step, expected[:d], 1e-6)
    if rows:
        agree(np.hstack([model.C, model.D])[-rows:] @ step, expected[d:], 1e-6)


@pytest.mark.parametrize("case", ["five_bar", "stewart", "springs"])
def test_small_motions_converge_to_the_model_at_order_two(case: str, tmp_path: Path) -> None:
    scene, q = {
        "five_bar": ("five_bar/swing", None),
        "stewart": ("stewart/default", None),
        "springs": (str(_write_scene(coupled_four_bar(tmp_path), tmp_path)), None),
    }[case]
    model = linearize(scene)
    d = len(model.states) // 2
    rest = [model.q_tree[model.coordinates.index(name)] for name in model.states[:d]]
    start = np.random.default_rng(3).uniform(-1, 1, d) * (0.05 if case == "stewart" else 1.0)
    misses = []
    for size in (4e-3, 2e-3, 1e-3):
        q = {name: float(x + size * dx) for name, x, dx in zip(model.states[:d], rest, start, strict=True)}
        overrides = {"t_end": 0.4, "initial": {"q": q}, "formulation": "reduced", "solver.rtol": 1e-12}
        run = simulate(scene, overrides)
        expected = expm(0.4 * model.A) @ np.concatenate([size * start, np.zeros(d)])
        moved = run.q_tree[-1][[model.coordinates.index(name) for name in model.states[:d]]] - rest
        misses.append(float(np.abs(moved - expected[:d]).max()))
    orders = [np.log2(one / two) for one, two in pairwise(misses)]
    assert min(orders) > 1.9
    assert misses[-1] < 1e-5


def _write_scene(mechanism: Mechanism, folder: Path) -> Path:
    path = folder / "small.scene.toml"
    path.write_text('mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 1.0\ninitial.at = "equilibrium"\n')
    assert mechanism.d == 1
    return path


def test_redundant_rows_stay_redundant_if_the_loops_are_slightly_open() -> None:
    """Bricard's six rows have rank five. A small step off the manifold makes them independent numerically."""
    mechanism, random = load("bricard"), np.random.default_rng(4)
    at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + 0.1).at
    perturbed = mechanism.kinematics(mechanism.tree.integrate(at.q_tree, 3e-9 * random.uniform(-1, 1, mechanism.n)))
    v = at.rho @ random.uniform(-1, 1, mechanism.d)
    closed, opened = (linear_model(Terms(mechanism, x, v), np.zeros(1), at="somewhere") for x in (at, perturbed))
    assert mechanism.redundant
    agree(opened.C, closed.C, 1e-7)
    agree(opened.D, closed.D, 1e-7)


# --- friction ------------------------------------------------------------------------------------


FRICTION = '\n[[joint]]\nname = "crank"\nfriction = 0.3\n'


def _write_scene_with_friction(folder: Path) -> str:
    coupled_four_bar(folder)
    path = folder / "mechanism.toml"
    path.write_text(path.read_text() + FRICTION)
    return str(_write_scene(load(str(path)), folder))


def test_dry_friction_is_smoothed_or_locks_its_joint(tmp_path: Path) -> None:
    scene, smoothing = _write_scene_with_friction(tmp_path), 0.05
    with pytest.raises(InputError, match=r"no freedom remains.*crank.*friction_smoothing"):
        linearize(scene)
    free = linearize(str(_write_scene(coupled_four_bar(tmp_path / "smooth"), tmp_path / "smooth")))
    smooth = linearize(scene, overrides={"friction_smoothing": smoothing})
    extra = -free.B[1, 0] * 0.3 / smoothing  # -F / s acts on the crank, as the motor does
    assert smooth.inputs == ("tau.crank",)
    agree(smooth.A - free.A, np.array([[0, 0], [0, extra]]), 1e-9)
    assert smooth.modes[0].frequency == 0.0, "overdamped"


def test_a_locked_joint_is_not_a_state() -> None:
    """With theta_1 locked, the second row of eq. 6 from the appendix remains."""
    mechanism, q_dot = load("five_bar"), 0.7
    at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + np.array([0.2, -0.1])).at
    state = Terms(mechanism, at, at.rho @ [0.0, q_dot])
    model = linear_model(state, np.array([0.3, 0.2]), at="somewhere", locked=np.array([0]))
    assert model.locked == ("theta_1",)
    assert model.states == ("theta_3", "v.theta_3")

    def acceleration(x: Array) -> Array:
        """Acceleration of theta_3 after steps in theta_3, its rate and its torque."""
        moved = at.q_tree + FIVE_BAR.rho(at.q_tree)[:, 1] * x[0]
        rate = np.array([0.0, q_dot + x[1]])
        C = FIVE_BAR.C(moved, FIVE_BAR.rho(moved) @ rate)
        force = 0.2 + x[2] - (C @ rate)[1] - FIVE_BAR.h(moved)[1]
        return np.array([force / FIVE_BAR.D(moved)[1, 1]])

    slopes = complex_step(acceleration, np.zeros(3))[0]
    agree(model.A, np.array([[0.0, 1.0], slopes[:2]]))
    agree(model.B, np.array([[0.0, 0.0], [0.0, slopes[2]]]))
