"""What is kept of each member: reductions of what the loop records, or functions of a whole `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.sampled import Sampled
from ckc_pin.ensembles.spec import OutputSpec, Reduction
from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined
from ckc_pin.run.columns import integral_unit, quantity_units
from ckc_pin.run.prepare import Prepared
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import record_columns

__all__ = ["Function", "Output", "Outputs", "Recorded"]

Function = Callable[[Run], Any]

SHORT = {
    "max_abs_u": OutputSpec(of="u", reduce="max_abs"),
    "max_abs_tau": OutputSpec(of="tau", reduce="max_abs"),
    "max_phi": OutputSpec(of="phi", reduce="max_abs"),
}  # one number each: the largest of all components
VECTORS = {"q_tree": "coordinate", "v_tree": "coordinate", "u": "independent", "tau": "actuated", "phi": "row",
           "error": "independent"}  # fmt: skip
SCALARS = ("energy", "dissipated", "lyapunov", "t")
DERIVED = ("settled", "energy_drift")
EVENT = "event."


@dataclass(frozen=True)
class Recorded:
    """What the loops have recorded of some members.

    Attributes
    ----------
    last : (members, width) array
        The last row of each; NaN for those that did not begin.
    kept : (members, columns, instants) array
        Columns over time; NaN where a member did not get to.
    met : (members, events) array
        When each event was met first, s; NaN for never.
    """

    last: Array
    kept: Array
    met: Array


@dataclass(frozen=True)
class Output:
    """One output: the dimensions after the member's, its shape in them, and the unit of each component."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    units: tuple[str, ...]
    compute: Callable[[Recorded], Array]


class Outputs:
    """Outputs of a sweep for a scene.

    Parameters
    ----------
    specs : mapping of str to str, OutputSpec or callable
    ready : Prepared

    Raises
    ------
    InputError
        No such quantity, coordinate or event (those there are are listed).

    Attributes
    ----------
    columns : list of int
        Which columns are kept over time.
    whole : bool
        Whether anything is kept over time; else the last row is enough.
    functions : dict of str to callable
    outputs : dict of str to Output
        Those that are no functions.
    """

    def __init__(self, specs: Mapping[str, str | OutputSpec | Function], ready: Prepared) -> None:
        self._ready, self._places = ready, record_columns(ready.mechanism)
        self._units = quantity_units(ready.mechanism)
        self.columns: list[int] = []
        self.functions: dict[str, Function] = {}
        self.outputs: dict[str, Output] = {}
        for name, spec in specs.items():
            if callable(spec):
                self.functions[name] = spec
            else:
                self.outputs[name] = self._output(name, spec)
        self.whole = bool(self.columns) or bool(self.functions)

    def compute(self, recorded: Recorded) -> dict[str, Array]:
        """Return the outputs of some members, (members, ...) each."""
        return {name: output.compute(recorded) for name, output in self.outputs.items()}

    def recorded(self, rows: Array) -> Recorded:
        """Return what a run of what was prepared has recorded, as of one member."""
        instants, events = self._ready.instants, self._ready.events
        kept = np.full((1, len(self.columns), len(instants)), np.nan)
        at = {float(t): i for i, t in enumerate(instants)}
        for row in rows:
            i = at.get(float(row[0]))
            if i is not None:
                kept[0, :, i] = row[self.columns]
        met = np.full((1, len(events)), np.nan)
        for t, event, _ in self._ready.loop.met():
            met[0, event] = np.fmin(met[0, event], t)
        return Recorded(rows[-1:], kept, met)

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """What stands along each dimension."""
        mechanism = self._ready.mechanism
        rows = tuple(".".join(name) for name in mechanism.closure.names)
        return {"coordinate": mechanism.coordinates, "independent": mechanism.independent,
                "actuated": mechanism.actuated, "row": rows}  # fmt: skip

    # --- construction ----------------------------------------------------------------------------

    def _output(self, name: str, spec: str | OutputSpec) -> Output:
        if isinstance(spec, str):
            if spec in SHORT:
                inner = self._reduced(name, SHORT[spec])
                unit = (joined(inner.units),)
                return Output((), (), unit, lambda recorded: np.fmax.reduce(inner.compute(recorded), axis=1))
            spec = OutputSpec(of=spec)
        if spec.of == "settled":
            return Output((), (), ("",), self._settled(name, spec.tolerance))
        if spec.of == "energy_drift":
            at = self._keep([self._places["energy"].start])
            return Output((), (), ("J",), lambda recorded: _drift(recorded.kept[:, at[0]]))
        if spec.of.startswith(EVENT):
            event = self._event(name, spec.of.removeprefix(EVENT))
            return Output((), (), ("s",), lambda recorded: recorded.met[:, event])
        return self._reduced(name, spec)

    def _reduced(self, name: str, spec: OutputSpec) -> Output:
        joints, smoothing = self._ready.mechanism.joints, self._ready.scene.spec.friction_smoothing
        if spec.of == "dissipated" and joints.has_smooth_friction(smoothing):  # None in a run
            return self._unknown(spec)
        columns, dims, wanted = self._quantity(name, spec.of)
        shape = (len(columns),) if dims else ()
        units = self._units_of(spec)
        if spec.reduce == "end" and wanted is None:
            return Output(dims, shape, units, lambda recorded: _squeezed(recorded.last[:, columns], dims))
        at, reduce = self._keep(columns), spec.reduce

        def compute(recorded: Recorded) -> Array:
            x = recorded.kept[:, at]
            return _squeezed(_reduce(x if wanted is None else x - wanted, reduce, self._ready.instants), dims)

        if reduce == "trajectory":
            return Output((*dims, "time"), (*shape, len(self._ready.instants)), units, compute)
        return Output(dims, shape, units, compute)

    def _unknown(self, spec: OutputSpec) -> Output:
        """Return an output of one number that is NaN."""
        times = len(self._ready.instants) if spec.reduce == "trajectory" else None
        dims, shape = ((), ()) if times is None else (("time",), (times,))
        return Output(dims, shape, self._units_of(spec), lambda recorded: np.full((len(recorded.last), *shape), np.nan))

    def _quantity(self, name: str, of: str) -> tuple[list[int], tuple[str, ...], Array | None]:
        """Where a quantity stands in a row, its dimension, and what is taken off it over time."""
        mechanism, q = self._ready.mechanism, self._places["q_tree"].start
        if of in mechanism.tree.index:
            return [q + mechanism.tree.index[of]], (), None
        if of == "error":
            return [q + int(k) for k in mechanism.partition.q], ("independent",), self._wanted(name)
        if of in VECTORS or of in SCALARS:
            place = self._places[of]
            return list(range(place.start, place.stop)), (VECTORS[of],) if of in VECTORS else (), None
        choices = ", ".join([*VECTORS, *SCALARS, *DERIVED, f"{EVENT}NAME", *SHORT, *mechanism.coordinates])
        raise InputError(f"outputs: {name}: no {of!r}; there are {choices}")

    def _units_of(self, spec: OutputSpec) -> tuple[str, ...]:
        """The unit of each component; an integral's is over time."""
        index = self._ready.mechanism.tree.index
        own = [self._units["q_tree"][index[spec.of]]] if spec.of in index else self._units[spec.of]
        return tuple(integral_unit(unit) if spec.reduce == "integral" else unit for unit in own)

    def _wanted(self, name: str) -> Array:
        """q_d over time, (d, instants)."""
        law, instants = _law(self._ready), self._ready.instants
        if isinstance(law, SetPoint):
            return np.tile(law.q_d[:, None], (1, len(instants)))
        if isinstance(law, Tracking) and callable(law.desired):
            return np.array([law.desired(float(t))[0] for t in instants]).T
        says = "error is q - q_d, and this scene's controller has no q_d as a function of time"
        raise InputError(f"outputs: {name}: {says}")

    def _keep(self, wanted: list[int]) -> list[int]:
        """Have columns kept over time; return where they are among those."""
        self.columns += [column for column in wanted if column not in self.columns]
        return [self.columns.index(column) for column in wanted]

    def _settled(self, name: str, tolerance: float) -> Callable[[Recorded], Array]:
        """Whether at the end everything rests, and q is q_d where there is a set point."""
        law, mechanism = _law(self._ready), self._ready.mechanism
        reach = mechanism.tree.step_scale
        q, v = self._places["q_tree"], self._places["v_tree"]

        def compute(recorded: Recorded) -> Array:
            at_rest = np.all(np.abs(recorded.last[:, v]) <= tolerance * reach, axis=1)
            if isinstance(law, SetPoint):
                error = recorded.last[:, q][:, mechanism.partition.q] - law.q_d
                at_rest &= np.all(np.abs(error) <= tolerance * reach[mechanism.partition.q], axis=1)
            return np.where(np.isnan(recorded.last[:, 0]), np.nan, at_rest.astype(float))

        return compute

    def _event(self, name: str, which: str) -> int:
        names = [event.label["name"] for event in self._ready.events]
        if which in names:
            return names.index(which)
        if which.isdigit() and int(which) < len(names):
            return int(which)
        there = ", ".join(f"{EVENT}{k} ({called})" for k, called in enumerate(names)) or "none"
        raise InputError(f"outputs: {name}: the scene has no event {which!r}; it has {there}")


def _law(ready: Prepared) -> Any:
    return ready.controller.controller if isinstance(ready.controller, Sampled) else ready.controller


def _squeezed(x: Array, dims: tuple[str, ...]) -> Array:
    return x if dims else x[:, 0]


def _drift(energy: Array) -> Array:
    """Largest |E - E(0)|, J."""
    return np.fmax.reduce(np.abs(energy - energy[:, :1]), axis=1)


def _reduce(x: Array, how: Reduction, instants: Array) -> Array:
    """Reduce (members, columns, instants) over time; instants that a member did not get to are left out.

    Each sum is over one member's own row, contiguous in memory, so that it does not depend on who else is there.
    """
    if how == "trajectory":
        return x
    if how == "end":
        there = ~np.isnan(x)
        last = x.shape[2] - 1 - np.argmax(there[:, :, ::-1], axis=2)
        return np.take_along_axis(x, last[:, :, None], axis=2)[:, :, 0]
    if how in ("min", "max", "max_abs"):
        return (np.fmin if how == "min" else np.fmax).reduce(np.abs(x) if how == "max_abs" else x, axis=2)
    y = x**2 if how == "rms" else x
    area = np.diff(instants) * (y[:, :, 1:] + y[:, :, :-1]) / 2
    lasted = np.where(np.isnan(area), 0.0, np.diff(instants))
    integral = np.ascontiguousarray(np.where(np.isnan(area), 0.0, area)).sum(axis=2)
    integral = np.where(np.isnan(x[:, :, 0]), np.nan, integral)
    if how == "integral":
        return integral
    seconds = np.ascontiguousarray(lasted).sum(axis=2)
    # no 0 / 0, whose NaN has another sign where it is computed several at a time
    mean = np.divide(integral, seconds, out=np.full_like(integral, np.nan), where=seconds > 0)
    return np.sqrt(mean) if how == "rms" else mean
