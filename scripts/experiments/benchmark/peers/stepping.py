"""Run a work by a program with a fixed step; refuse it if it would take longer than the budget."""

from __future__ import annotations

from ckc_pin.analysis.precision.motion import FixedStepProgram, Motion, motion_without_data
from ckc_pin.base.arrays import Array
from ckc_pin.scene.initial import find_start
from scripts.experiments.benchmark.work import INSTANTS, Work

__all__ = ["CONTROLLED", "dividing_step", "halved_steps", "run_fixed_step", "start_of"]

# Why a program is not compared on controlled motions.
CONTROLLED = (
    "the law of a controlled motion needs D, C and h of the reduced model, which it does not give; to call ours from "
    "it would time ours"
)

State = tuple[Array, Array]  # q_tree of Pinocchio, v_tree


def start_of(work: Work) -> State:
    """Return the start of a work: Pinocchio's q_tree, and v_tree."""
    start = find_start(work.mechanism, work.load())
    return start.at.q_tree, start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree


def halved_steps(work: Work, coarsest: float, many: int) -> list[float]:
    """Return step sizes, halved repeatedly; the coarsest is scaled down for motions shorter than two seconds."""
    first = coarsest * min(1.0, work.t_end / 2)
    return [first / 2**k for k in range(many)]


def dividing_step(work: Work, dt: float) -> float:
    """Return the step nearest to dt that divides the interval between instants."""
    between = work.t_end / INSTANTS
    return between / max(1, round(between / dt))


def run_fixed_step(work: Work, dt: float, program: FixedStepProgram, budget: float) -> Motion:
    """Run a work with a fixed step near dt and a budget in s."""
    many = round(work.t_end / INSTANTS / dividing_step(work, dt))
    try:
        foreseen = program.estimate_wall_s(many, INSTANTS)
        if foreseen > budget:
            return motion_without_data("refused", f"would take {foreseen:.0f} s, the budget is {budget:.0f} s")
        return program.run(many, INSTANTS)
    except Exception as error:  # a program may raise any exception if its solver fails
        return motion_without_data("failed", " ".join(str(error).split()) or type(error).__name__)
