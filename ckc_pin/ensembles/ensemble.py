"""Ensembles: run the members of a sweep in threads or on a cluster, and store them chunk by chunk."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

from ckc_pin.base.interrupt import acknowledge, interrupt_again, uninterrupted_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import describe_value, require_flag, require_path, require_table, require_type
from ckc_pin.ensembles.members import DONE, STOPPED, Chunk, Members, SweepTask
from ckc_pin.ensembles.outputs import Function
from ckc_pin.ensembles.progress import Advance, show_progress
from ckc_pin.ensembles.spec import find_scene_path, parse_sweep, read_sweep
from ckc_pin.ensembles.store import RESULTS, RESUME_HINT, Store, require_libraries
from ckc_pin.ensembles.store_layout import array_name
from ckc_pin.errors import CkcError, InputError
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.overrides import EXPECTED_OVERRIDES
from ckc_pin.scene.scene import EXPECTED_SCENE, Scene

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["SweepResult", "ensemble", "find_worst_members", "load_sweep_task", "run_sweep", "save_worst_members"]

CHUNK_DURATION_S = 1.0  # an interrupt loses this much work; the overhead of a chunk is much shorter
RHS_PER_S = {"generated": 3e6, "pinocchio": 6e5}  # a rough estimate for the size of a chunk, which no result depends on
MAX_SERIES_BYTES = 2**26  # of a chunk's recorded columns
MAX_CHUNK = 2**16  # members
MAX_WORST_MEMBERS = 3
Status = Literal["done", "stopped", "interrupted"]


@dataclass(frozen=True, repr=False)
class SweepResult(HasSummary):
    """Outcome of a sweep: counts of members, and the store of the results.

    Attributes
    ----------
    status : "done", "stopped" or "interrupted"
    message : str
        Why the sweep stopped or was interrupted.
    members, done, stopped, failed : int
        Number of all members, and of those by status.
    wall_s : float
        Wall-clock time, s.
    rate : float
        Members per second.
    repairs : str
        Damaged files that were repaired; empty without any.
    store : object
        What xarray opens.
    prepared : Members
        The prepared members, with which a member can be run again.
    """

    status: Status
    message: str
    members: int
    done: int
    stopped: int
    failed: int
    wall_s: float
    rate: float
    repairs: str
    store: Any
    prepared: Members

    def to_dict(self) -> dict[str, Any]:
        """Return status and counts as JSON-ready data."""
        keys = ("status", "message", "members", "done", "stopped", "failed", "wall_s", "rate")
        return {key: getattr(self, key) for key in keys}

    def summary(self) -> Summary:
        """Return status and counts, as `repr` and a notebook show them."""
        rows = [(key, f"{value:.4g}" if isinstance(value, float) else str(value)) for key, value in
                self.to_dict().items() if key not in ("status", "message")]  # fmt: skip
        outcome = f"{self.status}: {self.message}" if self.message else self.status
        return Summary(f"Sweep of {self.prepared.scene.name}, {outcome}", rows)

    def open_results(self) -> xr.Dataset:
        """Open the results as an `xarray.Dataset`, which reads its values on demand."""
        import xarray as xr

        return xr.open_zarr(self.store, consolidated=False, decode_timedelta=False)


def ensemble(
    scene: Scene | str | Path,
    variables: Mapping[str, Any],
    outputs: Mapping[str, str | Mapping[str, Any] | Function],
    *,
    members: int | None = None,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    threads: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    chunk: int | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Run a scene many times with varied parameters.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name, or its path. Its controller is described by a table, not by an object of Python.
    variables : mapping
        Distribution of each variable, by the name of a parameter or a key of the scene. ``{"uniform": [a, b]}``,
        "loguniform", "sobol" or "lhs" from a to b; ``{"normal": [mean, deviation]}``, or "lognormal" with those of the
        logarithm; ``{"grid": {"start": a, "stop": b, "count": n}}``; a list of values; ``{"file": "x.csv"}``. Grids,
        lists and files are crossed.
    outputs : mapping
        Quantities to keep, by names of your choice. A string stands for the value at the end of a run: "q_tree", or any
        name that ``run[name]`` takes, as "tau.theta_1" or "tip.x". ``{"of": "theta_1", "reduce": "max_abs"}`` reduces
        it over time and ``{"of": "theta_1", "at": 0.5}`` is its value at a time, s. Or a function of a `Run` that
        returns a number, or an array whose shape is the same for all members.
    members : int, optional
        Number of members, at each point of the crossed variables. Needed if a variable is random.
    seed : int
        Seed of random variables.
    overrides : mapping, optional
        Overrides of the scene, for all members.
    out : str or Path, optional
        Folder for ``results.zarr``. A sweep that exists there is resumed. Default: in memory.
    threads : int, optional
        Threads of this process. Default: one for each core.
    workers : int, optional
        Processes of a Dask cluster on this machine, instead of threads.
    scheduler : str, optional
        Address of an existing Dask cluster.
    chunk : int, optional
        Members that are run and written together. Default: about a second of work.
    progress : bool
        Show a progress bar on a terminal and in a notebook.

    Returns
    -------
    xarray.Dataset
        Variables, outputs, status and message by member. Outputs of a member that stopped or failed are NaN where it
        has none.

    Raises
    ------
    InputError, MechanismError, NumericalError
        The sweep or its scene cannot be run as written.
    KeyboardInterrupt
        Finished chunks are kept in `out`.

    Warns
    -----
    UserWarning
        Files in `out` were damaged or missing. The warning says which members were computed again, and why.
    """
    _require_tables(scene, variables, outputs, overrides)
    _require_resources(out, threads, workers, scheduler, chunk, progress)
    require_libraries()
    functions = {name: output for name, output in outputs.items() if callable(output)}
    data: dict[str, Any] = {
        "scene": scene.name if isinstance(scene, Scene) else str(scene),
        "seed": to_toml_value(seed), "overrides": to_toml_value(overrides or {}),
        "variables": {name: to_toml_value(x) for name, x in variables.items()},
        "outputs": {name: to_toml_value(x) for name, x in outputs.items() if name not in functions} or {"t": "t"},
    }  # fmt: skip
    if members is not None:
        data["members"] = to_toml_value(members)
    spec = parse_sweep(data, Sources("ensemble", Path()))
    if functions and len(functions) == len(outputs):
        spec = msgspec.structs.replace(spec, outputs={})  # parse_sweep needs at least one output that is not a function
    task = SweepTask(spec, "ensemble", scene, Path(), functions)
    result = run_sweep(
        task, None if out is None else Path(out), threads=threads, workers=workers, scheduler=scheduler, chunk=chunk,
        progress=progress,
    )  # fmt: skip
    if result.repairs:
        warnings.warn(result.repairs, stacklevel=2)
    if result.status == "interrupted":
        raise KeyboardInterrupt(result.message)
    if result.status == "stopped":
        raise InputError(result.message)
    results = result.open_results()
    return results.load() if out is None else results


def _require_tables(scene: Any, variables: Any, outputs: Any, overrides: Any) -> None:
    """Refuse arguments of wrong type that describe the sweep (InputError); their content is checked later."""
    require_type(scene, (Scene, str, Path), "ensemble: scene", EXPECTED_SCENE)
    if isinstance(scene, Scene) and (scene.controller is not None or scene.events):
        raise InputError(
            "ensemble: scene: a controller or event that is an object of Python is not supported, because members run "
            'in native threads and other processes; give a table, as controller={"type": "set_point", ...}'
        )
    require_table(variables, "ensemble: variables", 'a table by name, as {"link.link_2.mass": {"uniform": [0.2, 0.3]}}')
    require_table(outputs, "ensemble: outputs", 'a table by name, as {"end": "q_tree"}')
    if overrides is not None:
        require_table(overrides, "ensemble: overrides", EXPECTED_OVERRIDES)


def _require_resources(out: Any, threads: Any, workers: Any, scheduler: Any, chunk: Any, progress: Any) -> None:
    """Refuse arguments of wrong type that say how to run the sweep (InputError)."""
    if out is not None:
        require_path(out, "ensemble: out")
    if scheduler is not None:
        require_type(scheduler, str, "ensemble: scheduler", 'an address, as "tcp://10.0.0.1:8786"')
    require_flag(progress, "ensemble: progress")
    for name, count in (("threads", threads), ("workers", workers), ("chunk", chunk)):
        if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
            raise InputError(f"ensemble: {name}: expected a whole number of at least 1, got {describe_value(count)}")
    if scheduler and workers:
        raise InputError("ensemble: workers and scheduler: give one of them")


# --- sweeps ----------------------------------------------------------------------------------------


def load_sweep_task(path: str | Path) -> SweepTask:
    """Return the task of a sweep's file (InputError)."""
    spec, sources = read_sweep(path)
    return SweepTask(spec, str(path), find_scene_path(spec, sources), sources.folder)


def run_sweep(
    task: SweepTask,
    out: Path | None,
    *,
    threads: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    chunk: int | None = None,
    progress: bool = True,
) -> SweepResult:
    """Run the members of a sweep that are not in its store yet.

    Raises
    ------
    CkcError
        The sweep cannot be run as written. Later errors end the sweep and are the message of its result; finished
        chunks are kept.
    """
    require_libraries()
    threads = threads or os.cpu_count() or 1
    members = task.prepare(threads)
    task = replace(task, terms=members.terms)
    count = task.variables.count
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: cannot be written: {error.strerror}") from None
    store = Store(None if out is None else out / RESULTS, _describe_content(task, members), members, count,
                  chunk or _choose_chunk(members, count, threads))  # fmt: skip
    before = store.count_statuses()
    finished = count - before["pending"]
    started, message = perf_counter(), ""
    status: Status = "done"
    try:
        with ExitStack() as stack:
            pending = store.find_pending()
            if workers or scheduler:
                from ckc_pin.ensembles.cluster import compute_chunks, connect

                client = stack.enter_context(connect(scheduler, workers))
                worker_count = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
                chunks: Iterator[Chunk] = compute_chunks(client, task, pending, worker_count)
            else:
                chunks = _compute_in_threads(members, task, pending)
            bar = show_progress(members.scene.name, finished) if progress else nullcontext(None)
            advance = stack.enter_context(bar)
            started = perf_counter()
            try:
                _write_chunks(store, chunks, members, advance, finished)
            except InputError as error:
                status, message = "stopped", str(error)
    except KeyboardInterrupt as signal:
        status, message = "interrupted", f"interrupted{acknowledge(signal)}; {RESUME_HINT}"
    wall_s, after = perf_counter() - started, store.count_statuses()
    new = before["pending"] - after["pending"]
    return SweepResult(
        status=status,
        message=message,
        members=count,
        done=after["done"],
        stopped=after["stopped"],
        failed=after["failed"],
        wall_s=wall_s,
        rate=new / wall_s if new else 0.0,
        repairs=store.repairs,
        store=store.open(),
        prepared=members,
    )


def _compute_in_threads(members: Members, task: SweepTask, pending: Iterable[tuple[int, int]]) -> Iterator[Chunk]:
    for first, end in pending:
        yield members.run(first, task.variables.values(first, end))


def _write_chunks(
    store: Store, chunks: Iterator[Chunk], members: Members, advance: Advance | None, finished: int
) -> None:
    # Zarr writes files in another thread, which would continue after an interrupt while the statuses are counted.
    with uninterrupted_thread() as pool:
        for chunk in chunks:
            pool.submit(store.write, chunk, members.names).result()
            finished += len(chunk.status)
            if advance is not None:
                advance(finished, store.count)


def _describe_content(task: SweepTask, members: Members) -> dict[str, Any]:
    """Return everything that the results depend on."""
    functions = {name: getattr(f, "__qualname__", type(f).__qualname__) for name, f in task.functions.items()}
    named = {name: x if isinstance(x, str) else x.to_dict() for name, x in task.spec.outputs.items()}
    files = {file: Sources(task.name, task.folder).text(file) for v in task.spec.variables.values() if (file := v.file)}
    return {
        "scene_name": members.scene.name, "scene": members.scene.to_dict() | {"name": members.scene.name},
        "texts": members.ready.texts, "variables": msgspec.to_builtins(task.spec.variables), "files": files,
        "outputs": {**named, **functions}, "members": task.variables.count,
        "seed": task.spec.seed, "terms": members.terms,
    }  # fmt: skip


def _choose_chunk(members: Members, count: int, threads: int) -> int:
    """Return a number of members that takes about a second, and whose recorded columns fit into memory."""
    rhs = members.count_rhs()
    size = int(CHUNK_DURATION_S * threads * RHS_PER_S[members.terms] / max(rhs, 100))
    series_bytes = 8 * len(members.instants) * max(1, len(members.outputs.columns))
    return max(1, min(size, MAX_SERIES_BYTES // series_bytes, MAX_CHUNK, count))


# --- worst members ---------------------------------------------------------------------------------


def find_worst_members(results: xr.Dataset, name: str, max_count: int = MAX_WORST_MEMBERS) -> list[int]:
    """Return the members with the largest |output|, the worst first.

    Members that failed or whose output is NaN are omitted.
    """
    values = np.abs(results[array_name(name)].to_numpy().reshape(results.sizes["member"], -1))
    has_ended = np.isin(results["status"].to_numpy(), (DONE, STOPPED))
    size = np.where(has_ended, np.fmax.reduce(values, axis=1), np.nan)
    order = np.argsort(-size, kind="stable")  # NaN last
    return [int(k) for k in order[:max_count] if np.isfinite(size[k])]


def save_worst_members(
    members: Members, results: xr.Dataset, name: str, out: Path, max_count: int = MAX_WORST_MEMBERS
) -> list[Path]:
    """Run the worst members again and save them as ``worst_OUTPUT_MEMBER/run.npz``; return the folders.

    The runs have all output instants of the scene, and agree with the members to the tolerance of the integration.
    """
    folders = []
    for k in find_worst_members(results, name, max_count):
        values = np.array([float(results[array_name(variable)][k]) for variable in members.names])
        folder = out / f"worst_{array_name(name)}_{k}"
        try:
            run = simulate(members.scene_of(values))
        except CkcError:
            continue
        if run.status == "interrupted":
            raise interrupt_again(run.message)
        folder.mkdir(parents=True, exist_ok=True)
        run.save(folder / "run.npz")
        folders.append(folder)
    return folders
