"""A whole ensemble: prepared, run in threads or on a cluster, written chunk by chunk, and gone on with."""

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

from ckc_pin.base.interrupt import acknowledge
from ckc_pin.base.sources import Sources
from ckc_pin.base.validation import describe_value, require_flag, require_path, require_table, require_type
from ckc_pin.ensembles.members import Chunk, Members
from ckc_pin.ensembles.outputs import Function
from ckc_pin.ensembles.progress import Advance, bar
from ckc_pin.ensembles.spec import read_sweep, scene_path, sweep_of
from ckc_pin.ensembles.store import RESULTS, Store, require_libraries
from ckc_pin.ensembles.task import SweepTask
from ckc_pin.errors import InputError
from ckc_pin.scene.scene import EXPECTED_OVERRIDES, to_toml_value

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["SweepResult", "ensemble", "run_sweep", "sweep_task"]

CHUNK_S = 1.0  # of a chunk: what is lost at most, and long beside what it costs to hand it around
RATE = {"generated": 3e6, "pinocchio": 6e5}  # right-hand sides a second, roughly: a chunk's length is no result
MOST_BYTES = 2**26  # of what a chunk keeps over time
MOST_CHUNK = 2**16


@dataclass(frozen=True)
class SweepResult:
    """What `ckc sweep --json` prints, where the results are, and who can run a member again."""

    status: Literal["done", "stopped", "interrupted"]
    message: str
    members: int
    done: int
    stopped: int
    failed: int
    wall_s: float
    rate: float
    repairs: str
    place: Any
    prepared: Members


def ensemble(
    scene: str | Path,
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
    """Run a scene many times with other numbers.

    Parameters
    ----------
    scene : str or Path
        A scene's shipped name, or its path.
    variables : mapping
        By name of a number of the mechanism or a key of the scene how it differs: ``{"uniform": [a, b]}``,
        "loguniform", "sobol" or "lhs" from a to b; ``{"normal": [mean, deviation]}``, "lognormal" of the logarithm;
        ``{"grid": {"start": a, "stop": b, "count": n}}``; a list of values; ``{"file": "x.csv"}``. Grids, lists and
        files are crossed.
    outputs : mapping
        By a name of yours what is kept: "q_tree" and the like, of the end; ``{"of": "theta_1", "reduce": "max_abs"}``;
        or any function of a `Run` that gives a number or an array of one shape.
    members : int, optional
        How many, at each point of what is crossed; absent where nothing is drawn at random.
    seed : int
    overrides : mapping, optional
        Of the scene, for all members.
    out : str or Path, optional
        A folder, which gets ``results.zarr``; a sweep that is there is gone on with. Absent: in memory.
    threads : int, optional
        Of this process; absent: one a core.
    workers : int, optional
        Processes of a cluster of Dask's on this machine, in place of threads.
    scheduler : str, optional
        The address of a cluster of Dask's that is there.
    chunk : int, optional
        Members that are run and written together; absent: about a second's.
    progress : bool
        A bar, on a terminal and in a notebook.

    Returns
    -------
    xarray.Dataset
        Variables, outputs, status and message by member. What is kept of a member that stopped or failed is NaN where
        it did not get to.

    Raises
    ------
    InputError, MechanismError, NumericalError
        The sweep or its scene cannot be run as written.
    KeyboardInterrupt
        Chunks that were finished are in `out`.

    Warns
    -----
    UserWarning
        Files in `out` were damaged or missing: which members were computed again, and why.
    """
    _require_tables(scene, variables, outputs, overrides)
    _require_means(out, threads, workers, scheduler, chunk, progress)
    require_libraries()
    import xarray as xr

    functions = {name: output for name, output in outputs.items() if callable(output)}
    data: dict[str, Any] = {
        "scene": str(scene), "seed": to_toml_value(seed), "overrides": to_toml_value(overrides or {}),
        "variables": {name: _plain(x) for name, x in variables.items()},
        "outputs": {name: _plain(x) for name, x in outputs.items() if name not in functions} or {"t": "t"},
    }  # fmt: skip
    if members is not None:
        data["members"] = to_toml_value(members)
    spec = sweep_of(data, Sources("ensemble", Path()))
    if functions and len(functions) == len(outputs):
        spec = msgspec.structs.replace(spec, outputs={})  # a file has to name one
    task = SweepTask(spec, "ensemble", scene, Path(), functions)
    summary = run_sweep(
        task, None if out is None else Path(out), threads=threads, workers=workers, scheduler=scheduler, chunk=chunk,
        progress=progress,
    )  # fmt: skip
    if summary.repairs:
        warnings.warn(summary.repairs, stacklevel=2)
    if summary.status == "interrupted":
        raise KeyboardInterrupt(summary.message)
    if summary.status == "stopped":
        raise InputError(summary.message)
    found = xr.open_zarr(summary.place, consolidated=False, decode_timedelta=False)
    return found.load() if out is None else found


def _require_tables(scene: Any, variables: Any, outputs: Any, overrides: Any) -> None:
    """Refuse what says what to run, where it is of the wrong kind (InputError); what is in it is checked later."""
    require_type(scene, (str, Path), "ensemble: scene", "a scene's shipped name or its path")
    require_table(variables, "ensemble: variables", 'a table by name, as {"link.link_2.mass": {"uniform": [0.2, 0.3]}}')
    require_table(outputs, "ensemble: outputs", 'a table by name, as {"end": "q_tree"}')
    if overrides is not None:
        require_table(overrides, "ensemble: overrides", EXPECTED_OVERRIDES)


def _require_means(out: Any, threads: Any, workers: Any, scheduler: Any, chunk: Any, progress: Any) -> None:
    """Refuse what says how to run it, where it is of the wrong kind (InputError)."""
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


def sweep_task(path: str | Path) -> SweepTask:
    """Return the sweep of a file (InputError)."""
    spec, sources = read_sweep(path)
    return SweepTask(spec, str(path), scene_path(spec, sources), sources.folder)


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
    """Run what of a sweep is not there yet.

    Raises
    ------
    CkcError
        It cannot be run as written. What goes wrong later ends it: the summary's message says so, and what is there
        stays.
    """
    require_libraries()
    threads = threads or os.cpu_count() or 1
    members = task.members(threads)
    task = replace(task, terms=members.terms)
    count = task.variables().count
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: cannot be written: {error.strerror}") from None
    store = Store(None if out is None else out / RESULTS, _content(task, members), members, count,
                  chunk or _chunk(members, count, threads))  # fmt: skip
    before = store.counts()
    there = count - before["pending"]
    started, message = perf_counter(), ""
    status: Literal["done", "stopped", "interrupted"] = "done"
    try:
        with ExitStack() as own:
            pending = store.pending()
            if workers or scheduler:
                from ckc_pin.ensembles.cluster import chunks_by, client_of

                client = own.enter_context(client_of(scheduler, workers))
                hands = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
                chunks: Iterator[Chunk] = chunks_by(client, task, pending, hands)
            else:
                chunks = _here(members, task, pending)
            shown = own.enter_context(bar(members.scene.name, there) if progress else nullcontext(None))
            started = perf_counter()
            try:
                _collect(store, chunks, members, shown, there)
            except InputError as error:
                status, message = "stopped", str(error)
    except KeyboardInterrupt as signal:
        by = acknowledge(signal)
        status, message = "interrupted", f"interrupted{by}; what is there stays, the same command goes on from it"
    wall_s, after = perf_counter() - started, store.counts()
    ran = before["pending"] - after["pending"]
    return SweepResult(
        status, message, count, after["done"], after["stopped"], after["failed"], wall_s, ran / wall_s if ran else 0.0,
        store.repairs, store.place, members,
    )  # fmt: skip


def _here(members: Members, task: SweepTask, pending: Iterable[tuple[int, int]]) -> Iterator[Chunk]:
    for first, end in pending:
        yield members.run(first, task.variables().values(first, end))


def _collect(store: Store, chunks: Iterator[Chunk], members: Members, shown: Advance | None, there: int) -> None:
    for chunk in chunks:
        store.write(chunk, members.names)
        there += len(chunk.status)
        if shown is not None:
            shown(there, store.count)


def _content(task: SweepTask, members: Members) -> dict[str, Any]:
    """All that the results follow from."""
    functions = {name: getattr(f, "__qualname__", type(f).__qualname__) for name, f in task.functions.items()}
    files = {file: Sources(task.name, task.folder).text(file) for v in task.spec.variables.values() if (file := v.file)}
    return {
        "scene_name": members.scene.name, "scene": members.scene.to_dict() | {"name": members.scene.name},
        "texts": members.ready.texts, "variables": msgspec.to_builtins(task.spec.variables), "files": files,
        "outputs": {**msgspec.to_builtins(task.spec.outputs), **functions}, "members": task.variables().count,
        "seed": task.spec.seed, "terms": members.terms,
    }  # fmt: skip


def _chunk(members: Members, count: int, threads: int) -> int:
    """Members that take about a second, and whose columns over time fit into memory."""
    rhs = members.work()
    size = int(CHUNK_S * threads * RATE[members.terms] / max(rhs, 100))
    over_time = 8 * len(members.instants) * max(1, len(members.outputs.columns))
    return max(1, min(size, MOST_BYTES // over_time, MOST_CHUNK, count))


def _plain(value: Any) -> Any:
    return msgspec.to_builtins(value) if isinstance(value, msgspec.Struct) else to_toml_value(value)
