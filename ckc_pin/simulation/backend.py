"""Which backend evaluates a scene: the native core where it was built and knows the scene's parts, else Python."""

from __future__ import annotations

from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import unavailable
from ckc_pin.simulation.scene import SceneSpec

__all__ = ["takes_native", "why_python"]


def why_python(mechanism: Mechanism, spec: SceneSpec | None = None) -> str | None:
    """Say in half a sentence why the native core does not take a mechanism, or a scene of it; None when it does."""
    if reason := unavailable():
        return reason
    if spec is not None and spec.formulation == "dae":
        return None
    if mechanism.rooted:
        return f"{mechanism.rooted[0]} of a free root is independent, which the native core takes in a DAE alone"
    return None


def takes_native(mechanism: Mechanism, spec: SceneSpec, measured: bool = False) -> bool:
    """Choose; `measured`: what Python evaluates is to be counted and timed.

    Raises
    ------
    InputError
        The native core is asked for by name and cannot be had.
    """
    wanted = spec.solver.backend
    if wanted == "python" or (wanted == "auto" and measured):
        return False
    reason = why_python(mechanism, spec)
    if reason and wanted == "native":
        raise InputError(f'solver: backend = "native" cannot be had: {reason}; "auto" takes what there is')
    return reason is None
