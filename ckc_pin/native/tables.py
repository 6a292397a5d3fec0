"""Tables that describe a mechanism to the C++ core: model, constraint rows, springs, joints and partition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.library import Library
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rank import RANK_TOLERANCE, jacobian_scales
from ckc_pin.mechanism.rows import Affine, Component, Curved, Distance, Dot, RelativeLog
from ckc_pin.mechanism.springs import Springs

__all__ = ["closure_table", "core_table", "packed"]


def core_table(mechanism: Mechanism, library: Library | None = None, smoothing: float | None = None) -> dict[str, Any]:
    """Return the table from which a core of a mechanism is built.

    Parameters
    ----------
    mechanism : Mechanism
    library : Library, optional
        The mechanism's compiled terms. By default, the core evaluates the terms with Pinocchio.
    smoothing : float, optional
        Velocity scale of regularized dry friction, rad/s or m/s; zero for joints that stick. By default, the core has
        no friction and no joint stops.
    """
    rows, columns = jacobian_scales(mechanism.tree, mechanism.closure)
    compiled = {} if library is None else {"compiled": (library.path, library.parameters)}
    return {
        **compiled,
        "model": packed(mechanism.tree.model),
        "q_index": mechanism.tree.q_index.tolist(),
        "closure": closure_table(mechanism.closure, mechanism.n),
        "springs": _springs(mechanism.springs),
        "joints": _joints(mechanism, smoothing),
        "rotors": mechanism.tree.rotors.ravel() if mechanism.tree.rotors.any() else np.zeros(0),
        "rank": mechanism.rank,
        "independent_rows": mechanism.independent_rows,
        "q": mechanism.partition.q.tolist(),
        "z": mechanism.partition.z.tolist(),
        "row_scale": rows,
        "column_scale": columns,
        "rank_tolerance": RANK_TOLERANCE,
    }


def packed(model: Any) -> bytes:
    """Return Pinocchio's binary serialization of a model; its text format is fifteen times slower."""
    buffer = pin.serialization.StreamBuffer()
    model.saveToBinary(buffer)
    data: bytes = buffer.tobytes()
    return data


def closure_table(closure: Closure, n: int) -> dict[str, Any]:
    """Return the constraint rows of a closure by kind."""
    anchors = closure.anchors
    table: dict[str, Any] = {name: [] for name in ("component", "dot", "distance", "affine", "curve", "log")}
    numbers: dict[str, list[Array]] = {"length": [np.zeros(0)], "affine_matrix": [np.zeros((0, n))],
        "affine_offset": [np.zeros(0)], "rotation_a": [np.zeros((0, 9))], "rotation_b": [np.zeros((0, 9))]}  # fmt: skip
    curves = [np.zeros((0, 0))] * 3
    for group in closure.groups:
        out = group.out.tolist()
        match group:
            case Component():
                table["component"] += _rows(out, group.pair, group.direction)
            case Dot():
                table["dot"] += _rows(out, group.a, group.b)
            case Distance():
                table["distance"] += _rows(out, group.pair)
                numbers["length"].append(group.length)
            case Affine():
                table["affine"] += out
                numbers["affine_matrix"].append(_matrix(group.matrix, n))
                numbers["affine_offset"].append(group.offset)
                if isinstance(group, Curved):
                    table["curve"] += _rows(out, group.coordinate)
                    curves = [group.breaks, group.origins, group.coefficients.reshape(len(out), -1)]
            case RelativeLog():
                table["log"] += _rows(out[::3], out[1::3], out[2::3], group.joint_a, group.joint_b)
                numbers["rotation_a"].append(_matrix(group.rotation_a.reshape(-1, 9), 9))
                numbers["rotation_b"].append(_matrix(group.rotation_b.reshape(-1, 9), 9))
            case _:
                raise TypeError(f"{type(group).__name__}: the core has no constraint rows of this kind")
    return {
        **table,
        **{name: np.concatenate(parts) for name, parts in numbers.items()},
        **dict(zip(("curve_breaks", "curve_origins", "curve_coefficients"), curves, strict=True)),
        "rows": closure.rows,
        "point_joint": anchors.point_joint.tolist(),
        "point_local": _matrix(anchors.point_local, 3),
        "direction_joint": anchors.direction_joint.tolist(),
        "direction_local": _matrix(anchors.direction_local, 3),
    }


def _joints(mechanism: Mechanism, smoothing: float | None) -> dict[str, Any]:
    joints, n = mechanism.joints, mechanism.n
    if mechanism.prescribed and not smoothing:  # `prescribed_tables` have their friction
        prescribed = np.zeros(n, dtype=bool)
        prescribed[mechanism.prescribed_at] = True
        joints = joints.without(prescribed)
    moves = smoothing is not None
    return {
        "friction": joints.friction if moves else np.zeros(n),
        "lower": joints.lower if moves else np.full(n, -np.inf),
        "upper": joints.upper if moves else np.full(n, np.inf),
        "restitution": joints.restitution,
        "reach": mechanism.tree.step_scale,
        "size": mechanism.size,
        "smoothing": smoothing or 0.0,
    }


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
