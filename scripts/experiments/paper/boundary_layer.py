"""Boundary layer of the SPF: eq. 12 in fast time, the eigenvalues of eq. 13, and the jump of q_dot across the layer.

Eq. 12, dy/dtau = -phi_z^-1 phi at a frozen q, is Newton's method in continuous time: phi decays as
exp(-tau) exactly, so its solution is z on the level set phi = w(0) exp(-tau), and no integration is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import load_scene
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.experiment import W0, Problem, five_bar_problem, on_level, sample, vector

__all__ = [
    "Layer",
    "claims",
    "directions",
    "eigenvalues_around",
    "eq_13",
    "measured_layer",
    "problem_after_layer",
    "solve_eq_12",
]

EPSILONS = (1e-1, 1e-2, 1e-3, 1e-4)
TAUS = np.linspace(0.0, 12.0, 121)
SCENE = "five_bar/tracking"
DEEP = 40.0  # fast time after which the layer is over: exp(-40) is 4e-18


def solve_eq_12(mechanism: Mechanism, at: Kinematics, w: Array, taus: Array) -> Array:
    """Return y(tau) = z - h of eq. 12 from phi(q, h + y(0)) = w, shape (m, n - d).

    Parameters
    ----------
    mechanism : Mechanism
    at : Kinematics
        Configuration on phi = 0. Its q is kept, its z is h.
    w : (rows,) array
    taus : (m,) array
        Fast time t / epsilon, increasing.

    Raises
    ------
    NumericalError
        This branch has no such y.
    """
    ys = []
    off = on_level(mechanism, at, w)
    for tau in taus:
        off = on_level(mechanism, off, w * np.exp(-tau))
        ys.append(_y(mechanism, at, off))
    return np.array(ys)


def _y(mechanism: Mechanism, on: Kinematics, off: Kinematics) -> Array:
    return mechanism.tree.difference(on.q_tree, off.q_tree)[on.partition.z]


def eq_13(at: Kinematics) -> Array:
    """Return the gradient by y of eq. 12's right-hand side, -phi_z^-1 phi, at any z, shape (n - d, n - d).

    With s = phi_z^-1 phi it is -I + phi_z^-1 (d phi_z / dz)[s]: the identity's negative where phi = 0, in every
    configuration. The second derivatives of phi are symmetric, so that (d phi_z / dz)[s] is J_dot along
    s, z's columns (coordinates that are numbers: joints of one freedom).
    """
    z = at.partition.z
    along = np.zeros(at.tree.n)
    along[z] = at.phi_z_factor.solve(at.phi)
    return at.phi_z_factor.solve(at.J_dot(along)[:, z]) - np.eye(len(z))


def directions(rows: int, count: int) -> Array:
    """Return unit vectors in the space of w: evenly spaced for two rows, otherwise a fixed random sample."""
    if rows == 2:
        angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
        return np.column_stack([np.cos(angle), np.sin(angle)])
    sample_of = np.random.default_rng(13).normal(size=(count, rows))
    return sample_of / np.linalg.norm(sample_of, axis=1, keepdims=True)


def eigenvalues_around(mechanism: Mechanism, at: Kinematics, radius: float, count: int = 16) -> Array:
    """Return eigenvalues of `eq_13` at the z with the same q on phi = w, for `count` directions of |w| = radius.

    Returns
    -------
    (count, n - d) complex array
        NaN if the branch has no such z.
    """
    q = mechanism.independent_part(at.q_tree)
    values = np.full((count, len(at.partition.z)), np.nan, dtype=complex)
    for k, direction in enumerate(directions(mechanism.closure.rows, count)):
        closed = sigma(mechanism, q, at, radius * direction)
        if closed.verdict == "converged":
            values[k] = np.linalg.eigvals(eq_13(closed.at))
    return values


@dataclass(frozen=True)
class Layer:
    """The boundary layer by eq. 12 and as measured in runs of the SPF.

    Attributes
    ----------
    taus : (m,) array
    y : (m, n - d) array
        Solution of eq. 12.
    epsilons : (k,) array
    measured : (k, m, n - d) array
        z of the SPF minus z of the DAE at t = epsilon tau.
    """

    taus: Array
    y: Array
    epsilons: Array
    measured: Array

    @property
    def size(self) -> Array:
        """Largest component of y at each tau, shape (m,)."""
        return np.abs(self.y).max(axis=1)

    @property
    def misses(self) -> Array:
        """Largest |measured - y| over the layer for each epsilon, shape (k,)."""
        return np.abs(self.measured - self.y).max(axis=(1, 2))

    @property
    def factor(self) -> float:
        """Smallest k with |y(tau)| <= k |y(0)| exp(-tau)."""
        return float(np.max(self.size * np.exp(self.taus)) / self.size[0])


def measured_layer(
    problem: Problem, w: Array, epsilons: Sequence[float], taus: Array, convention: CoriolisVelocity = "rho"
) -> Layer:
    """Run the SPF and the DAE through the layer, with taus[0] = 0, for comparison with eq. 12.

    Raises
    ------
    NumericalError
        A run stops, or the start does not exist.
    """
    measured = []
    for epsilon in epsilons:
        spf = sample(problem.spf(epsilon, w, convention), "DOP853", 1e-12, epsilon * taus)
        dae = sample(problem.dae(), "DOP853", 1e-12, epsilon * taus)
        measured.append([_y(problem.mechanism, b.at, a.at) for a, b in zip(spf, dae, strict=True)])
    y = solve_eq_12(problem.mechanism, problem.at, w, taus)
    return Layer(taus, y, np.array(epsilons), np.array(measured))


def problem_after_layer(problem: Problem, w: Array) -> Problem:
    """Return the problem whose DAE is the limit of the SPF if C is evaluated at the actual z_dot (eq. 16).

    C is linear in the velocity. So z_dot = -phi_z^-1 phi / epsilon adds a term of order 1 / epsilon to q_ddot for a
    time of order epsilon. In the limit q is constant through the layer and
    dq_dot/dtau = -D^-1 C(q, z, -phi_z^-1 phi) q_dot. So q_dot jumps across the layer. Its kinetic energy does not,
    since D_dot - 2 C is skew-symmetric along this flow.

    Raises
    ------
    NumericalError
        phi = w cannot be reached at the start's q.
    """
    from scipy.integrate import solve_ivp

    mechanism, last = problem.mechanism, on_level(problem.mechanism, problem.at, w)

    def rate(tau: float, q_dot: Array) -> Array:
        nonlocal last
        last = on_level(mechanism, last, w * np.exp(-tau))
        velocity = np.zeros(mechanism.n)
        velocity[last.partition.z] = -last.phi_z_factor.solve(last.phi)
        terms = Terms(mechanism, last, velocity)
        return -terms.D_factor.solve(terms.C_times(q_dot))

    layer = solve_ivp(rate, (0.0, DEEP), problem.q_dot, method="DOP853", rtol=1e-12, atol=1e-14)
    return Problem(mechanism, problem.at, layer.y[:, -1], problem.force)


def claims(figures: Path) -> list[Claim]:
    """Answer the paper's claims on the boundary layer and its eigenvalues."""
    problem = five_bar_problem(True)
    return [_layer_claim(measured_layer(problem, W0, EPSILONS, TAUS), figures), _eigenvalue_claim(problem, figures)]


def _layer_claim(layer: Layer, figures: Path) -> Claim:
    orders = np.diff(np.log(layer.misses)) / np.diff(np.log(layer.epsilons))
    figure, (ax,) = chart()
    for epsilon, y, colour in zip(layer.epsilons, layer.measured, COLOURS, strict=False):
        ax.semilogy(layer.taus, np.abs(y).max(axis=1), color=colour, linewidth=3, label=f"SPF, ε = {epsilon:g} s")
    ax.semilogy(layer.taus, layer.size, color=BLACK, linewidth=1, label="eq. 12")
    ax.semilogy(layer.taus, layer.size[0] * np.exp(-layer.taus), ":", color=BLACK, label="|y(0)| exp(-τ)")
    ax.set(xlabel="fast time τ = t/ε", ylabel="largest component of y = z - h(t, x̄) (rad)")
    ax.set_title(f"The boundary layer, w(0) = {vector(W0)} m")
    ax.legend(fontsize=8)
    name = save(figure, figures, "boundary_layer.png")
    return Claim(
        key="boundary-layer",
        verdict="holds" if abs(orders[-1] - 1) <= 0.05 and layer.factor < 2 else "does not hold",
        figures=(name,),
        **render_blocks("claims/boundary-layer", layer=layer, order=orders[-1]),
    )


def _eigenvalue_claim(problem: Problem, figures: Path) -> Claim:
    mechanism, radius = problem.mechanism, float(np.linalg.norm(W0))
    layer = [on_level(mechanism, problem.at, W0 * np.exp(-tau)) for tau in TAUS]
    inside = np.array([np.sort(np.linalg.eigvals(eq_13(at)).real) for at in layer])
    scene = load_scene(SCENE)
    tracking = Problem.of_scene(scene)
    times = np.linspace(0.0, scene.spec.t_end, 96)
    way = sample(tracking.reduced(), "Radau", 1e-8, times)
    on = np.array([np.linalg.eigvals(eq_13(terms.at)) for terms in way])
    around = np.array([eigenvalues_around(tracking.mechanism, terms.at, radius) for terms in way])
    off = around.real.reshape(len(times), -1)
    missing = int(np.isnan(off).any(axis=1).sum())
    name = _draw_eigenvalues(inside, times, on.real, off, radius, figures)
    miss = float(np.abs(on + 1).max())
    stable = bool(np.nanmax(off) < 0) and missing == 0
    return Claim(
        key="eq-13",
        verdict="holds with a condition" if stable and miss < 1e-9 else "does not hold",
        figures=(name,),
        **render_blocks(
            "claims/eq-13",
            scene=SCENE,
            miss=miss,
            printed=-on.real.min(),
            radius=radius,
            directions=around.shape[1],
            missing=missing,
            off=(np.nanmin(off), np.nanmax(off)),
            inside=(inside.min(), inside.max()),
        ),
    )


def _draw_eigenvalues(inside: Array, times: Array, on: Array, off: Array, radius: float, figures: Path) -> str:
    figure, (left, right) = chart(2)
    for k, colour in zip(range(inside.shape[1]), COLOURS, strict=False):
        left.plot(TAUS, inside[:, k], color=colour, label=f"eigenvalue {k + 1}")
    left.set(xlabel="fast time τ = t/ε", ylabel="Re λ of the gradient by y of -φ_z⁻¹ φ")
    left.set_title("Along the boundary layer")
    low, high = np.nanmin(off, axis=1), np.nanmax(off, axis=1)
    right.fill_between(times, low, high, color=COLOURS[5], alpha=0.5, label=f"off it, |w| = {radius:.4g} m")
    right.plot(times, on, color=BLACK, label=["on φ = 0", *[None] * (on.shape[1] - 1)])
    right.set(xlabel="$t$ (s)", ylabel="Re λ")
    right.set_title(f"Along {SCENE}")
    for ax in (left, right):
        ax.legend(fontsize=8)
    return save(figure, figures, "eq13_eigenvalues.png")
