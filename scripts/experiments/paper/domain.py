"""Domains of the reduced model and the SPF: the implicit function theorem, and the domain of eq. 8."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ckc_pin.analysis.singularities import search_singular
from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics, Psi
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.ivp import PrintedSpf
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.experiment import march
from scripts.experiments.paper.five_bar import FIVE_BAR, PRINTED

__all__ = ["Beyond", "PsiCheck", "check_psi", "claims", "off_manifold"]

STATES = 1000
STARTS = 20
EPSILON = 1e-3
LAYERS = 20.0  # t / epsilon at the end of runs of the SPF towards phi = 0


@dataclass(frozen=True)
class PsiCheck:
    """Comparison of Psi_{q'} of eq. 3 with phi_z, at random and at singular configurations.

    Attributes
    ----------
    states : int
    determinant : float
        Largest | |det Psi_{q'}| - |det phi_z| |, relative to the largest |det phi_z|.
    rho : float
        Largest difference of rho by eq. 5, -Psi_{q'}^-1 Psi_q, from rho computed with phi_z,
        relative to its largest entry.
    singular : float
        Largest |det Psi_{q'}| at singular configurations.
    norm : float
        Smallest |Psi_{q'}| at singular configurations: the matrix itself is never zero.
    """

    states: int
    determinant: float
    rho: float
    singular: float
    norm: float


@dataclass(frozen=True)
class Beyond:
    """Runs of eq. 8 from random (q, z) off the manifold, with regular phi_z.

    Attributes
    ----------
    reachable : bool
        Whether phi(q, z) = 0 has a solution z at the q of these starts.
    sigma_min : (m,) array
        Smallest singular value of phi_z at the starts.
    layers : (m,) array
        t / epsilon at the end.
    arrived : (m,) array of bool
        Whether phi decayed like exp(-t / epsilon) to the end.
    """

    reachable: bool
    sigma_min: Array
    layers: Array
    arrived: Array


def check_psi(mechanism: Mechanism, states: int = STATES, seed: int = 0) -> PsiCheck:
    """Compare Psi_{q'} with phi_z at random configurations, nearly all of them off the constraint manifold.

    Parameters
    ----------
    mechanism : Mechanism
        Mechanism with square phi_z and joints of one freedom.
    """
    random = np.random.default_rng(seed)
    steps = random.uniform(-np.pi, np.pi, (states, mechanism.n))
    configurations = [mechanism.kinematics(mechanism.tree.integrate(mechanism.q_tree, step)) for step in steps]
    psi = np.array([np.linalg.det(Psi(at).jacobian) for at in configurations])
    phi_z = np.array([np.linalg.det(at.phi_z) for at in configurations])
    singular = [Psi(point.at).jacobian for point in search_singular(mechanism, STARTS)]
    return PsiCheck(
        states=states,
        determinant=float(np.abs(np.abs(psi) - np.abs(phi_z)).max() / np.abs(phi_z).max()),
        rho=max(_rho_difference(at) for at in configurations),
        singular=max(abs(float(np.linalg.det(jacobian))) for jacobian in singular),
        norm=min(float(np.linalg.norm(jacobian)) for jacobian in singular),
    )


def _rho_difference(at: Kinematics) -> float:
    Psi_q = np.vstack([np.zeros((len(at.phi), len(at.partition.q))), -np.eye(len(at.partition.q))])
    rho = -np.linalg.solve(Psi(at).jacobian, Psi_q)
    return float(np.abs(rho - at.rho).max() / np.abs(at.rho).max())


def off_manifold(mechanism: Mechanism, *, reachable: bool, count: int = STARTS, seed: int = 0) -> Beyond:
    """Run eq. 8 as printed from rest without control, from random (q, z) off the manifold."""
    random = np.random.default_rng(seed)
    none = np.zeros(mechanism.n)
    rows: list[tuple[float, float, bool]] = []
    for _ in range(1000):
        step = random.uniform(-np.pi, np.pi, mechanism.n)
        at = mechanism.kinematics(mechanism.tree.integrate(mechanism.q_tree, step))
        verdict = sigma(mechanism, mechanism.independent_part(at.q_tree)).verdict
        if verdict != ("converged" if reachable else "out of reach"):
            continue
        span = (0.0, LAYERS * EPSILON)
        spf = PrintedSpf(mechanism, at, np.zeros(mechanism.d), lambda t, terms: none, span, EPSILON, at.phi)
        outcome = march(spf, "Radau", 1e-5, span[1])
        gone = np.abs(outcome.terms.phi).max() <= 2 * np.exp(-LAYERS) * np.abs(at.phi).max() + 1e-7
        rows.append((at.sigma_min(), outcome.t / EPSILON, bool(gone and not outcome.stopped)))
        if len(rows) == count:
            break
    sigma_min, layers, arrived = zip(*rows, strict=True)
    return Beyond(reachable, np.array(sigma_min), np.array(layers), np.array(arrived))


def claims(figures: Path) -> list[Claim]:
    """Answer section II on the implicit function theorem and section II-A on the domain of the SPF."""
    mechanisms = {name: load(name) for name in (FIVE_BAR, PRINTED)}
    return [_psi_claim({name: check_psi(mechanism) for name, mechanism in mechanisms.items()}), _domain_claim()]


def _psi_claim(checks: dict[str, PsiCheck]) -> Claim:
    worst = max(max(check.determinant, check.rho, check.singular) for check in checks.values())
    rows = tuple(
        (name, f"{c.states}", f"{c.determinant:.0e}", f"{c.rho:.0e}", f"{c.singular:.0e}", f"{c.norm:.2f}")
        for name, c in checks.items()
    )
    return Claim(
        key="implicit-function",
        verdict="holds" if worst < 1e-9 else "does not hold",
        table=(
            ("mechanism", "states", "|det Psi| - |det phi_z|, relative", "rho, relative", "|det Psi| where singular",
             "|Psi| there"),
            rows,
        ),
        **render_blocks("claims/implicit-function"),
    )  # fmt: skip


def _domain_claim() -> Claim:
    mechanism = load(FIVE_BAR)
    over, beyond = (off_manifold(mechanism, reachable=reachable) for reachable in (True, False))
    larger = bool(beyond.sigma_min.min() > 0)
    stopped = not beyond.arrived.any()
    return Claim(
        key="spf-domain",
        verdict="holds with a condition" if larger and stopped else "holds" if larger else "does not hold",
        **render_blocks(
            "claims/spf-domain",
            starts=len(beyond.arrived),
            sigma_min=beyond.sigma_min.min(),
            arrived=beyond.arrived.sum(),
            layers=(beyond.layers.min(), beyond.layers.max()),
            over_starts=len(over.arrived),
            over_arrived=over.arrived.sum(),
        ),
    )
