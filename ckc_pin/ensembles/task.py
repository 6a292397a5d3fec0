"""A sweep as plain data: what a worker elsewhere needs to run any of its members."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path

import msgspec

from ckc_pin.base.sources import Sources
from ckc_pin.ensembles.members import Members
from ckc_pin.ensembles.outputs import Function
from ckc_pin.ensembles.spec import SweepSpec
from ckc_pin.ensembles.variables import Variables

__all__ = ["SweepTask"]


@dataclass(frozen=True)
class SweepTask:
    """One sweep.

    Attributes
    ----------
    spec : SweepSpec
    name : str
        What messages call it.
    scene : str or Path
    folder : Path or None
        Where files of values are.
    functions : dict of str to callable
        Outputs that are functions of a `Run`.
    terms : str or None
        Whose terms, where that is decided: on every machine the same.
    """

    spec: SweepSpec
    name: str
    scene: str | Path
    folder: Path | None
    functions: Mapping[str, Function] = field(default_factory=dict)
    terms: str | None = None

    def members(self, threads: int) -> Members:
        """Prepare its members."""
        overrides = dict(self.spec.overrides)
        if self.terms is not None:
            overrides["solver.terms"] = self.terms
        outputs = {**self.spec.outputs, **self.functions}
        return Members(self.scene, overrides, tuple(self.spec.variables), outputs, self.variables().count, threads)

    def variables(self) -> Variables:
        """Return its variables."""
        return self._variables

    @cached_property
    def _variables(self) -> Variables:
        return Variables(self.spec, Sources(self.name, self.folder))

    @cached_property
    def identity(self) -> str:
        """A name for what it computes."""
        functions = sorted(
            (name, getattr(f, "__qualname__", type(f).__qualname__)) for name, f in self.functions.items()
        )
        what = (msgspec.to_builtins(self.spec), str(self.scene), str(self.folder), functions, self.terms)
        return sha256(msgspec.json.encode(what, order="deterministic")).hexdigest()
