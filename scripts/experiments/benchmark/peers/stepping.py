"""A work by a program with a fixed step, refused where that would take longer than the budget."""

from __future__ import annotations

from ckc_pin.analysis.precision.motion import FixedStepProgram, Motion, motion_without_data
from ckc_pin.base.arrays import Array
from ckc_pin.scene.initial import find_start
from scripts.experiments.benchmark.work import INSTANTS, Work

__all__ = ["CONTROLLED", "divided", "halved", "start_of", "stepped"]

# why a program is not run on a controlled motion
CONTROLLED = (
    "the law of a controlled motion needs D, C and h of the reduced model, which it does not give; to call ours from "
    "it would time ours"
)

State = tuple[Array, Array]  # q_tree, v_tree by coordinate


def start_of(work: Work) -> State:
    """Return Pinocchio's q_tree and the v_tree that a work starts with."""
    start = find_start(work.mechanism, work.load())
    return start.at.q_tree, start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree


def halved(work: Work, coarsest: float, many: int) -> list[float]:
    """Return steps that halve from the coarsest on, shorter by as much as a motion is shorter than two seconds."""
    first = coarsest * min(1.0, work.t_end / 2)
    return [first / 2**k for k in range(many)]


def divided(work: Work, dt: float) -> float:
    """Return the step nearest to dt of which whole ones lead from instant to instant."""
    between = work.t_end / INSTANTS
    return between / max(1, round(between / dt))


def stepped(work: Work, dt: float, program: FixedStepProgram, budget: float) -> Motion:
    """Run a work with a fixed step, the nearest to dt that divides the instants; a budget in s."""
    many = round(work.t_end / INSTANTS / divided(work, dt))
    try:
        foreseen = program.estimate_wall_s(many, INSTANTS)
        if foreseen > budget:
            return motion_without_data("refused", f"would take {foreseen:.0f} s, the budget is {budget:.0f} s")
        return program.run(many, INSTANTS)
    except Exception as error:  # whatever a program raises where its solver fails
        return motion_without_data("failed", " ".join(str(error).split()) or type(error).__name__)
