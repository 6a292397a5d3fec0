"""The replay of a plan's torques in the step loop, and the scenes of plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.scene import Scene

__all__ = [
    "JUMP_GAP",
    "REPLAY_ERROR",
    "CoordinateMotion",
    "Cycle",
    "Replay",
    "Section",
    "cut",
    "make_scene",
    "replay_plan",
    "replay_warnings",
    "require_replayed",
    "torque_controller",
]

CUT_TOLERANCE = 1e-12  # of the duration, of the times at which a motion is cut
PERIODS = 3  # of scenes of periodic motions
REPLAY_TOLERANCE = 1e-11  # relative and absolute, of the step loop
BRANCH_TOLERANCE = 1e-6  # rad, m: of coordinates on the branch of the assembled configuration
REPLAY_ERROR = 1e-6  # rad, rad/s, m, m/s: of the replay at the end
MAX_REPLAY_ERROR = 1e-2  # the same units: a plan with a larger one fails
JUMP_GAP = 1e-7  # of the duration, between the rows at both sides of a jump of torques


class CoordinateMotion(Protocol):
    """A motion of the independent coordinates."""

    @property
    def corners(self) -> Array:
        """Times at which the accelerations may jump, with both ends, s."""

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""


@dataclass(frozen=True, eq=False)
class Section:
    """A part of a motion with parameters of its own, from one time to another, s."""

    mechanism: Mechanism
    begin: float
    end: float


class Cycle(Immutable, frozen=True):
    """A motion that repeats. Its scenes have several periods.

    Attributes
    ----------
    turns : (d,) array
        By how much the independent coordinates grow in a period, rad.
    periods : int
        Of the scenes.
    """

    turns: Array
    periods: int = PERIODS


@dataclass(frozen=True)
class Replay:
    """Simulation of a plan's torques in the step loop.

    Attributes
    ----------
    error : float
        Largest difference of the motion's coordinates and their rates at the end, SI units; of a motion that
        repeats, after several periods.
    max_tau : float
        Largest motor torque, N m or N.
    closure : float
        Largest |phi| of the plan between the points of its grid, m and rad.
    """

    error: float
    max_tau: float
    closure: float


def make_scene(
    mechanism: Mechanism, numbers: Array, rates: Array, t_end: float, controller: dict[str, Any], what: str, *,
    crosses: bool,
) -> Scene:  # fmt: skip
    """Return the scene of a plan: from coordinates and their rates (n,) each, with a controller.

    The DAE of eq. 1 is integrated if the plan crosses singular configurations.
    """
    names, at = mechanism.independent, mechanism.partition.q
    q = dict(zip(names, numbers[at].tolist(), strict=True))
    assembled = sigma(mechanism, numbers[at], mechanism.assembled)
    if np.abs(mechanism.tree.to_coordinates(assembled.at.q_tree) - numbers).max() > BRANCH_TOLERANCE:
        q |= {name: float(x) for name, x in zip(mechanism.coordinates, numbers, strict=True) if name not in q}
    return Scene(
        mechanism, t_end=t_end, initial={"q": q, "q_dot": dict(zip(names, rates[at].tolist(), strict=True))},
        controller=controller, name=f"{mechanism.name}, plan, {what} loop", formulation="dae" if crosses else "reduced",
        solver={"rtol": REPLAY_TOLERANCE, "atol": REPLAY_TOLERANCE, "output_dt": t_end / 200},
    )  # fmt: skip


def torque_controller(mechanism: Mechanism, t: Array, torque: Array, cycle: Cycle | None) -> dict[str, Any]:
    """Return the controller of recorded torques. Rows with the same time, where torques jump, become different ones."""
    if cycle is not None:
        t = np.concatenate([t + k * t[-1] for k in range(cycle.periods)])
        torque = np.tile(torque, (cycle.periods, 1))
    same, t, torque = np.flatnonzero(np.diff(t) == 0), np.array(t), np.array(torque)
    for rows, neighbours in ((same, same - 1), (same + 1, same + 2)):
        # The rows move along the lines to their neighbours, which keeps the impulse.
        share = JUMP_GAP * t[-1] / 2 / np.abs(t[neighbours] - t[rows])
        torque[rows] += share[:, None] * (torque[neighbours] - torque[rows])
        t[rows] += share * (t[neighbours] - t[rows])
    columns = {"t": t, **dict(zip(mechanism.motors.names, torque.T, strict=True))}
    return {"type": "torques", "file": columns, "interpolation": "linear"}


def replay_plan(
    mechanism: Mechanism, dynamics: ReducedDynamics, motion: CoordinateMotion, at: MotionInstants, t: Array,
    torque: Array, cycle: Cycle | None = None, sections: tuple[Section, ...] = (),
) -> Replay:  # fmt: skip
    """Simulate a plan's torques and compare the end with the plan's.

    Parameters
    ----------
    mechanism : Mechanism
    dynamics : ReducedDynamics
        In the coordinates of the motion.
    motion : CoordinateMotion
    at : MotionInstants
        The motion from its start on.
    t, torque : (k,) and (k, motors) arrays
    cycle : Cycle, optional
        Of a motion that repeats.
    sections : tuple of Section
        Parts of the motion with different parameters. Each begins at the end of the one before.
    """
    crosses, q_at = dynamics.mechanism.independent != mechanism.independent, dynamics.q_at
    parts = [(mechanism, motion, t, torque, cycle)]
    if sections:
        parts = [(x.mechanism, *cut(motion, t, torque, x), None) for x in sections]
        parts *= 1 if cycle is None else cycle.periods
    numbers, rates, max_tau = mechanism.tree.to_coordinates(at.q_tree[0]), at.v_tree[0], 0.0
    for model, part, part_t, part_torque, part_cycle in parts:
        controller = torque_controller(model, part_t, part_torque, part_cycle)
        t_end = float(part.corners[-1]) * (1 if part_cycle is None else part_cycle.periods)
        run = simulate(make_scene(model, numbers, rates, t_end, controller, "open", crosses=crosses))
        numbers, rates = run.q_tree[-1], run.v_tree[-1]
        max_tau = max(max_tau, float(np.abs(run.tau).max(initial=0.0)))
    q, q_dot, _ = motion(motion.corners[-1:])
    if cycle is not None:
        q = q + (cycle.periods - 1) * cycle.turns
    error = max(np.abs(numbers[q_at] - q[0]).max(), np.abs(rates[q_at] - q_dot[0]).max())
    closure = float(np.abs(dynamics.residual(at.q_tree)).max(initial=0.0))
    return Replay(float(error), max_tau, closure)


def replay_warnings(mechanism: Mechanism, replay: Replay) -> tuple[str, ...]:
    """Return a warning if a replay misses the end of its plan."""
    if replay.error <= REPLAY_ERROR:
        return ()
    remedy = "give more intervals"
    if mechanism.joints.friction.any():
        remedy = "joints with dry friction may stick, which the plan does not foresee; track the motion"
    return (f"the replay misses the end by {replay.error:.1e}; {remedy}",)


def require_replayed(mechanism: Mechanism, replay: Replay, t_end: float) -> None:
    """Raise NumericalError if a replay ends elsewhere. Dry friction has warnings instead, because joints may stick."""
    if replay.error > MAX_REPLAY_ERROR and not mechanism.joints.friction.any():
        raise NumericalError(
            f"optimize: stuck: the replay of the plan misses its end by {replay.error:.1e}: small errors grow "
            f"during its {t_end:.4g} s; give more intervals, limits.time or other limits"
        )


def cut(motion: CoordinateMotion, t: Array, torque: Array, section: Section) -> tuple[CoordinateMotion, Array, Array]:
    """Return a motion and rows of torques from the beginning of a section to its end, over the time since then.

    Of two rows at the beginning, the second one belongs to the section, and of two at the end the first one.
    """
    begin, end, tolerance = section.begin, section.end, CUT_TOLERANCE * float(t[-1])
    first, last = np.flatnonzero(t <= begin + tolerance)[-1], np.flatnonzero(t >= end - tolerance)[0]
    t, torque = t[first : last + 1] - begin, torque[first : last + 1]
    assert isinstance(motion, PiecewisePolynomial)
    middles = (motion.breaks[1:] + motion.breaks[:-1]) / 2
    pieces = np.flatnonzero((middles > begin) & (middles < end))
    breaks = motion.breaks[pieces[0] : pieces[-1] + 2] - begin
    t[[0, -1]] = breaks[[0, -1]] = 0.0, end - begin
    part = PiecewisePolynomial(breaks, motion.coefficients[:, pieces], corners=breaks,
                               max_frequency=motion.max_frequency, end=end - begin)  # fmt: skip
    return part, t, torque
