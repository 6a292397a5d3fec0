"""Errata of the model: eqs. 1 and 3, the appendix, Table I, the singular configurations."""

from __future__ import annotations

import numpy as np

from ckc_pin.analysis.singularities import search_singular
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.scene import load_scene
from ckc_pin.simulation.simulate import simulate
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
    """Eq. 1 without J^T lambda: the chains fall apart."""
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
        where='eq. 1 and section II, "the differential equation part of the DAE alone is sufficient"',
        printed="D' q'' + C' q' + h' = u', phi = 0",
        correct="D' q'' + C' q' + h' = u' + J^T lambda, phi = 0: n + (n - d) equations need as many unknowns. In eq. 6 "
        "lambda drops out, since rho^T J^T = 0",
        difference=float(np.abs(mechanism.kinematics(apart).phi).max()),
        agreement=float(np.abs(together.phi[-1]).max()),
        unit="m",
        measured=f"|phi| after {FALL} s of free fall from the start of `{FIVE_BAR}/swing`, at rest and closed: without "
        "and with the multipliers",
    )


def psi_determinant() -> Erratum:
    """Psi_{q'} = 0 for det Psi_{q'} = 0."""
    check = check_psi(load(FIVE_BAR), states=1)
    return Erratum(
        key="psi-determinant",
        where='section II and III-C, "Psi_{q\'} != 0", "Psi_{q\'} = 0"',
        printed="singular where Psi_{q'} = 0",
        correct="singular where det Psi_{q'} = 0",
        difference=check.norm,
        agreement=check.singular,
        unit="m (|Psi_{q'}|), m² (det)",
        measured="at singular configurations found by solving for them: least |Psi_{q'}|, largest |det Psi_{q'}|",
    )


def coriolis_power() -> Erratum:
    """Eq. 25: squares in c12 and c34."""
    printed, first = (
        max(_relative(LOOP.C_tree(q, v, power) @ v, terms.C_tree @ v) for q, v, terms in _states()) for power in (2, 1)
    )
    return Erratum(
        key="coriolis-power",
        where='eq. 25, c12 and c34 (and "q2", "q4" for theta_2, theta_4)',
        printed="c12 = -m2 l1 c2 theta_2_dot² sin theta_2",
        correct="the rate to the first power: the entry multiplies a velocity",
        difference=printed,
        agreement=first,
        unit="relative",
        measured=f"C' v' against Pinocchio's at {STATES} random states, |rates| up to 3 rad/s: with the square and "
        "with the first power",
    )


def coriolis_skew() -> Erratum:
    """Eq. 25, even with first powers, is not the Christoffel matrix."""
    printed = max(_skew(terms, LOOP.C_tree(q, v, 1)) for q, v, terms in _states())
    christoffel = max(_skew(terms, terms.C_tree) for _, _, terms in _states())
    return Erratum(
        key="coriolis-skew",
        where='eq. 25 and eq. 1, "Christoffel symbols matrices"',
        printed="[[-2 a theta_2_dot, -a theta_2_dot], [a theta_1_dot, 0]] with a = m2 l1 c2 sin theta_2, once c12 has "
        "its first power",
        correct="[[-a theta_2_dot, -a (theta_1_dot + theta_2_dot)], [a theta_1_dot, 0]], what "
        "`pin.computeCoriolisMatrix` returns: the same C' v', and D_dot' - 2 C' is skew, which eq. 19 needs",
        difference=printed,
        agreement=christoffel,
        unit="kg m²/s",
        measured=f"largest entry of D_dot' - C' - C'^T at {STATES} random states, D_dot' by central differences",
    )


def closure_angles() -> Erratum:
    """Eq. 27: the sum of angles belongs to the distal link."""
    at = stable_equilibrium(load(FIVE_BAR))
    return Erratum(
        key="closure-angles",
        where="eq. 27",
        printed="... - l3 cos(theta_3 + theta_4) - l4 cos theta_4 - c = 0",
        correct="... - l3 cos theta_3 - l4 cos(theta_3 + theta_4) - c = 0, sines alike: links 3 and 4 are proximal and "
        "distal in eqs. 24 to 26; c is the base link of Table I's row 0",
        difference=float(np.abs(LOOP.phi(at.q_tree)).max()),
        agreement=float(np.abs(at.phi).max()),
        unit="m",
        measured=f"|phi| of `{FIVE_BAR}` at its hanging equilibrium: eq. 27 as printed, and the program's",
        commands=("ckc check five_bar",),
    )


def table_rows() -> Erratum:
    """Table I, rows 3 and 4."""
    (_, printed, reach), (_, loop, loop_reach) = (widest(*tracking(name)) for name in (PRINTED, FIVE_BAR))
    return Erratum(
        key="table-rows",
        where="Table I, rows 3 and 4",
        printed="l3 = 0.3048, l4 = 0.2794 (and c, m, I with them): rows in the order of the loop, as eq. 27 puts l3 on "
        "the sum of angles",
        correct="links 3 and 4 of eqs. 24 to 26 (proximal, distal) take rows 4 and 3: `five_bar`. As printed, type 1 "
        "of Fig. 2, which needs l2 = l4, does not exist, and eq. 21 leaves the workspace",
        difference=printed - reach,
        agreement=max(0.0, loop - loop_reach),
        unit="m",
        measured="how far eq. 21 asks the elbows beyond the reach l2 + l4: "
        f"{printed:.4f} of {reach:.4f} as printed, {loop:.4f} of {loop_reach:.4f} otherwise",
        commands=("ckc check five_bar_as_printed/tracking",),
    )


def type_1_points() -> Erratum:
    """Type 1 is two points."""
    mechanism = load(FIVE_BAR)
    q = np.array([wrap(p.at.q_tree[[0, 2]]) for p in search_singular(mechanism, 20) if p.kind == "locked"])
    upper, lower = q[q[:, 0] > 0], q[q[:, 0] < 0]
    return Erratum(
        key="type-1-points",
        where="section III-A and Fig. 2, \"Type 1 singularity is represented by just a single point\"",
        printed="one point (theta_1, theta_3)",
        correct=f"two, ±({upper[0, 0]:.6f}, {upper[0, 1]:.6f}): the elbows coincide above and below the base; none "
        "when l2 and l4 differ",
        difference=float(np.linalg.norm(upper[0] - lower[0])),
        agreement=max(float(np.abs(found - found[0]).max()) for found in (upper, lower, np.vstack([upper, -lower]))),
        unit="rad",
        measured=f"distance of the two points found, and how well {len(q)} solutions from random starts agree on them",
    )  # fmt: skip


def lost_freedoms() -> Erratum:
    """No freedom is lost."""
    mechanism = load(FIVE_BAR)
    points = search_singular(mechanism, 20)
    return Erratum(
        key="lost-freedoms",
        where='section III-A, "the system ceases to have two DOFs"',
        printed="one freedom where phi_z is singular",
        correct="two: J keeps rank 2. The pair (theta_1, theta_3) describes one of them only",
        difference=min(point.sigma_min_J for point in points),
        agreement=max(point.sigma_min_phi_z for point in points),
        unit="m",
        measured=f"at {len(points)} singular configurations: least sigma_min(J), largest sigma_min(phi_z)",
        commands=("./scripts/experiment paper singular-freedoms",),
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
    ahead, behind = (
        Terms(mechanism, terms.at.moved(sign * step * terms.v_tree), terms.v_tree).D_tree for sign in (1.0, -1.0)
    )
    return float(np.abs((ahead - behind) / (2 * step) - C_tree - C_tree.T).max())
