"""A scene's native loop at its start, and the NumPy reference of its right-hand side."""

from __future__ import annotations

from typing import Any

from ckc_pin import load_scene
from ckc_pin.run.ivp import Ivp, as_ivp
from ckc_pin.run.prepare import Prepared, prepare


def start_loop(scene: str, overrides: dict[str, Any] | None = None) -> Prepared:
    """Return a scene with its loop at the start."""
    ready = prepare(load_scene(scene, overrides))
    ready.begin()
    return ready


def start_loop_and_ivp(scene: str, overrides: dict[str, Any] | None = None) -> tuple[Prepared, Ivp]:
    """Return a scene with its loop at the start, and its initial value problem in NumPy."""
    return start_loop(scene, overrides), as_ivp(scene, overrides)
