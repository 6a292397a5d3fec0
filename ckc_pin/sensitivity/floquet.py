"""Floquet multipliers: the stability of periodic motions from their monodromy matrix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.base.summary import HasSummary, Summary, format_eigenvalues, to_pairs
from ckc_pin.base.validation import describe_value, is_number, require_path
from ckc_pin.control.controllers import Controller, RecordedTorques, TorqueController, Tracking
from ckc_pin.control.point_path import PointPath
from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.prepare import prepare
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import Progress, simulate
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.parts import apply_sampling, build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene, as_scene
from ckc_pin.sensitivity.parameters import sensitivity_setup
from ckc_pin.sensitivity.sensitivities import sensitivities

__all__ = ["Floquet", "floquet"]

RETURN_TOLERANCE = 1e-5  # of coordinates and rates, relative to their largest value or 1 rad, m, rad/s or m/s
RETURN_TOLERANCE_OF_RANGE = 1e-2  # relative to the range of a coordinate, so that small motions must return, too
RANGE_ROUNDING = 1e-9  # of coordinates and rates, as RETURN_TOLERANCE; for coordinates that do not move
MIN_PERIOD_S = 1e-9
CLOCK_TOLERANCE = 1e-12  # relative to the period, for a period of a whole number of samples
DRIVE_INSTANTS = 24  # instants at which the drive is compared with its value one period later
CIRCLE_STEPS = 9  # points between a multiplier and the unit circle

ComplexArray = np.ndarray[Any, np.dtype[np.complex128]]


@dataclass(frozen=True, eq=False, repr=False)
class Floquet(HasSummary):
    """Monodromy matrix and Floquet multipliers of a periodic motion.

    Attributes
    ----------
    states : tuple of str
        Rows and columns of the matrix: the independent coordinates, then their rates.
    monodromy : (2 d, 2 d) array
        Derivative of the state after one period with respect to the initial state.
    multipliers : (2 d,) complex array
        Eigenvalues of the monodromy matrix, by decreasing absolute value. The motion is unstable if one of them is
        outside the unit circle.
    stable : bool or None
        True if all perturbations decay, False if one grows. None if the largest multiplier lies on the unit circle to
        within `uncertainty`.
    uncertainty : float
        Error of the monodromy matrix relative to its norm, from the run's tolerance and from the distance by which the
        motion misses its start. Coordinates are measured by their reach, and rates by reach times 2 pi / period. A
        double multiplier at 1 moves by the square root of it.
    period : float
        s.
    run : Run
        One period of the motion.
    """

    states: tuple[str, ...]
    monodromy: Array
    multipliers: ComplexArray
    stable: bool | None
    uncertainty: float
    period: float
    run: Run

    def summary(self) -> Summary:
        """Return multipliers and stability, as `repr` and a notebook show them."""
        return Summary(
            f"Floquet of {self.run.scene_name}, period {self.period:.9g} s",
            [
                ("states", list(self.states)),
                ("multipliers", format_eigenvalues(self.multipliers)),
                ("stability", self._describe_stability()),
            ],
        )

    def _describe_stability(self) -> str:
        verdict = {
            True: "perturbations decay",
            False: "perturbations grow, the motion is unstable",
            None: "to first order perturbations neither grow nor decay exponentially",
        }[self.stable]
        return (
            f"{verdict}: largest multiplier {np.abs(self.multipliers[0]):.6g} in size, relative uncertainty of the "
            f"monodromy matrix {self.uncertainty:.1g}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON-ready data, complex numbers as [re, im]."""
        return {
            "name": self.run.scene_name,
            "states": list(self.states),
            "period": self.period,
            "monodromy": self.monodromy.tolist(),
            "multipliers": to_pairs(self.multipliers),
            "stable": self.stable,
            "uncertainty": self.uncertainty,
        }

    def save(self, path: str | Path) -> Path:
        """Write the matrix and its multipliers to a file, NumPy's npz without pickle (docs/guide/sensitivities.md).

        The file is written completely or not at all.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        require_path(path, "Floquet.save: path")
        path = Path(path)
        arrays: dict[str, Any] = {"monodromy": self.monodromy, "multipliers": self.multipliers}
        arrays |= {"states": np.array(self.states, dtype=str), "period": self.period, "name": self.run.scene_name}
        with open_atomic(path) as file:
            np.savez_compressed(file, **arrays)
        return path


def floquet(
    scene: Scene | str | Path,
    period: float,
    overrides: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Floquet:
    """Return the monodromy matrix and the Floquet multipliers of a scene whose motion is periodic from its start.

    Parameters
    ----------
    scene : Scene, str or Path
    period : float
        s.
    overrides : mapping, optional
        As in `simulate`.
    progress : callable, optional
        Called as ``progress(t, period)`` about every 0.05 s while the variational equations are integrated.

    Returns
    -------
    Floquet

    Raises
    ------
    InputError
        The motion, or the desired motion or torques that drive it, does not return after the period. The message says
        by how much.
    NumericalError
        The run stops before the end of the period.
    """
    period = _require_period(period)
    scene = as_scene(scene, overrides, "floquet").with_overrides({"t_end": period})
    mechanism = load_scene_mechanism(scene)
    mechanism.refuse_prescribed_joints("floquet")
    if root := mechanism.independent_root_coordinates:
        raise InputError(
            f"{mechanism.name}: the independent coordinate {root[0]!r} belongs to a free root, whose rotation has no "
            "monodromy matrix; choose other independent coordinates, or fix the root"
        )
    law = build_scene_controller(scene, mechanism)
    sampled = apply_sampling(scene, law)
    if isinstance(sampled, Sampled):
        _require_whole_samples(sampled, period, scene.name)
    if (drive := _find_drive(law, mechanism)) is not None:
        _require_periodic_drive(drive, period)
    if scene.spec.initial.at is not None:
        scene = _start_from_coordinates(scene, mechanism)
    names = mechanism.independent
    parameters = [f"initial.{quantity}.{name}" for quantity in ("q", "q_dot") for name in names]
    try:
        # A scene without supported derivatives is rejected before anything is run.
        prepare(scene, set_up_sensitivities=sensitivity_setup(parameters))
    except InputError as error:
        raise InputError(f"floquet: {str(error).removeprefix('sensitivities: ')}") from None
    # The motion alone is checked first, because the variational equations cost 2 d times as much.
    _require_return(simulate(scene), period)
    derivatives = sensitivities(scene, parameters, None, progress)
    run, q = derivatives.run, mechanism.partition.q
    monodromy = np.concatenate([derivatives.q_tree[-1][q], derivatives.v_tree[-1][q]])
    multipliers = np.linalg.eigvals(monodromy).astype(np.complex128)
    order = np.argsort(-np.abs(multipliers), kind="stable")
    states = (*names, *(f"v.{name}" for name in names))
    uncertainty = _require_return(run, period) + scene.spec.solver.rtol
    reach = mechanism.tree.step_scale[q]
    scale = np.concatenate([reach, 2 * np.pi / period * reach])
    stable = _is_stable(monodromy / scale[:, None] * scale, multipliers, uncertainty)
    return Floquet(states, monodromy, multipliers[order], stable, uncertainty, period, run)


def _require_period(period: Any) -> float:
    """Return the period as a float; InputError if it is not a positive number."""
    if not is_number(period):
        raise InputError(f"floquet: period: expected a number of seconds, got {describe_value(period)}")
    if not np.isfinite(period) or period <= 0:
        raise InputError(f"period = {period:g}: expected a positive number of seconds")
    if period < MIN_PERIOD_S:
        raise InputError(f"period = {period:g} s is too short; a period is at least {MIN_PERIOD_S:g} s")
    return float(period)


def _is_stable(monodromy: Array, multipliers: ComplexArray, uncertainty: float) -> bool | None:
    """Return True if all multipliers are inside the unit circle for every matrix within the uncertainty.

    False if one is outside for every such matrix, None otherwise. A multiplier may lie on the circle if M - z I is
    within the uncertainty of a singular matrix for all z from the multiplier to the circle.
    """
    error = uncertainty * float(np.linalg.norm(monodromy, 2))
    may_be_on_circle = []
    for x in multipliers:
        sizes = np.geomspace(max(abs(x), 1e-300), 1.0, CIRCLE_STEPS)
        shifted = (monodromy - size * np.exp(1j * np.angle(x)) * np.eye(len(monodromy)) for size in sizes)
        may_be_on_circle.append(all(np.linalg.svd(matrix, compute_uv=False)[-1] <= error for matrix in shifted))
    if np.any((np.abs(multipliers) > 1) & ~np.array(may_be_on_circle)):
        return False
    return None if any(may_be_on_circle) else True


# --- periodicity ---------------------------------------------------------------------------------


class _Drive(NamedTuple):
    """A function of time that drives a scene: its name, its values, its end, and which of its values are angles."""

    name: str
    values_at: Callable[[float], Array]
    end: float
    is_angle: BoolArray


def _find_drive(law: Controller | TorqueController | None, mechanism: Mechanism) -> _Drive | None:
    if isinstance(law, RecordedTorques):
        rest = Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n))
        return _Drive("the torque over time", lambda t: law.tau(t, rest), float(law.times[-1]), np.zeros(0, bool))
    if not isinstance(law, Tracking):
        return None
    desired, is_angle = law.desired, ~mechanism.tree.in_metres[mechanism.partition.q]
    if isinstance(desired, PointPath):
        desired, is_angle = desired.path, is_angle[:0]
    end = float(getattr(desired, "end", np.inf))
    return _Drive("the desired motion", lambda t: np.concatenate(desired(t)[:2]), end, is_angle)


def _require_whole_samples(controller: Sampled, period: float, name: str) -> None:
    """Refuse a sampled controller whose state is not the same after a period (InputError)."""
    if controller.delay > 0:
        raise InputError(
            f"{name}: controller.delay: floquet does not support delayed outputs, because they are part of the state "
            "and the monodromy matrix is that of q and q_dot; remove the delay, or use check, which analyses the "
            "sampled loop"
        )
    samples = period / controller.sample_time
    if not abs(samples - max(1.0, round(samples))) <= CLOCK_TOLERANCE * samples:
        raise InputError(
            f"{name}: controller.sample_time: period = {period:.9g} s is {samples:.9g} samples; it must be a whole "
            "number of samples"
        )


def _require_periodic_drive(drive: _Drive, period: float) -> None:
    """Refuse a desired motion or torques over time that do not have the period (InputError)."""
    for t in period * np.arange(DRIVE_INSTANTS) / DRIVE_INSTANTS:
        if t + period > drive.end * (1 + 1e-12):
            return
        before, after = drive.values_at(t), drive.values_at(t + period)
        miss, angles = after - before, len(drive.is_angle)
        miss[:angles] = np.where(drive.is_angle, _wrap_angle(miss[:angles]), miss[:angles])
        largest = float(np.abs(miss).max())
        if not largest <= RETURN_TOLERANCE * max(1.0, float(np.abs(before).max())):
            raise InputError(
                f"period = {period:.9g} s is not a period: {drive.name} differs by {largest:.6g} between t = {t:.6g} s "
                "and one period later"
            )


def _wrap_angle(angle: Array) -> Array:
    """Return angles without whole turns, in [-pi, pi)."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def _start_from_coordinates(scene: Scene, mechanism: Mechanism) -> Scene:
    """Return the scene with the coordinates of its start as numbers, because they are the parameters."""
    start = find_start(mechanism, scene)
    q = mechanism.tree.named(mechanism.tree.to_coordinates(start.at.q_tree))
    overrides = {"initial": {"q": q, "q_dot": scene.spec.initial.q_dot}}
    return scene.with_overrides(overrides)


def _require_return(run: Run, period: float) -> float:
    """Return the difference between the end and the start of a motion, relative to its reach.

    Whole turns of a joint are ignored.

    Raises
    ------
    InputError
        The difference is too large for a periodic motion.
    """
    if run.status == "interrupted":
        raise interrupt_again(run.message)
    if run.status != "done" or run.t[-1] < period * (1 - 1e-12):
        raise NumericalError(f"floquet: the run stops before the end of the period: {run.message}")
    tree, largest = run.mechanism.tree, 0.0
    for label, values, unit in (("", run.q_tree, 1.0), (" (rate)", run.v_tree, 2 * np.pi / period)):
        miss = values[-1] - values[0]
        if not label:
            miss = np.where(tree.in_metres, miss, _wrap_angle(miss))
        scale = max(1.0, float(np.abs(values).max()))
        tolerance_of_range = RANGE_ROUNDING * scale * min(1.0, period) + RETURN_TOLERANCE_OF_RANGE * np.ptp(
            values, axis=0
        )
        tolerance = np.minimum(RETURN_TOLERANCE * scale, tolerance_of_range)
        worst = int(np.argmax(np.abs(miss) / tolerance))
        if not np.abs(miss[worst]) <= tolerance[worst]:
            raise InputError(
                f"period = {run.t[-1]:.9g} s is not a period: after it {run.coordinates[worst]}{label} differs by "
                f"{miss[worst]:.6g} from its {values[0, worst]:.6g} at the start"
            )
        largest = max(largest, float(np.abs(miss / (unit * tree.step_scale)).max()))
    return largest
