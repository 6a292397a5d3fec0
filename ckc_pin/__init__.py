"""Dynamics and control of closed kinematic chains on Pinocchio.

>>> import ckc_pin
>>> mechanism = ckc_pin.load("five_bar")
>>> terms = ckc_pin.terms(mechanism, {"theta_1": -1.2, "theta_3": -1.9}, {"theta_1": 0.4, "theta_3": -0.3})
>>> run = ckc_pin.simulate("five_bar/tracking", {"formulation": "reduced"})

Rooms, bottom to top: `errors`, `mechanism` (what it is), `dynamics` (terms and the three formulations),
`control`, `generated` (terms written out for one mechanism), `simulation`, and side by side `formats`, `analysis` and
`view`. README.md says where each equation lives.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.terms import Terms, terms
from ckc_pin.errors import CkcError, InputError, MechanismError, NumericalError
from ckc_pin.kinematics import load
from ckc_pin.kinematics.point import Point
from ckc_pin.mechanism import Mechanism

if TYPE_CHECKING:
    from ckc_pin.generated.symbolic import Symbolic
    from ckc_pin.kinematics.mapped import SingularityMap
    from ckc_pin.simulation import (
        Check,
        Event,
        Floquet,
        MotionForces,
        Run,
        Scene,
        Sensitivities,
        Simulator,
        as_ivp,
        check,
        floquet,
        inverse_dynamics,
        load_scene,
        sensitivities,
        simulate,
    )

__all__ = [
    "Check",
    "CkcError",
    "Event",
    "Floquet",
    "InputError",
    "Mechanism",
    "MechanismError",
    "MotionForces",
    "NumericalError",
    "Point",
    "Run",
    "Sampled",
    "Scene",
    "Sensitivities",
    "Simulator",
    "Terms",
    "as_ivp",
    "check",
    "floquet",
    "inverse_dynamics",
    "load",
    "load_scene",
    "play",
    "sensitivities",
    "simulate",
    "singularity_map",
    "symbolic",
    "terms",
]

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Load simulation when something of it is used first: terms and mechanisms do without."""
    from importlib import import_module

    if name == "simulation":
        return import_module("ckc_pin.simulation")
    if name in __all__:  # the others are here
        return getattr(import_module("ckc_pin.simulation"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Name what is loaded later, too."""
    return sorted({*globals(), *__all__})


def play(*runs: Run, **options: Any) -> Any:
    """Play runs in meshcat; see `ckc_pin.view.player.play`, which this loads when called."""
    from ckc_pin.view.player import play as play_runs

    return play_runs(runs, **options)


def singularity_map(mechanism: Mechanism | str | Path, **options: Any) -> SingularityMap:
    """Map where a mechanism can go and is singular; see `ckc_pin.analysis.map.singularity_map`, which this loads."""
    from ckc_pin.analysis.map import singularity_map as compute

    return compute(mechanism, **options)


def symbolic(mechanism: Mechanism | str | Path) -> Symbolic:
    """Write a mechanism's terms out as CasADi functions; see `ckc_pin.generated.symbolic`, which this loads."""
    from ckc_pin.generated.symbolic import symbolic as write

    return write(mechanism)
