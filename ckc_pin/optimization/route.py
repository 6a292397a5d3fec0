"""Places that a motion passes, with times at rest, and the whole motion over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.errors import InputError
from ckc_pin.optimization.along_path import minimum_norm_within
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.mesh_motion import Guess, Places, Solution
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.replay import Section

__all__ = ["Route", "Stay"]

FORCE_TOLERANCE = 1e-8  # relative to the largest force: what torques within limits may fail to produce


@dataclass(frozen=True)
class Stay:
    """A rest at a place: the name of the place, and how long the rest lasts, s."""

    name: str
    duration: float


class Route(Immutable, frozen=True):
    """Places that a motion passes, and how long it rests there.

    Attributes
    ----------
    places : Places
        Times are those of the motion without the times at rest.
    rests : (phases,) array
        Times at rest after each phase, s.
    rest_torque : (phases, motors) array
        Motor torques meanwhile.
    time : float
        Longest duration without the times at rest, s.
    members : tuple of ReducedDynamics
        Of each phase.
    """

    places: Places
    rests: Array
    rest_torque: Array
    time: float
    members: tuple[ReducedDynamics, ...]

    @classmethod
    def of(
        cls, members: Sequence[ReducedDynamics], limits: MotionLimits, places: Places, stays: Sequence[Stay],
        q_tree: Sequence[Array],
    ) -> Route:  # fmt: skip
        """Return the route through places with times of arrival and closed configurations (InputError)."""
        rests = np.array([stay.duration for stay in stays])
        t = places.t - np.append(0.0, np.append(0.0, np.cumsum(rests)[:-1]))
        if np.isfinite(t[-1]):
            t[-1] -= rests[-1]
        longest = limits.time - float(rests.sum())
        if np.any(np.diff(np.append(t[np.isfinite(t)], np.inf)) <= 0) or not longest > np.nanmax(t[:-1]):
            raise InputError("optimize: via: the times of places do not increase, or leave no time for the motion; "
                             "change time, dwell or limits.time")  # fmt: skip
        rest_torque = [_hold(dynamics, limits, place, stay.name) if stay.duration else np.zeros(dynamics.motors)
                       for dynamics, stay, place in zip(members, stays, q_tree[1:], strict=True)]  # fmt: skip
        return cls(replace(places, t=t), rests, np.array(rest_torque), longest, tuple(members))

    def sections(self, ends: Array) -> tuple[Section, ...]:
        """Return the parts of a motion with different parameters, from the ends of its phases; none if all are equal.

        Each part includes the time at rest at its end.
        """
        begin = np.append(ends[:-1] + self.offsets, ends[-1] + self.rests.sum())
        first = [k for k, x in enumerate(self.members) if k == 0 or x is not self.members[k - 1]]
        if len(first) == 1:
            return ()
        last = [*first[1:], len(self.members)]
        return tuple(Section(self.members[a].mechanism, float(begin[a]), float(begin[b]))
                     for a, b in zip(first, last, strict=True))  # fmt: skip

    @property
    def has_times(self) -> bool:
        """Whether the time of a place is given."""
        return bool(np.isfinite(self.places.t[1:]).any())

    @property
    def offsets(self) -> Array:
        """Time at rest before each phase, s."""
        return np.append(0.0, np.cumsum(self.rests)[:-1])

    def phase_of(self, t: Array, ends: Array) -> IntArray:
        """Return the phase at times without those at rest; where a phase ends, it is the next one."""
        return np.searchsorted(ends[1:-1], t, side="right")

    def motion(self, solution: Solution) -> PiecewisePolynomial:
        """Return a solution's motion with the times at rest."""
        moving, ends = solution.motion(), solution.values.ends
        if not self.rests.any():
            return moving
        breaks, coefficients = [moving.breaks[:1]], []
        phase = self.phase_of(moving.breaks[:-1], ends)
        for k, rest in enumerate(self.rests.tolist()):
            pieces = np.flatnonzero(phase == k)
            breaks.append(moving.breaks[pieces + 1] + self.offsets[k])
            coefficients.append(moving.coefficients[:, pieces])
            if rest:
                still = np.zeros_like(moving.coefficients[:, :1])
                still[-1, 0] = solution.values.q[pieces[-1] + 1]
                breaks.append(breaks[-1][-1:] + rest)
                coefficients.append(still)
        t = np.concatenate(breaks)
        return PiecewisePolynomial(t, np.concatenate(coefficients, axis=1), corners=t,
                                   max_frequency=moving.max_frequency, end=float(t[-1]))  # fmt: skip

    def torques(self, values: Guess, torque: Array) -> tuple[Array, Array]:
        """Return times and motor torques, linear between the rows. Where torques jump, two rows have the same time."""
        phase = values.mesh.phase_of_knots
        t, rows = values.torque_t + self.offsets[phase], torque
        for k in np.flatnonzero(self.rests)[::-1].tolist():
            at = int(np.searchsorted(phase, k, side="right"))
            # The next phase begins where the rest ends, to the last digit.
            end = t[at] if at < len(t) else t[at - 1] + self.rests[k]
            t = np.insert(t, at, [t[at - 1], end])
            rows = np.insert(rows, at, [self.rest_torque[k], self.rest_torque[k]], axis=0)
        return t, rows


def _hold(dynamics: ReducedDynamics, limits: MotionLimits, q_tree: Array, name: str) -> Array:
    """Return the torques of smallest norm that hold a mechanism at rest (InputError)."""
    still = np.zeros((1, dynamics.d))
    at = dynamics.instants(q_tree[None], still, still, np.zeros((1, dynamics.motors)))
    transmission = dynamics.transmission(q_tree[None])
    tau = minimum_norm_within(transmission, at.force, limits.torque)
    missing = np.abs(np.einsum("mdk,mk->md", transmission, tau) - at.force).max()
    if missing > FORCE_TOLERANCE * max(float(np.abs(at.force).max()), 1.0):
        raise InputError(
            f"optimize: {name}: dwell: torques within their limits do not hold the mechanism at rest there; raise "
            "limits.torque, or change the place"
        )
    return np.asarray(tau[0])
