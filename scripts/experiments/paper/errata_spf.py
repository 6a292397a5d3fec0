"""Errata of the singular perturbation formulation off the manifold: eqs. 11, 13 and the arguments in eq. 16."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.formulations import CoriolisVelocity, spf_terms
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import load_scene
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.erratum import Erratum
from scripts.experiments.paper.experiment import Problem, on_level
from scripts.experiments.paper.five_bar import FIVE_BAR

__all__ = ["SPF"]

W = np.array([0.01, -0.006])  # m, off the manifold
Q_DOT = np.array([1.0, -2.0])  # rad/s
EPSILON = 1e-3
STEP = 1e-5  # of central differences


def fast_error() -> Erratum:
    """Eq. 11: y is z - h, and its slow terms have a factor epsilon."""
    mechanism, on, at = _off_manifold()
    z = mechanism.partition.z
    z_dot = at.rho[z] @ Q_DOT - at.phi_z_factor.solve(W) / EPSILON

    def y(t: float) -> Array:
        step = np.zeros(mechanism.n)
        step[mechanism.partition.q], step[z] = t * Q_DOT, t * z_dot
        moved = mechanism.tree.integrate(at.q_tree, step)
        return (moved - sigma(mechanism, mechanism.independent_part(moved), on).at.q_tree)[z]

    short = STEP * EPSILON
    truth = EPSILON * (y(short) - y(-short)) / (2 * short)
    g, slow = EPSILON * z_dot, on.rho[z] @ Q_DOT
    return Erratum(
        key="fast-error",
        difference=float(np.abs(g - slow - truth).max()),
        agreement=float(np.abs(g - EPSILON * slow - truth).max()),
        unit="rad",
        **render_blocks("errata/fast-error", w=W.tolist(), q_dot=Q_DOT.tolist(), epsilon=EPSILON),
    )


def boundary_layer_sign() -> Erratum:
    """Eq. 13: the sign, and the constant c."""
    mechanism, on, _ = _off_manifold()
    z, columns = mechanism.partition.z, []
    for step in STEP * np.eye(mechanism.n)[z]:
        plus, minus = (on.integrate(sign * step) for sign in (1.0, -1.0))
        columns.append((plus.phi_z_factor.solve(plus.phi) - minus.phi_z_factor.solve(minus.phi)) / (2 * STEP))
    printed = np.linalg.eigvals(np.array(columns).T).real
    return Erratum(
        key="boundary-layer-sign",
        difference=float(printed.max()),
        agreement=float(np.abs(printed - 1.0).max()),
        unit="1 (per unit of fast time)",
        **render_blocks("errata/boundary-layer-sign"),
    )


def coriolis_arguments() -> Erratum:
    """Eq. 8's C(q, z, q_dot) is not eq. 16's C(q, q_dot, z, z_dot)."""
    mechanism, on, at = _off_manifold()

    def relative_error(where: Kinematics, w: Array) -> float:
        def C(velocity: CoriolisVelocity) -> Array:
            return spf_terms(mechanism, where, Q_DOT, EPSILON, w, velocity).C

        return float(np.abs(C("rho") - C("actual")).max())

    return Erratum(
        key="coriolis-arguments",
        difference=relative_error(at, W),
        agreement=relative_error(on, np.zeros(2)),
        unit="kg m²/s",
        commands=("./scripts/experiment paper tikhonov-velocity",),
        **render_blocks("errata/coriolis-arguments", w=W.tolist(), q_dot=Q_DOT.tolist(), epsilon=EPSILON),
    )


def gravity_arguments() -> Erratum:
    """Eq. 16's h(q) does not give eq. 17."""
    mechanism, on, at = _off_manifold()
    h_of_q, h, exact = (Terms(mechanism, where, np.zeros(4)).h for where in (on, at, at))
    return Erratum(
        key="gravity-arguments",
        difference=float(np.abs(h_of_q - exact).max()),
        agreement=float(np.abs(h - exact).max()),
        unit="N m",
        **render_blocks("errata/gravity-arguments", w=W.tolist()),
    )


SPF = (fast_error, boundary_layer_sign, coriolis_arguments, gravity_arguments)


def _off_manifold() -> tuple[Mechanism, Kinematics, Kinematics]:
    """Return the five-bar, a configuration half a radian off its equilibrium, and one with the same q on phi = W."""
    problem = Problem.of_scene(load_scene(f"{FIVE_BAR}/swing"))
    return problem.mechanism, problem.at, on_level(problem.mechanism, problem.at, W)
