"""Errata of the singular perturbation formulation: eqs. 11, 13 and 16's arguments, off the manifold."""

from __future__ import annotations

import numpy as np

from ckc_pin.dynamics.formulations import CoriolisVelocity, spf_terms
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.scene import load_scene
from scripts.experiments.paper.erratum import Erratum
from scripts.experiments.paper.experiment import Problem, on_level
from scripts.experiments.paper.five_bar import FIVE_BAR

__all__ = ["SPF"]

W = np.array([0.01, -0.006])  # m, off the manifold
Q_DOT = np.array([1.0, -2.0])  # rad/s
EPSILON = 1e-3
STEP = 1e-5  # of central differences


def fast_error() -> Erratum:
    """Eq. 11: y is z minus h, and its slow terms carry epsilon."""
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
        where="eq. 11 and the sentence before it",
        printed="y = h(t, x); dy/dtau = g - dh/dt - epsilon f grad h",
        correct="y = z - h(t, x); dy/dtau = g - epsilon (dh/dt + (dh/dx) f): without epsilon at dh/dt setting it to "
        "zero would not give eq. 12, and f grad h has no matching shapes",
        difference=float(np.abs(g - slow - truth).max()),
        agreement=float(np.abs(g - EPSILON * slow - truth).max()),
        unit="rad",
        measured=f"dy/dtau of eq. 8 by differences along its flow at w = {W.tolist()} m, q_dot = {Q_DOT.tolist()} "
        f"rad/s, epsilon = {EPSILON:g}, against both right-hand sides, h's rate along the motion taken as dh/dt",
    )


def boundary_layer_sign() -> Erratum:
    """Eq. 13: the sign, and c."""
    mechanism, on, _ = _off_manifold()
    z, columns = mechanism.partition.z, []
    for step in STEP * np.eye(mechanism.n)[z]:
        ahead, behind = (on.moved(sign * step) for sign in (1.0, -1.0))
        columns.append((ahead.phi_z_factor.solve(ahead.phi) - behind.phi_z_factor.solve(behind.phi)) / (2 * STEP))
    printed = np.linalg.eigvals(np.array(columns).T).real
    return Erratum(
        key="boundary-layer-sign",
        where="eq. 13",
        printed="Re lambda(grad_y g) <= Re lambda(grad_y phi_z^-1 phi) <= c <= 0",
        correct="Re lambda(grad_y (-phi_z^-1 phi)) <= c < 0, and it is -1: at y = 0 the gradient is minus the "
        "identity. c = 0 would not give exponential stability",
        difference=float(printed.max()),
        agreement=float(np.abs(printed - 1.0).max()),
        unit="1 (per unit of fast time)",
        measured="largest real part of the eigenvalues of grad_y phi_z^-1 phi on the manifold, which eq. 13 wants "
        "below zero; how far those of the correct form are from -1",
    )


def coriolis_arguments() -> Erratum:
    """Eq. 8's C(q, z, q_dot) is not eq. 16's C(q, q_dot, z, z_dot)."""
    mechanism, on, at = _off_manifold()

    def apart(where: Kinematics, w: Array) -> float:
        def C(velocity: CoriolisVelocity) -> Array:
            return spf_terms(mechanism, where, Q_DOT, EPSILON, w, velocity).C

        return float(np.abs(C("rho") - C("actual")).max())

    return Erratum(
        key="coriolis-arguments",
        where="eqs. 8, 16 and 17",
        printed="C(q, z, q_dot) in eq. 8, C(q, q_dot, z, z_dot) in eqs. 16 and 17",
        correct="two different matrices off the manifold: eq. 8's z_dot contains phi/epsilon. The program offers both "
        "(`coriolis_velocity`); eq. 8's is the default, and Tikhonov's theorem covers only it from a moving start",
        difference=apart(at, W),
        agreement=apart(on, np.zeros(2)),
        unit="kg m²/s",
        measured=f"largest difference of the two at w = {W.tolist()} m and at w = 0, q_dot = {Q_DOT.tolist()} rad/s, "
        f"epsilon = {EPSILON:g}",
        commands=("./scripts/experiment paper tikhonov-velocity",),
    )


def gravity_arguments() -> Erratum:
    """Eq. 16's h(q) does not give eq. 17."""
    mechanism, on, at = _off_manifold()
    h_of_q, h, own = (Terms(mechanism, where, np.zeros(4)).h for where in (on, at, at))
    return Erratum(
        key="gravity-arguments",
        where="eq. 16, h(q)",
        printed="u = D(q, z) a + C v + h(q) - K_D r",
        correct="h(q, z), as in eq. 8: only then does gravity cancel in eq. 17 while w is not zero",
        difference=float(np.abs(h_of_q - own).max()),
        agreement=float(np.abs(h - own).max()),
        unit="N m",
        measured=f"what is left in eq. 17 at w = {W.tolist()} m with h(sigma(q)), and with h(q, z)",
    )


SPF = (fast_error, boundary_layer_sign, coriolis_arguments, gravity_arguments)


def _off_manifold() -> tuple[Mechanism, Kinematics, Kinematics]:
    """Return the five-bar on phi = 0, half a radian off its equilibrium, and with the same q on phi = W."""
    problem = Problem.of_scene(load_scene(f"{FIVE_BAR}/swing"))
    return problem.mechanism, problem.at, on_level(problem.mechanism, problem.at, W)
