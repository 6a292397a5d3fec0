"""Eq. 6 at instants of several phases, in which bodies have different masses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.optimization.reduced import Derivatives, MotionInstants, ReducedDynamics

__all__ = ["PhaseDynamics"]

T = TypeVar("T", MotionInstants, Derivatives)


class PhaseDynamics:
    """The reduced equations of motion at instants that belong to phases.

    Parameters
    ----------
    members : sequence of ReducedDynamics
        Of each phase. They differ in the bodies' inertias only.
    phase : (m,) array
        Phases of the instants, in their order.
    """

    def __init__(self, members: Sequence[ReducedDynamics], phase: IntArray) -> None:
        self._parts: list[tuple[ReducedDynamics, slice]] = []
        for k in np.unique(phase).tolist():
            begin, end = np.searchsorted(phase, [k, k + 1]).tolist()
            if self._parts and self._parts[-1][0] is members[k]:
                begin = self._parts.pop()[1].start
            self._parts.append((members[k], slice(begin, end)))

    def instants(self, q_tree: Array, v: Array, a: Array, tau: Array) -> MotionInstants:
        """Return `ReducedDynamics.instants` of all phases."""
        return _joined([x.instants(q_tree[at], v[at], a[at], tau[at]) for x, at in self._parts])

    def differentiate(self, at: MotionInstants) -> Derivatives:
        """Return `ReducedDynamics.differentiate` of all phases."""
        if len(self._parts) == 1:
            return self._parts[0][0].differentiate(at)
        return _joined([x.differentiate(_selected(at, rows)) for x, rows in self._parts])

    def hessian(
        self, at: MotionInstants, by_x: Derivatives, weights: Array, state_weights: Array | None = None
    ) -> Array:
        """Return `ReducedDynamics.hessian` of all phases."""
        if len(self._parts) == 1:
            return self._parts[0][0].hessian(at, by_x, weights, state_weights)
        return np.concatenate([
            x.hessian(_selected(at, rows), _selected(by_x, rows), weights[rows],
                      None if state_weights is None else state_weights[rows])
            for x, rows in self._parts
        ])  # fmt: skip


def _selected(values: T, rows: slice) -> T:
    """Return the values at some of the instants."""
    return type(values)(**_by_field(values, lambda x: x[0][rows], [values]))


def _joined(parts: list[T]) -> T:
    """Return the values at the instants of all parts."""
    if len(parts) == 1:
        return parts[0]
    return type(parts[0])(**_by_field(parts[0], np.concatenate, parts))


def _by_field(values: T, combine: Callable[[list[Array]], Array], parts: Sequence[T]) -> dict[str, Any]:
    """Combine the arrays of each attribute of several structures; an attribute may be a tuple of arrays."""
    result: dict[str, Any] = {}
    for name in values.__struct_fields__:
        of_parts = [getattr(part, name) for part in parts]
        is_tuple = isinstance(of_parts[0], tuple)
        result[name] = tuple(combine(list(x)) for x in zip(*of_parts, strict=True)) if is_tuple else combine(of_parts)
    return result
