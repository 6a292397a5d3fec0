"""Other programs on the same mechanism: each a module with `PROGRAM`, `missing`, `version`, `settings`, `compute`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from ckc_pin.analysis.precision.motion import Motion
from scripts.experiments.benchmark.work import Work

__all__ = ["Peer", "peers"]


class Peer(Protocol):
    """What the report asks of a program."""

    name: str
    packaged: bool  # a program that is installed and called; not a loop that a user would have to write around one

    def missing(self, work: Work) -> str | None:
        """Why it cannot do a work; None where it can."""
        ...

    def version(self) -> str:
        """Its version."""
        ...

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        """Names of the settings it is tried with on a work, from coarse to fine steps."""
        ...

    def check(self, work: Work) -> str:
        """How well it agrees with this program at the start, a sentence."""
        ...

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        """Run a work; a run that would take longer than the budget, in s, is refused."""
        ...


def peers() -> list[Peer]:
    """All programs there are wrappers for, whether installed or not."""
    from scripts.experiments.benchmark.peers.drake import Drake
    from scripts.experiments.benchmark.peers.exudyn import Exudyn
    from scripts.experiments.benchmark.peers.ida import Ida
    from scripts.experiments.benchmark.peers.mujoco import Mujoco
    from scripts.experiments.benchmark.peers.pinocchio import Pinocchio
    from scripts.experiments.benchmark.peers.pinocchio_loop import PinocchioLoop

    return [Mujoco(), Drake(), Exudyn(), Pinocchio(), PinocchioLoop(), Ida()]
