"""The numbers of a mechanism that are arguments of its written-out code: what may vary without compiling anew."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Arguments", "constant", "labels", "near", "present", "values"]

NEGLIGIBLE = 1e-14  # what is below is zero, and what is that near to one or minus one is that


def present(given: Mapping[str, Array]) -> dict[str, BoolArray]:
    """Which numbers are arguments: what is zero is left out of the code, so that a planar mechanism's is planar."""
    return {name: np.abs(x) > NEGLIGIBLE for name, x in given.items()}


def values(given: Mapping[str, Array], which: Mapping[str, BoolArray]) -> Array:
    """Return the arguments, in the order of `Arguments.vector`."""
    return np.concatenate([np.asarray(x, dtype=float)[which[name]] for name, x in given.items()])


def labels(mechanism: Mechanism, which: Mapping[str, BoolArray]) -> list[str]:
    """Name the arguments, in the same order: what carries them, what they are, and the axis."""
    rows = [".".join(name) for name in mechanism.closure.names]
    carriers = {
        **{name: list(mechanism.tree.model.names) for name in ("offset", "mass", "centre", "inertia")},
        **{name: list(mechanism.coordinates) for name in ("armature", "constant")},
        **{name: list(mechanism.coordinates) for name in ("joint_stiffness", "joint_rest", "joint_damping")},
        **dict.fromkeys(("length", "affine", "affine_offset"), rows),
    }
    found = []
    for name, there in which.items():
        for index in np.argwhere(there):
            axes = "".join("xyz"[k] for k in index[1:]) if there.shape[1:] in ((3,), (3, 3)) else ""
            if name == "gravity":
                carrier, axes = "", "xyz"[index[0]]
            elif name == "affine":
                carrier, axes = carriers[name][index[0]], mechanism.coordinates[index[1]]
            elif name in carriers:
                carrier = carriers[name][index[0]]
            else:
                carrier, axes = "", ".".join([str(index[0]), *axes])
            found.append(".".join(part for part in (carrier, name, axes) if part))
    return found


class Arguments:
    """Symbols for those numbers.

    Parameters
    ----------
    which : mapping of str to bool arrays
        As `present` gives it.

    Attributes
    ----------
    vector : casadi.SX
    places : list of (str, tuple of int)
        What each of them is, and where in the array of that name.
    groups : list of lists of int
        Places in it of what changes together: a body's mass, centre and inertia; of other numbers all of a kind.
    """

    def __init__(self, which: Mapping[str, BoolArray]) -> None:
        import casadi as cs

        self._symbols: dict[str, dict[tuple[int, ...], Any]] = {}
        for name, there in which.items():
            at = [tuple(int(i) for i in index) for index in np.argwhere(there)]
            self._symbols[name] = {index: cs.SX.sym("_".join([name, *map(str, index)])) for index in at}
        self.vector = cs.vertcat(*(symbol for found in self._symbols.values() for symbol in found.values()))
        groups: dict[object, list[int]] = {}
        self.places = [(name, index) for name, found in self._symbols.items() for index in found]
        for place, (name, (first, *_)) in enumerate(self.places):
            groups.setdefault(first if name in ("mass", "centre", "inertia") else name, []).append(place)
        self.groups = [*groups.values()]

    def number(self, name: str, *index: int) -> Any:
        """Return one of them, a structural zero where there is none."""
        import casadi as cs

        return self._symbols[name].get(tuple(int(k) for k in index), cs.SX(1, 1))

    def column(self, name: str, *index: int) -> Any:
        """Return three of them as a column."""
        import casadi as cs

        return cs.vertcat(*(self.number(name, *index, k) for k in range(3)))

    def symmetric(self, name: str, *index: int) -> Any:
        """Return nine of them as a matrix, of which the lower triangle is read."""
        import casadi as cs

        rows = [[self.number(name, *index, max(i, j), min(i, j)) for j in range(3)] for i in range(3)]
        return cs.vertcat(*(cs.horzcat(*row) for row in rows))


def near(given: Array) -> Array:
    """Return plain numbers, of which those that are almost zero or one are."""
    found = np.array(given, dtype=float)
    for whole in (0.0, 1.0, -1.0):
        found[np.abs(found - whole) <= NEGLIGIBLE] = whole
    return found


def constant(given: Array) -> Any:
    """Return a matrix of plain numbers, without what is zero and with ones that are ones."""
    import casadi as cs

    return cs.sparsify(cs.SX(near(given)))
