"""Identification of a mass.

The five-bar's equations, as CasADi functions, are linear in the masses. The measurement is a run with noise added to
its torques. Least squares over all instants gives the mass of the left distal link. The equations are projected onto
the motions that the loop allows, so the unknown constraint forces drop out.
"""

import casadi as cs
import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

NAME = "link.link_2.mass"
NOISE = 0.01  # N m, standard deviation of the measured torques


@figure_style()
def main():
    run = ckc_pin.simulate("five_bar/tracking", {"formulation": "reduced", "solver.rtol": 1e-10})
    forces = ckc_pin.inverse_dynamics(run)
    model = ckc_pin.symbolic("five_bar")
    k = model.parameters.index(NAME)
    p, q, v, a = cs.SX.sym("p", len(model.parameters)), cs.SX.sym("q", 4), cs.SX.sym("v", 4), cs.SX.sym("a", 4)
    force = model.D_tree(q, p) @ a + model.bias_tree(q, v, p)
    force_and_slope = cs.Function("force_and_slope", [q, v, a, p], [force, cs.jacobian(force, p)[:, k]])

    rng = np.random.default_rng(7)
    without_link = model.values.copy()
    without_link[k] = 0.0
    slopes, residuals = [], []
    for j in range(len(run.t)):
        terms = ckc_pin.terms(run.mechanism, dict(zip(run.coordinates, run.q_tree[j].tolist(), strict=True)))
        state = run.q_tree[j], run.v_tree[j], forces.a_tree[j]
        rest, slope = (np.array(x).ravel() for x in force_and_slope(*state, without_link))
        measured = run.u[j] + NOISE * rng.standard_normal(2)
        slopes.append(terms.rho.T @ slope)  # eq. 6: constraint forces do no work along rho
        residuals.append(measured - terms.rho.T @ rest)
    slopes, residuals = np.concatenate(slopes), np.concatenate(residuals)
    mass = slopes @ residuals / (slopes @ slopes)
    sigma = NOISE / np.sqrt(slopes @ slopes)
    print(f"{NAME} = {mass:.5f} ± {sigma:.5f} kg; it is {model.values[k]:.5f}")
    assert abs(mass - model.values[k]) < 4 * sigma

    figure, ax = plt.subplots()
    ax.plot(slopes, residuals, ".", ms=3, alpha=0.5, label="measured, with noise")
    ends = np.array([slopes.min(), slopes.max()])
    ax.plot(ends, mass * ends, label=f"slope: {mass:.4f} ± {sigma:.4f} kg")
    ax.set(xlabel="torque per mass of the link (N m/kg)", ylabel="torque not explained by the rest (N m)")
    ax.set(xlim=(-0.5, 3.1), ylim=(-0.15, 0.85))  # a few points of the start lie far along the line
    ax.set(title=f"Mass of the left distal link, {model.values[k]:.4f} kg")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("identify_mass.png")
