"""Errata of the model: eqs. 1 and 3, the appendix, Table I, the singular configurations."""

from __future__ import annotations

import numpy as np

from ckc_pin.analysis.singularities import search_singular
from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.scene import load_scene
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.along_eq21 import tracking, widest
from scripts.experiments.paper.domain import check_psi
from scripts.experiments.paper.erratum import Erratum
from scripts.experiments.paper.experiment import Problem
from scripts.experiments.paper.five_bar import FIVE_BAR, PRINTED, wrap
from scripts.experiments.paper.printed import Printed

__all__ = ["MODEL"]

LOOP = Printed((1, 2, 4, 3))  # Table I numbered around the loop, `five_bar`
STATES = 200
FALL = 0.1  # s


def multipliers() -> Erratum:
    """Eq. 1 lacks J^T lambda, so that the loop opens."""
    from scipy.integrate import solve_ivp

    problem = Problem.of_scene(load_scene(f"{FIVE_BAR}/swing"))
    mechanism, n = problem.mechanism, problem.mechanism.n

    def chains(t: float, y: Array) -> Array:
        terms = Terms(mechanism, mechanism.kinematics(y[:n]), y[n:])
        return np.concatenate([y[n:], np.linalg.solve(terms.D_tree, -terms.bias_tree)])

    start = np.concatenate([problem.at.q_tree, problem.at.rho @ problem.q_dot])
    apart = solve_ivp(chains, (0.0, FALL), start, rtol=1e-10, atol=1e-12).y[:n, -1]
    together = simulate(f"{FIVE_BAR}/swing", {"formulation": "dae", "t_end": FALL})
    return Erratum(
        key="multipliers",
        difference=float(np.abs(mechanism.kinematics(apart).phi).max()),
        agreement=float(np.abs(together.phi[-1]).max()),
        unit="m",
        **render_blocks("errata/multipliers", fall=FALL),
    )


def psi_determinant() -> Erratum:
    """The condition Psi_{q'} = 0 should read det Psi_{q'} = 0."""
    check = check_psi(load(FIVE_BAR), states=1)
    return Erratum(
        key="psi-determinant",
        difference=check.norm,
        agreement=check.singular,
        unit="m (|Psi_{q'}|), m² (det)",
        **render_blocks("errata/psi-determinant"),
    )


def coriolis_power() -> Erratum:
    """Eq. 25 squares the rates in c12 and c34."""
    printed, first = (
        max(_relative(LOOP.C_tree(q, v, power) @ v, terms.C_tree @ v) for q, v, terms in _states()) for power in (2, 1)
    )
    return Erratum(
        key="coriolis-power",
        difference=printed,
        agreement=first,
        unit="relative",
        **render_blocks("errata/coriolis-power", states=STATES),
    )


def coriolis_skew() -> Erratum:
    """Eq. 25 is not the Christoffel matrix, even with first powers."""
    printed = max(_skew(terms, LOOP.C_tree(q, v, 1)) for q, v, terms in _states())
    christoffel = max(_skew(terms, terms.C_tree) for _, _, terms in _states())
    return Erratum(
        key="coriolis-skew",
        difference=printed,
        agreement=christoffel,
        unit="kg m²/s",
        **render_blocks("errata/coriolis-skew", states=STATES),
    )


def closure_angles() -> Erratum:
    """Eq. 27 assigns the sum of angles to the wrong link; it belongs to the distal one."""
    at = stable_equilibrium(load(FIVE_BAR))
    return Erratum(
        key="closure-angles",
        difference=float(np.abs(LOOP.phi(at.q_tree)).max()),
        agreement=float(np.abs(at.phi).max()),
        unit="m",
        commands=("ckc check five_bar",),
        **render_blocks("errata/closure-angles"),
    )


def table_rows() -> Erratum:
    """Rows 3 and 4 of Table I are exchanged."""
    (_, printed, reach), (_, loop, loop_reach) = (widest(*tracking(name)) for name in (PRINTED, FIVE_BAR))
    return Erratum(
        key="table-rows",
        difference=printed - reach,
        agreement=max(0.0, loop - loop_reach),
        unit="m",
        commands=("ckc check five_bar_as_printed/tracking",),
        **render_blocks("errata/table-rows", printed=(printed, reach), loop=(loop, loop_reach)),
    )


def type_1_points() -> Erratum:
    """Singularities of type 1 are two points."""
    mechanism = load(FIVE_BAR)
    q = np.array([wrap(p.at.q_tree[[0, 2]]) for p in search_singular(mechanism, 20) if p.kind == "locked"])
    upper, lower = q[q[:, 0] > 0], q[q[:, 0] < 0]
    return Erratum(
        key="type-1-points",
        difference=float(np.linalg.norm(upper[0] - lower[0])),
        agreement=max(float(np.abs(points - points[0]).max()) for points in (upper, lower, np.vstack([upper, -lower]))),
        unit="rad",
        **render_blocks("errata/type-1-points", q=upper[0], solutions=len(q)),
    )


def lost_freedoms() -> Erratum:
    """No freedom is lost at singularities of types 1 and 2."""
    mechanism = load(FIVE_BAR)
    points = search_singular(mechanism, 20)
    return Erratum(
        key="lost-freedoms",
        difference=min(point.sigma_min_J for point in points),
        agreement=max(point.sigma_min_phi_z for point in points),
        unit="m",
        commands=("./scripts/experiment paper singular-freedoms",),
        **render_blocks("errata/lost-freedoms", points=len(points)),
    )


MODEL = (
    multipliers, psi_determinant, coriolis_power, coriolis_skew, closure_angles, table_rows, type_1_points,
    lost_freedoms,
)  # fmt: skip


def _states() -> list[tuple[Array, Array, Terms]]:
    mechanism, random = load(FIVE_BAR), np.random.default_rng(0)
    pairs = [(random.uniform(-np.pi, np.pi, 4), random.uniform(-3, 3, 4)) for _ in range(STATES)]
    return [(q, v, Terms(mechanism, mechanism.kinematics(q), v)) for q, v in pairs]


def _relative(a: Array, b: Array) -> float:
    return float(np.abs(a - b).max() / np.abs(b).max())


def _skew(terms: Terms, C_tree: Array) -> float:
    mechanism: Mechanism = terms.mechanism
    step = 1e-5
    forward, backward = (
        Terms(mechanism, terms.at.integrate(sign * step * terms.v_tree), terms.v_tree).D_tree for sign in (1.0, -1.0)
    )
    return float(np.abs((forward - backward) / (2 * step) - C_tree - C_tree.T).max())
