"""A scene's loop at its start, and the same motion as the NumPy reference has it."""

from __future__ import annotations

from typing import Any

from ckc_pin import load_scene
from ckc_pin.run.ivp import Ivp, as_ivp
from ckc_pin.run.prepare import Prepared, prepare


def started(scene: str, overrides: dict[str, Any] | None = None) -> Prepared:
    """Return a scene with its loop at the start."""
    ready = prepare(load_scene(scene, overrides))
    ready.begin()
    return ready


def both(scene: str, overrides: dict[str, Any] | None = None) -> tuple[Prepared, Ivp]:
    """Return a scene with its loop at the start, and its motion in NumPy."""
    return started(scene, overrides), as_ivp(scene, overrides)
