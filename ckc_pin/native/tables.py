"""A mechanism as the tables that cross to C++: the rows, springs and partition that Python itself evaluates."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rows import Affine, Component, Distance, Dot, RelativeLog
from ckc_pin.mechanism.springs import Springs
from ckc_pin.mechanism.tree import Array
from ckc_pin.native import core

__all__ = ["make_core"]


def make_core(mechanism: Mechanism) -> Any:
    """Return a native core of a mechanism, with a workspace of its own."""
    return core().Core(
        mechanism.tree.model.saveToString(),
        mechanism.tree.place.tolist(),
        _closure(mechanism.closure, mechanism.n),
        _springs(mechanism.springs),
        mechanism.rank,
        mechanism.partition.q.tolist(),
        mechanism.partition.z.tolist(),
    )


def _closure(closure: Closure, n: int) -> dict[str, Any]:
    anchors = closure.anchors
    table: dict[str, Any] = {
        "rows": closure.rows,
        "point_joint": anchors.point_joint.tolist(),
        "point_local": _matrix(anchors.point_local, 3),
        "direction_joint": anchors.direction_joint.tolist(),
        "direction_local": _matrix(anchors.direction_local, 3),
        "component": [], "dot": [], "distance": [], "affine": [], "log": [],
        "length": np.zeros(0), "affine_matrix": np.zeros((0, n)), "affine_offset": np.zeros(0),
        "rotation_a": np.zeros((0, 9)), "rotation_b": np.zeros((0, 9)),
    }  # fmt: skip
    for group in closure.groups:
        out = group.out.tolist()
        match group:
            case Component():
                table["component"] = _rows(out, group.pair, group.direction)
            case Dot():
                table["dot"] = _rows(out, group.a, group.b)
            case Distance():
                table["distance"], table["length"] = _rows(out, group.pair), group.length
            case Affine():
                table["affine"] = out
                table["affine_matrix"], table["affine_offset"] = _matrix(group.matrix, n), group.offset
            case RelativeLog():
                table["log"] = _rows(out[::3], out[1::3], out[2::3], group.joint_a, group.joint_b)
                table["rotation_a"] = _matrix(group.rotation_a.reshape(-1, 9), 9)
                table["rotation_b"] = _matrix(group.rotation_b.reshape(-1, 9), 9)
            case _:
                raise TypeError(f"{type(group).__name__}: no such primitive crosses to the native core")
    return table


def _springs(springs: Springs) -> dict[str, Any]:
    table = {
        name: np.ascontiguousarray(getattr(springs, name), dtype=float)
        for name in (
            "stiffness", "rest_length", "damping", "joint_stiffness", "joint_rest", "joint_damping", "constant",
        )
    }  # fmt: skip
    anchors = springs.anchors
    return {
        **table,
        "point_joint": anchors.point_joint.tolist(),
        "point_local": _matrix(anchors.point_local, 3),
    }


def _rows(*columns: Any) -> list[list[int]]:
    return [[int(x) for x in row] for row in zip(*columns, strict=True)]


def _matrix(table: Array, columns: int) -> Array:
    return np.asarray(table, dtype=float).reshape(-1, columns)
