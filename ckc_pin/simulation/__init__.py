"""From a scene to a run: integrate, project, events, record."""

from ckc_pin.simulation.check import Check, check
from ckc_pin.simulation.run import Run
from ckc_pin.simulation.scene import Scene, load_scene
from ckc_pin.simulation.simulate import simulate

__all__ = ["Check", "Run", "Scene", "check", "load_scene", "simulate"]
