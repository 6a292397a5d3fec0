"""Answer the paper's statements on set-point control (section II-B)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import simulate
from scripts.experiments.certificate.certificate import Certificate
from scripts.experiments.certificate.gradient_bounds import Bound
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.lyapunov import Record
from scripts.experiments.paper.set_point_experiments import (
    DENSE,
    FORMULATIONS,
    NEAR_START,
    SCENE,
    Case,
    along_run,
    bounds,
    equilibria_of,
    gradient_error,
    load_case,
)
from scripts.experiments.paper.set_point_figures import draw_bounds, draw_lyapunov, draw_set
from scripts.experiments.paper.solutions import Equilibrium

__all__ = ["ROWS", "claims", "gain_claim", "gradient_claim", "lyapunov_claim", "uniqueness_claim"]

RATE_TOLERANCE = 1e-8  # relative: derivative of the recorded function by a spline against the formula
EXACT = 1e-9  # relative: differences of h against the chain rule
DIVISIONS = 30  # divisions of the certificates' lattices
LOW_GAIN = {"controller.K_P": 0.5}
ROWS: dict[str, dict[str, Any]] = {
    "equilibrium, K_P = 10 I": {},
    "equilibrium, K_P = 30 I": {"controller.K_P": 30.0},
    "(0.3, 0.5), K_P = 10 I": NEAR_START,
    "(0.3, 0.5), K_P = 2 I": {**NEAR_START, "controller.K_P": 2.0},
    "equilibrium, K_P = 2 I": {"controller.K_P": 2.0},
    "equilibrium, K_P = 1 I": {"controller.K_P": 1.0},
    "equilibrium, K_P = 0.5 I": LOW_GAIN,
}


def claims(figures: Path) -> list[Claim]:
    """Run the experiments on eqs. 14 and 15 and write their figures into a folder; return the claims."""
    runs = {name: along_run({**DENSE, **how}) for name, how in FORMULATIONS.items()}
    cases = {name: load_case(overrides) for name, overrides in ROWS.items()}
    certificates = {name: (case, case.certificate(DIVISIONS)) for name, case in cases.items()}
    case, certificate = next(iter(certificates.values()))
    first_run = next(iter(runs.values()))[0]
    return [
        lyapunov_claim({name: record for name, (_, record) in runs.items()}, figures),
        gradient_claim(case, gradient_error(case.mechanism, 60), bounds(case.mechanism), figures),
        gain_claim(case, certificate, certificates, first_run, figures),
        uniqueness_claim(certificates, {name: equilibria_of(case) for name, case in cases.items()}),
    ]


def lyapunov_claim(records: dict[str, Record], figures: Path) -> Claim:
    """Return the verdict on records of V_L by formulation."""
    rows = tuple(
        (name, f"{r.largest_increase:.1e}", f"{r.round_off:.1e}", f"{r.mismatch:.1e}") for name, r in records.items()
    )
    confirmed = all(r.monotone and r.mismatch <= RATE_TOLERANCE for r in records.values())
    worst = max(r.largest_increase for r in records.values())
    return Claim(
        key="set-point-lyapunov",
        verdict="holds" if confirmed else "does not hold",
        figures=(draw_lyapunov(records, figures),),
        table=(("formulation", "largest increase (J)", "rounding (J)", "rate: relative difference"), rows),
        **render_blocks(
            "claims/set-point-lyapunov",
            start=records[rows[0][0]].value[0],
            increase=worst,
            mismatch=max(r.mismatch for r in records.values()),
        ),
    )


def gradient_claim(case: Case, checked: tuple[float, float, int], branches: list[list[Bound]], figures: Path) -> Claim:
    """Return the verdict on bounds of dh/dq by branch, given the comparison of dh/dq with differences of h."""
    error, asymmetry, used = checked
    assembled, tail, gain = branches[0], branches[0][-2:], case.controller.K_P[0, 0]
    exponent = np.log(tail[1].norm / tail[0].norm) / np.log(tail[0].margin / tail[1].margin)
    bounded = exponent < 0.1 and error <= EXACT
    rows = tuple(
        (f"{bound.margin:g}", *(f"{b[k].norm:.5g}" for b in branches), *(f"{b[k].low:.5g}" for b in branches))
        for k, bound in enumerate(assembled)
    )
    of = ["assembled branch", *(f"branch {k + 2}" for k in range(len(branches) - 1))]
    return Claim(
        key="set-point-gradient-bound",
        verdict="holds" if bounded else "holds with a condition",
        figures=(draw_bounds(branches, case.controller.K_P, figures),),
        table=(("|s| >=", *(f"M_1, {x}" for x in of), *(f"smallest eigenvalue, {x}" for x in of)), rows),
        **render_blocks(
            "claims/set-point-gradient-bound",
            used=used,
            error=error,
            asymmetry=asymmetry,
            factor=tail[1].norm * tail[1].margin ** 3,
            exponent=exponent,
            gain=gain,
            margin=_margin_where(assembled, gain),
        ),
    )


def _margin_where(branch: list[Bound], norm: float) -> float:
    """Return the margin at which M_1 has a given value, by interpolation of log M_1 over log s_min."""
    s, m = (np.log([getattr(bound, name) for bound in branch]) for name in ("margin", "norm"))
    return float(np.exp(np.interp(np.log(norm), m, s)))


def gain_claim(
    case: Case, proof: Certificate, certificates: dict[str, tuple[Case, Certificate]], run: Run, figures: Path
) -> Claim:
    """Return the verdict by the certificate of the scene's case, with those of other cases in the table."""
    rows = tuple(
        (
            name,
            c.status,
            f"{c.level:.3g}",
            f"{c.safe_level:.3g}",
            "undefined" if np.isnan(c.smallest_eigenvalue) else f"{c.smallest_eigenvalue:.3g}",
            f"{c.smallest_margin:.3g}",
            f"{c.points}",
        )
        for name, (_, c) in certificates.items()
    )
    entered = run.t[int(np.argmax(run.lyapunov <= proof.safe_level))] if run.lyapunov is not None else np.nan
    certified = sum(c.status == "certified" for _, c in certificates.values())
    return Claim(
        key="set-point-gain-condition",
        verdict="holds" if proof.status == "certified" else "holds with a condition",
        figures=(draw_set(case, proof, run, DIVISIONS, figures),),
        table=(
            (
                "start, gain",
                "verdict",
                "V_L(start) (J)",
                "safe up to (J)",
                "smallest eigenvalue",
                "smallest |s|",
                "points",
            ),
            rows,
        ),
        **render_blocks(
            "claims/set-point-gain-condition",
            certificate=proof,
            entered=entered,
            cases=len(rows),
            certified=certified,
        ),
    )


def uniqueness_claim(
    certificates: dict[str, tuple[Case, Certificate]], solutions: Mapping[str, list[Equilibrium]]
) -> Claim:
    """Return the verdict on the uniqueness of eq. 15's solution in certified cases; the last case has a low gain."""
    unique = all(len(solutions[name]) == 1 for name, (_, c) in certificates.items() if c.status == "certified")
    rows = tuple((name, certificates[name][1].status, *_count(some)) for name, some in solutions.items())
    own_name, low_name = next(iter(rows))[0], next(reversed(certificates))
    end = simulate(SCENE, {**LOW_GAIN, "t_end": 60.0})
    q = np.array([end.q_tree[-1, end.column(name)] for name in end.independent])
    distance = min(float(np.abs(q - x.q).max()) for x in solutions[low_name] if x.kind == "minimum")
    target = certificates[own_name][0].controller.q_d
    return Claim(
        key="set-point-unique",
        verdict="holds" if unique else "does not hold",
        commands=(f"ckc run {SCENE} --set controller.K_P=0.5 --set t_end=60",),
        table=(("start, gain", "gain condition", "solutions", "stable", "stable at (rad)"), rows),
        **render_blocks(
            "claims/set-point-unique",
            unique=unique,
            solutions_of_scene=len(solutions[own_name]),
            low=len(solutions[low_name]),
            end=q,
            distance=distance,
            target=target,
        ),
    )


def _count(equilibria: list[Equilibrium]) -> tuple[str, str, str]:
    minima = [f"({_numbers(x.q)})" for x in equilibria if x.kind == "minimum"]
    return str(len(equilibria)), str(len(minima)), " ".join(minima)


def _numbers(q: Array) -> str:
    return ", ".join(f"{x:.4f}" for x in q)
