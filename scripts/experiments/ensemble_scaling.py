"""Extrapolate an ensemble to 10^9 members on many cores by a discrete-event simulation of Dask.

Its inputs are measured first: the time of a member on one core, of a task in Dask's scheduler, and of writing a chunk.
A worker asks for the next chunk when it has finished one. The scheduler serves one worker at a time, and the client
fetches and writes one result at a time. Each worker has CHUNKS_PER_WORKER
chunks in the queue, as in `ensembles.cluster`.
"""

from __future__ import annotations

import heapq
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ckc_pin.ensembles.cluster import CHUNKS_PER_WORKER
from ckc_pin.ensembles.members import Chunk, Members
from ckc_pin.ensembles.store import Store

NETWORK = 1.0e9  # bytes a second to the client: a 10 Gbit/s link
MEMBERS = 10**9
NUMBERS = 7  # stored for a member: two variables, four coordinates at the end, status and message


@dataclass(frozen=True)
class Costs:
    """Measured costs, all in seconds of processor time."""

    member: float  # of a core
    task: float  # of the scheduler
    files: float  # of the client, a chunk, whatever its size
    byte: float  # of the client


def simulate_cluster(costs: Costs, cores: int, chunk: int, members: int = MEMBERS) -> tuple[float, float, float]:
    """Simulate the cluster; return the total time in s and the utilization of workers and client."""
    size = 8.0 * NUMBERS * chunk
    work, write = chunk * costs.member, costs.files + size * (costs.byte + 1 / NETWORK)
    remaining = -(-members // chunk)
    chunks, scheduler, client = remaining, 0.0, 0.0
    idle = [(0.0, k) for k in range(cores)]  # when each worker is free
    heapq.heapify(idle)
    written: list[float] = []  # when each chunk is written: a further one is sent then
    sent = 0
    end = 0.0
    while remaining:
        free, k = heapq.heappop(idle)
        asked = free if sent < CHUNKS_PER_WORKER * cores else max(free, written[sent - CHUNKS_PER_WORKER * cores])
        scheduler = max(scheduler, asked) + costs.task
        done = scheduler + work
        client = max(client, done) + write
        written.append(client)
        heapq.heappush(idle, (done, k))
        end = client
        sent += 1
        remaining -= 1
    return end, chunks * work / (cores * end), chunks * write / end


def measure_costs(scratch: Path) -> Costs:
    """Measure the costs of a member, a task and a chunk."""
    names = ("initial.q.theta_1", "initial.q.theta_3")
    members = Members(
        "five_bar/swing", {"solver.rtol": 1e-6, "solver.terms": "generated"}, names, {"end": "q_tree"}, 1, 1
    )
    values = np.random.default_rng(1).uniform([-1.2, -1.4], [-0.9, -1.2], (2000, 2))
    members.run(0, values[:2])
    started = time.process_time()
    members.run(0, values)
    member = (time.process_time() - started) / len(values)
    seconds = {size: time_writing(members, scratch / f"{size}.zarr", size) for size in (100, 100_000)}
    byte = max(0.0, seconds[100_000] - seconds[100]) / (8 * NUMBERS * 99_900)
    return Costs(member, time_dask_task(), seconds[100], byte)


def time_writing(members: Members, path: Path, size: int) -> float:
    """Return the processor time that writing a chunk of `size` members takes, s."""
    chunks = 5
    store = Store(path, {}, members, chunks * size, size)
    random = np.random.default_rng(0)
    spent = time.process_time()
    for k in range(chunks):
        record = Chunk(k * size, random.normal(size=(size, 2)), np.ones(size, np.uint8), [""] * size,
                      {"end": random.normal(size=(size, 4))}, 0)  # fmt: skip
        store.write(record, members.names)
    return (time.process_time() - spent) / chunks


def time_dask_task() -> float:
    """Return the processor time that an empty task takes in scheduler and client together, s."""
    from dask.distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster,  # type: ignore[no-untyped-call]
        Client(cluster) as client,  # type: ignore[no-untyped-call]
    ):
        client.gather(client.map(int, range(10)))
        spent = time.process_time()
        client.gather(client.map(int, range(100, 1100)))
        return (time.process_time() - spent) / 1000


def main() -> None:
    """Print the measured costs and a Markdown table by number of cores and size of a chunk."""
    with tempfile.TemporaryDirectory() as scratch:
        costs = measure_costs(Path(scratch))
    print(
        f"a member {costs.member * 1e6:.0f} us of a core; a task {costs.task * 1e3:.2f} ms of scheduler and client; "
        f"a chunk {costs.files * 1e3:.1f} ms to write, and {1e-6 / costs.byte:.0f} MB a second\n"
    )
    columns = ("cores", "members a chunk", "s of a chunk", "hours for 10^9", "cores busy", "client busy")
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for cores in (2, 100, 1000):
        for seconds in (1.0, 10.0, 60.0):
            chunk = round(seconds / costs.member)
            end, busy, writes = simulate_cluster(costs, cores, chunk)
            print(
                f"| {cores} | {chunk:,} | {seconds:g} | {end / 3600:.2f} | {100 * busy:.0f} % | {100 * writes:.0f} % |"
            )
