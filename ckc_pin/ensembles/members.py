"""The members of a sweep: prepared once, run in threads without the interpreter, or one by one where that cannot be.

What cannot be put into a loop that is there already (another controller, another solver, a configuration that needs
more than following its loops from the scene's) is prepared as a run of its own. So is every member whose motion does
not end as it should, or does not begin: the run says why.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.codegen.library import Library, compile_terms, explain_too_large, find_compiled_terms
from ckc_pin.ensembles.member_numbers import MemberNumbers
from ckc_pin.ensembles.names import check_names
from ckc_pin.ensembles.outputs import Function, Outputs, Recorded
from ckc_pin.ensembles.spec import OutputSpec
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
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["DONE", "FAILED", "PENDING", "STATUS", "STOPPED", "Chunk", "Members"]

PENDING, DONE, STOPPED, FAILED = range(4)
Statuses = NDArray[np.uint8]
STATUS = ("pending", "done", "stopped", "failed")
WORTH = 1_000_000  # right-hand sides a coordinate, from which terms are compiled for a sweep
END, EVENT = "end", "event"
MAX_INTEGER = 2.0**63  # the integers that a scene takes


@dataclass(frozen=True)
class Chunk:
    """What came of some members: values of the variables, how each ended and why, outputs, work done."""

    first: int
    values: Array
    status: Statuses
    message: list[str]
    outputs: dict[str, Array]
    rhs: int


class Members:
    """A scene that is run many times with other numbers.

    Parameters
    ----------
    scene : str or Path
    overrides : mapping
        Of the scene, for all members.
    names : sequence of str
        The variables.
    outputs : mapping
        As of `Outputs`.
    count : int
        Members, by which it is known whether compiling terms repays.
    threads : int

    Raises
    ------
    CkcError
        The scene itself cannot be run; unknown variables or outputs.
    """

    def __init__(
        self,
        scene: str | Path,
        overrides: Mapping[str, Any],
        names: tuple[str, ...],
        outputs: Mapping[str, str | OutputSpec | Function],
        count: int,
        threads: int,
    ) -> None:
        self.scene_name, self._overrides, self.names = scene, dict(overrides), names
        self._threads = threads
        self.scene: Scene = load_scene(scene, overrides)
        self.ready = prepare(self.scene)
        self.mechanism = self.ready.mechanism
        self._vectors = check_names(scene, self._overrides, self.scene, self.mechanism, names)
        self._outputs = outputs
        self.outputs = Outputs(outputs, self.ready)
        self._require_one_time()
        self._parameters = [k for k, name in enumerate(names) if is_parameter(name)]
        parameters = ParameterMap(
            self.mechanism, self.scene.spec.parameters, partial(rebuild_scene_mechanism, self.scene)
        )
        self._numbers = MemberNumbers(parameters, [names[k] for k in self._parameters])
        self._library = self._terms(count)
        self.terms = "pinocchio" if self._library is None else "generated"
        self._overrides["solver.terms"] = self.terms
        self.shapes = self._shapes()
        self.batched = self._can_be_batched()
        self._batch: Any = None

    # --- running ---------------------------------------------------------------------------------

    def run(self, first: int, values: Array) -> Chunk:
        """Run members by the values of their variables, (members, variables).

        Raises
        ------
        KeyboardInterrupt
            Nothing of the chunk is kept.
        """
        count = len(values)
        width, T = self.ready.loop.width, len(self.instants)
        recorded = Recorded(
            np.full((count, width), np.nan),
            np.full((count, len(self.outputs.columns), T), np.nan),
            np.full((count, len(self.ready.events)), np.nan),
        )
        status, message = np.full(count, PENDING, np.uint8), [""] * count
        rhs = self._run_batch(values, recorded, status, message) if self.batched else 0
        outputs = self.outputs.compute(recorded)
        for name in self.outputs.functions:
            outputs[name] = np.full((count, *self.shapes[name][1]), np.nan)
        rhs += self._run_singly(np.flatnonzero(status == PENDING), values, status, message, outputs)
        return Chunk(first, values, status, message, outputs, rhs)

    def overrides_of(self, values: Array) -> dict[str, Any]:
        """Return a member's overrides. `simulate` and `ckc run` do the same run with them."""
        overrides = dict(self._overrides)
        for name, value in zip(self.names, values, strict=True):
            vector = self._vectors.get(name)
            if vector is not None:  # the scene gives it whole
                of, at = vector
                whole = list(overrides.get(of, self.scene.spec.parameters[of]))
                whole[at] = float(value)
                overrides[of] = whole
            else:
                whole_number = float(value).is_integer() and abs(value) < MAX_INTEGER and not is_parameter(name)
                overrides[name] = int(value) if whole_number else float(value)
        return overrides

    @property
    def instants(self) -> Array:
        """When members are looked at, s."""
        return self.ready.instants if self.outputs.whole else self.ready.instants[-1:]

    @property
    def units(self) -> dict[str, tuple[str, ...]]:
        """The unit of each variable, and of each component of each output that is no function, by name."""
        of_variables = {name: (key_unit(self.mechanism, name),) for name in self.names}
        return of_variables | {name: output.units for name, output in self.outputs.outputs.items()}

    def _run_batch(self, values: Array, recorded: Recorded, status: Statuses, message: list[str]) -> int:
        if self._batch is None:
            _, *others = self.ready.tables  # the scene's own terms may be without the numbers that vary from zero
            core = core_table(self.mechanism, self._library, self.scene.spec.friction_smoothing or 0.0)
            self._batch = _core.Batch(core, *others, self.mechanism.tolerance, self._threads)
        found, sound = self._numbers.evaluate(values[:, self._parameters])
        chosen = np.flatnonzero(sound)
        count = len(chosen)
        if not count:
            return 0
        varied = [(name, x[chosen].reshape(count, -1)) for name, x in found.items()]
        if found and self._library is not None:
            varied.append(("written", self._numbers.arguments(found, len(values))[chosen]))
        q, q_dot = self._starts(values[chosen])
        out: dict[str, Any] = {name: np.zeros(count, np.int64) for name in ("why", "filled")}
        out |= {"work": np.zeros(3 * count, np.int64), "t": np.empty(count)}
        out |= {name: np.full((count, *getattr(recorded, name).shape[1:]), np.nan) for name in ("last", "kept", "met")}
        self._batch.run(self._base, q, q_dot, [(name, np.ascontiguousarray(x)) for name, x in varied], self.instants,
                        self.outputs.columns, self.scene.spec.t_end, out)  # fmt: skip
        why = np.array([*_core.reasons, "start"])[out["why"]]
        good = np.isin(why, (END, EVENT)) & (out["filled"] > 0)
        to = chosen[good]
        recorded.last[to], recorded.kept[to], recorded.met[to] = (out[name][good] for name in ("last", "kept", "met"))
        status[to] = DONE
        for k in np.flatnonzero(why == EVENT):
            stopping = [j for j, event in enumerate(self.ready.events) if event.stop]
            j = max(stopping, key=lambda j: (out["met"][k, j] == out["met"][k, j], out["met"][k, j]))
            message[chosen[k]] = (
                f"stopped by the event at t = {out['t'][k]:.9g} s: {self.ready.events[j].label['name']}"
            )
        return int(out["work"].reshape(-1, 3)[good, 0].sum())

    def _starts(self, values: Array) -> tuple[Array, Array]:
        """Return q and q_dot of some members, (members, d) each."""
        q, q_dot = np.tile(self._q, (len(values), 1)), np.tile(self.ready.start.q_dot, (len(values), 1))
        for k, name in enumerate(self.names):
            for prefix, to in (("initial.q.", q), ("initial.q_dot.", q_dot)):
                if name.startswith(prefix):
                    to[:, self.mechanism.independent.index(name.removeprefix(prefix))] = values[:, k]
        return q, q_dot

    def _run_singly(
        self,
        which: IntArray,
        values: Array,
        status: Statuses,
        message: list[str],
        outputs: dict[str, Array],
    ) -> int:
        """Run members as runs of their own; their loops still turn in threads."""
        if not len(which):
            return 0

        cancelled = Event()

        def one(k: int) -> int:
            status[k], message[k], rhs = self._single(values[k], k, outputs, cancelled)
            return rhs

        if self._threads == 1 or len(which) == 1:
            return sum(one(int(k)) for k in which)
        with ThreadPoolExecutor(self._threads) as pool:
            try:
                return sum(pool.map(one, [int(k) for k in which]))
            except BaseException:
                cancelled.set()
                pool.shutdown(cancel_futures=True)
                raise

    def _single(self, values: Array, k: int, outputs: dict[str, Array], cancelled: Event) -> tuple[int, str, int]:
        """Run one member and enter its outputs: its output instants and its q_d may be its own."""

        def require_not_cancelled(t: float, t_end: float) -> None:
            if cancelled.is_set():
                raise KeyboardInterrupt

        try:
            ready = prepare(load_scene(self.scene_name, self.overrides_of(values)))
            rows, ended, message = record_rows(ready, require_not_cancelled)
        except CkcError as error:
            return FAILED, str(error), 0
        if ended == "interrupted":
            raise interrupt_again(message)
        own = Outputs(self._outputs, ready)
        for name, value in own.compute(own.recorded(rows)).items():
            outputs[name][k] = value[0]
        rhs = ready.loop.stats()["rhs"]
        status, message = (
            (DONE, "" if message == "reached t_end" else message) if ended == "done" else (STOPPED, message)
        )
        if self.outputs.functions:
            run = build_run(ready, rows, status=ended, message=message, wall_s=0.0)
            for name, function in self.outputs.functions.items():
                try:
                    outputs[name][k] = function(run)
                except Exception as error:  # a caller's function may raise anything
                    status, message = FAILED, f"output {name!r} raised {type(error).__name__}: {error}"
        return status, message, rhs

    # --- what is asked ---------------------------------------------------------------------------

    def _require_one_time(self) -> None:
        """Refuse trajectories at instants that are not the same of all members (InputError)."""
        own = [name for name in self.names if name in ("t_end", "solver.output_dt")]
        over_time = [name for name, output in self.outputs.outputs.items() if "time" in output.dims]
        if own and over_time:
            says = f"a trajectory is kept at the same instants of all members, which {own[0]} makes others"
            raise InputError(f"{self.scene.name}: outputs: {over_time[0]}: {says}; keep a reduction")

    def _shapes(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...]]]:
        """Dimensions and shape of each output, a function's found by calling it on the scene itself."""
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
                raise InputError(
                    f"outputs: {name} raised {type(error).__name__} for the scene itself: {error}"
                ) from error
            shapes[name] = (tuple(f"{name}_{k}" for k in range(value.ndim)), value.shape)
        return shapes

    def _terms(self, count: int) -> Library | None:
        """Compiled terms where they are asked for, are there, or repay compiling."""
        wanted, which = self.scene.spec.solver.terms, self._numbers.which
        if wanted == "pinocchio":
            return None
        if wanted == "generated":
            return compile_terms(self.mechanism, which=which)
        library = find_compiled_terms(self.mechanism, which)
        if library is not None or count < 2 or explain_too_large(self.mechanism):
            return library
        if count * self.work() < WORTH * self.mechanism.n:
            return None
        try:
            return compile_terms(self.mechanism, which=which)
        except InputError:  # no compiler, no CasADi: the general terms do
            return None

    def work(self) -> int:
        """Right-hand sides of the scene itself."""
        try:
            _, status, message = record_rows(self.ready)
        except CkcError:
            return 0
        if status == "interrupted":
            raise interrupt_again(message)
        return int(self.ready.loop.stats()["rhs"])

    def _can_be_batched(self) -> bool:
        """Whether members differ in nothing but what a loop that is there can be given."""
        spec, mechanism = self.scene.spec, self.mechanism
        starts = [name for k, name in enumerate(self.names) if k not in self._parameters]
        positions = [name for name in starts if name.startswith("initial.q.")]
        known = all(name.rpartition("initial.q.")[2] in mechanism.independent for name in positions) and all(
            name.startswith(("initial.q.", "initial.q_dot.")) for name in starts
        )
        if not known or not self._numbers.is_batched or self.outputs.functions or not mechanism.tree.is_euclidean:
            return False
        if spec.initial.w is not None or spec.solver.max_wall_s is not None or mechanism.splits_root:
            return False
        if mechanism.joints.has_events(spec.friction_smoothing):
            return False
        if spec.initial.at is not None and (positions or self._parameters):
            return False
        if not self._control_stays():
            return False
        start = self.ready.start.at
        self._base = start.q_tree if spec.initial.at is not None else find_branch(mechanism, spec.initial.q).q_tree
        self._q = mechanism.independent_part(start.q_tree)
        for k, name in enumerate(mechanism.independent):
            self._q[k] = spec.initial.q.get(name, self._q[k])
        return True

    def _control_stays(self) -> bool:
        """Whether what acts is the same table for all members."""
        control = self.ready.tables[2]
        law = control.get("law", {"kind": "none"})
        if law["kind"] == "call":
            return False
        if not self._parameters or law["kind"] == "none":
            return True
        of_plant = law["kind"] == "set_point" and getattr(self.scene.spec.controller, "model", None) is None
        by_point = law.get("desired", {}).get("kind") == "point"
        return not (of_plant or by_point or "observer" in control.get("sensor", {}))
