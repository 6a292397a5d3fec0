"""Run chunks of members in processes and on other machines with Dask."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterable, Iterator, Set
from concurrent.futures import Future, wait
from contextlib import contextmanager
from itertools import islice
from multiprocessing import active_children, resource_tracker
from multiprocessing.process import BaseProcess
from typing import Any

from ckc_pin.base.atomic_files import temporary_folder
from ckc_pin.base.interrupt import uninterrupted_thread
from ckc_pin.ensembles.members import Chunk, Members, SweepTask
from ckc_pin.ensembles.store import RESUME_HINT
from ckc_pin.errors import InputError

__all__ = ["CHUNKS_PER_WORKER", "compute_chunks", "connect"]

WORKER_NAME = "Dask Worker process"  # prefix of the names of Dask's worker processes
KILL_PERIOD_S = 0.02
SCHEDULER_TIMEOUT_S = 10.0
CHUNKS_PER_WORKER = 3  # submitted at a time, so that no worker idles and memory is bounded

_members: dict[str, Members] = {}  # the members of the last task that this worker prepared, by the task's identity


def _run_chunk(task: SweepTask, first: int, end: int) -> Chunk:
    """Run one chunk on a worker. Prepared members are reused for the next chunk of the same sweep."""
    if task.identity not in _members:
        _members.clear()
        _members[task.identity] = task.prepare(1)
    return _members[task.identity].run(first, task.variables.values(first, end))


@contextmanager
def connect(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """Connect to a scheduler, or start a cluster of processes that only this machine can reach.

    Parameters
    ----------
    scheduler : str or None
        Address of an existing scheduler.
    workers : int or None
        Number of processes to start without a scheduler.

    Yields
    ------
    dask.distributed.Client

    Raises
    ------
    InputError
        Dask is not installed, or the scheduler does not answer.
    """
    try:
        import dask
        from dask.distributed import Client
    except ModuleNotFoundError:
        raise InputError(
            "workers and schedulers need dask.distributed, which is not installed: pip install ckc_pin[cluster]"
        ) from None
    if scheduler is None:
        with (
            temporary_folder() as folder,
            dask.config.set({"temporary-directory": str(folder)}),
            _silence("distributed"),  # it logs tasks that an interrupt cancels and workers that it kills
            _start_cluster(workers) as client,
        ):
            yield client
        return
    try:
        # It is not the default client, which would receive all later Dask computations of this process.
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--scheduler {scheduler}: does not answer within {SCHEDULER_TIMEOUT_S:g} s ({type(error).__name__}); "
            "start one with `dask scheduler` and `dask worker ADDRESS`, or omit it for processes on this machine"
        ) from None
    # They log tracebacks if the scheduler is lost, which an error message reports anyway.
    with _silence("distributed", "distributed.client"), client:
        yield client


@contextmanager
def _silence(*names: str) -> Iterator[None]:
    """Suppress log records below CRITICAL of some loggers."""
    logs = [logging.getLogger(name) for name in names]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


@contextmanager
def _start_cluster(workers: int | None) -> Iterator[Any]:
    """Start a cluster of processes on this machine, and connect to it; an interrupt kills the processes.

    Dask cannot close a cluster whose construction was interrupted, so the cluster is constructed in another thread.
    """
    children_before = set(active_children())
    with uninterrupted_thread(_block_sigint) as pool:
        starting = pool.submit(_start, workers)
        try:
            try:
                _, client = starting.result()
            except (OSError, RuntimeError) as error:
                raise InputError(
                    f"workers: {workers} processes cannot be started ({error}); a script must call ensemble below "
                    '`if __name__ == "__main__":`, because each process imports the script'
                ) from None
            yield client
        except BaseException:
            closing = pool.submit(_close, starting)
            while not closing.done():
                _kill_workers(children_before)  # repeatedly, because Dask restarts workers until the cluster closes
                wait([closing], KILL_PERIOD_S)
            raise
        pool.submit(_close, starting).result()


def _block_sigint() -> None:
    """Block SIGINT in this thread, and so in all threads and processes that are started from it.

    Ctrl-C sends SIGINT to the workers, too. The process that started them kills them.
    """
    resource_tracker.ensure_running()  # `multiprocessing` would start it later, which unblocks SIGINT
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _start(workers: int | None) -> tuple[Any, Any]:
    """Start a cluster and connect to it."""
    from dask.distributed import Client, LocalCluster

    cluster = LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",  # any free port, because 8787 may be in use
        scheduler_kwargs={"dashboard": False},
        silence_logs=logging.CRITICAL,
    )
    try:
        return cluster, Client(cluster, set_as_default=False)  # type: ignore[no-untyped-call]
    except BaseException:
        cluster.close()
        raise


def _close(starting: Future[tuple[Any, Any]]) -> None:
    """Close a cluster if it could be started."""
    if starting.exception() is None:
        cluster, client = starting.result()
        client.close()
        cluster.close()


def _kill_workers(children_before: Set[BaseProcess]) -> None:
    """Kill the processes of a cluster, which would otherwise finish their chunks before they end.

    Parameters
    ----------
    children_before : set of processes
        Child processes from before the cluster.
    """
    for process in set(active_children()) - children_before:
        if process.name.startswith(WORKER_NAME):
            process.kill()


def compute_chunks(client: Any, task: SweepTask, pending: Iterable[tuple[int, int]], workers: int) -> Iterator[Chunk]:
    """Yield the results of pending chunks in the order in which workers finish them.

    Parameters
    ----------
    client : dask.distributed.Client
    task : SweepTask
    pending : iterable of (int, int)
        First and end of the members of each chunk.
    workers : int
        Number of workers.

    Raises
    ------
    InputError
        Workers raised an error or died repeatedly, or the scheduler is lost. Chunks that are not finished are lost.
    """
    from dask.distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    remaining = iter(pending)

    def submit(count: int) -> list[Any]:
        return [
            client.submit(_run_chunk, task, first, end, pure=False, key=f"{task.identity[:16]}-{first}", retries=2)
            for first, end in islice(remaining, count)
        ]

    running = as_completed(submit(CHUNKS_PER_WORKER * workers), loop=client.loop)  # type: ignore[no-untyped-call]
    for future in running:
        try:
            chunk = future.result()
        except (FutureCancelledError, CommClosedError) as error:
            raise InputError(
                f"the scheduler is lost, or was restarted ({type(error).__name__}); {RESUME_HINT}"
            ) from None
        except Exception as error:  # a worker may raise anything, or have died
            raise InputError(f"a worker failed: {type(error).__name__}: {error}; {RESUME_HINT}") from None
        for new in submit(1):
            running.add(new)  # type: ignore[no-untyped-call]
        yield chunk
