"""Outputs of an ensemble's members: reductions of recorded or derived quantities, or functions of a `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.sampled import unwrap_sampled
from ckc_pin.ensembles.spec import OutputSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined
from ckc_pin.run.columns import Quantity, integral_unit, list_quantities, quantity_units, unknown_quantity
from ckc_pin.run.derived import DerivedQuantities
from ckc_pin.run.prepare import Prepared
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import record_columns

__all__ = ["NAMED_REDUCTIONS", "TIME_TOLERANCE", "Function", "NamedQuantity", "Output", "Outputs", "Recorded"]

Function = Callable[[Run], Any]

NAMED_REDUCTIONS = {
    "max_abs_u": OutputSpec(of="u", reduce="max_abs"),
    "max_abs_tau": OutputSpec(of="tau", reduce="max_abs"),
    "max_phi": OutputSpec(of="phi", reduce="max_abs"),
}  # the largest of all components, one number each
VECTORS = {"q_tree": "coordinate", "v_tree": "coordinate", "u": "independent", "tau": "actuated", "phi": "row",
           "error": "independent"}  # fmt: skip
SCALARS = ("energy", "dissipated", "lyapunov", "t")
DERIVED = ("settled", "energy_drift")
EVENT = "event."
# Arrays of `DerivedQuantities`, which a mechanism determines from q' and v'.
OF_STATE = ("point_positions", "point_velocities", "kinetic_energy", "potential_energy", "sigma_min")
TIME_TOLERANCE = 1e-9  # of an instant after the end of a run, relative to the end
COLUMNS_OF = {"phi_max": "max_phi"} | {name: name for name in ("q_tree", "v_tree", "u", "tau", "phi", "w", "energy")}


@dataclass(frozen=True)
class Recorded:
    """Recorded quantities of some members, NaN where a member has none.

    Attributes
    ----------
    last_row : (members, width) array
        Last row of the record; NaN for members that did not begin.
    series : (members, columns, instants) array
        Columns at the output instants; NaN after a member's end.
    event_times : (members, events) array
        First occurrence of each event, s.
    """

    last_row: Array
    series: Array
    event_times: Array


@dataclass(frozen=True)
class Output:
    """One output: its dimensions after the member's, its shape in them, the units of its components, its function."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    units: tuple[str, ...]
    compute: Callable[[Recorded], Array]


@dataclass(frozen=True)
class NamedQuantity:
    """A reduction of a quantity that a run derives from its rows, such as ``tip.x``: a function of a `Run`.

    Attributes
    ----------
    name, unit : str
    spec : OutputSpec
    instants : (m,) array
        Output instants of the member.
    """

    name: str
    unit: str
    spec: OutputSpec
    instants: Array

    def __call__(self, run: Run) -> Any:
        """Return the reduction for a run. A trajectory is NaN after the run's end."""
        values = run[self.name]
        if self.spec.reduction == "end":
            return values[-1]
        series = np.full((1, 1, len(self.instants)), np.nan)
        index = np.minimum(np.searchsorted(self.instants, run.t), len(self.instants) - 1)
        is_output = self.instants[index] == run.t  # the last row of a run that stopped may lie between two instants
        series[0, 0, index[is_output]] = values[is_output]
        return _reduce(series, self.spec, self.instants)[0, 0]

    @property
    def units(self) -> tuple[str, ...]:
        """The unit, as of an `Output`."""
        return (self.unit,)

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the result."""
        return ("time",) if self.spec.reduction == "trajectory" else ()


class Outputs:
    """The outputs of a sweep for a prepared scene.

    Parameters
    ----------
    specs : mapping of str to str, OutputSpec or callable
    ready : Prepared
    has_fixed_mechanism : bool
        Whether all members have the mechanism of `ready`. If so, points and energies follow from recorded rows.

    Raises
    ------
    InputError
        Unknown quantity, coordinate or event. The message lists the valid ones.

    Attributes
    ----------
    columns : list of int
        Columns of the record that are needed at all output instants.
    needs_series : bool
        Whether an output needs more than the last row.
    functions : dict of str to callable
        Outputs that are functions of a run: the caller's, and quantities that rows do not contain.
    outputs : dict of str to Output
        All other outputs.
    """

    def __init__(
        self, specs: Mapping[str, str | OutputSpec | Function], ready: Prepared, *, has_fixed_mechanism: bool = False
    ) -> None:
        self._ready, self._slices = ready, record_columns(ready.loop)
        self._has_fixed_mechanism = has_fixed_mechanism
        self._units, self._quantities = quantity_units(ready.mechanism), list_quantities(ready.mechanism)
        self.columns: list[int] = []
        self.functions: dict[str, Function] = {}
        self.outputs: dict[str, Output] = {}
        for name, spec in specs.items():
            if callable(spec):
                self.functions[name] = spec
                continue
            named = self._find_derived(spec)
            if named is not None:
                self.functions[name] = named
            else:
                self.outputs[name] = self._create_output(name, spec)
        self.needs_series = bool(self.columns) or bool(self.functions)

    def compute(self, recorded: Recorded) -> dict[str, Array]:
        """Return the outputs of some members, (members, ...) each."""
        return {name: output.compute(recorded) for name, output in self.outputs.items()}

    def record(self, rows: Array) -> Recorded:
        """Return the recorded quantities of one member from the rows of its run."""
        instants, events = self._ready.instants, self._ready.events
        series = np.full((1, len(self.columns), len(instants)), np.nan)
        index_of = {float(t): i for i, t in enumerate(instants)}
        for row in rows:
            i = index_of.get(float(row[0]))
            if i is not None:
                series[0, :, i] = row[self.columns]
        event_times = np.full((1, len(events)), np.nan)
        for occurrence in self._ready.loop.occurrences():
            event_times[0, occurrence.event] = np.fmin(event_times[0, occurrence.event], occurrence.t)
        return Recorded(rows[-1:], series, event_times)

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Labels along each dimension."""
        mechanism = self._ready.mechanism
        rows = tuple(".".join(name) for name in mechanism.closure.names)
        return {"coordinate": mechanism.coordinates, "independent": mechanism.independent,
                "actuated": mechanism.actuated, "row": rows}  # fmt: skip

    # --- construction ----------------------------------------------------------------------------

    def _find_derived(self, spec: str | OutputSpec) -> NamedQuantity | None:
        """Return the output of a quantity that is not recorded in rows, or None of other quantities."""
        spec = OutputSpec(of=spec) if isinstance(spec, str) else spec
        quantity = self._quantities.get(spec.of)
        if quantity is None or quantity.array in (*COLUMNS_OF, "error") or self._is_special(spec.of):
            return None
        if self._has_fixed_mechanism and quantity.array in OF_STATE:
            return None
        unit = integral_unit(quantity.unit) if spec.reduction == "integral" else quantity.unit
        return NamedQuantity(spec.of, unit, spec, self._ready.instants)

    def _is_special(self, name: str) -> bool:
        """Whether a name denotes an output that is no single quantity of the naming scheme."""
        return name in (*VECTORS, *SCALARS, *DERIVED, *NAMED_REDUCTIONS) or name.startswith(EVENT)

    def _create_output(self, name: str, spec: str | OutputSpec) -> Output:
        if isinstance(spec, str):
            if spec in NAMED_REDUCTIONS:
                components = self._create_reduction(name, NAMED_REDUCTIONS[spec])
                unit = (joined(components.units),)
                return Output((), (), unit, lambda recorded: np.fmax.reduce(components.compute(recorded), axis=1))
            spec = OutputSpec(of=spec)
        if spec.of == "settled":
            return Output((), (), ("",), self._create_settled(spec.tolerance))
        if spec.of == "energy_drift":
            (energy,) = self._require_series([self._slices["energy"].start])
            return Output((), (), ("J",), lambda recorded: _compute_drift(recorded.series[:, energy]))
        if spec.of.startswith(EVENT):
            event = self._find_event(name, spec.of.removeprefix(EVENT))
            return Output((), (), ("s",), lambda recorded: recorded.event_times[:, event])
        return self._create_reduction(name, spec)

    def _create_reduction(self, name: str, spec: OutputSpec) -> Output:
        joints, smoothing = self._ready.mechanism.joints, self._ready.scene.spec.friction_smoothing
        if spec.of == "dissipated" and joints.has_smooth_friction(smoothing):
            return self._create_unknown(spec)
        quantity = self._quantities.get(spec.of)
        if quantity is not None and quantity.array in OF_STATE:
            return self._create_function_of_state(spec, quantity)
        columns, dims, reference = self._find_columns(name, spec.of)
        shape = (len(columns),) if dims else ()
        units = self._units_of(spec)
        if spec.reduction == "end" and reference is None:
            return Output(dims, shape, units, lambda recorded: _squeeze(recorded.last_row[:, columns], dims))
        indices, reduction = self._require_series(columns), spec.reduction

        def compute(recorded: Recorded) -> Array:
            x = recorded.series[:, indices]
            x = x if reference is None else x - reference
            return _squeeze(_reduce(x, spec, self._ready.instants), dims)

        if reduction == "trajectory":
            return Output((*dims, "time"), (*shape, len(self._ready.instants)), units, compute)
        return Output(dims, shape, units, compute)

    def _create_function_of_state(self, spec: OutputSpec, quantity: Quantity) -> Output:
        """Return the output of a quantity that the mechanism determines from q' and v', such as a point's position."""
        mechanism, instants, n = self._ready.mechanism, self._ready.instants, self._ready.mechanism.n
        columns = [k for name in ("q_tree", "v_tree") for k in range(self._slices[name].start, self._slices[name].stop)]

        def evaluate(states: Array) -> Array:
            """Return the quantity of states (k, 2 n); NaN where a member has none."""
            values = np.full(len(states), np.nan)
            is_recorded = np.isfinite(states).all(axis=1)
            q_tree, v_tree = states[is_recorded, :n], states[is_recorded, n:]
            derived = DerivedQuantities(np.zeros(len(q_tree)), q_tree, v_tree, mechanism)
            values[is_recorded] = quantity.select(getattr(derived, quantity.array))
            return values

        if spec.reduction == "end":
            return Output((), (), self._units_of(spec), lambda recorded: evaluate(recorded.last_row[:, columns]))
        indices = self._require_series(columns)

        def compute(recorded: Recorded) -> Array:
            states = recorded.series[:, indices].transpose(0, 2, 1)
            values = evaluate(states.reshape(-1, 2 * n)).reshape(len(states), 1, -1)
            return _squeeze(_reduce(values, spec, instants), ())

        dims, shape = (("time",), (len(instants),)) if spec.reduction == "trajectory" else ((), ())
        return Output(dims, shape, self._units_of(spec), compute)

    def _create_unknown(self, spec: OutputSpec) -> Output:
        """Return an output of a scalar that is NaN, because a run does not compute it."""
        instants = len(self._ready.instants) if spec.reduction == "trajectory" else None
        dims, shape = ((), ()) if instants is None else (("time",), (instants,))
        return Output(
            dims, shape, self._units_of(spec), lambda recorded: np.full((len(recorded.last_row), *shape), np.nan)
        )

    def _find_columns(self, name: str, name_of: str) -> tuple[list[int], tuple[str, ...], Array | None]:
        """Return the columns of a quantity, its dimensions, and the values over time that are subtracted from it."""
        mechanism, quantity = self._ready.mechanism, self._quantities.get(name_of)
        if name_of not in mechanism.tree.index and (name_of in VECTORS or name_of in SCALARS):
            if name_of == "error":
                start = self._slices["q_tree"].start
                columns = [start + int(k) for k in mechanism.partition.q]
                return columns, ("independent",), self._compute_q_d(name)
            dims = (VECTORS[name_of],) if name_of in VECTORS else ()
            return list(range(self._slices[name_of].start, self._slices[name_of].stop)), dims, None
        if quantity is None:
            arrays = [*VECTORS, *SCALARS, *DERIVED, f"{EVENT}NAME", *NAMED_REDUCTIONS]
            raise unknown_quantity(f"outputs: {name}: {name_of!r}", name_of, mechanism, arrays)
        column = quantity.column or 0
        if quantity.array == "error":
            start = self._slices["q_tree"].start
            return [start + int(mechanism.partition.q[column])], (), self._compute_q_d(name)[[column]]
        return [self._slices[COLUMNS_OF[quantity.array]].start + column], (), None

    def _units_of(self, spec: OutputSpec) -> tuple[str, ...]:
        """Return the unit of each component; an integral is over time."""
        is_vector = spec.of in self._units and spec.of not in self._ready.mechanism.tree.index
        units = self._units[spec.of] if is_vector else [self._quantities[spec.of].unit]
        return tuple(integral_unit(unit) if spec.reduction == "integral" else unit for unit in units)

    def _compute_q_d(self, name: str) -> Array:
        """Return q_d at the output instants, (d, instants)."""
        law, instants = _find_law(self._ready), self._ready.instants
        if isinstance(law, SetPoint):
            return np.tile(law.q_d[:, None], (1, len(instants)))
        if isinstance(law, Tracking) and callable(law.desired):
            return np.array([law.desired(float(t))[0] for t in instants]).T
        raise InputError(
            f"outputs: {name}: error is q - q_d, but the scene's controller has no q_d as a function of time; choose "
            "another output"
        )

    def _require_series(self, columns: list[int]) -> list[int]:
        """Record columns at all output instants; return their indices in `columns`."""
        self.columns += [column for column in columns if column not in self.columns]
        return [self.columns.index(column) for column in columns]

    def _create_settled(self, tolerance: float) -> Callable[[Recorded], Array]:
        """Return the function that is 1 for members at rest at their end, and at q_d of a set point."""
        law, mechanism = _find_law(self._ready), self._ready.mechanism
        step_scale = mechanism.tree.step_scale
        q, v = self._slices["q_tree"], self._slices["v_tree"]

        def compute(recorded: Recorded) -> Array:
            last = recorded.last_row
            is_settled = np.all(np.abs(last[:, v]) <= tolerance * step_scale, axis=1)
            if isinstance(law, SetPoint):
                error = last[:, q][:, mechanism.partition.q] - law.q_d
                is_settled &= np.all(np.abs(error) <= tolerance * step_scale[mechanism.partition.q], axis=1)
            return np.where(np.isnan(last[:, 0]), np.nan, is_settled.astype(float))

        return compute

    def _find_event(self, name: str, label: str) -> int:
        """Return the index of an event, which is given by name or index."""
        names = [event.label["name"] for event in self._ready.events]
        if label in names:
            return names.index(label)
        if label.isdigit() and int(label) < len(names):
            return int(label)
        valid = ", ".join(f"{EVENT}{k} ({event_name})" for k, event_name in enumerate(names)) or "none"
        raise InputError(f"outputs: {name}: the scene has no event {label!r}; it has {valid}")


def _find_law(ready: Prepared) -> Any:
    return unwrap_sampled(ready.controller)


def _squeeze(x: Array, dims: tuple[str, ...]) -> Array:
    return x if dims else x[:, 0]


def _compute_drift(energy: Array) -> Array:
    """Return the largest |E - E(0)|, J."""
    return np.fmax.reduce(np.abs(energy - energy[:, :1]), axis=1)


def _reduce(x: Array, spec: OutputSpec, instants: Array) -> Array:
    """Reduce (members, columns, instants) over time, ignoring instants after a member's end.

    Each sum runs over one member's row, which is contiguous in memory, so that it does not depend on other members.
    """
    reduction = spec.reduction
    if reduction == "trajectory":
        return x
    if spec.at is not None:
        is_within = spec.at <= instants[-1] * (1 + TIME_TOLERANCE)
        return x[:, :, int(np.argmin(np.abs(instants - spec.at)))] if is_within else np.full(x.shape[:2], np.nan)
    if reduction == "end":
        is_recorded = ~np.isnan(x)
        last = x.shape[2] - 1 - np.argmax(is_recorded[:, :, ::-1], axis=2)
        return np.take_along_axis(x, last[:, :, None], axis=2)[:, :, 0]
    if reduction in ("min", "max", "max_abs"):
        reduce = (np.fmin if reduction == "min" else np.fmax).reduce
        return np.asarray(reduce(np.abs(x) if reduction == "max_abs" else x, axis=2))
    y = x**2 if reduction == "rms" else x
    area = np.diff(instants) * (y[:, :, 1:] + y[:, :, :-1]) / 2
    durations = np.where(np.isnan(area), 0.0, np.diff(instants))
    integral = np.ascontiguousarray(np.where(np.isnan(area), 0.0, area)).sum(axis=2)
    integral = np.where(np.isnan(x[:, :, 0]), np.nan, integral)
    if reduction == "integral":
        return integral
    duration = np.ascontiguousarray(durations).sum(axis=2)
    # 0 / 0 would give NaN, whose sign depends on the number of members that NumPy divides at once.
    mean = np.divide(integral, duration, out=np.full_like(integral, np.nan), where=duration > 0)
    return np.sqrt(mean) if reduction == "rms" else mean
