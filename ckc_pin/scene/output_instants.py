"""When a run is recorded."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.scene.scene import Scene

__all__ = ["output_instants"]

OUTPUTS = 500  # instants when a scene gives no output_dt
MAX_OUTPUTS = 1_000_000


def output_instants(scene: Scene) -> Array:
    """Return when a run of a scene is recorded, s (InputError where that is too often)."""
    t_end, output_dt = scene.spec.t_end, scene.spec.solver.output_dt
    if output_dt is None:
        return np.unique(np.linspace(0.0, t_end, OUTPUTS + 1, dtype=float))  # fewer in a t_end of a few denormals
    if t_end / output_dt > MAX_OUTPUTS:
        says = f"solver.output_dt = {output_dt:g} gives more than {MAX_OUTPUTS} output instants in {t_end:g} s"
        raise InputError(f"{scene.sources.name}: {says}")
    times = np.arange(int(t_end / output_dt * (1 + 1e-12)) + 1, dtype=float) * output_dt
    if t_end - times[-1] > 1e-9 * min(output_dt, t_end):
        return np.append(times, t_end)
    times[-1] = t_end
    return times
