"""Records of measured motions, and runs of a mechanism that repeat them.

Each record is simulated with its motor torques from a given start, with the exact derivatives of the run with respect
to the unknowns and to the start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.control.controllers import RecordedTorques
from ckc_pin.errors import CkcError, InputError
from ckc_pin.identification.measured_motion import estimate_start
from ckc_pin.identification.records import Record, describe_missing, require_radians
from ckc_pin.identification.smooth_fit import SmoothFit
from ckc_pin.identification.smoothing import fit_record
from ckc_pin.identification.unknowns import LINK_VALUES, ParameterValue, Unknown, Unknowns
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import AXES
from ckc_pin.run.prepare import prepare
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import run_prepared
from ckc_pin.scene.scene import Scene
from ckc_pin.sensitivity.sensitivities import sensitivities

__all__ = [
    "MotionRun",
    "MotionUnknowns",
    "RecordedMotion",
    "RunError",
    "predict",
    "read_motion",
    "simulate_with_derivatives",
]

RTOL = 1e-10  # of runs


class RecordedMotion(Immutable, frozen=True):
    """One record with the inputs of its runs.

    Attributes
    ----------
    names : list of str
        Measured quantities.
    t : (m, k) array
        Times of the values, from the start of the run, s.
    values : (m, k) array
        NaN marks gaps.
    controller : RecordedTorques or None
    q, q_dot : (n,) and (d,) arrays
        First guess of the start.
    fits : mapping of str to SmoothFit
        Of the coordinates that gave it.
    """

    record: Record
    names: list[str]
    t: Array
    values: Array
    controller: RecordedTorques | None
    q: Array
    q_dot: Array
    fits: Mapping[str, SmoothFit]

    def until(self, part: float) -> RecordedMotion:
        """Return the first part of the record."""
        return replace(self, values=np.where(self.t <= part * np.nanmax(self.t), self.values, np.nan))


class MotionRun(Immutable, frozen=True):
    """A run: coordinates (rows, n), first rates (d,), measured quantities (m, k), and derivatives of these.

    The derivatives are by unknown (m, k, p) and by start (m, k, 2 d).
    """

    q: Array
    q_dot: Array
    predicted: Array
    by_unknown: Array
    by_start: Array


class MotionUnknowns(Unknowns):
    """Unknowns of runs.

    Attributes
    ----------
    directions : (p, r) array
        Orthonormal directions of the inertial numbers of links, in typical sizes, along which runs are differentiated.
        The others have no influence on any motion.
    """

    def __init__(
        self, mechanism: Mechanism, unknowns: Sequence[Unknown], links: Sequence[str], directions: Array | None
    ) -> None:
        super().__init__(mechanism, unknowns, links)
        inertial = [int(k) for at in self.bodies for k in at]
        units = np.eye(len(self.names))[:, inertial]
        self.directions = units if directions is None else units @ directions


class RunError(Exception):
    """A run did not reach the last measurement, or its mechanism cannot be built; its cause is what is wrong."""


# --- records ---------------------------------------------------------------------------------------


def read_motion(mechanism: Mechanism, record: Record, warnings: list[str]) -> RecordedMotion:
    """Return a record with the torques of its run, and estimate its start."""
    coordinates = [name for name in mechanism.coordinates if name in record.values]
    torques = [f"tau.{motor}" for motor in mechanism.motors.names]
    required = list(mechanism.independent) if len(coordinates) < mechanism.d else []
    if any(name in record.values for name in torques):
        required += torques
    missing = [name for name in required if name not in record.values]
    if missing:
        needed = f"{mechanism.d} coordinates and the torques of all motors or of none"
        raise InputError(describe_missing(record, missing, needed))
    estimated = next((name for name, delay in record.delay.items() if isinstance(delay, str)), None)
    if estimated is not None:
        raise InputError(
            f'identify: {record.source}: delay: {estimated}: method = "torques" estimates delays; give the delay in s'
        )
    has_torques = all(name in record.values for name in torques)
    if not has_torques:
        warnings.append(f"{record.source}: no torques were recorded, so the motors count as unpowered")
    require_radians(mechanism, record, coordinates)
    names = [name for name, x in record.values.items() if name not in torques and np.isfinite(x).any()]
    t = np.array([record.times(name) for name in names]).T
    values = np.array([record.values[name] for name in names]).T
    series = {name: _measured(record, name) for name in torques} if has_torques else {}
    begin, end = (max((x[0] for x, _ in series.values()), default=-np.inf),
                  min((x[-1] for x, _ in series.values()), default=np.inf))  # fmt: skip
    outside = np.isfinite(values) & ((t < begin) | (t > end))
    if outside.any():
        warnings.append(
            f"{record.source}: {outside.sum()} values before the first or after the last torque are left out"
        )
    values = np.where(outside, np.nan, values)
    first = float(t[np.isfinite(values)].min(initial=np.inf))
    chosen = list(mechanism.independent)
    if not set(chosen) <= set(coordinates):
        at = mechanism.tree.indices(tuple(coordinates), "identify: data")
        order, _ = pivoted_columns(mechanism.assembled.rho[at].T)
        chosen = [coordinates[k] for k in np.sort(order[: mechanism.d])]
    fits = fit_record(record, chosen)
    q, q_dot = estimate_start(mechanism, fits, first)
    controller = _interpolated(list(series.values()), first) if series else None
    return RecordedMotion(record, names, t - first, values, controller, q, q_dot, fits)


def _measured(record: Record, name: str) -> tuple[Array, Array]:
    """Return times and values of a torque without gaps (InputError)."""
    measured = np.isfinite(record.values[name])
    if measured.sum() < 2:
        raise InputError(f"identify: {record.source}: {name} has no values; give the torque, 0 if there is none")
    return record.times(name)[measured], record.values[name][measured]


def _interpolated(series: Sequence[tuple[Array, Array]], first: float) -> RecordedTorques:
    """Return torques over time from the first measurement on, interpolated linearly, also over gaps."""
    times = np.unique(np.concatenate([[first], *(times for times, _ in series)]))
    times = times[times >= first]
    columns = [np.interp(times, *one) for one in series]
    return RecordedTorques(times - first, np.array(columns).T, interpolates=True)


# --- runs ------------------------------------------------------------------------------------------


def simulate_with_derivatives(
    unknowns: MotionUnknowns, motion: RecordedMotion, x: Array, q: Array, q_dot: Array
) -> MotionRun:
    """Simulate a record from a start, with unknowns that are x typical sizes off theirs.

    Raises
    ------
    RunError
    """
    parameters = unknowns.parameters_at(unknowns.start + unknowns.scale * x)
    start = [f"initial.{key}.{name}" for key in ("q", "q_dot") for name in unknowns.mechanism.independent]
    instants, rows = _instants(motion)
    gradients = np.reshape([p.gradient * unknowns.scale for p in parameters], (len(parameters), -1))
    count, basis = len(LINK_VALUES) * len(unknowns.links), unknowns.directions
    inertial, others = parameters[:count], parameters[count:]
    directions = {
        f"direction {k}": {p.name: float(c) for p, c in zip(inertial, column, strict=True) if c}
        for k, column in enumerate((gradients[:count] @ basis).T)
    }
    try:
        scene = _make_scene(unknowns.mechanism, motion, parameters, q, q_dot, float(instants[-1]))
        names = [*(p.name for p in others), *start]
        result = sensitivities(scene, names, instants=instants, directions=directions)
    except CkcError as error:
        raise RunError(str(error)) from error
    predicted = _outputs(result.run, motion, rows)
    slopes = np.array([result[name][rows[:, k]] for k, name in enumerate(motion.names)]).transpose(1, 0, 2)
    by_other, by_start, by_direction = np.split(slopes, [len(others), len(names)], axis=2)
    by_unknown = by_other @ gradients[count:] + by_direction @ basis.T
    return MotionRun(result.run.q_tree, q_dot, predicted, by_unknown, by_start)


def predict(unknowns: MotionUnknowns, motion: RecordedMotion, x: Array, q: Array, q_dot: Array) -> Array:
    """Return the measured quantities of a run without derivatives, (m, k) (RunError)."""
    parameters = unknowns.parameters_at(unknowns.start + unknowns.scale * x)
    instants, rows = _instants(motion)
    try:
        scene = _make_scene(unknowns.mechanism, motion, parameters, q, q_dot, float(instants[-1]))
        run = run_prepared(replace(prepare(scene), instants=instants))
    except CkcError as error:
        raise RunError(str(error)) from error
    return _outputs(run, motion, rows)


def _instants(motion: RecordedMotion) -> tuple[Array, IntArray]:
    """Return the instants of a record's measurements with t = 0, and the row of each measurement (m, k)."""
    measured = np.isfinite(motion.values)
    instants, inverse = np.unique(np.append(motion.t[measured], 0.0), return_inverse=True)
    rows = np.zeros(motion.values.shape, dtype=np.intp)
    rows[measured] = inverse[:-1]
    return instants, rows


def _make_scene(
    mechanism: Mechanism,
    motion: RecordedMotion,
    parameters: Sequence[ParameterValue],
    q: Array,
    q_dot: Array,
    t_end: float,
) -> Scene:
    return Scene(
        mechanism, t_end=max(t_end, 1e-9), formulation="dae", controller=motion.controller,
        initial={"q": dict(zip(mechanism.coordinates, q.tolist(), strict=True)),
                 "q_dot": dict(zip(mechanism.independent, q_dot.tolist(), strict=True))},
        parameters=_overrides(mechanism, parameters), solver={"rtol": RTOL, "atol": RTOL / 10},
    )  # fmt: skip


def _overrides(mechanism: Mechanism, parameters: Sequence[ParameterValue]) -> dict[str, Any]:
    """Return the values of parameters, as vectors where the mechanism was built with this vector."""
    values: dict[str, Any] = {p.name: p.value for p in parameters}
    for name, vector in mechanism.overrides.items():
        components = [f"{name}.{axis}" for axis in AXES]
        if isinstance(vector, tuple) and any(x in values for x in components):
            values[name] = tuple(values.pop(x, old) for x, old in zip(components, vector, strict=True))
    return values


def _outputs(run: Run, motion: RecordedMotion, rows: IntArray) -> Array:
    """Return the measured quantities of a run at given rows, (m, k) (RunError)."""
    if run.status != "done":
        raise RunError(f"the run {run.message}")
    return np.array([run[name][rows[:, k]] for k, name in enumerate(motion.names)]).T
