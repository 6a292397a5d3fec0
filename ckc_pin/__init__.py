"""Dynamics and control of closed kinematic chains on Pinocchio.

>>> import ckc_pin
>>> mechanism = ckc_pin.load("five_bar")
>>> terms = ckc_pin.terms(mechanism, {"theta_1": -1.2, "theta_3": -1.9}, {"theta_1": 0.4, "theta_3": -0.3})
>>> run = ckc_pin.simulate("five_bar/tracking", {"formulation": "reduced"})

Rooms, bottom to top: `errors`, `mechanism` (what it is), `dynamics` (terms and the three formulations),
`control`, `simulation`, and side by side `study` and `view`. README.md says where each equation lives.
"""

from typing import Any

from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.terms import Terms, terms
from ckc_pin.errors import CkcError, InputError, MechanismError, NumericalError
from ckc_pin.mechanism import Mechanism, load
from ckc_pin.simulation import Check, Event, Run, Scene, Simulator, check, load_scene, simulate

__all__ = [
    "Check",
    "CkcError",
    "Event",
    "InputError",
    "Mechanism",
    "MechanismError",
    "NumericalError",
    "Run",
    "Sampled",
    "Scene",
    "Simulator",
    "Terms",
    "check",
    "load",
    "load_scene",
    "play",
    "simulate",
    "terms",
]

__version__ = "0.1.0"


def play(*runs: Run, **options: Any) -> Any:
    """Play runs in meshcat; see `ckc_pin.view.player.play`, which this loads when called."""
    from ckc_pin.view.player import play as play_runs

    return play_runs(runs, **options)
