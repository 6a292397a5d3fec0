"""Members of a sweep: prepared once, and run in native threads as a batch or one by one.

A batch takes members that differ in parameters and starts only. Other members are prepared as separate runs: those that
differ in the controller or the solver, and those whose loops cannot be closed by continuation from the scene's start.
Members whose motion does not begin or end regularly are run again separately, because a run gives the reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.base.sources import Sources
from ckc_pin.codegen.arguments import present
from ckc_pin.codegen.library import Library, compile_terms, explain_too_large, find_compiled_terms
from ckc_pin.ensembles.outputs import TIME_TOLERANCE, Function, NamedQuantity, Output, Outputs, Recorded
from ckc_pin.ensembles.spec import OutputSpec, SweepSpec
from ckc_pin.ensembles.variables import Variables, check_variable_names
from ckc_pin.errors import CkcError, InputError
from ckc_pin.mechanism.parameter_map import ParameterMap
from ckc_pin.mechanism.parameters import is_parameter
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from ckc_pin.run.columns import key_unit
from ckc_pin.run.prepare import prepare
from ckc_pin.run.simulate import build_run, record_rows
from ckc_pin.scene.initial import find_branch
from ckc_pin.scene.parts import rebuild_scene_mechanism
from ckc_pin.scene.saving import scene_texts
from ckc_pin.scene.scene import Scene, as_scene

__all__ = ["DONE", "FAILED", "PENDING", "STATUS", "STOPPED", "Chunk", "MemberNumbers", "Members", "SweepTask"]

PENDING, DONE, STOPPED, FAILED = range(4)
Statuses = NDArray[np.uint8]
STATUS = ("pending", "done", "stopped", "failed")
MIN_RHS_TO_COMPILE = 1_000_000  # right-hand sides for each coordinate, from which compiling terms saves time
END, EVENT = _core.StopReason.END.value, _core.StopReason.EVENT.value
MAX_INTEGER = 2.0**63  # of an integer in a scene
BATCHED_NUMBERS = {
    "gravity", "offset", "mass", "centre", "inertia", "point", "end", "length", "constant", "joint_stiffness",
    "joint_rest", "joint_damping", "stiffness", "rest_length", "damping",
}  # fmt: skip
DERIVED_NUMBERS = {"moment", "origin_inertia"}  # follow from mass, centre and inertia


@dataclass(frozen=True)
class SweepTask:
    """Serializable description of a sweep, with which a worker process can prepare and run its members.

    Attributes
    ----------
    spec : SweepSpec
    name : str
        Name of the sweep in messages.
    scene : Scene, str or Path
    folder : Path or None
        Folder of the files of values.
    functions : dict of str to callable
        Outputs that are functions of a `Run`.
    terms : str or None
        "generated" or "pinocchio" if that is decided; it is the same on every machine.
    """

    spec: SweepSpec
    name: str
    scene: Scene | str | Path
    folder: Path | None
    functions: Mapping[str, Function] = field(default_factory=dict)
    terms: str | None = None

    def prepare(self, threads: int) -> Members:
        """Prepare the members for a number of threads."""
        overrides = dict(self.spec.overrides)
        if self.terms is not None:
            overrides["solver.terms"] = self.terms
        outputs = {**self.spec.outputs, **self.functions}
        return Members(self.scene, overrides, tuple(self.spec.variables), outputs, self.variables.count, threads)

    @cached_property
    def variables(self) -> Variables:
        """Variables and their values."""
        return Variables(self.spec, Sources(self.name, self.folder))

    @cached_property
    def identity(self) -> str:
        """Hash of everything that the task computes."""
        functions = sorted(
            (name, getattr(f, "__qualname__", type(f).__qualname__)) for name, f in self.functions.items()
        )
        scene: Any = str(self.scene)
        if isinstance(self.scene, Scene):
            scene = scene_texts(self.scene, self.scene.name)
        content = (msgspec.to_builtins(self.spec), scene, str(self.folder), functions, self.terms)
        return sha256(msgspec.json.encode(content, order="deterministic")).hexdigest()


@dataclass(frozen=True)
class Chunk:
    """Results of consecutive members.

    Attributes
    ----------
    first : int
        The first member.
    values : (members, variables) array
    status : (members,) array
        Indices into `STATUS`.
    message : list of str
        Why a member stopped or failed; empty for others.
    outputs : dict of str to (members, ...) array
    rhs : int
        Right-hand sides of all members.
    """

    first: int
    values: Array
    status: Statuses
    message: list[str]
    outputs: dict[str, Array]
    rhs: int


class Members:
    """A scene that is run many times with different values of its variables.

    Parameters
    ----------
    scene : Scene, str or Path
    overrides : mapping
        Overrides of the scene, for all members.
    names : sequence of str
        The variables.
    outputs : mapping
        As in `Outputs`.
    count : int
        Number of members, which decides whether compiling terms saves time.
    threads : int
    lanes : bool
        Whether a thread computes several members at a time with compiled terms, in the lanes of the processor's vector
        registers. Results do not depend on it.

    Raises
    ------
    CkcError
        The scene cannot be run, or a variable or output is unknown.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        overrides: Mapping[str, Any],
        names: tuple[str, ...],
        outputs: Mapping[str, str | OutputSpec | Function],
        count: int,
        threads: int,
        *,
        lanes: bool = True,
    ) -> None:
        self._overrides, self.names = dict(overrides), names
        self._threads, self._lanes = threads, lanes
        self.scene = as_scene(scene, overrides, "ensemble")
        self.ready = prepare(self.scene)
        self.mechanism = self.ready.mechanism
        self._vectors = check_variable_names(self.scene, self.mechanism, names)
        self._output_specs = outputs
        self._has_fixed_mechanism = not any(is_parameter(name) for name in names)
        self.outputs = Outputs(outputs, self.ready, has_fixed_mechanism=self._has_fixed_mechanism)
        self._require_equal_instants()
        self._parameters = [k for k, name in enumerate(names) if is_parameter(name)]
        parameters = ParameterMap(
            self.mechanism, self.scene.spec.parameters, partial(rebuild_scene_mechanism, self.scene)
        )
        self._numbers = MemberNumbers(parameters, [names[k] for k in self._parameters])
        self._library = self._select_library(count)
        self.terms = "pinocchio" if self._library is None else "generated"
        self.shapes = self._find_shapes()
        self.is_batched = self._can_be_batched()
        self._batch: Any = None

    # --- running ---------------------------------------------------------------------------------

    def run(self, first: int, values: Array) -> Chunk:
        """Run members and return their results.

        Parameters
        ----------
        first : int
            The first member.
        values : (members, variables) array
            Values of the variables.

        Raises
        ------
        KeyboardInterrupt
            All results of the chunk are lost.
        """
        count, instants = len(values), len(self.instants)
        recorded = Recorded(
            last_row=np.full((count, self.ready.loop.width), np.nan),
            series=np.full((count, len(self.outputs.columns), instants), np.nan),
            event_times=np.full((count, len(self.ready.events)), np.nan),
        )
        status, message = np.full(count, PENDING, np.uint8), [""] * count
        rhs = self._run_batch(values, recorded, status, message) if self.is_batched else 0
        outputs = self.outputs.compute(recorded)
        for name in self.outputs.functions:
            outputs[name] = np.full((count, *self.shapes[name][1]), np.nan)
        rhs += self._run_separately(np.flatnonzero(status == PENDING), values, status, message, outputs)
        return Chunk(first, values, status, message, outputs, rhs)

    def scene_of(self, values: Array) -> Scene:
        """Return the scene of a member, which `simulate` runs as the ensemble does."""
        return self.scene.with_overrides(self._values_by_key(values))

    def overrides_of(self, values: Array) -> dict[str, Any]:
        """Return a member's overrides. `simulate` and `ckc run` do the same run with them."""
        return {**self._overrides, **self._values_by_key(values)}

    def _values_by_key(self, values: Array) -> dict[str, Any]:
        """Return the terms, and the values of a member's variables, by key of the scene; vectors are complete."""
        overrides: dict[str, Any] = {"solver.terms": self.terms}
        for name, value in zip(self.names, values, strict=True):
            vector = self._vectors.get(name)
            if vector is not None:  # the scene gives all three components
                vector_name, axis = vector
                components = list(overrides.get(vector_name, self.scene.spec.parameters[vector_name]))
                components[axis] = float(value)
                overrides[vector_name] = components
            else:
                is_integer = float(value).is_integer() and abs(value) < MAX_INTEGER and not is_parameter(name)
                overrides[name] = int(value) if is_integer else float(value)
        return overrides

    @property
    def instants(self) -> Array:
        """Instants at which members are recorded, s."""
        return self.ready.instants if self.outputs.needs_series else self.ready.instants[-1:]

    @property
    def units(self) -> dict[str, tuple[str, ...]]:
        """Units of each variable, and of the components of each output that is not a function, by name."""
        variable_units = {name: (key_unit(self.mechanism, name),) for name in self.names}
        return variable_units | {name: output.units for name, output in self._all_outputs().items()}

    def _all_outputs(self) -> dict[str, Output | NamedQuantity]:
        """Return all outputs whose dimensions and units are known, that is without the caller's functions."""
        derived = {name: x for name, x in self.outputs.functions.items() if isinstance(x, NamedQuantity)}
        return {**self.outputs.outputs, **derived}

    def count_rhs(self) -> int:
        """Run the scene itself, and return its number of right-hand sides."""
        try:
            _, status, message = record_rows(self.ready)
        except CkcError:
            return 0
        if status == "interrupted":
            raise interrupt_again(message)
        return int(self.ready.loop.stats().rhs)

    def _run_batch(self, values: Array, recorded: Recorded, status: Statuses, message: list[str]) -> int:
        """Run the members that a batch can take; enter their results, and return their right-hand sides."""
        if self._batch is None:
            _, *tables = self.ready.tables  # the scene's compiled terms may lack parameters that are zero in the scene
            core = core_table(self.mechanism, self._library, self.scene.spec.friction_smoothing or 0.0)
            self._batch = _core.Batch(core, *tables, tolerance=self.mechanism.tolerance, threads=self._threads)
        numbers, is_physical = self._numbers.evaluate(values[:, self._parameters])
        batched = np.flatnonzero(is_physical)
        count = len(batched)
        if not count:
            return 0
        parameters = [(_core.CoreParameter[name.upper()], x[batched].reshape(count, -1)) for name, x in numbers.items()]
        if numbers and self._library is not None:
            parameters.append((_core.CoreParameter.COMPILED, self._numbers.arguments(numbers, len(values))[batched]))
        q, q_dot = self._compute_starts(values[batched])
        recorded_by_key = {
            "last_row": recorded.last_row,
            "series": recorded.series,
            "event_times": recorded.event_times,
        }
        out: dict[str, Any] = {name: np.zeros(count, np.int64) for name in ("stop_reason", "row_count")}
        out |= {"counters": np.zeros(3 * count, np.int64), "t": np.empty(count)}
        out |= {key: np.full((count, *array.shape[1:]), np.nan) for key, array in recorded_by_key.items()}
        self._batch.run(
            self._base, q, q_dot, parameters=[(kind, np.ascontiguousarray(x)) for kind, x in parameters],
            instants=self.instants, columns=self.outputs.columns, until=self.scene.spec.t_end, out=out,
        )  # fmt: skip
        reasons = out["stop_reason"]  # values of StopReason; -1: the member could not be started
        is_regular = np.isin(reasons, (END, EVENT)) & (out["row_count"] > 0)
        for key, array in recorded_by_key.items():
            array[batched[is_regular]] = out[key][is_regular]
        status[batched[is_regular]] = DONE
        for k in np.flatnonzero(reasons == EVENT):
            stopping = [j for j, event in enumerate(self.ready.events) if event.stop]
            times = out["event_times"][k]
            j = max(stopping, key=lambda j: (times[j] == times[j], times[j]))  # NaN first
            message[batched[k]] = (
                f"stopped by the event at t = {out['t'][k]:.9g} s: {self.ready.events[j].label['name']}"
            )
        return int(out["counters"].reshape(-1, 3)[is_regular, 0].sum())

    def _compute_starts(self, values: Array) -> tuple[Array, Array]:
        """Return q and q_dot at the start of some members, (members, d) each."""
        q, q_dot = np.tile(self._q, (len(values), 1)), np.tile(self.ready.start.q_dot, (len(values), 1))
        for k, name in enumerate(self.names):
            for prefix, start in (("initial.q.", q), ("initial.q_dot.", q_dot)):
                if name.startswith(prefix):
                    start[:, self.mechanism.independent.index(name.removeprefix(prefix))] = values[:, k]
        return q, q_dot

    def _run_separately(
        self, indices: IntArray, values: Array, status: Statuses, message: list[str], outputs: dict[str, Array]
    ) -> int:
        """Prepare and run members one by one, their step loops in threads; return their right-hand sides."""
        if not len(indices):
            return 0
        cancelled = Event()

        def run_one(k: int) -> int:
            status[k], message[k], rhs = self._run_member(values[k], k, outputs, cancelled)
            return rhs

        if self._threads == 1 or len(indices) == 1:
            return sum(run_one(int(k)) for k in indices)
        with ThreadPoolExecutor(self._threads) as pool:
            try:
                return sum(pool.map(run_one, [int(k) for k in indices]))
            except BaseException:
                cancelled.set()
                pool.shutdown(cancel_futures=True)
                raise

    def _run_member(self, values: Array, k: int, outputs: dict[str, Array], cancelled: Event) -> tuple[int, str, int]:
        """Run one member, enter its outputs, and return its status, message and right-hand sides."""

        def require_not_cancelled(t: float, t_end: float) -> None:
            if cancelled.is_set():
                raise KeyboardInterrupt

        try:
            ready = prepare(self.scene_of(values))
            rows, ended, message = record_rows(ready, require_not_cancelled)
        except CkcError as error:
            return FAILED, str(error), 0
        if ended == "interrupted":
            raise interrupt_again(message)
        # Output instants and q_d may differ between members.
        member_outputs = Outputs(self._output_specs, ready, has_fixed_mechanism=self._has_fixed_mechanism)
        for name, value in member_outputs.compute(member_outputs.record(rows)).items():
            outputs[name][k] = value[0]
        rhs = ready.loop.stats().rhs
        status, message = (
            (DONE, "" if message == "reached t_end" else message) if ended == "done" else (STOPPED, message)
        )
        if self.outputs.functions:
            run = build_run(ready, rows, status=ended, message=message, wall_s=0.0)
            for name, function in member_outputs.functions.items():
                try:
                    outputs[name][k] = function(run)
                except Exception as error:  # a caller's function may raise anything
                    status, message = FAILED, f"output {name!r} raised {type(error).__name__}: {error}"
        return status, message, rhs

    # --- preparation -----------------------------------------------------------------------------

    def _require_equal_instants(self) -> None:
        """Refuse trajectories if output instants differ between members (InputError)."""
        time_variables = [name for name in self.names if name in ("t_end", "solver.output_dt")]
        dims_of = {name: output.dims for name, output in self._all_outputs().items()}
        trajectories = [name for name, dims in dims_of.items() if "time" in dims]
        if time_variables and trajectories:
            raise InputError(
                f"{self.scene.name}: outputs: {trajectories[0]}: a trajectory needs the same output instants for all "
                f"members, but {time_variables[0]} varies; use a reduction"
            )
        t_end = float(self.ready.instants[-1])
        for name, spec in self._output_specs.items():
            at = spec.at if isinstance(spec, OutputSpec) else None
            if at is not None and at > t_end * (1 + TIME_TOLERANCE) and not time_variables:
                raise InputError(f"{self.scene.name}: outputs: {name}: at = {at:g} s is after t_end = {t_end:g} s")

    def _find_shapes(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...]]]:
        """Return dimensions and shape of each output; functions are called on a run of the scene itself."""
        shapes = {name: (output.dims, output.shape) for name, output in self.outputs.outputs.items()}
        if not self.outputs.functions:
            return shapes
        rows, status, message = record_rows(self.ready)
        if status == "interrupted":
            raise interrupt_again(message)
        run = build_run(self.ready, rows, status=status, message=message, wall_s=0.0)
        for name, function in self.outputs.functions.items():
            try:
                value = np.asarray(function(run), dtype=float)
            except Exception as error:  # a caller's function may raise anything
                if isinstance(function, NamedQuantity):
                    raise InputError(f"outputs: {name}: {error}") from error
                raise InputError(
                    f"outputs: {name} raised {type(error).__name__} for the scene itself: {error}"
                ) from error
            dims = function.dims if isinstance(function, NamedQuantity) else None
            shapes[name] = (tuple(f"{name}_{k}" for k in range(value.ndim)) if dims is None else dims, value.shape)
        return shapes

    def _select_library(self, count: int) -> Library | None:
        """Return compiled terms if they are requested, exist, or save time; None for Pinocchio's terms."""
        terms, varying_arguments = self.scene.spec.solver.terms, self._numbers.which
        if terms == "pinocchio":
            return None
        if terms == "generated":
            return compile_terms(self.mechanism, which=varying_arguments, of_members=self._lanes)
        library = find_compiled_terms(self.mechanism, varying_arguments, of_members=self._lanes)
        if library is not None or count < 2 or explain_too_large(self.mechanism):
            return library
        if count * self.count_rhs() < MIN_RHS_TO_COMPILE * self.mechanism.n:
            return None
        try:
            return compile_terms(self.mechanism, which=varying_arguments, of_members=self._lanes)
        except InputError:  # without a compiler or CasADi, Pinocchio's terms are used
            return None

    def _can_be_batched(self) -> bool:
        """Return whether members differ only in numbers that a native loop can take."""
        spec, mechanism = self.scene.spec, self.mechanism
        scene_keys = [name for k, name in enumerate(self.names) if k not in self._parameters]
        positions = [name for name in scene_keys if name.startswith("initial.q.")]
        if not all(name.startswith(("initial.q.", "initial.q_dot.")) for name in scene_keys):
            return False
        if not all(name.rpartition("initial.q.")[2] in mechanism.independent for name in positions):
            return False
        if not self._numbers.is_batched or self.outputs.functions or not mechanism.tree.is_euclidean:
            return False
        if spec.initial.w is not None or spec.solver.max_wall_s is not None or mechanism.splits_root:
            return False
        if mechanism.joints.has_events(spec.friction_smoothing):
            return False
        if spec.initial.at is not None and (positions or self._parameters):
            return False
        if not self._has_constant_control():
            return False
        start = self.ready.start.at
        self._base = start.q_tree if spec.initial.at is not None else find_branch(mechanism, spec.initial.q).q_tree
        self._q = mechanism.independent_part(start.q_tree)
        for k, name in enumerate(mechanism.independent):
            self._q[k] = spec.initial.q.get(name, self._q[k])
        return True

    def _has_constant_control(self) -> bool:
        """Return whether the native controller is the same for all members."""
        control = self.ready.tables[2]
        law = control.get("law", {"kind": "none"})
        if law["kind"] == "call":
            return False
        if not self._parameters or law["kind"] == "none":
            return True
        uses_plant = law["kind"] == "set_point" and getattr(self.scene.spec.controller, "model", None) is None
        follows_point = law.get("desired", {}).get("kind") == "point"
        return not (uses_plant or follows_point or "observer" in control.get("sensor", {}))


class MemberNumbers:
    """Numbers of a mechanism's model as functions of the parameters that an ensemble varies.

    Parameters
    ----------
    parameters : ParameterMap
    names : sequence of str
        Single parameters that vary.

    Attributes
    ----------
    is_batched : bool
        Whether a batch can take all numbers. If not, each member's mechanism is rebuilt.
    which : dict of str to bool arrays
        Numbers that are not zero for some member: the arguments of compiled terms.
    """

    def __init__(self, parameters: ParameterMap, names: Sequence[str]) -> None:
        self._map, self.names = parameters, tuple(names)
        self.which = present(parameters.numbers)
        self.is_batched = True
        if not self.names:
            return
        trial = np.random.default_rng(0).uniform(0.5, 1.0, (1, len(self.names)))
        numbers, _ = parameters.evaluate(self.names, trial)
        self.is_batched = set(numbers) <= BATCHED_NUMBERS | DERIVED_NUMBERS and parameters.reproduces(self.names)
        if self.is_batched:
            for key in BATCHED_NUMBERS & set(numbers):
                self.which[key] = self.which[key] | present({key: numbers[key][0]})[key]

    def evaluate(self, members: Array) -> tuple[dict[str, Array], BoolArray]:
        """Return the numbers that differ between members, and which members are physical.

        Parameters
        ----------
        members : (members, names) array
            Values of the parameters.

        Returns
        -------
        dict of str to (members, ...) array
        (members,) array of bool
        """
        numbers, is_physical = self._map.evaluate(self.names, members)
        return {key: x for key, x in numbers.items() if key in BATCHED_NUMBERS}, is_physical

    def arguments(self, numbers: Mapping[str, Array], members: int) -> Array:
        """Return the arguments of compiled terms, (members, arguments), from the numbers that differ."""
        columns = []
        for key, base in self._map.numbers.items():
            part = numbers[key] if key in numbers else np.broadcast_to(base, (members, *base.shape))
            columns.append(part[:, self.which[key]])
        return np.ascontiguousarray(np.concatenate(columns, axis=1))
