"""From a scene to a run: integrate, project, events, record. Or step by step, the loop closed by the caller."""

from ckc_pin.simulation.check import Check, check
from ckc_pin.simulation.ensembles.ensemble import ensemble
from ckc_pin.simulation.events import Event
from ckc_pin.simulation.floquet import Floquet, floquet
from ckc_pin.simulation.inverse import inverse_dynamics
from ckc_pin.simulation.ivp import as_ivp
from ckc_pin.simulation.linear_model import LinearModel
from ckc_pin.simulation.linearize import linearize
from ckc_pin.simulation.locus import GainLocus, gain_locus
from ckc_pin.simulation.motion_forces import MotionForces
from ckc_pin.simulation.run import Run
from ckc_pin.simulation.scene import Scene, load_scene
from ckc_pin.simulation.sensitivities import Sensitivities, sensitivities
from ckc_pin.simulation.simulate import simulate
from ckc_pin.simulation.simulator import Simulator
from ckc_pin.simulation.stability_result import Stability
from ckc_pin.simulation.state import State

__all__ = [
    "Check",
    "Event",
    "Floquet",
    "GainLocus",
    "LinearModel",
    "MotionForces",
    "Run",
    "Scene",
    "Sensitivities",
    "Simulator",
    "Stability",
    "State",
    "as_ivp",
    "check",
    "ensemble",
    "floquet",
    "gain_locus",
    "inverse_dynamics",
    "linearize",
    "load_scene",
    "sensitivities",
    "simulate",
]
