"""Distance of a pose to the nearest singular configuration, computed in a thread."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from ckc_pin.analysis.map.nearest import find_nearest_singular
from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.summary import format_quantities
from ckc_pin.control.actuation import Actuation
from ckc_pin.errors import CkcError
from ckc_pin.explorer.background import NewestTask
from ckc_pin.explorer.quantity import DIGITS, LiveQuantity, PoseState, ShownQuantities, format_number
from ckc_pin.kinematics.mapped import NearestSingular
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism

__all__ = ["NearestSingularity"]

ABANDON_AFTER_S = 3.0  # a longer search is given up for a newer pose, so that a pose at rest is searched at once
MIN_GAP_RATIO = 0.01  # of the distance: coordinates that differ less are not listed


class _Outdated(Exception):
    """The search is given up for a newer pose, or because the quantity was hidden."""


class NearestSingularity(LiveQuantity):
    """The singular configuration of phi_z that is nearest in all of q, on the present branch.

    Attributes
    ----------
    on_update : callable or None
        Called in the thread when a result has been computed.
    """

    name, label = "nearest_singular", "distance to the nearest singular configuration"

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        super().__init__(mechanism, actuation)
        self.on_update: Callable[[], None] | None = None
        self._task: NewestTask[Array] | None = None
        self._copy: Mechanism | None = None  # of the thread
        self._requested: Array | None = None
        self._result: tuple[Array, float, NearestSingular | str | None] | None = None  # q_tree, time, result

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        mechanism = self.mechanism
        if not mechanism.dependent:
            return "without loops there is no singular configuration"
        if mechanism.splits_root:
            return CONSTRAINED_IN_PART
        if mechanism.independent_root_coordinates:
            return "a free root has independent coordinates, among which distances have no meaning"
        return "" if mechanism.d else "the mechanism has no freedoms"

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return the distance at the newest pose for which it is known, and ask for that at this pose."""
        self._request(state.at)
        if self._result is None:
            return [["distance", "computing"]]
        q_tree, time, result = self._result
        age = "" if np.array_equal(q_tree, state.at.q_tree) else f", of the pose {perf_counter() - time:.1f} s ago"
        if isinstance(result, str):
            return [["distance", f"unknown: {result}{age}"]]
        if result is None:
            return [["distance", f"none within half a turn{age}"]]
        mechanism = self.mechanism
        units = [mechanism.tree.units()[k] for k in mechanism.partition.q]
        place = format_quantities(mechanism.independent, result.q, units, DIGITS)
        gaps = np.abs(result.q - result.q_d)
        text = ", ".join(place[k] for k in np.flatnonzero(gaps > MIN_GAP_RATIO * result.distance))
        distance = f"{format_number(result.distance, result.unit)} ({result.kind}){age}"
        return [["distance", distance], ["at", text]]

    def remove(self) -> list[dict[str, object]]:
        """End the thread; there is no drawing."""
        self.close()
        return []

    def close(self) -> None:
        """End its thread."""
        if self._task is not None:
            self._task.close()
        self._task, self._requested, self._result = None, None, None

    def _request(self, at: Kinematics) -> None:
        if self._requested is not None and np.array_equal(self._requested, at.q_tree):
            return
        if self._task is None:
            self._copy = self.mechanism.copy(self.mechanism.sources)
            self._task = NewestTask(self._compute, "ckc_pin nearest singular configuration", rests=True)
        self._requested = at.q_tree
        self._task.request(at.q_tree)

    def _compute(self, q_tree: Array, is_outdated: Callable[[], bool]) -> None:
        """Compute the distance at a pose, in the thread."""
        mechanism, time = self._copy, perf_counter()
        assert mechanism is not None
        mechanism.q_tree = q_tree  # the search begins at the assembled configuration
        q = mechanism.independent_part(q_tree)
        rest = (q, np.zeros_like(q), np.zeros_like(q))

        def stand_still(t: float) -> tuple[Array, Array, Array]:
            """Return the pose as a trajectory; the search asks for it before each of its steps."""
            if self._task is None or (is_outdated() and perf_counter() - time > ABANDON_AFTER_S):
                raise _Outdated
            return rest

        result: NearestSingular | str | None
        try:
            with one_blas_thread():
                result = find_nearest_singular(mechanism, stand_still, np.zeros(1))
        except _Outdated:
            return
        except CkcError as error:
            result = str(error)
        if self._task is None:  # hidden in the meantime
            return
        self._result = (q_tree, time, result)
        if self.on_update is not None:
            self.on_update()
