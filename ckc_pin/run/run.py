"""The `Run`: what a simulation gives, as one value that can be saved, loaded and replayed anywhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from os.path import isdir, isfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.sources import Sources
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.base.validation import describe_value, is_number, require_path
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import build
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import plain_values
from ckc_pin.run.columns import as_csv, as_data_frame, as_dataset
from ckc_pin.run.instants import part_of, state_of
from ckc_pin.run.run_file import ARRAYS, OPTIONAL, RunMeta, read_run, write_run
from ckc_pin.run.state import State
from ckc_pin.run.summary import run_summary

if TYPE_CHECKING:
    import pandas
    import xarray

    from ckc_pin.view.inline import Figures, Playback
    from ckc_pin.view.server import ViewServer

__all__ = ["Run", "Status"]

Status = Literal["done", "stopped", "interrupted"]

META = tuple(name for name in RunMeta.__struct_fields__ if name not in ("format", "hashes"))


@dataclass(frozen=True, eq=False, repr=False)
class Run(HasSummary):
    """A simulated motion; a row of each array is an output instant.

    ``run["theta_1"]`` is a coordinate along the motion, ``run.sel(t=0.5)`` the state at an instant, ``run.plot()`` and
    ``run.play()`` show it, `to_xarray`, `to_pandas` and `to_csv` hand it over.

    Attributes
    ----------
    status : "done", "stopped" or "interrupted"
    message : str
        Why, in one sentence.
    t : (m,) array
        Output instants, s.
    q_tree, v_tree : (m, n) arrays
        By coordinate, in the order of `coordinates`.
    u, tau : (m, d) and (m, actuators) arrays
        Eq. 6's force in the order of `independent`; the motors' torques in the order of `actuated`. Where torques act
        and phi_z is singular, there is no u: not finite.
    phi, w : (m, rows) arrays
        The closure's residual, and what it should be (zero but for the SPF started off its manifold).
    energy : (m,) array
        Kinetic and potential energy, J.
    lyapunov : (m,) array or None
        The controller's Lyapunov function.
    dissipated : (m,) array or None
        Energy that dry friction and impacts have taken since the start, J. None where there are neither, and with
        `friction_smoothing`, where friction is a force like a damper's whose work is not counted.
    max_phi, max_phi_dot : float
        Largest |phi - w| and |phi_dot - w_dot| over the output instants.
    events : list of dict
        Events that were met, in order of time: t, name, of, coordinate, value, direction (1 rising, -1 falling; of
        "limit" 1 is leaving, -1 coming back), stop. Beside a scene's: where a joint sticks or slides (of "friction"),
        touches a stop, leaves it or bounces off it (of "stop").
    stats : dict
        rhs, steps, rejected, newton, factorizations, jacobians, switches, method, steps_by_method, python_calls (of a
        caller's controller and events), terms (at the end), rhs_by_terms ("pinocchio", "generated", or
        "general": compiled terms, but the general elimination because theirs rounds too much), wall_s.
    scene : dict
        The scene as resolved.
    texts : dict of str to str
        The mechanism file and every file that it or the scene names.
    profile : dict
        Terms evaluated, how often and for how long, when asked for.
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
    max_phi: float
    max_phi_dot: float
    events: list[dict[str, Any]]
    stats: dict[str, Any]
    scene_name: str
    scene: dict[str, Any]
    texts: dict[str, str]
    profile: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def mechanism(self) -> Mechanism:
        """The mechanism, built again from the run's own texts.

        InputError: it is not the one that the numbers are of.
        """
        overrides = plain_values(self.scene.get("parameters", {}))
        mechanism = build(self.texts[MECHANISM_FILE], Sources(self.scene_name, None, self.texts), overrides)
        for what in ("coordinates", "independent", "actuated"):
            own, theirs = getattr(self, what), getattr(mechanism, what)
            if own != theirs:
                says = f"{', '.join(own)}, its mechanism's {', '.join(theirs)}"
                raise InputError(f"{self.scene_name}: damaged: the run's {what} are {says}")
        if self.phi.shape[1] != mechanism.closure.rows:
            rows = f"{self.phi.shape[1]} columns, its mechanism {mechanism.closure.rows} rows"
            raise InputError(f"{self.scene_name}: damaged: the run's phi has {rows}")
        return mechanism

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return run_summary(self)

    # --- by name, by time ------------------------------------------------------------------------

    def __getitem__(self, name: str) -> Array:
        """Return a coordinate along the run, shape (m,), or an array by its name, as ``run["energy"]``.

        Raises
        ------
        InputError
            Neither; names those there are.
        """
        if name in self.coordinates:
            return self.q_tree[:, self.coordinates.index(name)]
        others = [other for other in (*ARRAYS, *OPTIONAL) if getattr(self, other) is not None]
        if name not in others:
            own = ", ".join(self.coordinates)
            raise InputError(
                f"run[{describe_value(name)}]: there are the coordinates {own}, and the arrays {', '.join(others)}"
            )
        return np.asarray(getattr(self, name))

    @overload
    def sel(self, *, t: float) -> State: ...

    @overload
    def sel(self, *, t: slice) -> Run: ...

    def sel(self, *, t: float | slice) -> State | Run:
        """Return the run at an instant, or from one time to another.

        Parameters
        ----------
        t : float or slice
            s. A number: the state at the output instant nearest to it, whose own t says which that is. A slice: the
            run's instants from its start to its stop, both included.

        Returns
        -------
        State or Run
            Of a part of a run `stats`, `max_phi` and `max_phi_dot` are those of the whole.

        Raises
        ------
        InputError
            A time before the run's start or after its end, or none between the two.
        """
        first, last = float(self.t[0]), float(self.t[-1])
        if isinstance(t, slice):
            return part_of(self, first if t.start is None else t.start, last if t.stop is None else t.stop, t.step)
        if not is_number(t):
            raise InputError(f"Run.sel: t: expected a time, s, or slice(start, stop), got {describe_value(t)}")
        if not first <= t <= last:
            raise InputError(f"Run.sel: t = {t:g} s; the run is from {first:g} to {last:g} s")
        return state_of(self, self.at(t))

    def column(self, coordinate: str) -> int:
        """Return the column of a coordinate; InputError names the valid ones."""
        if coordinate not in self.coordinates:
            raise InputError(f"no coordinate {coordinate!r} in this run; there are {', '.join(self.coordinates)}")
        return self.coordinates.index(coordinate)

    def at(self, t: float) -> int:
        """Return the row of the output instant nearest to t, s."""
        if not is_number(t):
            raise InputError(f"Run.at: expected a time, s, got {describe_value(t)}")
        return int(np.argmin(np.abs(self.t - t)))

    @cached_property
    def points(self) -> dict[str, Array]:
        """World positions of the mechanism's points along the run, {name: (m, 3) array}."""
        mechanism = self.mechanism
        paths = {name: np.empty((len(self.t), 3)) for name in mechanism.points}
        for k, numbers in enumerate(self.q_tree):
            for name, p in mechanism.point_positions(mechanism.tree.from_coordinates(numbers)).items():
                paths[name][k] = p
        return paths

    @cached_property
    def motor_rates(self) -> Array:
        """Rates of the motors themselves, before their gears, along the run, shape (m, motors), rad/s or m/s."""
        return self.v_tree @ self.mechanism.motors.transmission.T

    def too_fast(self) -> dict[str, float]:
        """Return the largest rate of each motor that is above its speed limit at some output instant."""
        motors = self.mechanism.motors
        largest = np.abs(self.motor_rates).max(axis=0, initial=0.0)
        every = zip(motors.names, largest, motors.speed_limit, strict=True)
        return {name: float(rate) for name, rate, limit in every if rate > limit}

    def loop_forces(self) -> dict[str, Array]:
        """Multipliers of eq. 1 along the run by loop, {name: (m, rows of the loop) array}, N or N m.

        For a point row: the force that the loop exerts on frame A, along the row's axis. NaN where J has lost rank, so
        that nothing determines them.
        """
        from ckc_pin.run.recorded_joints import loop_forces

        return loop_forces(self)

    def to_dict(self) -> dict[str, Any]:
        """Return what `ckc run --json` prints (docs/reference/json.md): scalars, and the last instant by name."""
        last = {name: path[-1].tolist() for name, path in self.points.items()}
        return {
            "status": self.status,
            "message": self.message,
            "t": float(self.t[-1]),
            "coordinates": list(self.coordinates),
            "q_tree": self.q_tree[-1].tolist(),
            "v_tree": self.v_tree[-1].tolist(),
            "u": self.u[-1].tolist(),
            "tau": self.tau[-1].tolist(),
            "points": last,
            "max_abs_u": float(np.abs(self.u).max(initial=0.0)),
            "max_abs_tau": float(np.abs(self.tau).max(initial=0.0)),
            "too_fast": self.too_fast(),
            "max_phi": self.max_phi,
            "max_phi_dot": self.max_phi_dot,
            "energy_start": float(self.energy[0]),
            "energy_end": float(self.energy[-1]),
            "dissipated": None if self.dissipated is None else float(self.dissipated[-1]),
            "formulation": self.scene["formulation"],
            "epsilon": self.scene["epsilon"] if self.scene["formulation"] == "spf" else None,
            "events": self.events,
            "stats": self.stats,
        }

    # --- to look at, to hand over -------------------------------------------------------------------

    def plot(self) -> Figures:
        """Draw the run: figures that a notebook shows and `save(folder)` writes; see `ckc_pin.plot`."""
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
        """Play the run: in a notebook below the cell, elsewhere in the browser until Ctrl-C; see `ckc_pin.play`."""
        import ckc_pin

        return ckc_pin.play(self, speed=speed, gap=gap, meshes=meshes, forces=forces, inline=inline)

    def to_xarray(self) -> xarray.Dataset:
        """Return the run as xarray's Dataset, by t, coordinate, independent, motor, row and point (extra `data`)."""
        return as_dataset(self)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the run as pandas' DataFrame by t, with the columns of `to_csv` (extra `data`)."""
        return as_data_frame(self)

    def to_csv(self, path: str | Path) -> Path:
        """Write the run as CSV: t, each coordinate by its name, v.NAME, u.NAME, tau.MOTOR, phi.ROW, w.ROW, energy.

        Points are POINT.x, .y, .z. Every number is written to its last digit.

        Raises
        ------
        InputError
            It cannot be written; a joint is called as another column is.
        """
        require_path(path, "Run.to_csv: path")
        write_atomic(Path(path), as_csv(self))
        return Path(path)

    # --- files -----------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write the run to a file: whole or not at all, also when the machine goes down meanwhile.

        Raises
        ------
        InputError
            It cannot be written; what was there is still there.
        """
        require_path(path, "Run.save: path")
        path = Path(path)
        arrays = {name: getattr(self, name) for name in (*ARRAYS, *OPTIONAL) if getattr(self, name) is not None}
        write_run(path, self.coordinates, arrays, self._meta())
        return path

    @classmethod
    def load(cls, path: str | Path) -> Run:
        """Read a run file, or the run.npz of a folder.

        Raises
        ------
        InputError
            No such file, not a run file, damaged, too large, or of another version.
        """
        require_path(path, "Run.load: path", "the path of a run file, or of a folder that holds a run.npz")
        path = Path(path)
        if isdir(path):
            path = path / "run.npz"
        if not isfile(path):
            mode = path.parent / "mode_1.npz"  # a linear model's folder has one for each
            where = f"; there is {mode}" if isfile(mode) else ""
            raise InputError(f"{path}: no such run file; ckc run SCENE --out DIR writes one{where}")
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
