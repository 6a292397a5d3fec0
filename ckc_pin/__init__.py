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

TYPE_CHECKING = False  # importing `typing`, NumPy or Pinocchio here would delay the signal handlers of `ckc`
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Any

    from ckc_pin.control.controllers import Controller, SetPoint, Tracking
    from ckc_pin.control.sampled import Sampled
    from ckc_pin.dynamics.terms import Terms, terms
    from ckc_pin.errors import CkcError, InputError, MechanismError, NumericalError
    from ckc_pin.generated.symbolic import Symbolic
    from ckc_pin.kinematics import load
    from ckc_pin.kinematics.mapped import SingularityMap
    from ckc_pin.kinematics.point import Point
    from ckc_pin.mechanism import Mechanism
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
    from ckc_pin.view.inline import Figures, Playback
    from ckc_pin.view.server import ViewServer

__all__ = [
    "Check",
    "CkcError",
    "Controller",
    "Event",
    "Floquet",
    "GainLocus",
    "InputError",
    "LinearModel",
    "Mechanism",
    "MechanismError",
    "MotionForces",
    "NumericalError",
    "Point",
    "Run",
    "Sampled",
    "Scene",
    "Sensitivities",
    "SetPoint",
    "Simulator",
    "Stability",
    "State",
    "Terms",
    "Tracking",
    "as_ivp",
    "check",
    "ensemble",
    "floquet",
    "gain_locus",
    "inverse_dynamics",
    "linearize",
    "load",
    "load_scene",
    "play",
    "plot",
    "sensitivities",
    "simulate",
    "singularity_map",
    "symbolic",
    "terms",
]

__version__ = "0.1.0"


MODULES = {  # of the names that do without simulation
    "CkcError": "errors",
    "Controller": "control.controllers",
    "InputError": "errors",
    "Mechanism": "mechanism",
    "MechanismError": "errors",
    "NumericalError": "errors",
    "Point": "kinematics.point",
    "Sampled": "control.sampled",
    "SetPoint": "control.controllers",
    "Terms": "dynamics.terms",
    "Tracking": "control.controllers",
    "load": "kinematics",
    "terms": "dynamics.terms",
}
FOLDERS = ("control", "dynamics", "errors", "kinematics", "mechanism", "simulation")


def __getattr__(name: str) -> Any:
    """Import the module of a public name when the name is used first."""
    from importlib import import_module

    if name in FOLDERS:
        return import_module(f"ckc_pin.{name}")
    if name not in __all__:  # the others are here
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"ckc_pin.{MODULES.get(name, 'simulation')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Name what is loaded later, too."""
    return sorted({*globals(), *__all__})


def play(
    *runs: Run,
    speed: float = 1.0,
    gap: float = 0.0,
    meshes: str | Path | None = None,
    forces: bool = False,
    open_browser: bool = False,
    port: int = 0,
    block: bool = True,
    inline: bool | None = None,
) -> Playback | ViewServer | None:
    """Play runs: in a notebook below the cell, elsewhere in the browser, on this machine only.

    Parameters
    ----------
    runs : Run
        They lie on each other; all of one mechanism.
    speed : float
        Seconds of the run in a second of playback, to begin with.
    gap : float
        Above zero: how many times larger the gaps of the loops are drawn.
    meshes : path, optional
        The mechanism's folder, where the URDF's mesh files are.
    forces : bool
        Draw what the loops carry and what the motors give as arrows; the page can hide them.
    open_browser, port, block
        In the browser: open the address too; a port of 127.0.0.1, 0 for any free one; wait until Ctrl-C, or return the
        server at once, which plays until its `stop`.
    inline : bool, optional
        Return a page that a notebook shows, and `save` writes; absent: in a notebook.

    Raises
    ------
    InputError
        No run, runs of several mechanisms, numbers that cannot be, a port in use, meshcat missing.
    """
    from ckc_pin.simulation.notebook import in_notebook
    from ckc_pin.view.inline import Playback
    from ckc_pin.view.player import play as play_runs

    if in_notebook() if inline is None else inline:
        return Playback(runs, speed=speed, gap=gap, meshes=meshes, forces=forces)
    return play_runs(
        runs, speed=speed, gap=gap, meshes=meshes, forces=forces, open_browser=open_browser, port=port, block=block
    )


def plot(*shown: Run | LinearModel | GainLocus | Sensitivities) -> Figures:
    """Draw runs, a linear model, a locus or sensitivities; a notebook shows the figures, `save(folder)` writes them.

    Parameters
    ----------
    shown : Run, or one LinearModel, GainLocus or Sensitivities
        Runs of one mechanism under one kind of control share a figure. A linear model has poles and modes.

    Returns
    -------
    Figures
        matplotlib's figures by name.

    Raises
    ------
    InputError
        Nothing, or something else; matplotlib missing.
    """
    from ckc_pin.view.inline import Figures

    return Figures(shown)


def singularity_map(
    mechanism: Mechanism | str | Path,
    *,
    scene: Scene | str | Path | None = None,
    space: str = "joint",
    over: Sequence[str] | None = None,
    point: str | None = None,
    cells: int = 200,
    progress: Callable[[float], None] | None = None,
) -> SingularityMap:
    """Map where a mechanism can go and is singular; see `ckc_pin.analysis.map.singularity_map`, which this loads."""
    from ckc_pin.analysis.map import singularity_map as compute

    return compute(mechanism, scene=scene, space=space, over=over, point=point, cells=cells, progress=progress)


def symbolic(mechanism: Mechanism | str | Path) -> Symbolic:
    """Write a mechanism's terms out as CasADi functions; see `ckc_pin.generated.symbolic`, which this loads."""
    from ckc_pin.generated.symbolic import symbolic as write

    return write(mechanism)
