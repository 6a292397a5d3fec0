"""The `Run`: results of a simulation as one value that can be indexed, plotted, exported, saved and loaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field, replace
from functools import cached_property
from os.path import isdir, isfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.sources import Sources
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.tables import to_csv_text, to_data_frame
from ckc_pin.base.validation import describe_value, is_number, require_path
from ckc_pin.codegen.library import explain_too_large
from ckc_pin.control.desired import Desired
from ckc_pin.control.forces import BodyForce, LinkForceSpec, place_forces
from ckc_pin.errors import CkcError, InputError
from ckc_pin.kinematics.loading import build
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import plain_values
from ckc_pin.mechanism.units import joined
from ckc_pin.run.columns import (
    Quantity,
    evaluate_quantity,
    list_columns,
    list_quantities,
    quantity_units,
    to_dataset,
    unknown_quantity,
)
from ckc_pin.run.derived import RunQuantities
from ckc_pin.run.desired_path import DesiredPath, compute_desired_path, sample_target
from ckc_pin.run.run_file import ARRAYS, OPTIONAL, WORKS, RunMeta, read_run, write_run
from ckc_pin.run.state import State, recorded_state
from ckc_pin.scene.parts import prescribed_positions
from ckc_pin.scene.scene import describe_formulation
from ckc_pin.scene.spec import InitialSpec, PrescribedSpec

if TYPE_CHECKING:
    import pandas
    import xarray

    from ckc_pin.view.inline import Figures, Playback
    from ckc_pin.view.server import ViewServer

__all__ = ["Run", "Status", "format_work"]

Status = Literal["done", "stopped", "interrupted"]

META = tuple(name for name in RunMeta.__struct_fields__ if name not in ("format", "hashes"))
MAX_EVENTS_SHOWN = 10
LONG_RUN_S = 10.0  # compiling the terms of a mechanism usually takes less, s


@dataclass(frozen=True, eq=False, repr=False)
class Run(HasSummary):
    """Results of a simulation. Arrays have a row for each output instant.

    ``run["theta_1"]`` is a coordinate along the motion, ``run["tau.theta_1"]`` a motor torque, ``run["tip.v.x"]`` the
    velocity of a point; docs/reference/names.md lists the names. ``run.sel(t=0.5)`` is the state at an instant.
    ``run.plot()`` draws figures and ``run.play()`` plays the motion. `to_xarray`, `to_pandas` and `to_csv` export it.

    Attributes
    ----------
    status : "done", "stopped" or "interrupted"
    message : str
        Reason of the status, in one sentence.
    t : (m,) array
        Output instants, s.
    q_tree, v_tree : (m, n) arrays
        Values and rates by coordinate, in the order of `coordinates`.
    u, tau : (m, d) and (m, actuators) arrays
        Eq. 6's force in the order of `independent`; motor torques in the order of `actuated`. With torque controllers u
        is not finite where phi_z is singular.
    phi, w : (m, rows) arrays
        Constraint residual and its exact value, which is zero except for the SPF started off its manifold.
    energy : (m,) array
        Kinetic and potential energy, J.
    lyapunov : (m,) array or None
        The controller's Lyapunov function.
    dissipated : (m,) array or None
        Energy dissipated by dry friction and impacts since the start, J. None without them, and with
        `friction_smoothing`, where the work of friction is not recorded.
    works : (m, 5) array or None
        Works of motors, dampers, friction, forces and impacts since the start, J. None unless the scene's `work` is on.
    force_values : (m, 6 k) array or None
        Force, N, and moment, N m, of each of k forces on links, in their axes. None without any.
    prescribed_states : (m, 2 k) array or None
        Of each of k prescribed joints, its acceleration, rad/s^2 or m/s^2, and 1 while it moves as prescribed, else 0.
        None without any.
    max_phi, max_phi_dot : float
        Largest |phi - w| and |phi_dot - w_dot| over the output instants.
    events : list of dict
        Events in order of time: t, name, of, coordinate, value, direction (1 rising, -1 falling; for "limit" 1 leaving,
        -1 coming back), stop. They include the mode transitions of joints: sticking and sliding (of "friction"),
        touching a stop, leaving it and bouncing off it (of "stop").
    stats : dict
        rhs, steps, rejected, newton, factorizations, jacobians, switches, method, steps_by_method, python_calls (calls
        of a controller and of event functions in Python), terms (at the end), rhs_by_terms ("pinocchio", "generated",
        or "general": compiled terms with the general elimination, used where theirs is inaccurate), wall_s.
    scene : dict
        The scene with all defaults filled in.
    texts : dict of str to str
        The mechanism file and every file that it or the scene names.
    warnings : tuple of str
        About the mechanism, the start, a desired motion that left the workspace, and motors above their speed limit.
        `ckc run` adds what `ckc_pin.check` finds by following the desired motion ahead.
    profile : dict
        Evaluated terms with their number of calls and their time, if requested.
    """

    status: Status
    message: str
    coordinates: tuple[str, ...]
    independent: tuple[str, ...]
    actuated: tuple[str, ...]
    t: Array
    q_tree: Array
    v_tree: Array
    u: Array
    tau: Array
    phi: Array
    w: Array
    energy: Array
    lyapunov: Array | None
    dissipated: Array | None
    works: Array | None
    force_values: Array | None
    prescribed_states: Array | None
    max_phi: float
    max_phi_dot: float
    events: list[dict[str, Any]]
    stats: dict[str, Any]
    scene_name: str
    scene: dict[str, Any]
    texts: dict[str, str]
    warnings: tuple[str, ...] = ()
    profile: dict[str, Any] = field(default_factory=dict)
    built_mechanism: InitVar[Mechanism | None] = (
        None  # the simulated mechanism, so that `mechanism` need not rebuild it
    )
    built_target: InitVar[Desired | Array | None] = None  # desired motion of a controller that was given in Python

    def __post_init__(self, built_mechanism: Mechanism | None, built_target: Desired | Array | None) -> None:
        object.__setattr__(self, "_built_mechanism", built_mechanism)
        object.__setattr__(self, "_built_target", built_target)

    @cached_property
    def mechanism(self) -> Mechanism:
        """The run's mechanism. For a run from a file it is rebuilt from the run's texts.

        Raises
        ------
        InputError
            The run's columns do not fit the mechanism.
        """
        simulated: Mechanism | None = self._built_mechanism  # type: ignore[attr-defined]
        if simulated is not None:
            return simulated
        overrides = plain_values(self.scene.get("parameters", {}))
        sources = Sources(self.scene_name, None, self.texts)
        initial = msgspec.convert(self.scene.get("initial", {}), InitialSpec)
        positions = prescribed_positions(self.prescribed, initial.q)
        mechanism = build(self.texts[MECHANISM_FILE], sources, overrides, positions)
        for attribute in ("coordinates", "independent", "actuated"):
            names, expected = getattr(self, attribute), getattr(mechanism, attribute)
            if names != expected:
                raise InputError(
                    f"{self.scene_name}: damaged: the run's {attribute} are {', '.join(names)}, its mechanism's "
                    f"{', '.join(expected)}"
                )
        if self.phi.shape[1] != mechanism.closure.rows:
            raise InputError(
                f"{self.scene_name}: damaged: the run's phi has {self.phi.shape[1]} columns, its mechanism "
                f"{mechanism.closure.rows} rows"
            )
        return mechanism

    @property
    def prescribed(self) -> list[PrescribedSpec]:
        """The scene's prescribed joints."""
        return msgspec.convert(self.scene.get("prescribed", []), list[PrescribedSpec])

    def prescribed_at(self, k: int) -> tuple[Array, BoolArray]:
        """Return the accelerations of the prescribed joints at output instant k, and whether each is prescribed there.

        Raises
        ------
        InputError
            The run is of an older version, which did not record them.
        """
        if self.prescribed_states is None:
            raise InputError(f"{self.scene_name}: this run does not have its prescribed accelerations; run it again")
        accelerations, is_prescribed = self.prescribed_states[k].reshape(-1, 2).T
        return accelerations, is_prescribed > 0

    def forces_at(self, k: int) -> list[BodyForce]:
        """Return the forces on links with their values at output instant k."""
        values = () if self.force_values is None else self.force_values[k].reshape(-1, 6)
        return [force.fixed(value) for force, value in zip(self._placed_forces, values, strict=True)]

    @cached_property
    def _placed_forces(self) -> list[BodyForce]:
        return place_forces(msgspec.convert(self.scene.get("force", []), list[LinkForceSpec]), self.mechanism)

    def summary(self) -> Summary:
        """Return a one-screen summary: final state, largest forces, energy, residual, work and events."""
        mechanism = self._mechanism_or_none()
        units = ([], []) if mechanism is None else (mechanism.tree.units(), mechanism.tree.units("/s"))
        rows: list[Row] = [
            ("formulation", describe_formulation(self.scene, exact=not self.w[0].any())),
            ("instants", f"{len(self.t)}, from t = {self.t[0]:g} to {self.t[-1]:g} s"),
            ("q_tree at the end", format_quantities(self.coordinates, self.q_tree[-1], units[0], 9)),
            ("v_tree at the end", format_quantities(self.coordinates, self.v_tree[-1], units[1])),
        ]
        if np.any(self.u) or np.any(self.tau) or "controller" in self.scene:
            u_unit = tau_unit = ""
            if mechanism is not None:
                by_quantity = quantity_units(mechanism)
                u_unit, tau_unit = f" {joined(by_quantity['u'])}", f" {joined(by_quantity['tau'])}"
            u, tau = _largest_finite(self.u), _largest_finite(self.tau)
            rows.append(("largest |u|, |tau|", f"{u:.4g}{u_unit}, {tau:.4g}{tau_unit}"))
        rows += self._list_warnings(mechanism)
        rows.append(("energy start, end", f"{self.energy[0]:.9g}, {self.energy[-1]:.9g} J"))
        if self.dissipated is not None:
            rows.append(("friction, impacts took", f"{self.dissipated[-1]:.9g} J"))
        if self.works is not None:
            values = format_quantities(WORKS, self.works[-1], ["J"] * len(WORKS), 9)
            rows.append(("works at the end", values))
            rows.append(("energy minus works", f"constant to {self.energy_error:.2g} J"))
        rows.append(("largest |phi - w|", f"{self.max_phi:.2g} (its rate {self.max_phi_dot:.2g})"))
        rows += format_work(self.stats, self._suggest_compiling(mechanism))
        rows += [("event", f"t = {event['t']:.9g} s: {event['name']}") for event in self.events[:MAX_EVENTS_SHOWN]]
        if len(self.events) > MAX_EVENTS_SHOWN:
            rows.append(("", f"and {len(self.events) - MAX_EVENTS_SHOWN} more events"))
        outcome = self.message if self.message.startswith(self.status) else f"{self.status}: {self.message}"
        return Summary(f"Run of {self.scene_name}, {outcome}", rows)

    def _list_warnings(self, mechanism: Mechanism | None) -> list[Row]:
        """Return a row for each warning about the run, and one for those about its mechanism."""
        of_mechanism = set() if mechanism is None else {*mechanism.warnings} & {*self.warnings}
        speed_warnings = [] if mechanism is None else self.list_speed_warnings()
        texts = [text for text in dict.fromkeys((*self.warnings, *speed_warnings)) if text not in of_mechanism]
        rows: list[Row] = [("warning", text) for text in texts]
        if of_mechanism:
            rows.append(("warnings", f"{len(of_mechanism)} about the mechanism, in run.warnings and ckc check"))
        return rows

    def _mechanism_or_none(self) -> Mechanism | None:
        """Return the mechanism, or None if the run's texts are damaged: a summary is printed all the same."""
        try:
            return self.mechanism
        except CkcError:
            return None

    def _suggest_compiling(self, mechanism: Mechanism | None) -> str:
        """Return a hint for a long run that compiled terms would have made faster, or an empty text."""
        if self.stats.get("terms", "pinocchio") != "pinocchio" or self.stats["wall_s"] < LONG_RUN_S:
            return ""
        if mechanism is None or explain_too_large(mechanism):
            return ""
        return "; compiled ones are several times faster: ckc compile"

    @property
    def energy_error(self) -> float:
        """Largest change of the energy minus the works of motors, dampers, friction, forces and impacts, J.

        NaN unless the scene's `work` is on. The SPF that starts off its manifold has a balance of its own.
        """
        if self.works is None:
            return np.nan
        balance = self.energy - self.works.sum(axis=1)
        return float(np.abs(balance - balance[0]).max())

    # --- access by name and by time --------------------------------------------------------------

    def __getitem__(self, name: str) -> Array:
        """Return a quantity along the run by its name, shape (m,), or an array, as ``run["q_tree"]``.

        Quantities that are not recorded are computed at their first use.

        Parameters
        ----------
        name : str
            ``theta_1``, ``v.theta_1``, ``a.theta_1``, ``u.theta_1``, ``tau.MOTOR``, ``desired.theta_1``,
            ``desired.v.theta_1``, ``error.theta_1``, ``tip.x``, ``tip.v.x``, ``loop.LOOP.ROW``, ``joint.JOINT.fx``,
            ``energy.kinetic``, ``energy.potential``, ``energy.total``, ``work.motors`` and others, ``phi.LOOP.ROW``,
            ``phi.max``, ``sigma_min``.

        Raises
        ------
        InputError
            There is no such quantity; the message lists the existing ones and the nearest one. Or this run does not
            determine it.
        """
        if name in self.coordinates:
            return self.q_tree[:, self.coordinates.index(name)]
        arrays = [array for array in (*ARRAYS, *OPTIONAL) if getattr(self, array) is not None]
        if name in arrays:
            return np.asarray(getattr(self, name))
        quantity = self.quantities.get(str(name))
        if quantity is None:
            raise unknown_quantity(f"run[{describe_value(name)}]", name, self.mechanism, arrays)
        return evaluate_quantity(self, name, quantity)

    @cached_property
    def quantities(self) -> dict[str, Quantity]:
        """The names that ``run[name]`` takes for scalar quantities, with array, column and unit of each."""
        return list_quantities(self.mechanism)

    @cached_property
    def derived(self) -> RunQuantities:
        """Arrays that are not recorded, such as point velocities and accelerations; each is computed at first use."""
        return RunQuantities(self)

    @property
    def q(self) -> Array:
        """Independent coordinates, shape (m, d), in the order of `independent`."""
        return self.q_tree[:, self._independent_columns]

    @property
    def q_dot(self) -> Array:
        """Rates of the independent coordinates, shape (m, d). A free root has them in its own axes."""
        return self.v_tree[:, self._independent_columns]

    @property
    def _independent_columns(self) -> list[int]:
        return [self.coordinates.index(name) for name in self.independent]

    @cached_property
    def desired_path(self) -> DesiredPath | None:
        """Desired independent coordinates and their rates along the run; None without a desired motion.

        They follow from the scene. The desired motion of a `Tracking` or `SetPoint` that was given in Python is known
        until the run is saved.
        """
        target: Desired | Array | None = self._built_target  # type: ignore[attr-defined]
        if "controller" in self.scene or target is None:
            return compute_desired_path(self)
        return sample_target(target, self.t, len(self.independent))

    @property
    def desired(self) -> Array | None:
        """Desired independent coordinates q_d, shape (m, d); None without a desired motion."""
        return None if self.desired_path is None else self.desired_path.q

    @property
    def error(self) -> Array | None:
        """Errors q - q_d of the independent coordinates, shape (m, d); None without a desired motion."""
        return None if self.desired is None else self.q - self.desired

    @overload
    def sel(self, *, t: float) -> State: ...

    @overload
    def sel(self, *, t: slice) -> Run: ...

    def sel(self, *, t: float | slice) -> State | Run:
        """Return the state at an instant, or the part of the run between two times.

        Parameters
        ----------
        t : float or slice
            s. A number selects the state at the nearest output instant, whose time is `State.t`. A slice selects the
            instants from its start to its stop, both included.

        Returns
        -------
        State or Run
            A part of a run keeps `stats`, `max_phi` and `max_phi_dot` of the whole run.

        Raises
        ------
        InputError
            A time outside the run, or a slice without output instants.
        """
        first, last = float(self.t[0]), float(self.t[-1])
        if isinstance(t, slice):
            return self._part(first if t.start is None else t.start, last if t.stop is None else t.stop, t.step)
        if not is_number(t):
            raise InputError(f"Run.sel: t: expected a time, s, or slice(start, stop), got {describe_value(t)}")
        if not first <= t <= last:
            raise InputError(f"Run.sel: t = {t:g} s; the run is from {first:g} to {last:g} s")
        return recorded_state(self, self.at(t))

    def _part(self, start: Any, stop: Any, step: Any) -> Run:
        """Return the run's instants from start to stop (s) with the events between them."""
        if step is not None or not (is_number(start) and is_number(stop)):
            raise InputError(
                f"Run.sel: t: expected a slice of two times, s, without a step, got slice({start!r:.40}, {stop!r:.40})"
            )
        rows = (start <= self.t) & (self.t <= stop)
        if not rows.any():
            raise InputError(
                f"Run.sel: no output instant from {start:g} to {stop:g} s; the run is from {self.t[0]:g} to "
                f"{self.t[-1]:g} s"
            )
        arrays = {name: getattr(self, name) for name in (*ARRAYS, *OPTIONAL)}
        selected: dict[str, Any] = {name: x if x is None else x[rows] for name, x in arrays.items()}
        return self._replace(events=[event for event in self.events if start <= event["t"] <= stop], **selected)

    def column(self, coordinate: str) -> int:
        """Return the column of a coordinate.

        Raises
        ------
        InputError
            There is no such coordinate; the message lists the existing ones.
        """
        if coordinate not in self.coordinates:
            raise InputError(f"no coordinate {coordinate!r} in this run; there are {', '.join(self.coordinates)}")
        return self.coordinates.index(coordinate)

    def at(self, t: float) -> int:
        """Return the row of the output instant nearest to t (s)."""
        if not is_number(t):
            raise InputError(f"Run.at: expected a time, s, got {describe_value(t)}")
        return int(np.argmin(np.abs(self.t - t)))

    @cached_property
    def points(self) -> dict[str, Array]:
        """World positions of the mechanism's points along the run, {name: (m, 3) array}."""
        positions = self.derived.point_positions
        return {name: positions[:, 3 * k : 3 * k + 3] for k, name in enumerate(self.mechanism.points)}

    @cached_property
    def motor_rates(self) -> Array:
        """Rates of the motor shafts, before the gears, along the run, shape (m, motors), rad/s or m/s."""
        return self.v_tree @ self.mechanism.motors.transmission.T

    def too_fast(self) -> dict[str, float]:
        """Return the largest rate of each motor that exceeds its speed limit at some output instant, rad/s or m/s."""
        motors = self.mechanism.motors
        largest = np.abs(self.motor_rates).max(axis=0, initial=0.0)
        rates = zip(motors.names, largest, motors.speed_limit, strict=True)
        return {name: float(rate) for name, rate, limit in rates if rate > limit}

    def list_speed_warnings(self) -> list[str]:
        """Return a warning for each motor that exceeds its speed limit."""
        speed_limit = self.mechanism.motors.speed_limit
        if not np.isfinite(speed_limit).any():
            return []
        limits = dict(zip(self.actuated, speed_limit, strict=True))
        return [
            f"{name} turns at {x:.4g}, its speed_limit is {limits[name]:.4g}" for name, x in self.too_fast().items()
        ]

    def with_warnings(self, warnings: Sequence[str]) -> Run:
        """Return the run with further warnings, each of them once."""
        merged = tuple(dict.fromkeys((*self.warnings, *warnings)))
        return self if merged == self.warnings else self._replace(warnings=merged)

    def _replace(self, **attributes: Any) -> Run:
        """Return the run with other attributes, and with what it keeps of the simulation."""
        built: dict[str, Any] = {name: getattr(self, f"_{name}") for name in ("built_mechanism", "built_target")}
        return replace(self, **built, **attributes)

    def loop_forces(self) -> dict[str, Array]:
        """Return the multipliers of eq. 1 along the run by loop, {name: (m, rows of the loop) array}, N or N m.

        The multiplier of a point row is the force that the loop exerts on frame A along the row's axis. NaN is returned
        where J has lost rank, because the multipliers are not determined there.
        """
        from ckc_pin.run.recorded import compute_loop_forces

        return compute_loop_forces(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON of `ckc run` (docs/reference/json.md): scalars, and the state at the end."""
        return {
            "status": self.status,
            "message": self.message,
            "warnings": list(self.warnings),
            "t": float(self.t[-1]),
            "coordinates": list(self.coordinates),
            "q_tree": self.q_tree[-1].tolist(),
            "v_tree": self.v_tree[-1].tolist(),
            "u": self.u[-1].tolist(),
            "tau": self.tau[-1].tolist(),
            "points": {name: path[-1].tolist() for name, path in self.points.items()},
            "max_abs_u": float(np.abs(self.u).max(initial=0.0)),
            "max_abs_tau": float(np.abs(self.tau).max(initial=0.0)),
            "too_fast": self.too_fast(),
            "max_phi": self.max_phi,
            "max_phi_dot": self.max_phi_dot,
            "energy_start": float(self.energy[0]),
            "energy_end": float(self.energy[-1]),
            "dissipated": None if self.dissipated is None else float(self.dissipated[-1]),
            "works": None if self.works is None else dict(zip(WORKS, self.works[-1].tolist(), strict=True)),
            "energy_error": None if self.works is None else self.energy_error,
            "formulation": self.scene["formulation"],
            "epsilon": self.scene["epsilon"] if self.scene["formulation"] == "spf" else None,
            "events": self.events,
            "stats": self.stats,
        }

    # --- figures, playback, export ---------------------------------------------------------------

    def plot(self) -> Figures:
        """Draw figures of the run. A notebook shows them and `save(folder)` writes them; see `ckc_pin.plot`."""
        import ckc_pin

        return ckc_pin.plot(self)

    def play(
        self,
        *,
        speed: float = 1.0,
        gap: float = 0.0,
        meshes: str | Path | None = None,
        forces: bool = False,
        inline: bool | None = None,
    ) -> Playback | ViewServer | None:
        """Play the run in the notebook or, outside a notebook, in the browser until Ctrl-C; see `ckc_pin.play`."""
        import ckc_pin

        return ckc_pin.play(self, speed=speed, gap=gap, meshes=meshes, forces=forces, inline=inline)

    def to_xarray(self) -> xarray.Dataset:
        """Return an xarray Dataset by t, coordinate, independent, motor, row and point (needs the extra `data`)."""
        return to_dataset(self)

    def to_pandas(self, columns: Sequence[str] | None = None) -> pandas.DataFrame:
        """Return a pandas DataFrame by t with the columns of `to_csv` (needs the extra `data`)."""
        return to_data_frame("t", self.t, list_columns(self, columns, "Run.to_pandas"))

    def to_csv(self, path: str | Path, columns: Sequence[str] | None = None) -> Path:
        """Write the run as CSV, with all digits of each number.

        Parameters
        ----------
        path : str or Path
        columns : sequence of str, optional
            Names as in ``run[name]``. Default: coordinates, ``v.``, ``u.``, ``tau.``, the desired motion and the errors
            if there are any, positions and velocities of points, ``phi.``, ``w.``, ``energy.total``, and ``energy``,
            its older name.

        Raises
        ------
        InputError
            The file cannot be written, a column is unknown, or a joint has the name of another column.
        """
        require_path(path, "Run.to_csv: path")
        write_atomic(Path(path), to_csv_text("t", self.t, list_columns(self, columns)))
        return Path(path)

    # --- files -----------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write the run to a file atomically, so that an interruption or a power failure leaves no partial file.

        Raises
        ------
        InputError
            It cannot be written. An existing file is kept.
        """
        require_path(path, "Run.save: path")
        path = Path(path)
        arrays = {name: getattr(self, name) for name in (*ARRAYS, *OPTIONAL) if getattr(self, name) is not None}
        write_run(path, self.coordinates, arrays, self._meta())
        return path

    @classmethod
    def load(cls, path: str | Path) -> Run:
        """Read a run file, or the run.npz in a folder.

        Raises
        ------
        InputError
            The file is missing, no run file, damaged, too large, or of another version.
        """
        require_path(path, "Run.load: path", "the path of a run file, or of a folder that holds a run.npz")
        path = Path(path)
        if isdir(path):
            path = path / "run.npz"
        if not isfile(path):
            mode = path.parent / "mode_1.npz"  # The folder of a linear model has a file for each mode.
            hint = f"; there is {mode}" if isfile(mode) else ""
            raise InputError(f"{path}: no such run file; ckc run SCENE --out DIR writes one{hint}")
        try:
            coordinates, arrays, meta = read_run(path)
        except InputError as error:
            raise InputError(f"{error}; ckc run SCENE --out DIR writes a new one") from None
        rest: dict[str, Any] = {**dict.fromkeys(OPTIONAL), **arrays} | {name: getattr(meta, name) for name in META}
        for name in ("max_phi", "max_phi_dot"):
            rest[name] = np.nan if rest[name] is None else rest[name]
        return cls(coordinates=coordinates, **rest)

    def _meta(self) -> RunMeta:
        return RunMeta(**{name: getattr(self, name) for name in META})


def format_work(stats: dict[str, Any], hint: str = "") -> list[Row]:
    """Return rows of a summary for the work of a run or simulator; `hint` is appended to the row of the terms."""
    steps = ", ".join(f"{name} {count} steps" for name, count in stats["steps_by_method"].items())
    calls = f", {stats['python_calls']} calls of your functions" if stats["python_calls"] else ""
    seconds = f", {stats['wall_s']:.2g} s" if "wall_s" in stats else ""
    terms = stats.get("terms", "pinocchio")  # Old run files have no such key.
    before = stats.get("rhs_by_terms", {}).get("pinocchio", 0)
    late = f", compiled after {before} right-hand sides" if terms == "generated" and before else ""
    work = f"{stats['rhs']} right-hand sides, {stats['newton']} Newton iterations"
    return [
        ("method", f"{steps or stats['method']}, {stats['rejected']} rejected"),
        ("terms", terms + late + hint),
        ("work", f"{work}, {stats['factorizations']} factorizations{calls}{seconds}"),
    ]


def _largest_finite(values: Array) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
