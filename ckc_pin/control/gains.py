"""Gains as a scalar, a table by joint, or a matrix in the order of `independent`; checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.control.spec import Gain
from ckc_pin.errors import InputError

__all__ = ["gain_matrix", "require_positive_definite"]

LARGEST = 1e100  # of a gain: its products with others, and their squares, do not overflow


def gain_matrix(gain: Gain | Array, names: Sequence[str], what: str) -> Array:
    """Return a gain as a (d, d) matrix.

    Raises
    ------
    InputError
        Wrong shape, an unknown or missing joint, or a number that is not finite.
    """
    d = len(names)
    if isinstance(gain, dict):
        unknown = [name for name in gain if name not in names]
        missing = [name for name in names if name not in gain]
        if unknown or missing:
            problem = f"{unknown[0]!r} is none of them" if unknown else f"{missing[0]!r} is missing"
            raise InputError(f"controller.{what}: a table needs the joints {', '.join(names)}; {problem}")
        matrix = np.diag([float(gain[name]) for name in names])
    elif is_number(gain):
        matrix = float(cast(float, gain)) * np.eye(d)
    else:
        shape = f"controller.{what}: a matrix must be {d} x {d}, rows in the order {', '.join(names)}"
        matrix = _numbers(gain, what, shape)
        if matrix.shape != (d, d):
            raise InputError(shape)
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"controller.{what}: an entry is not a finite number")
    if np.abs(matrix).max(initial=0.0) > LARGEST:
        raise InputError(f"controller.{what}: an entry is above {LARGEST:g}")
    return matrix


def _numbers(gain: Any, what: str, shape: str) -> Array:
    if not isinstance(gain, list | tuple | np.ndarray):
        takes = "a number, a table by joint or a matrix"
        raise InputError(f"controller.{what}: expected {takes}, got {describe_value(gain)}")
    try:
        return np.array(gain, dtype=float)
    except (TypeError, ValueError):  # rows of several lengths, words among the numbers
        raise InputError(shape) from None


def require_positive_definite(matrix: Array, what: str, *, semi: bool = False) -> None:
    """Raise InputError unless a matrix is symmetric positive definite (or semi-definite)."""
    size = float(np.abs(matrix).max(initial=0.0))
    skew = np.abs(matrix - matrix.T)
    if skew.max(initial=0.0) > 1e-12 * size:
        i, j = np.unravel_index(int(np.argmax(skew)), skew.shape)
        entries = f"[{i}][{j}] = {matrix[i, j]:g} and [{j}][{i}] = {matrix[j, i]:g}"
        raise InputError(f"controller: {what} is not symmetric: its entries {entries} differ")
    least = float(np.linalg.eigvalsh(matrix)[0]) if len(matrix) else 1.0
    rounding = 1e-14 * size  # [[1, 1], [1, 1]] is semi-definite whichever way its zero eigenvalue is rounded
    if least < -rounding or (least <= rounding and not semi):
        kind = "positive semi-definite" if semi else "positive definite"
        raise InputError(f"controller: {what} is not {kind}: its least eigenvalue is {least:.3g}")
