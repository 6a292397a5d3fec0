"""Benchmark of sensitivities: processor time of the loop with p parameters over the time without."""

from __future__ import annotations

from time import process_time

from ckc_pin.run.simulate import record_rows
from ckc_pin.sensitivity.parameters import sensitivity_setup
from scripts.experiments.bench import prepare_scene

# A scene, its tolerance, and parameter names; the first p of them get sensitivities.
RUNS = (
    ("five_bar/swing", 1e-9, ("link.link_2.mass", "initial.q.theta_1", "link.link_3.mass", "gravity.y",
                              "link.link_2.com.x", "joint.theta_2.xyz.x")),
    ("delta", 1e-6, ("link.plate.mass", "initial.q.arm_1", "link.arm_link_1.mass", "gravity.z",
                     "link.arm_link_2.com.x", "initial.q_dot.arm_2")),
    ("five_bar/set_point", 1e-8, ("link.link_2.mass", "controller.K_P", "controller.q_d.theta_1", "gravity.y",
                                  "initial.q_dot.theta_1", "link.link_3.mass")),
)  # fmt: skip
NUMBERS, TIMES = (1, 2, 6), 25
TERMS = {"pinocchio": "Pinocchio's", "generated": "generated"}


def ratios(scene: str, rtol: float, names: tuple[str, ...], terms: str) -> list[tuple[float, float]]:
    """Compare runs with 1, 2 and 6 parameters with a run without: ratios of seconds and of right-hand sides.

    Times are the minimum of several repetitions, with all runs in turn.
    """
    overrides = {"formulation": "dae", "solver.rtol": rtol, "solver.terms": terms}
    runs = [
        prepare_scene(scene, overrides, set_up_sensitivities=sensitivity_setup(names[:p]) if p else None)
        for p in (0, *NUMBERS)
    ]
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in range(TIMES):
        for run, times in zip(runs, seconds, strict=True):
            began = process_time()
            record_rows(run)
            times.append(process_time() - began)
    fastest, rhs = [min(times) for times in seconds], [run.loop.stats().rhs for run in runs]
    return [(a / fastest[0], b / rhs[0]) for a, b in zip(fastest[1:], rhs[1:], strict=True)]


def main(only: str = "") -> int:
    """Print a Markdown table of the lines that contain `only`; return 1 if compiled terms take more than 1 + p."""
    print("| run | terms |", *(f"p = {p} |" for p in NUMBERS), "\n|---|---|---:|---:|---:|")
    missed = 0
    for scene, rtol, names in RUNS:
        for terms, says in TERMS.items():
            if only not in f"sensitivities, {scene}, {says}":
                continue
            pairs = ratios(scene, rtol, names, terms)
            missed += terms == "generated" and any(x > 1 + p for p, (x, _) in zip(NUMBERS, pairs, strict=True))
            cells = " | ".join(f"{x:.2f}, {n:.2f} right-hand sides" for x, n in pairs)
            print(f"| `{scene}`, `rtol = {rtol:g}` | {says} | {cells} |", flush=True)
    return 1 if missed else 0
