"""Runs that are drawn together: their validation, desired motions, labels, line styles and colours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.validation import require_type
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.desired_path import DesiredPath
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.style import escape_mathtext, label_runs

__all__ = ["DesiredPoses", "RunGroup", "compute_desired_poses", "coordinate_columns", "require_runs"]

SETTLING_RATIO = 0.01  # a set-point motion has settled when its error is below this fraction of the initial error


def require_runs(runs: Any, where: str) -> list[Run]:
    """Return one run or several runs as a list.

    Raises
    ------
    InputError
        There is no run, or an element is not a `Run`. `where` names the public function in the message.
    """
    items = list(runs) if isinstance(runs, list | tuple) else [runs]
    if not items:
        raise InputError(f"{where}: no run given; give at least one")
    for item in items:
        require_type(item, Run, f"{where}: runs", "runs, as simulate and Run.load return them")
    return items


# --- desired motion ------------------------------------------------------------------------------


@dataclass(frozen=True)
class DesiredPoses:
    """Desired configurations of the whole mechanism at some output times of a run.

    Attributes
    ----------
    q_tree : (m, nq) array
        Configurations of the tree, Pinocchio's q. Where the desired pose is unreachable, the last reachable one.
    is_reachable : (m,) array of bool
        Whether the mechanism can be assembled at q_d on the branch of the run.
    """

    q_tree: Array
    is_reachable: BoolArray


def compute_desired_poses(run: Run, rows: IntArray) -> DesiredPoses | None:
    """Compute sigma(q_d) at some output times of a run; None if the scene has no desired motion."""
    desired = run.desired_path
    if desired is None:
        return None
    mechanism = run.mechanism
    kinematics = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[rows[0]]))
    poses, is_reachable = [], []
    for q_d in desired.q[rows]:
        solution = sigma(mechanism, q_d, kinematics) if np.all(np.isfinite(q_d)) else None
        is_reachable.append(solution is not None and solution.verdict == "converged")
        kinematics = solution.at if solution is not None and is_reachable[-1] else kinematics
        poses.append(kinematics.q_tree)
    return DesiredPoses(np.array(poses), np.array(is_reachable))


# --- groups --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunGroup:
    """Runs of one mechanism under one kind of control, drawn in the same panels.

    Attributes
    ----------
    kind : "set_point", "tracking", "joint_servo", "own" (a controller written in Python) or "motion" (no control)
    runs : list of Run
        In drawing order.
    desired_paths : list of DesiredPath or None
        One for each run.
    has_small_panels : bool
        Whether each panel shows one coordinate or motor only.
    """

    kind: str
    runs: list[Run]
    desired_paths: list[DesiredPath | None]
    has_small_panels: bool = False

    @property
    def mechanism(self) -> Mechanism:
        """The first run's mechanism; all runs have the same coordinates."""
        return self.runs[0].mechanism

    @property
    def independent(self) -> tuple[str, ...]:
        """The independent coordinates."""
        return self.runs[0].independent

    @property
    def t_end(self) -> float:
        """End time of the longest run, s."""
        return max(float(run.t[-1]) for run in self.runs)

    @cached_property
    def line_styles(self) -> list[dict[str, Any]]:
        """matplotlib's line properties for each run."""
        return style.line_styles(self.runs)

    @cached_property
    def labels(self) -> list[str]:
        """A label for each run, with its status if it did not finish."""
        outcomes = ["" if r.status == "done" else f" ({r.status} at {r.t[-1]:.4g} s)" for r in self.runs]
        return [escape_mathtext(label) + text for label, text in zip(label_runs(self.runs), outcomes, strict=True)]

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Coordinates with curves: all of them without a controller, else the independent ones."""
        return self.runs[0].coordinates if self.kind in ("motion", "prescribed") else self.independent

    @cached_property
    def curve_names(self) -> list[str]:
        """Coordinates and motors with curves; a motion without control has none of motors."""
        motors = () if self.kind == "motion" else self.runs[0].actuated
        return list(dict.fromkeys([*self.independent, *self.coordinates, *motors]))

    @cached_property
    def colours(self) -> dict[str, str]:
        """A colour for each coordinate and motor. Those that move or push least are grey if colours run out."""
        sizes = {name: self._compute_size(name) for name in self.curve_names}
        independent_sizes = {name: sizes[name] for name in self.independent}
        coloured = style.select_largest(independent_sizes)
        if len(coloured) < style.MAX_COLOURS:
            other_sizes = {name: size for name, size in sizes.items() if name not in independent_sizes}
            coloured += style.select_largest(other_sizes)[: style.MAX_COLOURS - len(coloured)]
        return dict.fromkeys(sizes, style.REST_COLOUR) | style.assign_colours(coloured)

    def _compute_size(self, name: str) -> float:
        """Return a coordinate's range, rad or relative to the mechanism's size, or a motor's largest effort."""
        run = self.runs[0]
        if name in run.coordinates:
            unit = float(self.mechanism.tree.step_scale[run.column(name)])
            return float(max(np.ptp(run.q_tree[:, run.column(name)]) for run in self.runs)) / unit
        return float(max(np.abs(run.tau[:, run.actuated.index(name)]).max() for run in self.runs))

    def with_one_colour(self) -> RunGroup:
        """Return a group of the same runs for small panels, in which all curves have the same colour."""
        group = replace(self, has_small_panels=True)
        names = self.runs[0].coordinates + self.runs[0].actuated
        group.__dict__["colours"] = dict.fromkeys(names, style.COLOURS[0])
        return group

    @cached_property
    def t_shown(self) -> float:
        """End of the time axis, s. For set-point control it is twice the settling time, if that is earlier."""
        if self.kind != "set_point":
            return self.t_end
        settling_time = 0.0
        for run, desired in zip(self.runs, self.desired_paths, strict=True):
            if desired is not None:
                error = np.abs(run.q_tree[:, coordinate_columns(run, run.independent)] - desired.q).max(axis=1)
                last_row = np.flatnonzero(error >= SETTLING_RATIO * error[0])[-1]
                settling_time = max(settling_time, float(run.t[last_row]))
        return min(self.t_end, 2.0 * settling_time) or self.t_end

    @cached_property
    def distinct_desired(self) -> list[tuple[Run, DesiredPath]]:
        """Each distinct desired path once, with the longest of the runs that have it."""
        distinct: dict[str, tuple[Run, DesiredPath]] = {}
        for run, desired in sorted(zip(self.runs, self.desired_paths, strict=True), key=lambda pair: -pair[0].t[-1]):
            if desired is not None:
                controller = run.scene["controller"]
                distinct.setdefault(repr(controller.get("desired", controller.get("q_d"))), (run, desired))
        return list(distinct.values())


def coordinate_columns(run: Run, names: tuple[str, ...] | list[str]) -> list[int]:
    """Return the columns of `run.q_tree` that belong to coordinates."""
    return [run.column(name) for name in names]
