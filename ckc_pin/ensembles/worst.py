"""The members where an output is largest, run again as runs that can be played."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.ensembles.members import DONE, STOPPED, Members
from ckc_pin.ensembles.store_layout import array_name
from ckc_pin.errors import CkcError
from ckc_pin.run.simulate import simulate

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["save_worst", "worst_members"]

MOST = 3


def worst_members(results: xr.Dataset, name: str, most: int = MOST) -> list[int]:
    """Return the members where the largest number of an output is largest, the worst first."""
    values = np.abs(results[array_name(name)].to_numpy().reshape(results.sizes["member"], -1))
    size = np.where(np.isin(results["status"].to_numpy(), (DONE, STOPPED)), np.fmax.reduce(values, axis=1), np.nan)
    order = np.argsort(-size, kind="stable")  # NaN last
    return [int(k) for k in order[:most] if np.isfinite(size[k])]


def save_worst(members: Members, results: xr.Dataset, name: str, out: Path, most: int = MOST) -> list[Path]:
    """Run the worst members again and save them as ``OUTPUT_MEMBER/run.npz``; return the folders.

    They run at all the scene's output instants, and do the same as before to integration's tolerance.
    """
    folders = []
    for k in worst_members(results, name, most):
        values = np.array([float(results[array_name(variable)][k]) for variable in members.names])
        folder = out / f"worst_{array_name(name)}_{k}"
        try:
            run = simulate(members.scene_name, members.overrides_of(values))
        except CkcError:
            continue
        if run.status == "interrupted":
            raise interrupt_again(run.message)
        folder.mkdir(parents=True, exist_ok=True)
        run.save(folder / "run.npz")
        folders.append(folder)
    return folders
