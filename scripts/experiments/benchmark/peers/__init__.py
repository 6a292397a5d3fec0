"""Wrappers of other programs, which run the benchmark's works; each implements `Peer`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from ckc_pin.analysis.precision.motion import Motion
from scripts.experiments.benchmark.work import Work

__all__ = ["Peer", "peers"]


class Peer(Protocol):
    """Interface of a program in the benchmark."""

    name: str
    packaged: bool  # True for a program as installed; False if its user has to write the loop

    def missing(self, work: Work) -> str | None:
        """Return why the program cannot run a work, None if it can."""
        ...

    def version(self) -> str:
        """Return the program's version."""
        ...

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        """Yield the names of the settings to run a work with, from coarse to fine steps."""
        ...

    def check(self, work: Work) -> str:
        """Return a sentence on how well the program's model agrees with ckc_pin's at the start."""
        ...

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        """Run a work; refuse a run that would take longer than the budget, in s."""
        ...


def peers() -> list[Peer]:
    """Return the wrappers of all programs, installed or not."""
    from scripts.experiments.benchmark.peers.environments import program_peers
    from scripts.experiments.benchmark.peers.exudyn import Exudyn
    from scripts.experiments.benchmark.peers.ida import Ida
    from scripts.experiments.benchmark.peers.mujoco import Mujoco
    from scripts.experiments.benchmark.peers.pinocchio import Pinocchio
    from scripts.experiments.benchmark.peers.pinocchio_loop import PinocchioLoop

    loops = [PinocchioLoop("constraintDynamics"), PinocchioLoop("lcaba")]
    return [Mujoco(), *program_peers(), Exudyn(), Pinocchio(), *loops, Ida()]
