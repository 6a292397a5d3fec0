"""Sliders of the mechanism's named parameters, and the mechanism with other values at the present pose."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ckc_pin.explorer.messages import ParameterInfo
from ckc_pin.kinematics.assembly import reassemble
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import split_component, split_name, values_of, with_components
from ckc_pin.mechanism.units import parameter_unit
from ckc_pin.mechanism.warnings import compute_moving_mass

__all__ = ["list_parameters", "rebuild"]

STANDARD_GRAVITY = 9.81  # m/s^2, for scales of forces
MAX_GRAVITY = 20.0  # m/s^2, end of its sliders
SHIFT = 0.5  # mechanism sizes: half the scale of a position
MOMENTS, PRODUCTS = ("ixx", "iyy", "izz"), (".ixy", ".ixz", ".iyz")  # entries of an inertia
HALF_TO_DOUBLE = ("mass", *MOMENTS, "length", "torque_limit", "speed_limit")  # keys of positive values
ZERO_TO_DOUBLE = ("armature", "damping", "friction", "stiffness", "rest_length", "rotor_inertia")  # never negative


def list_parameters(mechanism: Mechanism, original: Mechanism | None = None) -> list[ParameterInfo]:
    """Return the sliders of all parameters. Vectors have one for each component.

    Parameters
    ----------
    mechanism : Mechanism
    original : Mechanism, optional
        Its values are the defaults, and its scales those of the sliders. Default: `mechanism`.
    """
    original = original or mechanism
    values, defaults = _scalars(mechanism), _scalars(original)
    mass = compute_moving_mass(original)[0] or 1.0
    typical = _typical_sizes(mass, original.size)
    sliders = []
    for name, default in defaults.items():
        unit = parameter_unit(original, name)
        size = _smallest_moment(name, defaults) if name.endswith(PRODUCTS) else typical.get(unit, 1.0)
        lower, upper = _scale(name, default, unit, original.size, size)
        value = values[name]
        sliders.append(
            ParameterInfo(
                name=name, group=name.partition(".")[0], unit=unit, value=value, default=default,
                lower=min(lower, value), upper=max(upper, value),
            )
        )  # fmt: skip
    return sliders


def rebuild(mechanism: Mechanism, values: Mapping[str, float], at: Kinematics) -> tuple[Mechanism, Kinematics]:
    """Return the mechanism with other values of scalar parameters, at the same q on the same branch if possible.

    Parameters
    ----------
    mechanism : Mechanism
        As loaded. The assembled configuration of the result follows from its own.
    values : mapping
        All values that differ from those of `mechanism`, by name.
    at : Kinematics
        The present configuration, of `mechanism` or of an earlier result.

    Raises
    ------
    InputError, MechanismError
        An unknown name or an invalid value; or the reason why the mechanism cannot be assembled here.
    """
    overrides = {name: x for name, x in with_components(mechanism.overrides).items() if not isinstance(x, tuple)}
    overrides |= {name: float(value) for name, value in values.items()}
    with mechanism.sources.prefix_errors():
        return reassemble(mechanism, overrides, at)


def _scalars(mechanism: Mechanism) -> dict[str, float]:
    """Return the values of all scalar parameters and of the components of vectors."""
    values = with_components(values_of(mechanism.spec, mechanism.urdf))
    return {name: value for name, value in values.items() if not isinstance(value, tuple)}


def _typical_sizes(mass: float, size: float) -> dict[str, float]:
    """Return a size by unit for parameters that are zero, from a mass, kg, and a length, m."""
    force = mass * STANDARD_GRAVITY
    return {
        "kg": mass, "kg m²": mass * size**2, "m": size, "rad": math.pi, "N": force, "N m": force * size,
        "N/m": force / size, "N m/rad": force * size, "N s/m": force / size, "N m s/rad": force * size,
    }  # fmt: skip


def _smallest_moment(name: str, values: Mapping[str, float]) -> float:
    """Return the smallest moment of inertia of the body whose product of inertia is named, kg m^2."""
    return min(values[f"{name[:-3]}{moment}"] for moment in MOMENTS) or 1.0


def _scale(name: str, value: float, unit: str, size: float, typical: float) -> tuple[float, float]:
    """Return the ends of a slider."""
    root, _, key = split_name(split_component(name)[0])
    last = key.rpartition(".")[2]
    if root == "gravity":
        half = max(MAX_GRAVITY, 2 * abs(value))
        return -half, half
    if key == "restitution":
        return 0.0, 1.0
    if unit == "rad":
        return value - math.pi, value + math.pi
    if last in ("xyz", "com", "lower", "upper", "rest", "offset") and unit == "m":
        return value - SHIFT * size, value + SHIFT * size
    if last in HALF_TO_DOUBLE + ZERO_TO_DOUBLE:
        return (0.5 * value if last in HALF_TO_DOUBLE else 0.0), (2 * value if value else typical)
    if last == "ratio":
        return min(0.5 * value, 2 * value), max(0.5 * value, 2 * value)
    half = abs(value) or typical
    return value - half, value + half
