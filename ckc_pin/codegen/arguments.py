"""Arguments of compiled terms: numbers of a mechanism that may change without compiling again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import list_line_springs, list_loop_frames, list_spring_ends
from ckc_pin.mechanism.units import ROTOR, STIFF, VISCOUS, effort, row_units

__all__ = ["Arguments", "argument_names", "argument_units", "constant", "present", "snap_to_units", "values"]

NEGLIGIBLE = 1e-14  # numbers closer than this to 0, 1 or -1 are replaced by it


def present(numbers: Mapping[str, Array]) -> dict[str, BoolArray]:
    """Return which numbers are arguments. Zeros are not, so that the code of a planar mechanism is planar."""
    return {name: np.abs(x) > NEGLIGIBLE for name, x in numbers.items()}


def values(numbers: Mapping[str, Array], which: Mapping[str, BoolArray]) -> Array:
    """Return the arguments, in the order of `Arguments.vector`."""
    return np.concatenate([np.asarray(x, dtype=float)[which[name]] for name, x in numbers.items()])


def argument_names(mechanism: Mechanism, which: Mapping[str, BoolArray]) -> list[str]:
    """Name the arguments in the order of `Arguments.vector`, as parameters are named: ``link.link_2.mass``.

    Mass, com and inertia are those of the whole body that a joint moves, in the joint's frame. Numbers without a
    parameter of their own are named by the joint or row that they belong to.
    """
    tree, spec = mechanism.tree, mechanism.spec
    joints, links = list(tree.model.names), mechanism.frames.bodies
    rows = [".".join(row) for row in mechanism.closure.names]
    lines = list_line_springs(spec)
    points, ends = ([name for name, _ in frames] for frames in (list_loop_frames(spec), list_spring_ends(spec)))
    entry = "xyz".__getitem__
    by_kind: dict[str, Callable[..., str]] = {
        "gravity": lambda k: f"gravity.{entry(k)}",
        "offset": lambda j, k: f"joint.{joints[j]}.xyz.{entry(k)}",
        "mass": lambda j: f"link.{links[j]}.mass",
        "centre": lambda j, k: f"link.{links[j]}.com.{entry(k)}",
        "inertia": lambda j, k, m: f"link.{links[j]}.inertia.i{entry(k)}{entry(m)}",
        "armature": lambda k: f"joint.{tree.coordinates[k]}.armature",
        "rotors": lambda k, j: f"rotors.{tree.coordinates[k]}.{tree.coordinates[j]}",
        "point": lambda k, i: f"{points[k]}.xyz.{entry(i)}",
        "length": lambda row: f"loop.{rows[row]}",
        "affine": lambda row, k: f"{rows[row]}.{tree.coordinates[k]}",
        "affine_offset": lambda row: f"{rows[row]}.offset",
        "constant": lambda k: f"joint.{tree.coordinates[k]}.force",
        "joint_stiffness": lambda k: f"joint.{tree.coordinates[k]}.stiffness",
        "joint_rest": lambda k: f"joint.{tree.coordinates[k]}.rest",
        "joint_damping": lambda k: f"joint.{tree.coordinates[k]}.damping",
        "end": lambda k, i: f"{ends[k]}.xyz.{entry(i)}",
        "stiffness": lambda k: f"spring.{lines[k]}.stiffness",
        "rest_length": lambda k: f"spring.{lines[k]}.rest_length",
        "damping": lambda k: f"spring.{lines[k]}.damping",
    }
    return [by_kind[kind](*index) for kind, present in which.items() for index in np.argwhere(present).tolist()]


def argument_units(mechanism: Mechanism, which: Mapping[str, BoolArray]) -> list[str]:
    """Return the units of the arguments, in the order of `Arguments.vector`; "" if dimensionless."""
    units, rows = mechanism.tree.units(), row_units(mechanism)
    by_kind: dict[str, Callable[..., str]] = {
        "gravity": lambda k: "m/s²",
        "mass": lambda j: "kg",
        "inertia": lambda j, k, m: "kg m²",
        "armature": lambda k: ROTOR[units[k]],
        "rotors": lambda k, j: ROTOR[units[k]] if units[k] == units[j] else "kg m",
        "affine": lambda row, k: "" if rows[row] == units[k] else f"{rows[row]}/{units[k]}",
        "affine_offset": lambda row: rows[row],
        "constant": lambda k: effort(units[k]),
        "joint_stiffness": lambda k: STIFF[units[k]],
        "joint_rest": lambda k: units[k],
        "joint_damping": lambda k: VISCOUS[units[k]],
        "stiffness": lambda k: STIFF["m"],
        "damping": lambda k: VISCOUS["m"],
    }
    return [
        by_kind[kind](*index) if kind in by_kind else "m"  # the others are lengths
        for kind, present in which.items()
        for index in np.argwhere(present).tolist()
    ]


class Arguments:
    """Symbols of the arguments.

    Parameters
    ----------
    which : mapping of str to bool arrays
        As `present` returns it.

    Attributes
    ----------
    vector : casadi.SX
    places : list of (str, tuple of int)
        Of each argument: the name of its array, and its index there.
    groups : list of lists of int
        Indices of arguments that are differentiated together: mass, centre and inertia of a body; of other numbers,
        all of one name.
    """

    def __init__(self, which: Mapping[str, BoolArray]) -> None:
        import casadi as cs

        self._symbols: dict[str, dict[tuple[int, ...], Any]] = {}
        for name, there in which.items():
            at = [tuple(int(i) for i in index) for index in np.argwhere(there)]
            self._symbols[name] = {index: cs.SX.sym("_".join([name, *map(str, index)])) for index in at}
        self.vector = cs.vertcat(*(symbol for symbols in self._symbols.values() for symbol in symbols.values()))
        groups: dict[object, list[int]] = {}
        self.places = [(name, index) for name, symbols in self._symbols.items() for index in symbols]
        for place, (name, (first, *_)) in enumerate(self.places):
            groups.setdefault(first if name in ("mass", "centre", "inertia") else name, []).append(place)
        self.groups = [*groups.values()]

    def number(self, name: str, *index: int) -> Any:
        """Return the symbol of a number; a structural zero if it is no argument."""
        import casadi as cs

        return self._symbols[name].get(tuple(int(k) for k in index), cs.SX(1, 1))

    def column(self, name: str, *index: int) -> Any:
        """Return three numbers as a column."""
        import casadi as cs

        return cs.vertcat(*(self.number(name, *index, k) for k in range(3)))

    def symmetric(self, name: str, *index: int) -> Any:
        """Return nine numbers as a symmetric matrix, from the lower triangle."""
        import casadi as cs

        rows = [[self.number(name, *index, max(i, j), min(i, j)) for j in range(3)] for i in range(3)]
        return cs.vertcat(*(cs.horzcat(*row) for row in rows))


def snap_to_units(numbers: Array) -> Array:
    """Return a copy of an array; numbers within `NEGLIGIBLE` of 0, 1 or -1 are replaced by it."""
    snapped = np.array(numbers, dtype=float)
    for unit in (0.0, 1.0, -1.0):
        snapped[np.abs(snapped - unit) <= NEGLIGIBLE] = unit
    return snapped


def constant(numbers: Array) -> Any:
    """Return a constant CasADi matrix with structural zeros, after `snap_to_units`."""
    import casadi as cs

    return cs.sparsify(cs.SX(snap_to_units(numbers)))
