"""Undo and redo: the poses and parameter values after each gesture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array

__all__ = ["PoseHistory", "Snapshot"]

MAX_SNAPSHOTS = 1000


@dataclass(frozen=True)
class Snapshot:
    """A configuration of the tree (nq,), and the parameter values by name that differ from the files."""

    q_tree: Array
    parameters: Mapping[str, float]

    def is_same(self, other: Snapshot) -> bool:
        """Whether another snapshot is of the same configuration and parameters."""
        return np.array_equal(self.q_tree, other.q_tree) and dict(self.parameters) == dict(other.parameters)


class PoseHistory:
    """Snapshots in the order of the gestures, and the place of the present one."""

    def __init__(self, first: Snapshot) -> None:
        self._snapshots, self._place = [first], 0

    @property
    def present(self) -> Snapshot:
        """The snapshot after the last gesture, undo or redo."""
        return self._snapshots[self._place]

    @property
    def can_undo(self) -> bool:
        """Whether there is an earlier snapshot."""
        return self._place > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a later snapshot."""
        return self._place < len(self._snapshots) - 1

    def add(self, snapshot: Snapshot) -> None:
        """Add a snapshot after the present one unless it is the same. Later ones are dropped."""
        if not snapshot.is_same(self.present):
            self._snapshots = [*self._snapshots[: self._place + 1], snapshot][-MAX_SNAPSHOTS:]
            self._place = len(self._snapshots) - 1

    def replace_parameters(self, snapshot: Snapshot) -> None:
        """Let a snapshot take the place of the present one, whose parameters were changed by the same slider."""
        self._snapshots = [*self._snapshots[: self._place], snapshot]

    def undo(self) -> Snapshot:
        """Go to the snapshot before the present one, if there is one, and return it."""
        self._place = max(self._place - 1, 0)
        return self.present

    def redo(self) -> Snapshot:
        """Go to the snapshot after the present one, if there is one, and return it."""
        self._place = min(self._place + 1, len(self._snapshots) - 1)
        return self.present
