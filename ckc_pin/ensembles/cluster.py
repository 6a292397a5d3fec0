"""Chunks of members in processes and on machines: all of it Dask's, but for what one worker does with one chunk."""

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
from ckc_pin.ensembles.members import Chunk, Members
from ckc_pin.ensembles.store import STAYS
from ckc_pin.ensembles.task import SweepTask
from ckc_pin.errors import InputError

__all__ = ["chunks_by", "client_of"]

WORKER = "Dask Worker process"  # how the names of Dask's worker processes begin
KILL_PERIOD_S = 0.02
PATIENCE = 10.0  # s, for a scheduler to answer
AHEAD = 3  # chunks a worker that are waiting or under way: none of them idles, and memory is bounded

_members: dict[str, Members] = {}  # of this process: what was prepared last


def work(task: SweepTask, first: int, end: int) -> Chunk:
    """Run one chunk on a worker; what is prepared for a sweep is kept for its next chunk."""
    if task.identity not in _members:
        _members.clear()
        _members[task.identity] = task.members(1)
    return _members[task.identity].run(first, task.variables().values(first, end))


@contextmanager
def client_of(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """Connect to a scheduler, or start a cluster of processes on this machine, which nobody else can reach.

    Raises
    ------
    InputError
        Dask is not installed; the scheduler does not answer.
    """
    try:
        import dask
        from dask.distributed import Client
    except ModuleNotFoundError:
        says = (
            "processes and machines are run by dask.distributed, which is not installed: pip install ckc_pin[cluster]"
        )
        raise InputError(says) from None
    if scheduler is None:
        with (
            temporary_folder() as folder,
            dask.config.set({"temporary-directory": str(folder)}),
            _silenced("distributed"),  # of tasks that are cancelled and workers that are killed, by an interrupt
            _local_cluster(workers) as client,
        ):
            yield client
        return
    try:
        # no default: one that does not answer would be asked for all that the process computes by Dask afterwards
        client = Client(scheduler, timeout=PATIENCE, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--scheduler {scheduler}: does not answer within {PATIENCE:g} s ({type(error).__name__}); start one with "
            "`dask scheduler` and `dask worker ADDRESS`, or leave it out for processes on this machine"
        ) from None
    # they have tracebacks of a scheduler that is lost, of which a message tells
    with _silenced("distributed", "distributed.client"), client:
        yield client


@contextmanager
def _silenced(*names: str) -> Iterator[None]:
    """Show nothing of logs below CRITICAL."""
    logs = [logging.getLogger(name) for name in names]
    before = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in zip(logs, before, strict=True):
            log.setLevel(level)


@contextmanager
def _local_cluster(workers: int | None) -> Iterator[Any]:
    """Start a cluster of processes on this machine, and connect to it; an interrupt kills the processes.

    Dask cannot close a cluster whose construction was
    interrupted, so the cluster is constructed in another thread.
    """
    others = set(active_children())
    with uninterrupted_thread(_block_sigint) as pool:
        starting = pool.submit(_start, workers)
        try:
            try:
                _, client = starting.result()
            except (OSError, RuntimeError) as error:
                raise InputError(
                    f"workers: {workers} processes cannot be started ({error}); a script of yours calls ensemble below "
                    '`if __name__ == "__main__":`, since each process reads the script again'
                ) from None
            yield client
        except BaseException:
            closing = pool.submit(_close, starting)
            while not closing.done():
                _kill_workers(others)  # again and again: Dask starts a killed worker anew until the cluster is closing
                wait([closing], KILL_PERIOD_S)
            raise
        pool.submit(_close, starting).result()


def _block_sigint() -> None:
    """Block SIGINT in this thread, and by that in all threads and processes that are started from it.

    Ctrl-C sends SIGINT to the workers, too. They are killed by the process that started them.
    """
    resource_tracker.ensure_running()  # which unblocks SIGINT when `multiprocessing` starts it later
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _start(workers: int | None) -> tuple[Any, Any]:
    """Start a cluster and connect to it."""
    from dask.distributed import Client, LocalCluster

    cluster = LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},  # any port: 8787 may be taken
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


def _kill_workers(others: Set[BaseProcess]) -> None:
    """Kill the processes of a cluster, which would otherwise finish their chunks before they end.

    Parameters
    ----------
    others : set of processes
        Child processes from before the cluster.
    """
    for process in set(active_children()) - others:
        if process.name.startswith(WORKER):
            process.kill()


def chunks_by(client: Any, task: SweepTask, pending: Iterable[tuple[int, int]], workers: int) -> Iterator[Chunk]:
    """Yield chunks as workers finish them, in whatever order.

    Raises
    ------
    InputError
        A chunk that its workers cannot finish: those that died, or what it raised. Others that are under way are lost.
    """
    from dask.distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    todo = iter(pending)

    def submit(count: int) -> list[Any]:
        return [
            client.submit(work, task, first, end, pure=False, key=f"{task.identity[:16]}-{first}", retries=2)
            for first, end in islice(todo, count)
        ]

    running = as_completed(submit(AHEAD * workers), loop=client.loop)  # type: ignore[no-untyped-call]
    for future in running:
        try:
            chunk = future.result()
        except (FutureCancelledError, CommClosedError) as error:
            raise InputError(f"the scheduler is lost, or was restarted ({type(error).__name__}); {STAYS}") from None
        except Exception as error:  # what a worker raised, or that workers died over it
            raise InputError(f"a worker failed: {type(error).__name__}: {error}; {STAYS}") from None
        for more in submit(1):
            running.add(more)  # type: ignore[no-untyped-call]
        yield chunk
