"""What inverse dynamics finds, as one value: to look at, to print, to save."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Status
from ckc_pin.run.summary import forces_summary

__all__ = ["MotionForces", "collected"]

BEYOND = 1e-9  # of a limit: what was cut off there stands at it, but for rounding


@dataclass(frozen=True, eq=False, repr=False)
class MotionForces(HasSummary):
    """What acts in a mechanism along a motion; a row of each array is an instant.

    Attributes
    ----------
    status : "done", "stopped" or "interrupted"
    message : str
        Why, in one sentence, and what of the forces is not unique.
    name : str
        The scene's.
    mechanism : Mechanism
    t : (m,) array
        s.
    q_tree, v_tree, a_tree : (m, n) arrays
        Configuration, velocity and acceleration by coordinate, in the order of `coordinates`.
    tau : (m, actuators) array
        In the order of `actuated`, N m or N; not cut at the limits.
    limit : (motors,) array
        Of |tau|, infinite where there is none.
    loop_forces : dict of str to (m, rows of the loop) array
        Multipliers of eq. 1, N or N m, couplings among them.
    loop_wrenches : dict of str to (m, 6) array
        What each loop does to the body of its frame A, at that frame's origin, in world axes: force, N, and moment,
        N m. Couplings have none.
    joint_forces : dict of str to (m, 6) array
        What each joint transmits to the body that it carries, at the joint's origin: force and moment in world axes,
        those along its axis included. Free roots have none.
    exceeded : list of dict
        Motors that are asked for more than their limit: motor, limit, t (the first instant), most (the largest |tau|),
        t_most.
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
        """Return what there is to see of it."""
        return forces_summary(self)

    def to_dict(self) -> dict[str, Any]:
        """Return motion and forces as JSON-ready data."""
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

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Labels of the tree's coordinates."""
        return self.mechanism.coordinates

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the actuators."""
        return self.mechanism.actuated

    def rows(self, loop: str) -> list[str]:
        """Return what the multipliers of a loop belong to: the labels of its rows."""
        return [row for name, row in self.mechanism.closure.names if name == loop]

    def save(self, path: Path) -> Path:
        """Write it to a file, NumPy's npz without pickle (docs/reference/run_file.md): whole or not at all.

        Raises
        ------
        InputError
            It cannot be written.
        """
        about = {"status": self.status, "message": self.message, "name": self.name, "exceeded": self.exceeded}
        arrays = {
            **{name: getattr(self, name) for name in ("t", "q_tree", "v_tree", "a_tree", "tau")},
            "coordinates": np.array(self.coordinates, dtype=str),
            "actuated": np.array(self.actuated, dtype=str),
            "rows": np.array([".".join(name) for name in self.mechanism.closure.names], dtype=str),
            "multipliers": np.hstack([np.zeros((len(self.t), 0)), *self.loop_forces.values()]),
            "loops": np.array(list(self.loop_wrenches), dtype=str),
            "loop_wrenches": _stacked(self.loop_wrenches, len(self.t)),
            "joints": np.array(list(self.joint_forces), dtype=str),
            "joint_forces": _stacked(self.joint_forces, len(self.t)),
            "meta": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        }
        with open_atomic(path) as file:
            np.savez_compressed(file, **arrays)
        return path


def collected(
    rows: Sequence[dict[str, Any]],
    mechanism: Mechanism,
    limit: Array,
    name: str,
    status: Status,
    message: str,
) -> MotionForces:
    """Put instants, one after the other, into one value; see there.

    Parameters
    ----------
    rows : sequence of dict
        At least one: t, q_tree, v_tree, a_tree, tau, multipliers, and loop_wrenches and joint_forces by name.
    """
    arrays = {key: np.array([row[key] for row in rows]) for key in ("t", "q_tree", "v_tree", "a_tree", "tau")}
    forces, loops = np.array([row["multipliers"] for row in rows]), [loop for loop, _ in mechanism.closure.names]
    if mechanism.redundant:
        names = ", ".join(mechanism.redundant)
        message += f"; rows that others imply ({names}) leave loop and joint forces open: those of least multipliers"
    return MotionForces(
        status=status,
        message=message,
        name=name,
        mechanism=mechanism,
        limit=limit,
        loop_forces={loop: forces[:, [x == loop for x in loops]] for loop in dict.fromkeys(loops)},
        loop_wrenches={x: np.array([row["loop_wrenches"][x] for row in rows]) for x in rows[0]["loop_wrenches"]},
        joint_forces={x: np.array([row["joint_forces"][x] for row in rows]) for x in rows[0]["joint_forces"]},
        exceeded=_exceeded(arrays["t"], arrays["tau"], limit, mechanism.actuated),
        **arrays,
    )


def _exceeded(t: Array, tau: Array, limit: Array, motors: Sequence[str]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for k, motor in enumerate(motors):
        size, most = np.abs(tau[:, k]), float(limit[k])
        beyond = np.flatnonzero(size > most * (1 + BEYOND))
        if len(beyond):
            peak = int(np.argmax(size))
            found.append({"motor": motor, "limit": most, "t": float(t[beyond[0]]), "most": float(size[peak]),
                          "t_most": float(t[peak])})  # fmt: skip
    return found


def _stacked(wrenches: dict[str, Array], count: int) -> Array:
    """Wrenches by name as one array (m, names, 6)."""
    return np.stack(list(wrenches.values()), axis=1) if wrenches else np.zeros((count, 0, 6))
