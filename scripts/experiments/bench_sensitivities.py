"""What sensitivities cost: processor time of the loop with p parameters by that without."""

from __future__ import annotations

from time import process_time

from ckc_pin.run.simulate import record_rows
from ckc_pin.sensitivity.parameters import derivatives_of
from scripts.experiments.bench import ready

# A scene, its tolerance, and names of which the first p vary.
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
    """Of runs with 1, 2 and 6 parameters: seconds by those of a run without, and right-hand sides by its own.

    The least of several, taken in turns.
    """
    overrides = {"formulation": "dae", "solver.rtol": rtol, "solver.terms": terms}
    runs = [ready(scene, overrides, derivatives=derivatives_of(names[:p]) if p else None) for p in (0, *NUMBERS)]
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in range(TIMES):
        for run, found in zip(runs, seconds, strict=True):
            began = process_time()
            record_rows(run)
            found.append(process_time() - began)
    least, rhs = [min(found) for found in seconds], [run.loop.stats()["rhs"] for run in runs]
    return [(a / least[0], b / rhs[0]) for a, b in zip(least[1:], rhs[1:], strict=True)]


def main(only: str = "") -> int:
    """Print a Markdown table of the lines with some words; return 1 when one written out takes more than 1 + p."""
    print("| run | terms |", *(f"p = {p} |" for p in NUMBERS), "\n|---|---|---:|---:|---:|")
    missed = 0
    for scene, rtol, names in RUNS:
        for terms, says in TERMS.items():
            if only not in f"sensitivities, {scene}, {says}":
                continue
            found = ratios(scene, rtol, names, terms)
            missed += terms == "generated" and any(x > 1 + p for p, (x, _) in zip(NUMBERS, found, strict=True))
            cells = " | ".join(f"{x:.2f}, {n:.2f} right-hand sides" for x, n in found)
            print(f"| `{scene}`, `rtol = {rtol:g}` | {says} | {cells} |", flush=True)
    return 1 if missed else 0
