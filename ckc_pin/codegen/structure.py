"""The hash of everything about a mechanism that is written into its compiled terms, for names of cached files."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.compiler import hash_of
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rows import Curved, RelativeLog

__all__ = ["structure_key"]


def structure_key(mechanism: Mechanism, which: Mapping[str, BoolArray]) -> str:
    """Return the hash of everything that enters expressions: this package, the tree, the rows, which numbers are zero.

    Parameters
    ----------
    mechanism : Mechanism
    which : mapping
        Numbers that are arguments (`arguments.present`).
    """
    tree, closure = mechanism.tree, mechanism.closure
    model = tree.model
    joints = [
        (
            parent,
            joint.idx_q,
            joint.idx_v,
            placement.rotation.tolist(),
            None if joint.nq == 7 else (tree.axis(k)[0].tolist(), bool(tree.axis(k)[1])),
        )
        for k, (parent, joint, placement) in enumerate(
            zip(model.parents, model.joints, model.jointPlacements, strict=True)
        )
        if k > 0
    ]
    groups = [(type(group).__name__, _constants(group)) for group in closure.groups]
    anchors = closure.anchors
    table = (anchors.point_joint.tolist(), anchors.direction_joint.tolist(), anchors.direction_local.tolist())
    arguments = {name: x.tolist() for name, x in which.items()}
    springs = mechanism.springs.anchors.point_joint.tolist()
    return hash_of((_package_hash(), joints, groups, table, arguments, springs, mechanism.redundant))


def _constants(group: Any) -> dict[str, Any]:
    """Return the attributes of a group of constraint rows that compiled terms contain as constants."""
    is_relative, is_curve = isinstance(group, RelativeLog), isinstance(group, Curved)
    return {
        name: np.asarray(getattr(group, name)).tolist()
        for name in group.__struct_fields__
        if is_relative
        or (is_curve and name not in ("matrix", "offset"))
        or name in ("out", "pair", "direction", "a", "b")
    }


@cache
def _package_hash() -> str:
    folder = Path(__file__).parent
    return hash_of([path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.py"))])
