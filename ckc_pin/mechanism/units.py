"""Units of a mechanism's quantities and parameters; "" for dimensionless ones."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ckc_pin.mechanism.couplings import coupled_joints, find_coupling
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import split_component, split_name

__all__ = ["ROTOR", "STIFF", "VISCOUS", "effort", "joined", "motor_units", "parameter_unit", "row_units"]

ROTOR = {"m": "kg", "rad": "kg m²"}  # inertia of a coordinate, by its unit
STIFF = {"m": "N/m", "rad": "N m/rad"}
VISCOUS = {"m": "N s/m", "rad": "N m s/rad"}
OF_LINK = {"mass": "kg", "com": "m"}  # other keys are entries of an inertia
OF_FRAME = {"xyz": "m", "rpy": "rad"}


def joined(units: Iterable[str]) -> str:
    """Return the units of several quantities as one text, "rad or m"."""
    return " or ".join(sorted({unit for unit in units if unit}, key=len, reverse=True))


def effort(unit: str) -> str:
    """Return the unit of the generalized force on a coordinate of unit "m" or "rad"."""
    return "N" if unit == "m" else "N m"


def motor_units(mechanism: Mechanism) -> list[str]:
    """Return the unit of each motor's output: "N" if it drives only prismatic joints, "N m" otherwise."""
    return [effort(unit) for unit in _shafts(mechanism)]


def row_units(mechanism: Mechanism) -> list[str]:
    """Return the unit of each row of phi."""
    return ["m" if metres else "rad" for metres in np.atleast_1d(mechanism.closure.in_metres(mechanism.tree))]


def parameter_unit(mechanism: Mechanism, name: str) -> str:
    """Return the unit of a parameter of `mechanism.parameters`."""
    root, carrier, key = split_name(split_component(name)[0])
    last = key.rpartition(".")[2]
    if root == "gravity":
        return "m/s²"
    if root == "link":
        return OF_LINK.get(key, "kg m²")
    if last in OF_FRAME:
        return OF_FRAME[last]
    if root == "loop":
        return "m"
    if root == "motor":
        unit = _shafts(mechanism)[mechanism.motors.names.index(carrier)]
        of_motor = {"rotor_inertia": ROTOR[unit], "torque_limit": effort(unit), "speed_limit": f"{unit}/s"}
        return of_motor.get(key.partition(".")[0], "")
    return _of_coordinate(mechanism, root, carrier, key)


def _of_coordinate(mechanism: Mechanism, root: str, carrier: str, key: str) -> str:
    """Return the unit of a parameter that depends on the unit of a coordinate."""
    spec, units = mechanism.spec, dict(zip(mechanism.coordinates, mechanism.tree.units(), strict=True))
    if root == "coupling":
        coupling = spec.coupling[find_coupling(spec, carrier)]
        first, last = coupled_joints(coupling)[0], coupled_joints(coupling)[-1]
        a, b = units[first], units[key.removeprefix("joints.") if key.startswith("joints.") else last]
        return a if key == "offset" else "" if a == b else f"{a}/{b}"
    if root == "spring":
        joint = spec.spring[int(carrier)].joint
        unit = "m" if joint is None else units[joint]
        return {"stiffness": STIFF[unit], "damping": VISCOUS[unit], "rest_length": "m"}.get(key, unit)
    unit = units[spec.force[int(carrier)].joint if root == "force" else carrier]
    by_key = {"armature": ROTOR[unit], "damping": VISCOUS[unit], "restitution": "", "lower": unit, "upper": unit}
    return by_key.get(key, effort(unit))  # friction, and the value of a force


def _shafts(mechanism: Mechanism) -> list[str]:
    """Return the unit of each motor's coordinate: "m" if it drives only prismatic joints, "rad" otherwise."""
    lengths, turns = mechanism.tree.in_metres, mechanism.motors.transmission != 0
    return ["m" if np.all(lengths[row]) else "rad" for row in turns]
