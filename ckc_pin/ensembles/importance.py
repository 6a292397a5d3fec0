"""Which variable matters: Sobol indices, shares of an output's variance, by SciPy."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.ensembles.members import DONE
from ckc_pin.ensembles.spec import VariableSpec
from ckc_pin.ensembles.store import require_libraries
from ckc_pin.ensembles.task import SweepTask
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["importance", "laws_of"]

CHUNK = 4096  # members at once


def importance(task: SweepTask, count: int, threads: int | None = None) -> xr.Dataset:
    """Return first-order and total Sobol indices of a sweep's outputs that are one number.

    Parameters
    ----------
    task : SweepTask
    count : int
        A power of 2; (variables + 2) count members are run, of Saltelli's design.
    threads : int, optional

    Returns
    -------
    xarray.Dataset
        first_order and total_order by output and variable.

    Raises
    ------
    InputError
        A count that is no power of 2, a single variable, variables that are no random ones, no output of one number,
        members that fail.
    """
    require_libraries()
    import xarray as xr
    from scipy.stats import sobol_indices

    names, laws = list(task.spec.variables), laws_of(task, count)
    members = task.members(threads or os.cpu_count() or 1)
    outputs = [name for name, (dims, _) in members.shapes.items() if not dims]
    if not outputs:
        raise InputError('indices: no output is one number; name one, e.g. drift = "energy_drift"')

    def of(values: Array) -> Array:
        found = []
        for first in range(0, values.shape[1], CHUNK):
            chunk = members.run(first, np.ascontiguousarray(values[:, first : first + CHUNK].T))
            bad = np.flatnonzero(chunk.status != DONE)
            if len(bad):
                says = f"{len(bad)} of {len(chunk.status)} members did not end, the first: {chunk.message[bad[0]]}"
                raise InputError(f"indices: variances are of all members; {says}")
            found.append(np.array([chunk.outputs[name] for name in outputs]))
        return np.concatenate(found, axis=1)

    indices: Any = sobol_indices(func=of, n=count, dists=laws, rng=np.random.default_rng(task.spec.seed))
    shape = len(outputs), len(names)
    return xr.Dataset(
        {
            "first_order": (("output", "variable"), np.reshape(indices.first_order, shape)),
            "total_order": (("output", "variable"), np.reshape(indices.total_order, shape)),
        },
        coords={"output": outputs, "variable": names},
    )


def laws_of(task: SweepTask, count: int) -> list[Any]:
    """Return the variables' distributions, where all that is known without a run allows indices (InputError)."""
    if count < 2 or count & (count - 1):
        raise InputError(f"indices: {count} is no power of 2, which Saltelli's design needs")
    names = list(task.spec.variables)
    if len(names) < 2:
        raise InputError(f"indices: {names[0]} alone makes all of the variance; vary something beside it")
    return [_law(name, spec) for name, spec in task.spec.variables.items()]


def _law(name: str, spec: VariableSpec) -> Any:
    """A variable's distribution, as SciPy has it."""
    from scipy import stats

    kind = spec.kind
    if kind in ("grid", "list", "file"):
        raise InputError(f"indices: {name} is no random variable but a {kind}; give uniform, normal, ...")
    a, b = getattr(spec, kind)
    if kind == "normal":
        return stats.norm(a, b)
    if kind == "lognormal":
        return stats.lognorm(b, scale=np.exp(a))
    return stats.loguniform(a, b) if kind == "loguniform" else stats.uniform(a, b - a)
