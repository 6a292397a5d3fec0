"""Warnings about numbers that look like millimetres or degrees: the program takes metres and radians."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from ckc_pin.mechanism.couplings import coupled_joints
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Value, values_of

__all__ = ["describe_degrees", "find_unit_warnings", "looks_like_degrees"]

MAX_MACHINE_M = 1000.0  # larger mechanisms are in millimetres whatever their mass
LARGE_MACHINE_M = 10.0  # a mechanism of this size has more mass than MIN_MASS_PER_METRE
MIN_MASS_PER_METRE = 1.0  # kg/m: a light truss has more
MAX_LENGTH_RATIO = 50.0  # of a length to the median of the others
MIN_GAP = 3.0  # ratio of the shortest long length to the longest other one: a row of many links has none
MIN_LENGTH_M = 5.0  # shorter lengths are not reported
MIN_LIMIT_M = 20.0  # limits of slides below it may stand for none
MAX_LENGTH_M = 1e5  # larger limits stand for none
MAX_ANGLE = 2 * math.pi * (1 + 1e-3)  # rad: roll, pitch, yaw and guesses seldom turn further
MAX_TURNS = 4 * math.pi * (1 + 1e-3)  # rad: limits of joints of several turns are at most two turns each way
MAX_DEGREES = 720.0
WHOLE_DEGREES = 5.0  # angles in degrees are mostly multiples of it
UNLIMITED = (100.0, 1000.0)  # limits of plus and minus so much stand for none
MAX_NAMED = 4  # numbers that one warning quotes


def looks_like_degrees(angle: float, largest: float = MAX_ANGLE) -> bool:
    """Whether an angle in radians is beyond the largest plausible one and a multiple of five degrees if in degrees."""
    return largest < abs(angle) <= MAX_DEGREES and math.remainder(angle, WHOLE_DEGREES) == 0


def find_unit_warnings(mechanism: Mechanism) -> list[str]:
    """Return warnings that name the lengths which look like millimetres and the angles which look like degrees."""
    warnings, values = [], values_of(mechanism.spec, mechanism.urdf)
    if millimetres := _mention(_find_long(mechanism, values)) or _describe_size(mechanism):
        warnings.append(f"lengths look like millimetres: {millimetres}; lengths are in metres")
    return warnings + _warn_of_degrees(list(_find_degrees(mechanism, values)))


def describe_degrees(angles: Mapping[str, float]) -> list[str]:
    """Return a warning that names angles which look like degrees; none if there are none."""
    return _warn_of_degrees([f"{name} = {x:g} rad" for name, x in angles.items()])


def _warn_of_degrees(texts: list[str]) -> list[str]:
    return [f"angles look like degrees: {_mention(texts)}; angles are in radians"] if texts else []


def _mention(numbers: Iterator[str] | list[str]) -> str:
    """Return the first of several numbers with their names, and how many more there are."""
    listed = list(numbers)
    more = f" and {len(listed) - MAX_NAMED} more" if len(listed) > MAX_NAMED else ""
    return ", ".join(listed[:MAX_NAMED]) + more


def _describe_size(mechanism: Mechanism) -> str:
    size, mass = mechanism.size, float(sum(body.mass for body in list(mechanism.tree.model.inertias)[1:]))
    if size > MAX_MACHINE_M or (size > LARGE_MACHINE_M and mass < MIN_MASS_PER_METRE * size):
        return f"the size of the mechanism is {size:.4g} m, its moving mass {mass:.4g} kg"
    return ""


def _find_long(mechanism: Mechanism, values: Mapping[str, Value]) -> Iterator[str]:
    """Name lengths many times longer than the others: a part of a file that is in millimetres."""
    lengths = {name: math.hypot(*x) for name, x in values.items() if isinstance(x, tuple) and _is_position(name)}
    lengths |= {name: x for name, x in values.items() if isinstance(x, float) and name.endswith("length")}
    # The median by hand: `statistics` and NumPy's import much more than a short run needs.
    positive = sorted(x for x in lengths.values() if x > 0) or [mechanism.size]
    usual = (positive[(len(positive) - 1) // 2] + positive[len(positive) // 2]) / 2
    shortest_long = min((x for x in lengths.values() if _is_long(x, usual)), default=math.inf)
    if shortest_long > MIN_GAP * max((x for x in lengths.values() if not _is_long(x, usual)), default=0.0):
        yield from (f"{name} = {x:.4g} m" for name, x in lengths.items() if _is_long(x, usual))
    tree = mechanism.tree
    lower, upper = tree.limits()
    for k in np.flatnonzero(tree.in_metres):
        name = tree.coordinates[k]
        if name in tree.free_coordinates:
            continue
        limits = [float(x) for x in (lower[k], upper[k]) if np.isfinite(x)]
        if len(limits) == 2 and not _is_unlimited(*limits) and max(map(abs, limits)) <= MAX_LENGTH_M:
            yield from (
                f"limit of {name} = {x:.4g} m"
                for x in limits
                if abs(x) >= MIN_LIMIT_M and _is_long(abs(x), mechanism.size)
            )
        guess = mechanism.spec.q_guess.get(name, 0.0)
        if _is_long(abs(guess), mechanism.size):
            yield f"q_guess.{name} = {guess:.4g} m"


def _is_position(name: str) -> bool:
    return name.endswith((".xyz", ".com"))


def _is_long(length: float, usual: float) -> bool:
    return length > max(MIN_LENGTH_M, MAX_LENGTH_RATIO * usual)


def _is_unlimited(lower: float, upper: float) -> bool:
    return lower == -upper and (upper in UNLIMITED or upper > UNLIMITED[-1])


def _find_degrees(mechanism: Mechanism, values: Mapping[str, Value]) -> Iterator[str]:
    """Name limits, guesses and rest positions of revolute joints, and roll, pitch and yaw."""
    tree, spec = mechanism.tree, mechanism.spec
    angles = {name for name, unit in zip(tree.coordinates, tree.units(), strict=True) if unit == "rad"}
    lower, upper = tree.limits()
    for k, name in enumerate(tree.coordinates):
        limits = (float(lower[k]), float(upper[k]))
        if name in angles and not _is_unlimited(*limits) and any(looks_like_degrees(x, MAX_TURNS) for x in limits):
            yield f"limits of {name} = {limits[0]:g} to {limits[1]:g} rad"
    yield from (f"q_guess.{k} = {x:g} rad" for k, x in spec.q_guess.items() if k in angles and looks_like_degrees(x))
    for k, spring in enumerate(spec.spring):
        if spring.joint in angles and spring.rest is not None and looks_like_degrees(spring.rest):
            yield f"spring.{k}.rest = {spring.rest:g} rad"
    for coupling in spec.coupling:
        if set(coupled_joints(coupling)) <= angles and looks_like_degrees(coupling.offset):
            yield f"offset of the coupling of {coupled_joints(coupling)[0]} = {coupling.offset:g} rad"
    rotations = [(name, x) for name, x in values.items() if name.endswith(".rpy")]
    rotations += [(f"tree {tree_.file}, rpy", tree_.rpy) for tree_ in spec.tree]
    for name, rotation in rotations:
        if isinstance(rotation, tuple) and any(MAX_ANGLE < abs(x) <= MAX_DEGREES for x in rotation):
            yield f"{name} = [{', '.join(f'{x:g}' for x in rotation)}] rad"
