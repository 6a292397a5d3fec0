"""Variables of an FMU: names, units, and whether an importer may set them; in the order of `templates/fmu.c`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.arguments import argument_names, argument_units, present, values
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.mechanism.units import effort, joined, motor_units, row_units

__all__ = ["Variable", "list_stops", "list_variables", "to_xml_name"]

AXES = ("x", "y", "z")
# Characters that XML, or a normalized string of XML, cannot have.
NOT_IN_XML = re.compile("[^\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
STOP = "distance from the stop, or its force while the joint rests on it: an event indicator"


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU, a real number.

    Attributes
    ----------
    name : str
        As the quantity is called in results: ``v.theta_1``.
    reference : int
        Value reference: place in the array `values` of the C code.
    causality, variability : str
        As in the standard.
    initial : str
        "exact" with a start value, or "calculated"; "" for the time.
    start : float or None
    unit : str
    description : str
    derivative_of : int or None
        Value reference of the state whose derivative it is.
    is_event_indicator : bool
    """

    name: str
    reference: int
    causality: str
    variability: str
    initial: str
    start: float | None = None
    unit: str = ""
    description: str = ""
    derivative_of: int | None = None
    is_event_indicator: bool = False


def list_variables(
    mechanism: Mechanism, q_tree: Array, q_dot: Array, epsilon: float | None
) -> tuple[list[Variable], dict[str, str]]:
    """Return an FMU's variables, and names that differ from those of parameters and quantities.

    Parameters
    ----------
    mechanism : Mechanism
    q_tree : (nq,) array
        Configuration at the start.
    q_dot : (d,) array
        Rates of the independent coordinates at the start.
    epsilon : float or None
        s, of eq. 8 in model exchange; None for eq. 6.
    """
    variables = [
        replace(variable, reference=k)
        for k, variable in enumerate(_iterate_variables(mechanism, q_tree, q_dot, epsilon or 0.0))
    ]
    place = {name: variables[-1].reference for name, variables in _by_name(variables).items()}
    states = mechanism.independent if epsilon is None else mechanism.coordinates
    derivative_of = {place[f"v.{name}"]: place[name] for name in states}
    derivative_of |= {place[f"a.{name}"]: place[f"v.{name}"] for name in mechanism.independent}
    renamed = {}
    for k, variable in enumerate(variables):
        if k != place[variable.name]:
            renamed[variable.name] = f"parameter.{variable.name}"
            variables[k] = variable = replace(variable, name=renamed[variable.name])
        variables[k] = replace(variable, derivative_of=derivative_of.get(k))
    used = {x.name for x in variables}
    for k, variable in enumerate(variables):
        name = base = to_xml_name(variable.name)
        count = 1
        while name != variable.name and name in used:
            count += 1
            name = f"{base}_{count}"
        if name != variable.name:
            used.add(name)
            renamed[repr(variable.name)] = name
            variables[k] = replace(variable, name=name)
    return [x for x in variables if x.name != "epsilon" or epsilon is not None], renamed


def to_xml_name(name: str) -> str:
    """Return a name with the characters that XML cannot have replaced by underscores."""
    return NOT_IN_XML.sub("_", name)


def list_stops(mechanism: Mechanism) -> list[tuple[int, int, float]]:
    """Return the coordinate, the side, 1 for the upper one or -1, and the position of each stop of a mechanism."""
    bounds = zip(mechanism.joints.lower, mechanism.joints.upper, strict=True)
    return [
        (k, side, float(x))
        for k, both in enumerate(bounds)
        for side, x in zip((-1, 1), both, strict=True)
        if np.isfinite(x)
    ]


def _by_name(variables: Sequence[Variable]) -> dict[str, list[Variable]]:
    result: dict[str, list[Variable]] = {}
    for variable in variables:
        result.setdefault(variable.name, []).append(variable)
    return result


def _iterate_variables(mechanism: Mechanism, q_tree: Array, q_dot: Array, epsilon: float) -> Iterator[Variable]:
    numbers, tree = model_numbers(mechanism), mechanism.tree
    which, rows = present(numbers), [".".join(name) for name in mechanism.closure.names]
    coordinates, units = mechanism.coordinates, tree.units()
    positions = dict(zip(coordinates, tree.to_coordinates(q_tree), strict=True))
    rates = dict(zip(mechanism.independent, q_dot, strict=True))
    points = [f"{point}.{{}}{axis}" for point in mechanism.points for axis in AXES]
    yield Variable("time", 0, "independent", "continuous", "", None, "s", "time")
    for name, value, unit in zip(
        argument_names(mechanism, which), values(numbers, which), argument_units(mechanism, which), strict=True
    ):
        yield Variable(name, 0, "parameter", "fixed", "exact", float(value), unit)
    yield Variable("epsilon", 0, "parameter", "fixed", "exact", epsilon, "s", "time constant of eq. 8")
    for name, unit in zip(mechanism.motors.names, motor_units(mechanism), strict=True):
        yield Variable(f"tau.{name}", 0, "input", "continuous", "exact", 0.0, unit, "motor torque or force")
    for name, unit in zip(coordinates, units, strict=True):
        text = "generalized force on the coordinate, in addition to the motors"
        yield Variable(f"force.{name}", 0, "input", "continuous", "exact", 0.0, effort(unit), text)
    for name, unit in zip(coordinates, units, strict=True):
        is_independent = name in rates
        start = float(positions[name]) if is_independent else None
        yield _output(name, unit, "coordinate", start)
    for name, unit in zip(coordinates, tree.units("/s"), strict=True):
        yield _output(f"v.{name}", unit, "rate", float(rates[name]) if name in rates else None)
    for name, unit in zip(coordinates, tree.units("/s²"), strict=True):
        yield _output(f"a.{name}", unit, "acceleration")
    for row, unit in zip(rows, row_units(mechanism), strict=True):
        yield _output(f"loop.{row}", effort(unit), "multiplier of the constraint row")
    for name in points:
        yield _output(name.format(""), "m", "position of the point in the world")
    for name in points:
        yield _output(name.format("v."), "m/s", "velocity of the point in the world")
    for name in ("kinetic", "potential", "total"):
        yield _output(f"energy.{name}", "J", "energy")
    row_unit = joined(row_units(mechanism))
    yield _output("phi.max", row_unit if " or " not in row_unit else "", "largest residual of the loops")
    for k, side, _ in list_stops(mechanism):
        indicator = _output(f"stop.{coordinates[k]}.{'lower' if side < 0 else 'upper'}", "", STOP)
        yield replace(indicator, is_event_indicator=True)


def _output(name: str, unit: str, description: str, start: float | None = None) -> Variable:
    initial = "calculated" if start is None else "exact"
    return Variable(name, 0, "output", "continuous", initial, start, unit, description)
