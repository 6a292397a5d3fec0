"""Assembly branches at the present q: a list, and a ghost for each branch other than the present one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.base.summary import format_quantities
from ckc_pin.errors import InputError
from ckc_pin.explorer.messages import BranchList
from ckc_pin.explorer.paths import BRANCHES
from ckc_pin.kinematics.sigma import assembly_branches
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation
from ckc_pin.view import bodies, commands
from ckc_pin.view.commands import Command
from ckc_pin.view.geometry import compute_placements

__all__ = ["draw_branches", "find_branches", "list_branches"]

MAX_LISTED = 24  # branches; more of them mean that the mechanism can move at this q
OPACITIES = (0.36, 0.12)  # of the first and of the last ghost
DIGITS = 4  # of a coordinate in the list


def find_branches(mechanism: Mechanism, at: Kinematics) -> list[Kinematics]:
    """Return the closed configurations at the q of a configuration, this one first, by a search of up to seconds.

    Angles are within half a turn of the middle of their stops, or of the present angle, where that closes the loops.

    Parameters
    ----------
    mechanism : Mechanism
        May be another copy than that of `at`, for use in another thread.
    at : Kinematics
        A closed configuration.

    Raises
    ------
    InputError
        The mechanism is too large for the search, or has a free root.
    """
    here = mechanism.kinematics(at.q_tree)
    first, *others = assembly_branches(mechanism, here)
    return [first, *(_unwind(mechanism, here, branch) for branch in others)]


def list_branches(mechanism: Mechanism, at: Kinematics) -> tuple[list[Kinematics], BranchList]:
    """Return the branches at the q of a configuration, and the report with a line of text for each.

    The list is empty, with a note, if the mechanism is too large for the search. At most `MAX_LISTED` are listed.
    """
    try:
        branches = find_branches(mechanism, at)
    except InputError as error:
        return [], BranchList(branches=[], current=0, note=str(error))
    note = "there is no other branch at this q" if len(branches) == 1 else ""
    if len(branches) > MAX_LISTED:
        note = (
            f"the first {MAX_LISTED} of {len(branches)} configurations: with so many, the mechanism can move although "
            "q stands still"
        )
    branches = branches[:MAX_LISTED]
    lines = [f"{k + 1}: {_describe(mechanism, branch)}" for k, branch in enumerate(branches)]
    return branches, BranchList(branches=lines, current=0, note=note)


def draw_branches(mechanism: Mechanism, branches: Sequence[Kinematics], current: int) -> list[Command]:
    """Return the commands that replace all ghosts by those of a list of branches, except the current one.

    Ghosts are the paler the later they stand in the list. An empty list removes all of them.
    """
    drawing = [commands.delete(BRANCHES)]
    for k, branch in enumerate(branches):
        if k != current:
            root = f"{BRANCHES}/{k + 1}"
            poses = compute_placements(mechanism, branch.q_tree[None])
            opacity = float(np.interp(k, [0, max(len(branches) - 1, 1)], OPACITIES))
            appearance = bodies.Appearance(opacity, bodies.GHOST.colour, is_ghost=True)
            drawing += bodies.draw_bodies(mechanism, root, poses, appearance)
            drawing += bodies.place_bodies(mechanism, root, poses)
    return drawing


def _describe(mechanism: Mechanism, branch: Kinematics) -> str:
    tree, z = mechanism.tree, mechanism.partition.z
    units = [tree.units()[k] for k in z]
    text = ", ".join(format_quantities(mechanism.dependent, tree.to_coordinates(branch.q_tree)[z], units, DIGITS))
    violation = describe_stop_violation(mechanism, branch.q_tree)
    return f"{text}; {violation}" if violation else text


def _unwind(mechanism: Mechanism, here: Kinematics, branch: Kinematics) -> Kinematics:
    """Return a branch without whole turns of its angles. Couplings may need these turns; then it stays as it is."""
    z = [k for k in mechanism.partition.z if not mechanism.tree.in_metres[k]]
    lower, upper = mechanism.tree.limits()
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = here.q_tree.copy()
    middle[bounded] = 0.5 * (lower[bounded] + upper[bounded])
    q_tree = branch.q_tree.copy()
    q_tree[z] -= 2 * np.pi * np.round((q_tree[z] - middle[z]) / (2 * np.pi))
    unwound = mechanism.kinematics(q_tree)
    is_closed = np.abs(unwound.phi).max(initial=0.0) <= max(mechanism.tolerance, np.abs(branch.phi).max(initial=0.0))
    return unwound if is_closed else branch
