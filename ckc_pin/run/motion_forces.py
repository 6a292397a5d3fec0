"""Motor, loop and joint forces of a motion: the result of inverse dynamics."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic, write_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.tables import require_names, to_csv_text, to_data_frame
from ckc_pin.base.validation import describe_value, require_path
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.units import motor_units
from ckc_pin.run.columns import (
    Quantity,
    list_quantities,
    unknown_quantity,
)
from ckc_pin.run.derived import DerivedQuantities
from ckc_pin.run.run import Status

if TYPE_CHECKING:
    import pandas

    from ckc_pin.view.inline import Figures

__all__ = ["MotionForces", "collect_forces"]

OWN_ARRAYS = ("q_tree", "v_tree", "a_tree", "tau", "multipliers", "joint_wrenches")  # in the order of a table
NOT_COMPUTED = ("u", "desired", "desired_dot", "error", "phi", "w", "phi_max")
MOMENT_TOLERANCE = 1e-9  # of the force times the mechanism's size: a smaller moment is not printed
LIMIT_TOLERANCE = 1e-9  # relative to a limit: a torque clipped at its limit may exceed it by rounding


@dataclass(frozen=True, eq=False, repr=False)
class MotionForces(HasSummary):
    """Forces in a mechanism along a motion. Arrays have a row for each instant.

    ``forces["tau.theta_1"]`` is a motor torque, ``forces["loop.elbow.x"]`` the multiplier of a constraint row and
    ``forces["joint.theta_2.fx"]`` a component of a joint's wrench; docs/reference/names.md lists the names. `plot`
    draws them, `to_pandas` and `to_csv` export them.

    Attributes
    ----------
    status : "done", "stopped" or "interrupted"
    message : str
        Reason of the status, in one sentence, and forces that are not unique.
    name : str
        Name of the scene.
    mechanism : Mechanism
    t : (m,) array
        Times, s.
    q_tree, v_tree, a_tree : (m, n) arrays
        Configuration, velocity and acceleration by coordinate, in the order of `coordinates`.
    tau : (m, actuators) array
        Motor torques in the order of `actuated`, N m or N; not clipped at the limits.
    limit : (2, motors) array
        Lower and upper limits of tau; infinite for motors without one.
    loop_forces : dict of str to (m, rows of the loop) array
        Multipliers of eq. 1 by loop and coupling, N or N m.
    loop_wrenches : dict of str to (m, 6) array
        Wrench of each loop on the body of its frame A, at that frame's origin, in world axes: force, N, and moment,
        N m. Couplings have none.
    joint_forces : dict of str to (m, 6) array
        Wrench that each joint transmits to its child body, at the joint's origin, in world axes: force, N, and moment,
        N m, including those along the joint's axis. Free roots have none.
    exceeded : list of dict
        Motors whose limit is exceeded: motor, limit (the size of the one that is exceeded most), t (the first instant),
        most (the largest |tau| beyond that limit), t_most.
    """

    status: Status
    message: str
    name: str
    mechanism: Mechanism
    t: Array
    q_tree: Array
    v_tree: Array
    a_tree: Array
    tau: Array
    limit: Array
    loop_forces: dict[str, Array]
    loop_wrenches: dict[str, Array]
    joint_forces: dict[str, Array]
    exceeded: list[dict[str, Any]]

    def summary(self) -> Summary:
        """Return a one-screen summary: largest motor torques, names of loops and joints, exceeded limits."""
        rows: list[Row] = [("instants", f"{len(self.t)}, from t = {self.t[0]:g} to {self.t[-1]:g} s")]
        exceeded = {entry["motor"]: entry for entry in self.exceeded}
        for k, (motor, unit) in enumerate(zip(self.actuated, motor_units(self.mechanism), strict=True)):
            items = [self._format_largest(np.abs(self.tau[:, k]), unit)]
            lower, upper = self.limit[:, k]
            if np.isfinite(lower) or np.isfinite(upper):
                onset = f", exceeded from t = {exceeded[motor]['t']:.4g} s on" if motor in exceeded else ""
                limits = f"limit {upper:.4g}" if lower == -upper else f"limits {lower:.4g} to {upper:.4g}"
                items.append(f"{limits} {unit}{onset}")
            rows.append((f"motor {motor}", items))
        for loop, multipliers in self.loop_forces.items():
            if loop not in self.loop_wrenches:
                rows.append((f"coupling {loop}", self._format_largest(np.abs(multipliers[:, 0]), "")))
                continue
            wrench = self.loop_wrenches[loop]
            force, moment = np.linalg.norm(wrench[:, :3], axis=1), np.linalg.norm(wrench[:, 3:], axis=1)
            if force.any() or not moment.any():
                rows.append((f"loop {loop}", self._format_largest(force, "N")))
            if moment.max() > MOMENT_TOLERANCE * self.mechanism.size * force.max():
                rows.append((f"loop {loop}, moment", self._format_largest(moment, "N m")))
        rows.append(("joint_forces", list(self.joint_forces)))
        return Summary(f"MotionForces of {self.name}, {self.status}: {self.message}", rows)

    def _format_largest(self, sizes: Array, unit: str) -> str:
        k = int(sizes.argmax())
        return f"at most {f'{sizes[k]:.4g} {unit}'.rstrip()} at t = {self.t[k]:.4g} s"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON of `ckc inverse` (docs/reference/json.md): all arrays as lists, forces by name."""
        loops = {}
        for loop, multipliers in self.loop_forces.items():
            wrench = self.loop_wrenches.get(loop)
            loops[loop] = {
                "rows": self.rows(loop),
                "multipliers": multipliers.tolist(),
                "force": None if wrench is None else wrench[:, :3].tolist(),
                "moment": None if wrench is None else wrench[:, 3:].tolist(),
            }
        return {
            **{name: getattr(self, name).tolist() for name in ("t", "q_tree", "v_tree", "a_tree", "tau")},
            "coordinates": self.coordinates,
            "actuated": self.actuated,
            "loop_forces": loops,
            "joint_forces": {joint: wrench.tolist() for joint, wrench in self.joint_forces.items()},
            "exceeded": self.exceeded,
            "redundant": self.mechanism.redundant,
            "status": self.status,
            "message": self.message,
        }

    # --- access by name, figures, export ---------------------------------------------------------

    def __getitem__(self, name: str) -> Array:
        """Return a quantity along the motion by its name, shape (m,).

        Parameters
        ----------
        name : str
            ``theta_1``, ``v.theta_1``, ``a.theta_1``, ``tau.MOTOR``, ``loop.LOOP.ROW``, ``joint.JOINT.fx`` to ``.mz``,
            ``tip.x``, ``tip.v.x``, ``energy.kinetic``, ``energy.potential``, ``energy.total``, ``sigma_min``.

        Raises
        ------
        InputError
            There is no such quantity; the message lists the nearest ones. Or inverse dynamics does not compute it.
        """
        quantity = self.quantities.get(str(name))
        where = f"forces[{describe_value(name)}]"
        if quantity is None:
            raise unknown_quantity(where, name, self.mechanism)
        if quantity.array in NOT_COMPUTED:
            raise InputError(f"{where}: inverse dynamics has no such quantity; a run has it")
        return quantity.select(getattr(self if quantity.array in OWN_ARRAYS else self._derived, quantity.array))

    @cached_property
    def quantities(self) -> dict[str, Quantity]:
        """All names of quantities, with array, column and unit of each."""
        return list_quantities(self.mechanism)

    @cached_property
    def _derived(self) -> DerivedQuantities:
        return DerivedQuantities(self.t, self.q_tree, self.v_tree, self.mechanism)

    @property
    def multipliers(self) -> Array:
        """Multipliers of eq. 1 by constraint row, shape (m, rows), N or N m."""
        return np.hstack([np.zeros((len(self.t), 0)), *self.loop_forces.values()])

    @property
    def joint_wrenches(self) -> Array:
        """Wrenches that the joints transmit, one after the other, shape (m, 6 joints)."""
        return np.hstack([np.zeros((len(self.t), 0)), *self.joint_forces.values()])

    def plot(self) -> Figures:
        """Draw motor efforts and loop forces. A notebook shows the figure and `save(folder)` writes it."""
        import ckc_pin

        return ckc_pin.plot(self)

    def to_pandas(self, columns: Sequence[str] | None = None) -> pandas.DataFrame:
        """Return a pandas DataFrame by t with the columns of `to_csv` (needs the extra `data`)."""
        return to_data_frame("t", self.t, self._list_columns(columns, "MotionForces.to_pandas"))

    def to_csv(self, path: str | Path, columns: Sequence[str] | None = None) -> Path:
        """Write the motion and its forces as CSV, with all digits of each number.

        Parameters
        ----------
        path : str or Path
        columns : sequence of str, optional
            Names as in ``forces[name]``. Default: coordinates, ``v.``, ``a.``, ``tau.``, ``loop.``, ``joint.``.

        Raises
        ------
        InputError
            The file cannot be written, or a column is unknown.
        """
        require_path(path, "MotionForces.to_csv: path")
        write_atomic(Path(path), to_csv_text("t", self.t, self._list_columns(columns, "MotionForces.to_csv")))
        return Path(path)

    def _list_columns(self, columns: Sequence[str] | None, where: str) -> dict[str, Array]:
        if columns is None:
            return {name: self[name] for name, quantity in self.quantities.items() if quantity.array in OWN_ARRAYS}
        return {name: self[name] for name in require_names(columns, where)}

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the tree's coordinates."""
        return self.mechanism.coordinates

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the motors."""
        return self.mechanism.actuated

    def rows(self, loop: str) -> list[str]:
        """Return the names of a loop's constraint rows, in the order of its multipliers."""
        return [row for name, row in self.mechanism.closure.names if name == loop]

    def save(self, path: Path) -> Path:
        """Write all values to a NumPy npz file without pickle (docs/reference/run_file.md), atomically.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        meta = {"status": self.status, "message": self.message, "name": self.name, "exceeded": self.exceeded}
        arrays = {
            **{name: getattr(self, name) for name in ("t", "q_tree", "v_tree", "a_tree", "tau")},
            "coordinates": np.array(self.coordinates, dtype=str),
            "actuated": np.array(self.actuated, dtype=str),
            "rows": np.array([".".join(name) for name in self.mechanism.closure.names], dtype=str),
            "multipliers": self.multipliers,
            "loops": np.array(list(self.loop_wrenches), dtype=str),
            "loop_wrenches": _stack_wrenches(self.loop_wrenches, len(self.t)),
            "joints": np.array(list(self.joint_forces), dtype=str),
            "joint_forces": _stack_wrenches(self.joint_forces, len(self.t)),
            "meta": np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8),
        }
        with open_atomic(path) as file:
            np.savez_compressed(file, **arrays)
        return path


def collect_forces(
    parts: Sequence[dict[str, Any]],
    mechanism: Mechanism,
    limit: Array,
    *,
    name: str,
    status: Status,
    message: str,
) -> MotionForces:
    """Return the `MotionForces` of consecutive parts of a motion.

    Parameters
    ----------
    parts : sequence of dict
        One dict for each part, at least one, with arrays of its instants: t, q_tree, v_tree, a_tree, tau, multipliers,
        and by name loop_wrenches and joint_forces.
    mechanism, limit, name, status, message
        As in `MotionForces`.
    """
    keys = ("t", "q_tree", "v_tree", "a_tree", "tau", "multipliers")
    arrays = {key: np.concatenate([part[key] for part in parts]) for key in keys}
    forces, loops = arrays.pop("multipliers"), [loop for loop, _ in mechanism.closure.names]
    if mechanism.redundant:
        names = ", ".join(mechanism.redundant)
        message += f"; rows {names} are redundant, so loop and joint forces are those with minimum-norm multipliers"
    return MotionForces(
        status=status,
        message=message,
        name=name,
        mechanism=mechanism,
        limit=limit,
        loop_forces={loop: forces[:, [x == loop for x in loops]] for loop in dict.fromkeys(loops)},
        loop_wrenches=_join([part["loop_wrenches"] for part in parts]),
        joint_forces=_join([part["joint_forces"] for part in parts]),
        exceeded=_find_exceeded_limits(arrays["t"], arrays["tau"], limit, mechanism.actuated),
        **arrays,
    )


def _join(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Return the wrenches by name of consecutive parts of a motion."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _find_exceeded_limits(t: Array, tau: Array, limit: Array, motors: Sequence[str]) -> list[dict[str, Any]]:
    exceeded: list[dict[str, Any]] = []
    for k, motor in enumerate(motors):
        lower, upper = limit[:, k] * (1 + LIMIT_TOLERANCE)
        beyond = np.flatnonzero((tau[:, k] < lower) | (tau[:, k] > upper))
        if len(beyond):
            peak = int(np.argmax(np.maximum(lower - tau[:, k], tau[:, k] - upper)))
            maximum = abs(float(limit[int(tau[peak, k] > upper), k]))
            exceeded.append({"motor": motor, "limit": maximum, "t": float(t[beyond[0]]),
                             "most": abs(float(tau[peak, k])), "t_most": float(t[peak])})  # fmt: skip
    return exceeded


def _stack_wrenches(wrenches: dict[str, Array], count: int) -> Array:
    """Return wrenches by name as one array, shape (m, names, 6)."""
    return np.stack(list(wrenches.values()), axis=1) if wrenches else np.zeros((count, 0, 6))
