"""Sobol indices of a sweep's variables: their shares of an output's variance, by SciPy."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.ensembles.members import DONE, SweepTask
from ckc_pin.ensembles.spec import VariableSpec
from ckc_pin.ensembles.store import require_libraries
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["build_distributions", "compute_sobol_indices"]

CHUNK_SIZE = 4096  # members that are run together


def compute_sobol_indices(task: SweepTask, count: int, threads: int | None = None) -> xr.Dataset:
    """Return first-order and total Sobol indices of a sweep's scalar outputs.

    Parameters
    ----------
    task : SweepTask
    count : int
        A power of 2. Saltelli's design runs (variables + 2) count members.
    threads : int, optional

    Returns
    -------
    xarray.Dataset
        first_order and total_order by output and variable.

    Raises
    ------
    InputError
        The count is not a power of 2, there is one variable only, a variable is not random, no output is scalar, or
        members stop or fail.
    """
    require_libraries()
    import xarray as xr
    from scipy.stats import sobol_indices

    names, distributions = list(task.spec.variables), build_distributions(task, count)
    members = task.prepare(threads or os.cpu_count() or 1)
    outputs = [name for name, (dims, _) in members.shapes.items() if not dims]
    if not outputs:
        raise InputError('indices: no output is one number; name one, e.g. drift = "energy_drift"')

    def evaluate(values: Array) -> Array:
        parts = []
        for first in range(0, values.shape[1], CHUNK_SIZE):
            chunk = members.run(first, np.ascontiguousarray(values[:, first : first + CHUNK_SIZE].T))
            unfinished = np.flatnonzero(chunk.status != DONE)
            if len(unfinished):
                raise InputError(
                    "indices: a variance needs all members, but "
                    f"{len(unfinished)} of {len(chunk.status)} did not end, the first: {chunk.message[unfinished[0]]}"
                )
            parts.append(np.array([chunk.outputs[name] for name in outputs]))
        return np.concatenate(parts, axis=1)

    rng = np.random.default_rng(task.spec.seed)
    indices: Any = sobol_indices(func=evaluate, n=count, dists=distributions, rng=rng)
    shape = len(outputs), len(names)
    return xr.Dataset(
        {
            "first_order": (("output", "variable"), np.reshape(indices.first_order, shape)),
            "total_order": (("output", "variable"), np.reshape(indices.total_order, shape)),
        },
        coords={"output": outputs, "variable": names},
    )


def build_distributions(task: SweepTask, count: int) -> list[Any]:
    """Return the variables' distributions.

    Raises
    ------
    InputError
        The count is not a power of 2, there is one variable only, or a variable is not random. These errors do not
        need a run.
    """
    if count < 2 or count & (count - 1):
        raise InputError(f"indices: {count} is not a power of 2, which Saltelli's design needs")
    names = list(task.spec.variables)
    if len(names) < 2:
        raise InputError(f"indices: {names[0]} is the only variable; add at least one more")
    return [_build_distribution(name, spec) for name, spec in task.spec.variables.items()]


def _build_distribution(name: str, spec: VariableSpec) -> Any:
    """Return a variable's distribution of `scipy.stats`."""
    from scipy import stats

    kind = spec.kind
    if kind in ("grid", "list", "file"):
        raise InputError(f"indices: {name} is not random but a {kind}; give uniform, normal, ...")
    a, b = getattr(spec, kind)
    if kind == "normal":
        return stats.norm(a, b)
    if kind == "lognormal":
        return stats.lognorm(b, scale=np.exp(a))
    return stats.loguniform(a, b) if kind == "loguniform" else stats.uniform(a, b - a)
