"""Linear models of random closed mechanisms: A and B against the flow of eq. 1, C and D against multipliers."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ckc_pin.dynamics import Terms, dae_acceleration, multipliers
from ckc_pin.kinematics.sigma import minimum_norm_step, project_onto_closure
from ckc_pin.linear.linear_model import linear_model
from ckc_pin.native.plant import Plant
from tests.analytic.five_bar import Array
from tests.property.mechanisms import Closed, closed_mechanism
from tests.property.strategies import TYPES, seeds

H, T = 2e-5, 2e-3  # size of the deviations; s
TOLERANCE = 2e-4  # relative; a short spring is nonlinear for such deviations
every_mechanism = st.builds(
    closed_mechanism, st.sampled_from(TYPES), seeds, free=st.booleans(), redundant=st.booleans()
).filter(lambda closed: closed.regular)


@settings(max_examples=12)
@given(every_mechanism)
def test_linear_model_is_the_first_order_of_eq_1(closed: Closed) -> None:
    mechanism, state, random = closed.mechanism, closed.random_state(), np.random.default_rng(5)
    tree, rank = mechanism.tree, mechanism.rank
    tau = random.uniform(-1, 1, len(mechanism.actuated))
    model = linear_model(state, tau, at="somewhere")
    plant = Plant(mechanism).at(state, mechanism.motors.force(tau))
    d, plant_rows = len(plant.at), plant.at
    x, dtau = random.uniform(-1, 1, 2 * d), random.uniform(-1, 1, len(tau))
    step, dv = plant.T @ x[:d], plant.V @ x[:d] + plant.T @ x[d:]

    def state_at(h: float) -> Array:
        """Return a state on the constraint manifold whose deviation is h x to first order."""
        at = project_onto_closure(mechanism.kinematics(tree.integrate(state.q_tree, h * step)), rank)
        v = state.v_tree + h * dv
        return np.concatenate([at.q_tree, v + minimum_norm_step(at.J, rank, at.J @ v, tree.step_scale)])

    def terms_at(y: Array) -> Terms:
        return Terms(mechanism, mechanism.kinematics(y[: tree.nq]), y[tree.nq :])

    def flow(h: float, t: float) -> Array:
        force = mechanism.motors.force(tau + h * dtau)

        def rate(_: float, y: Array) -> Array:
            return np.concatenate(
                [tree.configuration_rate(y[: tree.nq], y[tree.nq :]), dae_acceleration(terms_at(y), force)]
            )

        return solve_ivp(rate, (0.0, t), state_at(h), rtol=1e-12, atol=1e-14, method="DOP853").y[:, -1]

    def deviation(t: float) -> Array:
        centre, plus, minus = (flow(h, t) for h in (0.0, H, -H))
        moved = [tree.difference(centre[: tree.nq], y[: tree.nq]) for y in (plus, minus)]
        return np.concatenate([(moved[0] - moved[1])[plant_rows], (plus - minus)[tree.nq :][plant_rows]]) / (2 * H)

    rates = (8 * (deviation(T) - deviation(-T)) - (deviation(2 * T) - deviation(-2 * T))) / (12 * T)
    assert np.abs(model.A @ x + model.B @ dtau - rates).max() <= TOLERANCE * np.abs(rates).max()

    def forces(h: float) -> Array:
        plus, force = terms_at(state_at(h)), mechanism.motors.force(tau + h * dtau)
        return multipliers(plus, force, dae_acceleration(plus, force))

    slopes, rows = (forces(2 * H) - forces(-2 * H)) / (4 * H), mechanism.closure.rows
    assert np.abs((model.C @ x + model.D @ dtau)[-rows:] - slopes).max() <= TOLERANCE * np.abs(slopes).max()
