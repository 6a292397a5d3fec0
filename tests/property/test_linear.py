"""Linear models of any closed mechanism: A and B are of the flow of eq. 1 by SciPy, C and D of the multipliers."""

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

H, T = 2e-5, 2e-3  # of the deviations; s
ROOM = 2e-4  # of what is compared: a spring that is short bends within a deviation
every_mechanism = st.builds(
    closed_mechanism, st.sampled_from(TYPES), seeds, free=st.booleans(), redundant=st.booleans()
).filter(lambda closed: closed.regular)


@settings(max_examples=12)
@given(every_mechanism)
def test_linear_model_is_the_first_order_of_eq_1(closed: Closed) -> None:
    mechanism, state, random = closed.mechanism, closed.near(), np.random.default_rng(5)
    tree, rank = mechanism.tree, mechanism.rank
    tau = random.uniform(-1, 1, len(mechanism.actuated))
    model = linear_model(state, tau, at="somewhere")
    plant = Plant(mechanism).at(state, mechanism.motors.force(tau))
    d, own = len(plant.at), plant.at
    x, more = random.uniform(-1, 1, 2 * d), random.uniform(-1, 1, len(tau))
    step, dv = plant.T @ x[:d], plant.V @ x[:d] + plant.T @ x[d:]

    def beside(h: float) -> Array:
        """A state on the closure whose deviation is h x to first order."""
        at = project_onto_closure(mechanism.kinematics(tree.integrate(state.q_tree, h * step)), rank)
        v = state.v_tree + h * dv
        return np.concatenate([at.q_tree, v + minimum_norm_step(at.J, rank, at.J @ v, tree.step_scale)])

    def here(y: Array) -> Terms:
        return Terms(mechanism, mechanism.kinematics(y[: tree.nq]), y[tree.nq :])

    def after(h: float, t: float) -> Array:
        force = mechanism.motors.force(tau + h * more)

        def rate(_: float, y: Array) -> Array:
            return np.concatenate(
                [tree.configuration_rate(y[: tree.nq], y[tree.nq :]), dae_acceleration(here(y), force)]
            )

        return solve_ivp(rate, (0.0, t), beside(h), rtol=1e-12, atol=1e-14, method="DOP853").y[:, -1]

    def deviation(t: float) -> Array:
        middle, there, other = (after(h, t) for h in (0.0, H, -H))
        moved = [tree.difference(middle[: tree.nq], y[: tree.nq]) for y in (there, other)]
        return np.concatenate([(moved[0] - moved[1])[own], (there - other)[tree.nq :][own]]) / (2 * H)

    rates = (8 * (deviation(T) - deviation(-T)) - (deviation(2 * T) - deviation(-2 * T))) / (12 * T)
    assert np.abs(model.A @ x + model.B @ more - rates).max() <= ROOM * np.abs(rates).max()

    def forces(h: float) -> Array:
        there, force = here(beside(h)), mechanism.motors.force(tau + h * more)
        return multipliers(there, force, dae_acceleration(there, force))

    slopes, rows = (forces(2 * H) - forces(-2 * H)) / (4 * H), mechanism.closure.rows
    assert np.abs((model.C @ x + model.D @ more)[-rows:] - slopes).max() <= ROOM * np.abs(slopes).max()
