"""Answer the paper's statements on tracking control (sections II-C and III-C)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import Tracking
from ckc_pin.control.desired import Harmonics
from ckc_pin.control.spec import MotionSpec
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import load
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.deviations import PERIOD, Deviation
from scripts.experiments.paper.lyapunov import Record
from scripts.experiments.paper.tracking_experiments import (
    ON_MANIFOLD,
    SETTINGS,
    SINCE,
    START,
    W0,
    WHOLE,
    deviations,
    lyapunov_along,
    off_manifold,
)
from scripts.experiments.paper.tracking_figures import draw_deviations, draw_lyapunov
from scripts.experiments.paper.tracking_identities import Skewness, claimed_form, printed_form, rate_form, skewness

__all__ = ["accepted", "claims", "deviations_claim", "gains_claim", "lyapunov_claim", "skew_claim"]

RATE_TOLERANCE = 1e-7  # relative: derivative of the recorded function by a spline against eq. 19
SKEW = 1e-8  # relative: differences of D against C
EXACT = 1e-8  # rad: largest difference at tight tolerances
SEEN = 1e-7  # rad: smaller deviations are rounding errors, whose period has no meaning
SHOWN = (
    "controller's own sigma to 1e-2 m",
    "reduced: BDF, rtol 1e-2",
    "SPF, eq. 8: BDF, rtol 1e-2",
    "reduced: Radau, rtol 1e-3",
    "SPF, eq. 8: Radau, rtol 1e-3",
    "sigma of both to 1e-2 m",
)
PERIODIC = 0.9  # share of a deviation's variance from which it counts as periodic
STATES = 30
LAYERS = (1e-3, 1e-4)  # epsilons of runs through the boundary layer; the first run is drawn

VELOCITY: dict[CoriolisVelocity, str] = {"rho": "rho q_dot", "actual": "the actual velocity"}
OffManifold = tuple[float, CoriolisVelocity, bool]  # epsilon, velocity of C, whether the run starts moving


def claims(figures: Path) -> list[Claim]:
    """Run the experiments on eqs. 16 to 19 and write their figures into a folder; return the claims."""
    first = {name: lyapunov_along({**how, **START}) for name, how in ON_MANIFOLD.items()}
    later = {name: lyapunov_along({**how, **WHOLE}, SINCE) for name, how in ON_MANIFOLD.items()}
    off = {
        (epsilon, convention, moving): off_manifold(epsilon, convention, moving)
        for epsilon in LAYERS
        for convention in VELOCITY
        for moving in (False, True)
    }
    skew = {epsilon: skewness(load("five_bar"), STATES, epsilon) for epsilon in (1e-2, *LAYERS)}
    apart = deviations({name: x for group in SETTINGS.values() for name, x in group.items()})
    return [
        lyapunov_claim(first, later, off, figures),
        skew_claim(skew),
        gains_claim(),
        deviations_claim(*apart, figures),
    ]


# --- eqs. 18 and 19 along runs -----------------------------------------------------------------------------------


def lyapunov_claim(
    first: Mapping[str, Record], later: Mapping[str, Record], off: Mapping[OffManifold, Record], figures: Path
) -> Claim:
    """Return the verdict on records from w(0) = 0 by formulation, and on records from off the manifold."""
    rows = [(name, "0", "either", *_cells(x)) for name in first for x in (first[name], later[name])]
    rows += [
        (f"SPF, eq. 17, ε = {epsilon:g}, {'moving' if moving else 'at rest'}", str(W0), VELOCITY[name], *_cells(x))
        for (epsilon, name, moving), x in off.items()
    ]
    on = [*first.values(), *later.values()]
    rho, actual = (max(x.mismatch for key, x in off.items() if key[1] == name) for name in VELOCITY)
    kept = all(x.mismatch <= RATE_TOLERANCE and x.monotone for x in on) and actual <= RATE_TOLERANCE
    rising = sum(not x.monotone for x in (*on, *off.values()))
    whole = next(iter(later.values()))
    layer = next(iter(off))[0]
    drawn = {f"C at {VELOCITY[name]}": off[layer, name, True] for name in VELOCITY}
    return Claim(
        key="tracking-lyapunov",
        verdict="does not hold" if not kept else "holds" if rho <= RATE_TOLERANCE else "holds with a condition",
        figures=(draw_lyapunov(whole, drawn, layer, figures),),
        table=(("run", "w(0) (m)", "C at", "t (s)", "rate: relative difference", "V rises by (J)"), tuple(rows)),
        **render_blocks(
            "claims/tracking-lyapunov",
            on=max(x.mismatch for x in on),
            start=next(iter(first.values())).value[0],
            end=whole.value[-1],
            t_end=whole.t[-1],
            w=W0,
            actual=actual,
            rho=rho,
            rising=rising,
            records=len(on) + len(off),
        ),
    )


def _cells(record: Record) -> tuple[str, str, str]:
    span = f"{record.t[0]:g} to {record.t[-1]:g}"
    return span, f"{record.mismatch:.1e}", "-" if record.largest_increase <= 0 else f"{record.largest_increase:.1e}"


# --- assumptions of eq. 19 ---------------------------------------------------------------------------------------


def skew_claim(by_epsilon: Mapping[float, Skewness]) -> Claim:
    """Return the verdict on the skew-symmetry of D_dot - 2 C, by epsilon."""
    rows = tuple(
        (f"{e:g}", f"{x.on:.1e}", f"{x.off_rho_rho:.1e}", f"{x.off_actual_actual:.1e}", f"{x.off_actual_rho:.2g}")
        for e, x in by_epsilon.items()
    )
    on, level, actual = (
        max(getattr(x, name) for x in by_epsilon.values()) for name in ("on", "off_rho_rho", "off_actual_actual")
    )
    mixed = [x.off_actual_rho for x in by_epsilon.values()]
    return Claim(
        key="tracking-skew",
        verdict=(
            "does not hold" if max(on, level, actual) > SKEW
            else "holds" if max(mixed) <= SKEW
            else "holds with a condition"
        ),
        table=(
            ("epsilon", "phi = 0", "off: level set, C at rho q_dot", "off: actual, C at actual",
             "off: actual, C at rho q_dot"),
            rows,
        ),
        **render_blocks(
            "claims/tracking-skew", states=next(iter(by_epsilon.values())).states, on=on, actual=actual,
            mixed=(min(mixed), max(mixed)), level=level,
        ),
    )  # fmt: skip


ONE = np.eye(2)
FULL = np.array([[10.0, 3.0], [3.0, 5.0]])
GAINS: dict[str, tuple[Array, Array]] = {
    "Lambda = I, K_D = 10 I (eq. 22)": (ONE, 10 * ONE),
    "both diagonal": (np.diag([1.0, 3.0]), np.diag([10.0, 2.0])),
    "Lambda = K_D^-1 S, S symmetric": (np.linalg.solve(FULL, np.array([[20.0, 4.0], [4.0, 8.0]])), FULL),
    "Lambda diagonal, K_D full": (np.diag([1.0, 3.0]), FULL),
    "Lambda = ((1, 1.5), (-1.5, 10)), K_D = I": (np.array([[1.0, 1.5], [-1.5, 10.0]]), ONE),
}


def gains_claim() -> Claim:
    """Return the verdict on eqs. 18 and 19 as quadratic forms, for several kinds of gains."""
    rows, fits, misfits = [], list[float](), list[float]()
    for name, (Lambda, K_D) in GAINS.items():
        A, form = Lambda.T @ K_D, rate_form(Lambda, K_D)
        symmetric = bool(np.abs(A - A.T).max() <= 1e-12 * np.abs(A).max())
        gap, printed = (float(np.abs(form - f(Lambda, K_D)).max()) for f in (claimed_form, printed_form))
        (fits if symmetric else misfits).append(gap)
        lows = (f"{np.linalg.eigvalsh(x)[0]:.3g}" for x in ((A + A.T) / 2, form))
        rows.append((name, _yes(symmetric), f"{gap:.2g}", f"{printed:.2g}", *lows, _yes(accepted(Lambda, K_D))))
    return Claim(
        key="tracking-gains",
        verdict="holds with a condition" if max(fits) <= 1e-10 < min(misfits) else "does not hold",
        table=(
            ("gains", "Lambda^T K_D symmetric", "last line: off by", "line before: off by",
             "smallest eigenvalue: Lambda^T K_D", "smallest eigenvalue: -dV_1/dt", "accepted by the program"),
            tuple(rows),
        ),
        **render_blocks("claims/tracking-gains",
                        fit=max(fits), misfit=min(misfits), eigenvalue=rows[-1][5], printed=rows[0][3]),
    )  # fmt: skip


def _yes(answer: bool) -> str:
    return "yes" if answer else "no"


def accepted(Lambda: Array, K_D: Array) -> bool:
    """Whether `Tracking` accepts the gains."""
    desired = Harmonics([MotionSpec(), MotionSpec()])
    try:
        Tracking(Lambda, K_D, desired)
    except InputError:
        return False
    return True


# --- section III-C: "the more exact reduced model periodically sees some deviations" -----------------------------


def deviations_claim(t: Array, error: Array, by_setting: Mapping[str, Deviation], figures: Path) -> Claim:
    """Return the verdict on deviations from the exact run, by setting of `SETTINGS`."""
    tight, loose, shared, separate = ([by_setting[name] for name in group] for group in SETTINGS.values())
    largest = max(x.largest for x in tight)
    periodic = [name for name, x in by_setting.items() if _periodic(x)]
    return Claim(
        key="tracking-deviations",
        verdict="does not hold" if largest < EXACT else "holds",
        figures=(draw_deviations(t, error, {name: by_setting[name] for name in SHOWN}, figures),),
        table=(
            ("run", "largest deviation (rad)", "share that repeats", "strongest period (2π s)", "largest |phi| (m)"),
            tuple((name, *_deviation_cells(x)) for name, x in by_setting.items()),
        ),
        **render_blocks(
            "claims/tracking-deviations",
            tight=largest,
            loose=(min(x.largest for x in loose), max(x.largest for x in loose)),
            loose_repeats=max(x.repeats for x in loose),
            shared=max(x.largest for x in shared),
            shared_open=max(x.open for x in shared),
            separate=max(x.largest for x in separate),
            separate_open=max(x.open for x in separate),
            separate_repeats=min(x.repeats for x in separate),
            share=PERIODIC,
            periodic=periodic,
        ),
    )


def _periodic(x: Deviation) -> bool:
    return x.largest > SEEN and x.repeats > PERIODIC


def _deviation_cells(x: Deviation) -> tuple[str, ...]:
    repeating = (f"{x.repeats:.2f}", f"{x.period / PERIOD:.2g}") if x.largest > SEEN else ("", "")
    return f"{x.largest:.1e}", *repeating, f"{x.open:.0e}"
