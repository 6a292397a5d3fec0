"""The result of `optimize`: a motion with its motor torques, its replay in the step loop, scenes and files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary, to_json
from ckc_pin.base.tables import to_csv_text, to_data_frame
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.optimization.replay import CoordinateMotion, Cycle, Replay, Section, cut, make_scene, torque_controller
from ckc_pin.run.columns import list_quantities
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.scene import Scene

if TYPE_CHECKING:
    import pandas

    from ckc_pin.run.run import Run
    from ckc_pin.view.inline import Figures

__all__ = ["ActiveLimit", "Crossing", "Plan", "find_active", "measure"]

ACTIVE_FRACTION = 0.01  # of a limit's range: a quantity that comes closer makes the limit active
MERGED_GAP = 0.005  # of the duration: a limit that is left for less counts as active all the time
BANDWIDTH = 20.0  # of the tracking controller, in units of 1 / t_end


@dataclass(frozen=True)
class ActiveLimit:
    """A limit that a quantity reaches, from one time to another, s."""

    quantity: str
    side: str
    begin: float
    end: float


@dataclass(frozen=True)
class Crossing:
    """A passage through a singular configuration.

    Attributes
    ----------
    t : float
        s.
    unbalanced : float
        Force in the direction in which the motors produce least, that the motion needs beyond theirs, relative to the
        whole force that it needs: 0 up to the error of the plan.
    """

    t: float
    unbalanced: float


@dataclass(frozen=True, eq=False, repr=False)
class Plan(HasSummary):
    """A planned motion with its motor torques.

    Attributes
    ----------
    mechanism : Mechanism
    status : "solved"
    message : str
    t_end : float
        Duration, s.
    cost : float
    parts : dict of str to float
        Parts of the cost, without weights: time in s, effort in N² m² s, and so on.
    iterations : int
        Of the optimizer; sweeps of a motion along a path.
    coordinates : tuple of str
        Coordinates of `motion`: the independent ones, or others if it crosses singular configurations.
    motion : CoordinateMotion
        These coordinates over time, with rates and accelerations.
    torque_t, torque : (k,) and (k, motors) arrays
        Motor torques, linear between the rows.
    t, quantities : (m,) and (m, names) arrays
        Quantities of `limits.names` at instants.
    margin : (m,) array
        Smallest singular value of phi_z, relative to the start; 1 without loops.
    limits : MotionLimits
    active : tuple of ActiveLimit
    replay : Replay
    warnings : tuple of str
    crossings : tuple of Crossing
        Passages through singular configurations.
    via_t : tuple of float
        When the motion reaches the places of ``[[via]]``, s.
    cycle : Cycle, optional
        Of a motion that repeats. The other attributes are of one period.
    sections : tuple of Section
        Parts with different parameters; empty if all are equal.
    """

    mechanism: Mechanism
    status: str
    message: str
    t_end: float
    cost: float
    parts: dict[str, float]
    iterations: int
    coordinates: tuple[str, ...]
    motion: CoordinateMotion
    torque_t: Array
    torque: Array
    t: Array
    quantities: Array
    margin: Array
    limits: MotionLimits
    active: tuple[ActiveLimit, ...]
    replay: Replay
    warnings: tuple[str, ...]
    crossings: tuple[Crossing, ...] = ()
    via_t: tuple[float, ...] = ()
    cycle: Cycle | None = None
    sections: tuple[Section, ...] = ()

    def part(self, number: int) -> Plan:
        """Return the plan of one of the `sections`, which has a scene of its own. Its time begins at 0.

        Cost, replay and warnings are those of the whole plan.

        Parameters
        ----------
        number : int
            From 0 on.

        Raises
        ------
        InputError
            There is no such section.
        """
        if not 0 <= number < len(self.sections):
            raise InputError(f"part: expected a number below {len(self.sections)}, the sections, got {number}")
        section = self.sections[number]
        motion, t, torque = cut(self.motion, self.torque_t, self.torque, section)
        rows = (self.t >= section.begin) & (self.t <= section.end)
        active = [replace(x, begin=max(x.begin, section.begin) - section.begin,
                          end=min(x.end, section.end) - section.begin)
                  for x in self.active if x.begin < section.end and x.end > section.begin]  # fmt: skip
        return replace(
            self, mechanism=section.mechanism, t_end=section.end - section.begin, motion=motion, torque_t=t,
            torque=torque, t=self.t[rows] - section.begin, quantities=self.quantities[rows], margin=self.margin[rows],
            active=tuple(active), via_t=(), cycle=None, sections=(),
        )  # fmt: skip

    def columns(self) -> dict[str, Array]:
        """Return coordinates, rates, accelerations and motor torques by name at the instants `t`."""
        named = zip(self.limits.names, self.quantities.T, strict=True)
        return {name: x for name, x in named if name.split(".")[0] not in ("speed", "power", "total_power", "distance")}

    def scene(self, control: str = "open") -> Scene:
        """Return a scene that replays the plan.

        Parameters
        ----------
        control : "open" or "closed"
            The plan's torques over time, or tracking control (eq. 16) of the plan's motion.

        Raises
        ------
        InputError
            Parameters change in the motion. Each `part` has a scene. Or tracking control of a motion that crosses
            singular configurations, where eq. 16 has no torques.
        """
        if self.sections:
            raise InputError("scene: parameters change in this plan; take plan.part(k).scene() of each section")
        if control == "closed" and not self.can_be_tracked:
            raise InputError(
                "plan.scene: tracking control (eq. 16) has no torques in the singular configurations that the plan "
                'crosses; take control = "open"'
            )
        n, periods = self.mechanism.n, 1 if self.cycle is None else self.cycle.periods
        return make_scene(self.mechanism, self.quantities[0, :n], self.quantities[0, n : 2 * n],
                           periods * self.t_end, self._controller(control), control,
                           crosses=not self.can_be_tracked)  # fmt: skip

    @property
    def can_be_tracked(self) -> bool:
        """Whether the motion is one of the independent coordinates, which tracking control (eq. 16) needs."""
        return self.coordinates == self.mechanism.independent

    def _controller(self, control: str) -> dict[str, Any]:
        if control == "open":
            return torque_controller(self.mechanism, self.torque_t, self.torque, self.cycle)
        mechanism = self.mechanism
        at = mechanism.assembled
        inertia = np.diag(Terms(mechanism, at, np.zeros(mechanism.n)).D)
        bandwidth = BANDWIDTH / self.t_end
        t = np.linspace(0.0, self.t_end, len(self.t))
        q, _, _ = self.motion(t)
        if self.cycle is not None:
            k = np.repeat(np.arange(self.cycle.periods), len(t) - 1)
            q = np.concatenate([np.tile(q[:-1], (self.cycle.periods, 1)) + k[:, None] * self.cycle.turns,
                                q[:1] + self.cycle.periods * self.cycle.turns])  # fmt: skip
            t = np.linspace(0.0, self.cycle.periods * self.t_end, len(q))
        table = {"t": t, **dict(zip(mechanism.independent, q.T, strict=True))}
        return {"type": "tracking", "Lambda": bandwidth, "desired": {"file": table},
                "K_D": dict(zip(mechanism.independent, (bandwidth * inertia).tolist(), strict=True))}  # fmt: skip

    def simulate(self) -> Run:
        """Run the plan's torques in the step loop."""
        return simulate(self.scene())

    def to_csv(self, path: str | Path) -> Path:
        """Write t and the `columns` for a controller (InputError)."""
        write_atomic(Path(path), to_csv_text("t", self.t, self.columns()))
        return Path(path)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the table of `to_csv` (needs the extra `data`)."""
        return to_data_frame("t", self.t, self.columns())

    def plot(self) -> Figures:
        """Draw motion, torques with their limits, and margin. A notebook shows them; `save(folder)` writes them."""
        import ckc_pin

        return ckc_pin.plot(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Write open.scene.toml, closed.scene.toml, plan.csv and plan.json into a folder (InputError).

        Scenes of `sections` are in folders of their own, part_1 and so on. A motion that crosses singular
        configurations has no closed.scene.toml.
        """
        folder = Path(folder)
        parts = {folder / f"part_{k + 1}": self.part(k) for k in range(len(self.sections))} or {folder: self}
        scenes = [part.scene(name).save(place, name, overwrite=overwrite or name == "closed")
                  for place, part in parts.items() for name in ("open", "closed")
                  if name == "open" or self.can_be_tracked]  # fmt: skip
        files = [*scenes, self.to_csv(folder / "plan.csv"), folder / "plan.json"]
        write_atomic(files[-1], to_json(self.to_dict(files)) + "\n")
        return files

    def summary(self) -> Summary:
        """Return duration, cost, replay, and the limits that the motion reaches."""
        units = list_quantities(self.mechanism)
        largest = [f"{name} {np.abs(self.torque[:, k]).max():.4g} {units[f'tau.{name}'].unit}"
                   for k, name in enumerate(self.mechanism.motors.names)]  # fmt: skip
        reached = [f"{x.quantity} {x.side}, {x.begin:.3g} to {x.end:.3g} s" for x in self.active]
        crossed = [f"at {x.t:.4g} s, unbalanced force {x.unbalanced:.1e}" for x in self.crossings]
        periods = "" if self.cycle is None else f"{self.cycle.periods} periods, "
        rows: list[Row] = [
            ("status", f"{self.status}: {self.message}"),
            ("duration", f"{self.t_end:.6g} s"),
            *([("places reached", [f"{t:.6g} s" for t in self.via_t])] if self.via_t else []),
            ("cost", f"{self.cost:.6g}: " + ", ".join(f"{name} {x:.4g}" for name, x in self.parts.items())),
            ("iterations", str(self.iterations)),
            ("largest torques", largest),
            ("sigma_min", f"at least {self.margin.min():.3g} of the start's"),
            *([("crosses singular configurations", crossed)] if crossed else []),
            ("active limits", reached or "none"),
            ("replay", f"{periods}error {self.replay.error:.1e}, largest torque {self.replay.max_tau:.4g}, "
             f"closure of the plan {self.replay.closure:.1e}"),
        ]  # fmt: skip
        rows += [("warning", warning) for warning in self.warnings]
        return Summary(f"Plan of {self.mechanism.name}", rows)

    def to_dict(self, files: list[Path] | None = None) -> dict[str, Any]:
        """Return the result as JSON-ready data.

        Parameters
        ----------
        files : list of Path, optional
            Written files.
        """
        return {
            "name": self.mechanism.name,
            "status": self.status,
            "message": self.message,
            "t_end": self.t_end,
            "cost": self.cost,
            "parts": self.parts,
            "iterations": self.iterations,
            "replay": {"error": self.replay.error, "max_tau": self.replay.max_tau, "closure": self.replay.closure},
            "margin": float(self.margin.min()),
            "via_t": list(self.via_t),
            "periods": 1 if self.cycle is None else self.cycle.periods,
            "active": [{"quantity": x.quantity, "side": x.side, "from": x.begin, "to": x.end} for x in self.active],
            "crossings": [{"t": x.t, "unbalanced": x.unbalanced} for x in self.crossings],
            "warnings": list(self.warnings),
            "files": _relative_names(files or []),
        }


def _relative_names(files: list[Path]) -> list[str]:
    """Return paths of files relative to the folder that has all of them."""
    folder = min((path.parent for path in files), key=lambda x: len(x.parts), default=Path())
    return [path.relative_to(folder).as_posix() for path in files]


def measure(mechanism: Mechanism, dynamics: ReducedDynamics, limits: MotionLimits, at: MotionInstants) -> Array:
    """Return the quantities that have limits at each instant, in the order of `limits.names`, shape (m, names)."""
    numbers = np.array([mechanism.tree.to_coordinates(one) for one in at.q_tree])
    shafts, distances = at.v_tree @ mechanism.motors.transmission.T, dynamics.distances(at.q_tree, limits.spheres)
    power = shafts * at.tau
    return np.hstack([numbers, at.v_tree, at.a_tree, shafts, at.tau, power, power.sum(axis=1, keepdims=True),
                      distances])  # fmt: skip


def find_active(limits: MotionLimits, t: Array, quantities: Array, margin: Array) -> list[ActiveLimit]:
    """List the limits that quantities reach, each from one time to another, in the order of these times."""
    lower, upper = limits.bounds()
    size = np.where(np.isfinite(upper) & np.isfinite(lower), upper - lower, limits.sizes(quantities))
    reached: list[ActiveLimit] = []
    names = limits.names
    sides = [
        ("lower", quantities - lower <= ACTIVE_FRACTION * size / 2),
        ("upper", upper - quantities <= ACTIVE_FRACTION * size / 2),
    ]
    for side, active in sides:
        for k in np.flatnonzero(active.any(axis=0)):
            reached += [ActiveLimit(names[k], side, *span) for span in _spans(t, active[:, k])]
    if limits.singularity:
        close = margin <= limits.singularity * (1 + ACTIVE_FRACTION)
        reached += [ActiveLimit("sigma_min", "lower", *span) for span in _spans(t, close)]
    return sorted(reached, key=lambda x: (x.begin, x.quantity))


def _spans(t: Array, active: BoolArray) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]]).astype(int)))
    spans: list[tuple[float, float]] = []
    for begin, end in zip(t[edges[::2]].tolist(), t[edges[1::2] - 1].tolist(), strict=True):
        if spans and begin - spans[-1][1] < MERGED_GAP * float(t[-1]):
            begin = spans.pop()[0]
        spans.append((begin, end))
    return spans
