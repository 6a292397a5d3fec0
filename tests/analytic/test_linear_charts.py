"""Linear models where q is not a chart: other coordinates, tangent bases, singular states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, Mechanism, NumericalError, linearize, load
from ckc_pin.dynamics import Terms, dae_acceleration
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.linear_model import linear_model
from ckc_pin.mechanism.library import mechanism_file
from ckc_pin.native.plant import Plant
from tests.analytic.five_bar import FIVE_BAR, Array, complex_step
from tests.analytic.small_models import plate_on_springs
from tests.analytic.test_linearization import agree


def test_a_free_root_constrained_in_part_has_a_tangent_basis(tmp_path: Path) -> None:
    """No set of joint coordinates is a chart. Deviations are expressed in a frame that rotates with the motion."""
    mechanism = plate_on_springs(tmp_path)
    assert mechanism.splits_root
    tree, n, random = mechanism.tree, mechanism.n, np.random.default_rng(0)
    at = mechanism.assembled
    J = at.J
    v = random.uniform(-1, 1, n)
    v -= np.linalg.pinv(J) @ (J @ v)
    state = Terms(mechanism, at, v)
    model = linear_model(state, np.zeros(0), at="somewhere")
    assert len(model.states) == 8
    chart = [mechanism.coordinates.index(name) for name in model.states[:4]]
    # SciPy integrates eq. 1 from the state and from perturbed states.
    plant = Plant(mechanism).at(state, np.zeros(n))
    x = random.uniform(-1, 1, 8)
    step, dv = plant.T @ x[:4], plant.V @ x[:4] + plant.T @ x[4:]

    def flow(h: float, t: float) -> Array:
        def rate(_: float, y: Array) -> Array:
            here = Terms(mechanism, mechanism.kinematics(y[: tree.nq]), y[tree.nq :])
            a = dae_acceleration(here, np.zeros(n))
            return np.concatenate([tree.configuration_rate(y[: tree.nq], y[tree.nq :]), a])

        y = np.concatenate([tree.integrate(at.q_tree, h * step), v + h * dv])
        return solve_ivp(rate, (0, t), y, rtol=1e-11, atol=1e-13, method="DOP853").y[:, -1]

    def deviation(t: float, h: float) -> Array:
        here, there, other = flow(0.0, t), flow(h, t), flow(-h, t)
        q = (
            tree.difference(here[: tree.nq], there[: tree.nq]) - tree.difference(here[: tree.nq], other[: tree.nq])
        ) / 2
        return np.concatenate([q[chart], (there - other)[tree.nq :][chart] / 2]) / h

    h, t = 1e-4, 2e-3
    rates = (8 * (deviation(t, h) - deviation(-t, h)) - (deviation(2 * t, h) - deviation(-2 * t, h))) / (12 * t)
    agree(model.A @ x, rates, 1e-5)
    assert np.abs(model.A[:4, :4]).max() > 0.1


def test_other_coordinates_replace_a_q_that_is_not_a_chart() -> None:
    """At the five-bar's type 1 singularity the elbows coincide: det phi_z = 0, but J has full rank."""
    mechanism, q_1 = load("five_bar"), float(np.arccos(0.1524 / 0.2794))
    numbers = np.array([q_1, 1.0 - q_1, np.pi - q_1, 1.0 - (np.pi - q_1)])  # any orientation of the distal links
    at = mechanism.kinematics(numbers)
    assert np.abs(at.phi).max() < 1e-12
    assert at.margin() < 1e-9
    model = linear_model(Terms(mechanism, at, np.zeros(4)), np.zeros(2), at="at a singular q")
    assert model.states[:2] != mechanism.independent
    assert np.all(np.isfinite(model.A))
    assert "theta_1, theta_3 do not determine the configuration there" in model.notes[0]
    # The derivatives of eq. 1 along the other coordinates, by complex steps.
    chart = [mechanism.coordinates.index(name) for name in model.states[:2]]
    others = [k for k in range(4) if k not in chart]
    J = FIVE_BAR.J(numbers)
    T = np.zeros((4, 2))
    T[chart] = np.eye(2)
    T[others] = -np.linalg.solve(J[:, others], J[:, chart])

    def acceleration(x: Array) -> Array:
        return FIVE_BAR.acceleration_and_multipliers(numbers + T @ x[:2], np.zeros(4), x[2:])[0][chart]

    slopes = complex_step(acceleration, np.zeros(4))
    agree(model.A[2:, :2], slopes[:, :2], 1e-9)
    agree(model.B[2:], slopes[:, 2:], 1e-9)
    # The tip can rotate about the coincident elbows, and no motor drives this rotation.
    with pytest.raises(InputError, match=r"cannot hold .* along theta_[24],"):
        linearize(mechanism, dict(zip(mechanism.coordinates, numbers.tolist(), strict=True)))


def test_a_singular_configuration_is_rejected() -> None:
    """J loses rank if all coordinates are given; phi_z is singular if only the independent ones are given."""
    mechanism = load("n_four_bar")
    with pytest.raises(NumericalError, match="theta_0 = 0 is singular"):
        linearize(mechanism, {"theta_0": 0.0})
    with pytest.raises(NumericalError, match=r"J has lost rank.*another configuration"):
        linearize(mechanism, dict.fromkeys(mechanism.coordinates, 0.0))
    state = Terms(mechanism, mechanism.kinematics(np.zeros(mechanism.n)), np.zeros(mechanism.n))
    with pytest.raises(NumericalError, match="J has lost rank"):
        linear_model(state, np.zeros(1), at="there")


def _load_with_slider_as_q(folder: Path) -> Mechanism:
    source = mechanism_file("slider_crank").parent
    for file in source.iterdir():
        text = file.read_text(encoding="utf-8").replace('independent = ["crank"]', 'independent = ["slider"]')
        (folder / file.name).write_text(text, encoding="utf-8")
    return load(folder / "mechanism.toml")


def test_a_fold_is_rejected(tmp_path: Path) -> None:
    """At a dead centre the slider does not determine crank and rod."""
    mechanism = _load_with_slider_as_q(tmp_path)
    for distance in (0.0, 1e-13):
        with pytest.raises(NumericalError, match=r"slider = 0\.4 is singular.*crank, rod, slider"):
            linearize(mechanism, {"slider": 0.4 - distance})
    assert linearize(mechanism, {"slider": 0.39}).states == ("slider", "v.slider")


def test_another_coordinate_is_the_state_near_a_fold(tmp_path: Path) -> None:
    """There the slider determines crank and rod to half of the digits, and its A would be of size 1 / angle**2."""
    by_crank, by_slider = load("slider_crank"), _load_with_slider_as_q(tmp_path)
    for angle, chart in ((1e-3, "slider"), (1e-6, "rod")):
        at = by_crank.kinematics(sigma(by_crank, np.array([angle])).at.q_tree)
        other = Terms(by_slider, by_slider.kinematics(at.q_tree), np.zeros(by_slider.n))
        model = linear_model(other, np.zeros(1), at="near the dead centre")
        expected = linear_model(Terms(by_crank, at, np.zeros(by_crank.n)), np.zeros(1), at="there")
        assert model.states[0] == chart
    agree(model.A, expected.A, 1e-4)  # A of the rod's angle, which is proportional to the crank's near the dead centre
