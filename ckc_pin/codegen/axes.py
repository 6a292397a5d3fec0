"""Axes that vectors of a branch are resolved in, and what turns them into those of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.arguments import constant, near

__all__ = ["Axes", "Turns"]


@dataclass(frozen=True)
class Axes:
    """Of the branch that begins with a joint; the world's are those of joint 0."""

    turns: Turns
    joint: int

    def into(self, other: Axes) -> Any:
        """What turns vectors into other axes, (3, 3)."""
        return self.turns.between(self.joint, other.joint)


@dataclass
class Turns:
    """Rotations of axes into each other, constants.

    Where branches are alike, how they are turned against what is none of them are numbers that differ: symbols, even
    for those of one branch that are zero or one, so that all branches do the same.

    Parameters
    ----------
    rotations : sequence of (3, 3) arrays
        Of each joint's own axes, as it is placed, in the world: the world's first. Asked for of roots' alone.
    alike : sequence of sequences of int
        The joints that alike branches begin with.

    Attributes
    ----------
    symbols, values : list of casadi.SX, list of float
    whose : list of (int, (int, int, int))
        The joint that a symbol's branch begins with, and which of its numbers it is.
    """

    rotations: Sequence[Array]
    alike: Sequence[Sequence[int]] = ()
    symbols: list[Any] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    whose: list[tuple[int, tuple[int, int, int]]] = field(default_factory=list)
    _made: dict[tuple[int, int], Any] = field(default_factory=dict)

    def between(self, one: int, other: int) -> Any:
        """Return what turns vectors of the axes of one into those of the other, (3, 3)."""
        if (one, other) not in self._made:
            found = self._between(one, other)
            self._made[one, other], self._made[other, one] = found, found.T
        return self._made[one, other]

    def _between(self, one: int, other: int) -> Any:
        import casadi as cs

        for branch, base in ((one, other), (other, one)):
            group = next((group for group in self.alike if branch in group), [branch])
            if base in group or len(group) == 1:
                continue
            turned = {k: near(self.rotations[k].T @ self.rotations[base]) for k in group}
            differ = np.ptp([*turned.values()], axis=0) > 0
            found = constant(np.where(differ, 0.0, turned[branch]))
            for i, j in np.argwhere(differ).tolist():
                found[i, j] = cs.SX.sym(f"turn_{branch}_{base}_{i}_{j}")
                self.symbols.append(found[i, j])
                self.values.append(turned[branch][i, j])
                self.whose.append((branch, (base, i, j)))
            return found.T if branch == one else found
        return constant(self.rotations[other].T @ self.rotations[one])
