"""Test vectors of exported C: random states, with terms by Pinocchio and results of the reference formulations."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.comparison import reference_acceleration, reference_terms, sample_configurations
from ckc_pin.codegen.elimination import elimination_order
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.formulations import reduced_acceleration, tree_force
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.formats.c.names import initializer
from ckc_pin.kinematics.sigma import SINGULAR_ON_PATH_MARGIN
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["QUANTITIES", "write_vectors"]

# Quantities that the runner compares, by the name of their member in a vector.
QUANTITIES = {
    "phi": "MECH_ROWS", "J": "MECH_ROWS * MECH_N", "D_tree": "MECH_N * MECH_N", "bias_tree": "MECH_N",
    "J_dot_v": "MECH_ROWS", "damping": "MECH_N", "h_tree": "MECH_N", "potential": "1", "acceleration": "MECH_N",
    "multipliers": "MECH_ROWS", "sigma": "MECH_NQ", "rho": "MECH_N * MECH_D", "D_reduced": "MECH_D * MECH_D",
    "C_reduced": "MECH_D * MECH_D", "h_reduced": "MECH_D", "inverse": "MECH_D", "forward": "MECH_D",
    "tree_acceleration": "MECH_N", "positions": "3 * MECH_POINTS", "velocities": "3 * MECH_POINTS",
    "set_point": "MECH_D", "set_point_tau": "MECH_MOTORS", "tracking": "MECH_D",
}  # fmt: skip
INPUTS = {
    "q_tree": "MECH_NQ", "v_tree": "MECH_N", "u_tree": "MECH_N", "guess": "MECH_NQ", "q": "MECH_D", "q_dot": "MECH_D",
    "q_ddot": "MECH_D", "tau": "MECH_MOTORS", "q_d": "MECH_D", "q_d_dot": "MECH_D", "q_d_ddot": "MECH_D",
    "K_P": "MECH_D * MECH_D", "K_V": "MECH_D * MECH_D", "Lambda": "MECH_D * MECH_D", "K_D": "MECH_D * MECH_D",
}  # fmt: skip
GUESS_DISTANCE = 0.02  # rad, or times the mechanism's size: of the guess from sigma(q)

Vector = dict[str, Array]


def write_vectors(mechanism: Mechanism) -> str:
    """Return the header of test vectors, with the templates' prefixes.

    Raises
    ------
    InputError
        Elimination loses digits at all random states.
    """
    vectors = list(make_vectors(mechanism))
    if not vectors:
        raise InputError(
            f"{mechanism.name}: export to c: its acceleration would have to be eliminated with pivoting everywhere, "
            "which compiled terms do not do; check masses and inertias"
        )
    members = [f"  double {name}[MECH_SIZE({size})];" for name, size in (INPUTS | QUANTITIES).items()]
    items = [
        "  {" + ",\n   ".join(f".{name} = {initializer(np.ravel(x, order='F'))}" for name, x in vector.items()) + "}"
        for vector in vectors
    ]
    return "\n".join(
        [
            "/* Test vectors of the C code, computed by ckc_pin from Pinocchio's terms; read by mech_test.c. */",
            "#ifndef MECH_VECTORS_H",
            "#define MECH_VECTORS_H",
            '#include "mech.h"',
            "",
            f"enum {{ {', '.join(name.upper() for name in QUANTITIES)}, QUANTITIES }};",
            f"enum {{ VECTORS = {len(vectors)} }};",
            "",
            "/* `scale`: of each quantity, the size of summands that may cancel. */",
            "typedef struct {",
            "  double scale[QUANTITIES];",
            *members,
            "} vector;",
            "",
            "static const vector vectors[VECTORS] = {",
            ",\n".join(items),
            "};",
            "",
            "#endif",
            "",
        ]
    )


def make_vectors(mechanism: Mechanism) -> Iterator[Vector]:
    """Yield test vectors: terms of the tree on the constraint manifold and off it, reduced terms on it."""
    random, order = np.random.default_rng(0), elimination_order(mechanism, mechanism.independent_rows)
    off = mechanism.assembled
    for at, is_closed in sample_configurations(mechanism, random):
        if not is_closed:
            off = at
            continue
        if at.margin() <= SINGULAR_ON_PATH_MARGIN:
            continue
        tree_at = at if mechanism.redundant else off  # off the manifold, redundant rows contradict each other
        q_dot = random.uniform(-2, 2, mechanism.d) * mechanism.tree.step_scale[mechanism.partition.q]
        v_tree = random.uniform(-2, 2, mechanism.n) * mechanism.tree.step_scale
        tree = Terms(mechanism, tree_at, tree_at.rho @ q_dot if mechanism.redundant else v_tree)
        reduced, u_tree = Terms(mechanism, at, at.rho @ q_dot), random.uniform(-1, 1, mechanism.n)
        acceleration = reference_acceleration(tree, order, u_tree)
        if acceleration is not None and reference_acceleration(reduced, order, u_tree) is not None:
            yield _make_vector(tree, u_tree, acceleration, reduced, random)


def _make_vector(
    tree: Terms, u_tree: Array, acceleration: Array, reduced: Terms, random: np.random.Generator
) -> Vector:
    mechanism, at = tree.mechanism, reduced.at
    d, scale = mechanism.d, mechanism.tree.step_scale
    q, q_dot = reduced.q, reduced.q_dot
    q_d, q_d_dot, q_d_ddot, q_ddot = (
        q + 0.1 * (mechanism.independent_part(mechanism.q_tree) - q),
        *random.uniform(-1, 1, (3, d)) * scale[mechanism.partition.q],
    )
    tau = random.uniform(-1, 1, len(mechanism.motors.names))
    gains = [_random_gain(random, d) for _ in range(3)]
    set_point = SetPoint(mechanism, gains[0], gains[1], q_d, at)
    tracking = Tracking(3.0 * np.eye(d), gains[2], lambda t: (q_d, q_d_dot, q_d_ddot))
    results = {name: x for name, x in reference_terms(tree).items() if name != "J_dot"}
    results["acceleration"] = acceleration, 0.0
    results["multipliers"] = _multipliers(tree, acceleration, u_tree), float(np.abs(u_tree).max())
    jacobians = list(mechanism.point_jacobians(tree.q_tree).values())
    velocities = np.ravel([jacobian @ tree.v_tree for jacobian in jacobians])
    results["positions"] = np.ravel(list(mechanism.point_positions(tree.q_tree).values())), mechanism.size
    results["velocities"] = velocities, float(np.abs(velocities).max(initial=0.0))
    results |= _reduced_results(reduced, q_ddot, tau)
    u_set_point, u_tracking = set_point.u(0.0, reduced), tracking.u(0.0, reduced)
    results["set_point"] = u_set_point, float(np.abs(gains[0]).max())
    results["set_point_tau"] = _motor_torques(mechanism, at, u_set_point), float(np.abs(u_set_point).max())
    results["tracking"] = u_tracking, results["inverse"][1]
    inputs = {
        "q_tree": tree.q_tree, "v_tree": tree.v_tree, "u_tree": u_tree, "guess": _disturb(at, random), "q": q,
        "q_dot": q_dot, "q_ddot": q_ddot, "tau": tau, "q_d": q_d, "q_d_dot": q_d_dot, "q_d_ddot": q_d_ddot,
        "K_P": gains[0], "K_V": gains[1], "Lambda": tracking.Lambda, "K_D": gains[2],
    }  # fmt: skip
    scales = np.array([max(results[name][1], 1e-300) for name in QUANTITIES])
    return {"scale": scales} | inputs | {name: results[name][0] for name in QUANTITIES}


def _reduced_results(terms: Terms, q_ddot: Array, tau: Array) -> dict[str, tuple[Array, float]]:
    at, motors = terms.at, terms.mechanism.motors
    rho, speed, D = float(np.abs(at.rho).max()), float(np.abs(terms.v_tree).max()), float(np.abs(terms.D).max())
    acceleration = at.rho @ q_ddot + terms.rho_dot_times(terms.q_dot)
    h = rho * float(np.abs(terms.h_tree).max())
    return {
        "sigma": (terms.q_tree, 1.0),
        "rho": (at.rho, 0.0),
        "D_reduced": (terms.D, 0.0),
        "C_reduced": (terms.C, D * rho * speed),
        "h_reduced": (terms.h, h),
        "inverse": (at.rho.T @ tree_force(terms, acceleration), D * float(np.abs(acceleration).max()) + h),
        "tree_acceleration": (acceleration, float(np.abs(acceleration).max())),
        "forward": (reduced_acceleration(terms, motors.force(tau)), 0.0),
    }


def _multipliers(terms: Terms, acceleration: Array, u_tree: Array) -> Array:
    """Return the multipliers of eq. 1, those of redundant rows zero."""
    kept, multipliers = terms.mechanism.independent_rows, np.zeros(len(terms.phi))
    force = tree_force(terms, acceleration) - u_tree
    multipliers[kept] = np.linalg.lstsq(terms.at.J[kept].T, force, rcond=None)[0]
    return multipliers


def _motor_torques(mechanism: Mechanism, at: Kinematics, u: Array) -> Array:
    """Return torques of minimum norm for a force u, clipped at the motors' limits."""
    motors = mechanism.motors
    torques = np.linalg.lstsq((motors.transmission @ at.rho).T, u, rcond=None)[0]
    return np.asarray(np.clip(torques, *motors.torque_limit))


def _random_gain(random: np.random.Generator, d: int) -> Array:
    """Return a random symmetric positive definite matrix."""
    root = random.uniform(-1, 1, (d, d))
    gain = 10.0 * np.eye(d) + root @ root.T
    return np.asarray((gain + gain.T) / 2)


def _disturb(at: Kinematics, random: np.random.Generator) -> Array:
    """Return a closed configuration near another one, from which sigma starts."""
    scale = at.tree.step_scale[at.partition.q]
    step = GUESS_DISTANCE * random.uniform(-1, 1, len(scale)) * scale
    return at.integrate(at.rho @ step).q_tree
