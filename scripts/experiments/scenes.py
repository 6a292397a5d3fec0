"""Compare the runs of all shipped scenes with SciPy on the same equations, in units of their tolerance."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from ckc_pin import InputError, as_ivp, load, simulate
from ckc_pin.analysis.precision.motion import FORMULATIONS
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.scene.names import list_catalogue

REFERENCE_RTOL = 1e-11
MAX_ERROR = 100  # largest error of a run over its tolerance
# s: NumPy takes a millisecond per right-hand side, and chaotic motions amplify errors later.
SPANS = {"andrews": 0.01, "delta": 0.1, "stewart": 0.05, "talos": 0.01, "two_ur5": 0.1}
SPAN = 0.3
FRICTION_SMOOTHING = 0.1  # rad/s; without it the right-hand side of sticking joints is not a function of t and y


def relative_error(scene: str, overrides: dict[str, Any]) -> tuple[float, str]:
    """Return the largest error of q' and v' over a run, relative to tolerance and largest value, and the method."""
    run = simulate(scene, overrides)
    problem = as_ivp(scene, overrides)
    rows = np.linspace(0, len(run.t) - 1, 5).astype(int)
    # Scenes of eq. 8 are stiff in z only, with the rate 1 / epsilon.
    method = "Radau" if overrides.get("spf_coordinates") == "z" or scene.startswith("flyball") else "DOP853"
    solution = solve_ivp(
        problem.f,
        (0.0, run.t[-1]),
        problem.y0,
        method,
        t_eval=run.t[rows],
        rtol=REFERENCE_RTOL,
        atol=REFERENCE_RTOL / 100,
    )
    assert solution.success, solution.message
    error = 0.0
    for row, y in zip(rows, solution.y.T, strict=True):
        q_tree = problem.mechanism.tree.to_coordinates(problem.terms(run.t[row], y).q_tree)
        for ours, theirs in ((run.q_tree[row], q_tree), (run.v_tree[row], problem.velocity(run.t[row], y))):
            error = max(error, np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))
    return error / run.scene["solver"]["rtol"], run.stats["method"]


def main() -> int:
    """Print the table; return 1 if an error is too large."""
    print("| scene | " + " | ".join(FORMULATIONS) + " |\n|---|" + "---|" * len(FORMULATIONS))
    bad = 0
    with one_blas_thread():
        for name, _, scenes in list_catalogue():
            for scene in scenes:
                cells = []
                smooth = {"friction_smoothing": FRICTION_SMOOTHING} if load(name).joints.friction.any() else {}
                for overrides in FORMULATIONS.values():
                    span = SPANS.get(name, SPAN)
                    try:
                        error, method = relative_error(
                            f"{name}/{scene}", {**overrides, **smooth, "t_end": span, "solver.output_dt": span / 20}
                        )
                    except InputError:
                        cells.append("refused")
                        continue
                    bad += not error <= MAX_ERROR
                    cells.append(f"{error:.2g} {method}")
                print(f"| {name}/{scene} | " + " | ".join(cells) + " |", flush=True)
    return 1 if bad else 0
