"""Runs that share a figure: their names, lines and colours, and how much time is worth showing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.desired import DesiredPath
from ckc_pin.view.labels import plain, run_labels

__all__ = ["Group", "columns"]

SETTLED = 0.01  # of the error at the start


@dataclass(frozen=True)
class Group:
    """Runs of one mechanism under one kind of control, to be drawn on each other.

    Attributes
    ----------
    kind : "set_point", "tracking", "own" (a controller that is not the scene's) or "motion"
    runs : list of Run
        In drawing order.
    wanted : list of DesiredPath or None
    small : bool
        Whether the panels are, each with one name alone.
    """

    kind: str
    runs: list[Run]
    wanted: list[DesiredPath | None]
    small: bool = False

    @property
    def mechanism(self) -> Mechanism:
        """The first run's; the others have the same coordinates."""
        return self.runs[0].mechanism

    @property
    def independent(self) -> tuple[str, ...]:
        """The independent coordinates."""
        return self.runs[0].independent

    @property
    def end(self) -> float:
        """How much time was simulated, s."""
        return max(float(run.t[-1]) for run in self.runs)

    @cached_property
    def lines(self) -> list[dict[str, Any]]:
        """Each run's line."""
        return style.lines(self.runs)

    @cached_property
    def labels(self) -> list[str]:
        """Each run's name."""
        ends = ["" if r.status == "done" else f" ({r.status} at {r.t[-1]:.4g} s)" for r in self.runs]
        return [plain(label) + end for label, end in zip(run_labels(self.runs), ends, strict=True)]

    @cached_property
    def shown_names(self) -> list[str]:
        """What the figure has curves of: of a motion all coordinates, otherwise the independent ones and the motors."""
        run = self.runs[0]
        others = [name for name in run.coordinates if name not in self.independent]
        return list(dict.fromkeys([*self.independent, *(others if self.kind == "motion" else run.actuated)]))

    @cached_property
    def colours(self) -> dict[str, str]:
        """A colour for each coordinate and motor: their own for the few that move or push most, grey for the rest."""
        sizes = {name: self._size(name) for name in self.shown_names}
        first = {name: sizes[name] for name in self.independent}
        own = style.foremost(first)
        if len(own) < style.MOST:
            rest = {name: size for name, size in sizes.items() if name not in first}
            own += style.foremost(rest)[: style.MOST - len(own)]
        return dict.fromkeys(sizes, style.REST) | style.colours(own)

    def _size(self, name: str) -> float:
        """How far a coordinate goes, in radians or in the mechanism's size, or how hard a motor pushes."""
        run = self.runs[0]
        if name in run.coordinates:
            unit = float(self.mechanism.tree.step_scale[run.column(name)])
            return float(max(np.ptp(run.q_tree[:, run.column(name)]) for run in self.runs)) / unit
        return float(max(np.abs(run.tau[:, run.actuated.index(name)]).max() for run in self.runs))

    def in_one_colour(self) -> Group:
        """Return the same runs for panels that each have one name alone."""
        found = replace(self, small=True)
        found.__dict__["colours"] = dict.fromkeys(self.runs[0].coordinates + self.runs[0].actuated, style.COLOURS[0])
        return found

    @cached_property
    def shown(self) -> float:
        """How much time the panels show, s: of a motion that settles early, its first part."""
        if self.kind != "set_point":
            return self.end
        settled = 0.0
        for run, wanted in zip(self.runs, self.wanted, strict=True):
            if wanted is not None:
                size = np.abs(run.q_tree[:, columns(run, run.independent)] - wanted.q).max(axis=1)
                settled = max(settled, float(run.t[np.flatnonzero(size >= SETTLED * size[0])[-1]]))
        return min(self.end, 2.0 * settled) or self.end

    @cached_property
    def desired(self) -> list[tuple[Run, DesiredPath]]:
        """What was wanted, once where several runs want the same, as long as the longest of them."""
        found: dict[str, tuple[Run, DesiredPath]] = {}
        for run, wanted in sorted(zip(self.runs, self.wanted, strict=True), key=lambda pair: -pair[0].t[-1]):
            if wanted is not None:
                controller = run.scene["controller"]
                found.setdefault(repr(controller.get("desired", controller.get("q_d"))), (run, wanted))
        return list(found.values())


def columns(run: Run, names: tuple[str, ...] | list[str]) -> list[int]:
    """Return the columns of coordinates."""
    return [run.column(name) for name in names]
