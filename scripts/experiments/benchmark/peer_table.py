"""Compare a program that follows the protocol with references and with ckc_pin, in the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from joblib import Memory

from ckc_pin.analysis.precision.motion import Setting
from scripts.experiments.benchmark import ours
from scripts.experiments.benchmark.make import BUDGET, CACHE, exact_of
from scripts.experiments.benchmark.peers.protocol import ProgramPeer
from scripts.experiments.benchmark.row import Row, compare_with_reference
from scripts.experiments.benchmark.work import WORKS

__all__ = ["print_table"]


def print_table(command: str, keys: Sequence[str] = ()) -> bool:
    """Print errors and times of the works, all of them without keys; return whether no run failed.

    ckc_pin runs as DAE with the same relative tolerance.
    """
    peer, memory, failures = ProgramPeer(command), Memory(CACHE, verbose=0), 0
    print(f"{peer.name}, {peer.version()}")
    for work in WORKS:
        if keys and work.key not in keys:
            continue
        reason = peer.missing(work)
        print(f"\n{work.key}: {f'not compared, {reason}' if reason else peer.check(work)}", flush=True)
        if reason:
            continue
        exact = exact_of(work, memory)()
        print(f"  {'setting':24} {'error':>8} {'ms':>9}   {'ckc_pin':>8} {'ms':>9}   (reference: {exact.accuracy:.0e})")
        for name in peer.settings(work, quick=True):
            setting = Setting("dae", "auto", max(float(name.rpartition("rtol ")[2]), 1e-13))
            theirs = compare_with_reference(work, peer.name, name, peer.compute(work, name, BUDGET.peer), exact)
            motion = ours.compute(work, setting, BUDGET.ours)
            row = compare_with_reference(work, ours.PROGRAM, ours.name_of(setting), motion, exact)
            failures += theirs.status == "failed"
            print(f"  {name:24} {_cells(theirs)}   {_cells(row)}  {theirs.reason}".rstrip(), flush=True)
    return not failures


def _cells(row: Row) -> str:
    if row.error_max is None or row.wall_s is None:
        return f"{row.status:>18}"
    return f"{row.error_max:8.0e} {1e3 * row.wall_s:9.3g}"
