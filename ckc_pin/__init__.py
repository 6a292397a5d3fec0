"""Dynamics and control of closed kinematic chains on Pinocchio.

>>> import ckc_pin
>>> mechanism = ckc_pin.load("five_bar")
>>> terms = ckc_pin.terms(mechanism, {"theta_1": -1.2, "theta_3": -1.9}, {"theta_1": 0.4, "theta_3": -0.3})
>>> run = ckc_pin.simulate("five_bar/tracking", {"formulation": "reduced"})

Subpackages, bottom to top; a module imports only from subpackages below its own:

============================ ==========================================================================
`errors`, `base`             exceptions; files, argument validation, summaries, small dense matrices
`mechanism`                  the mechanism file, the URDF tree, loop closures, rank, named parameters
`kinematics`                 sigma (eq. 4), assembly, continuation, points as tools
`dynamics`                   terms of the equations of motion, the three formulations, equilibria
`control`                    controllers, desired motions, motors, sampling
`codegen`                    compiled terms of one mechanism
`native`                     the C++ core: systems, integrators, events, the step loop
`scene`                      scene files and the objects they describe
`run`                        simulation, runs, the stepwise simulator, inverse dynamics
`linear`, `sensitivity`      linear models and stability; derivatives of runs, Floquet multipliers
`ensembles`                  many runs with different parameters
`identification`             parameters from measurements, and motions that make them known
`optimization`               planned motions
`formats`, `analysis`        import and export; checks, singularity maps, work-precision reports
`view`, `explorer`, `cli`    figures and 3-D playback; the explorer in the browser; the command `ckc`
============================ ==========================================================================

docs/architecture.md describes them, and what happens in a call of `simulate`.
"""

from __future__ import annotations

# Importing `typing`, NumPy or Pinocchio here would delay the signal handlers of `ckc`.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Any

    import xarray

    from ckc_pin.analysis.check import Check, check
    from ckc_pin.codegen.symbolic import Symbolic
    from ckc_pin.control.controllers import Controller, SetPoint, Tracking
    from ckc_pin.control.forces import Force
    from ckc_pin.control.joint_servo import JointServo
    from ckc_pin.control.sampled import Sampled
    from ckc_pin.dynamics.terms import Terms, terms
    from ckc_pin.ensembles.ensemble import ensemble
    from ckc_pin.errors import CkcError, InputError, MechanismError, NumericalError
    from ckc_pin.explorer.explore import Explorer, explore
    from ckc_pin.identification.calibration import calibrate
    from ckc_pin.identification.calibration_result import Calibration
    from ckc_pin.identification.excitation import Excitation, excite
    from ckc_pin.identification.identify import identify
    from ckc_pin.identification.result import Identification
    from ckc_pin.kinematics import load
    from ckc_pin.kinematics.mapped import SingularityMap
    from ckc_pin.kinematics.point import Point
    from ckc_pin.linear.linear_model import LinearModel
    from ckc_pin.linear.linearize import linearize
    from ckc_pin.linear.locus import GainLocus, gain_locus
    from ckc_pin.linear.stability_result import Stability
    from ckc_pin.mechanism import Mechanism
    from ckc_pin.mechanism.spec import Loop
    from ckc_pin.optimization.optimize import optimize
    from ckc_pin.optimization.plan import Plan
    from ckc_pin.optimization.planner import HorizonPlan, Planner
    from ckc_pin.run.events import Event
    from ckc_pin.run.inverse import inverse_dynamics
    from ckc_pin.run.ivp import as_ivp
    from ckc_pin.run.motion_forces import MotionForces
    from ckc_pin.run.run import Run
    from ckc_pin.run.simulate import simulate
    from ckc_pin.run.simulator import Simulator
    from ckc_pin.run.state import State
    from ckc_pin.scene.scene import Scene, load_scene
    from ckc_pin.sensitivity.floquet import Floquet, floquet
    from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
    from ckc_pin.view.inline import Figures, Playback
    from ckc_pin.view.server import ViewServer

__all__ = [
    "Calibration",
    "Check",
    "CkcError",
    "Controller",
    "Event",
    "Excitation",
    "Explorer",
    "Floquet",
    "Force",
    "GainLocus",
    "HorizonPlan",
    "Identification",
    "InputError",
    "JointServo",
    "LinearModel",
    "Loop",
    "Mechanism",
    "MechanismError",
    "MotionForces",
    "NumericalError",
    "Plan",
    "Planner",
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
    "calibrate",
    "check",
    "ensemble",
    "excite",
    "explore",
    "floquet",
    "gain_locus",
    "identify",
    "inverse_dynamics",
    "linearize",
    "load",
    "load_scene",
    "optimize",
    "play",
    "plot",
    "sensitivities",
    "simulate",
    "singularity_map",
    "symbolic",
    "terms",
]

__version__ = "0.1.0"


MODULES = {
    "Calibration": "identification.calibration_result",
    "Check": "analysis.check",
    "CkcError": "errors",
    "Controller": "control.controllers",
    "Event": "run.events",
    "Excitation": "identification.excitation",
    "Explorer": "explorer.explore",
    "Floquet": "sensitivity.floquet",
    "Force": "control.forces",
    "GainLocus": "linear.locus",
    "HorizonPlan": "optimization.planner",
    "Identification": "identification.result",
    "InputError": "errors",
    "JointServo": "control.joint_servo",
    "LinearModel": "linear.linear_model",
    "Loop": "mechanism.spec",
    "Mechanism": "mechanism",
    "MechanismError": "errors",
    "MotionForces": "run.motion_forces",
    "NumericalError": "errors",
    "Plan": "optimization.plan",
    "Planner": "optimization.planner",
    "Point": "kinematics.point",
    "Run": "run.run",
    "Sampled": "control.sampled",
    "Scene": "scene.scene",
    "Sensitivities": "sensitivity.sensitivities",
    "SetPoint": "control.controllers",
    "Simulator": "run.simulator",
    "Stability": "linear.stability_result",
    "State": "run.state",
    "Terms": "dynamics.terms",
    "Tracking": "control.controllers",
    "as_ivp": "run.ivp",
    "calibrate": "identification.calibration",
    "check": "analysis.check",
    "ensemble": "ensembles.ensemble",
    "excite": "identification.excitation",
    "explore": "explorer.explore",
    "floquet": "sensitivity.floquet",
    "gain_locus": "linear.locus",
    "identify": "identification.identify",
    "inverse_dynamics": "run.inverse",
    "linearize": "linear.linearize",
    "load": "kinematics",
    "load_scene": "scene.scene",
    "optimize": "optimization.optimize",
    "sensitivities": "sensitivity.sensitivities",
    "simulate": "run.simulate",
    "terms": "dynamics.terms",
}
ROOMS = (
    "analysis", "base", "codegen", "control", "dynamics", "ensembles", "errors", "explorer", "formats",
    "identification", "kinematics", "linear", "mechanism", "native", "optimization", "run", "scene", "sensitivity",
    "view",
)  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import the module of a public name at its first use."""
    from importlib import import_module

    if name in ROOMS:
        return import_module(f"ckc_pin.{name}")
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"ckc_pin.{MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, whether they are imported already or not."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


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
    """Play runs in 3-D: in a notebook below the cell, otherwise in a browser on this machine.

    Parameters
    ----------
    runs : Run
        Runs of one mechanism, drawn on top of each other.
    speed : float
        Initial speed: seconds of the run in a second of playback.
    gap : float
        Magnification of the gaps in the loops; 0 draws them as they are.
    meshes : path, optional
        Folder of the mechanism, which has the URDF's mesh files.
    forces : bool
        Draw loop forces and motor torques as arrows. The page can hide them.
    open_browser : bool
        Open the address in the default browser.
    port : int
        Port on 127.0.0.1; 0 takes a free one.
    block : bool
        Wait until Ctrl-C. Otherwise return the server, which plays until its `stop` is called.
    inline : bool, optional
        Return a page that a notebook displays and `save` writes. Default: True in a notebook.

    Returns
    -------
    Playback, ViewServer or None

    Raises
    ------
    InputError
        No run, runs of several mechanisms, an invalid number, a port in use, or meshcat is not installed.
    """
    from ckc_pin.base.summary import in_notebook
    from ckc_pin.view.inline import Playback
    from ckc_pin.view.player import play_runs

    if in_notebook() if inline is None else inline:
        return Playback(runs, speed=speed, gap=gap, meshes=meshes, forces=forces)
    return play_runs(
        runs, speed=speed, gap=gap, meshes=meshes, forces=forces, open_browser=open_browser, port=port, block=block
    )


def plot(
    *shown: Run
    | LinearModel
    | GainLocus
    | Sensitivities
    | MotionForces
    | Excitation
    | Plan
    | SingularityMap
    | Identification
    | xarray.Dataset,
) -> Figures:
    """Draw figures of runs, or of another result: a linear model, a root locus, sensitivities and others.

    Parameters
    ----------
    shown : Run, or one other result: LinearModel, GainLocus, Sensitivities, Identification, Dataset and so on
        Runs of one mechanism under one kind of control share a figure. A linear model has figures of poles and modes.
        The Dataset of an `ensemble` has a figure for each output: quantiles over time, a line over one variable, or a
        map over two.

    Returns
    -------
    Figures
        Matplotlib figures by name. A notebook displays them, and `save(folder)` writes them.

    Raises
    ------
    InputError
        An argument of another type, no argument, or matplotlib is not installed.
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
    loci: bool = True,
    progress: Callable[[float], None] | None = None,
) -> SingularityMap:
    """Compute the workspace and the singular configurations of a mechanism: `ckc_pin.analysis.map.singularity_map`."""
    from ckc_pin.analysis.map import singularity_map as compute

    return compute(
        mechanism, scene=scene, space=space, over=over, point=point, cells=cells, loci=loci, progress=progress
    )


def symbolic(mechanism: Mechanism | str | Path) -> Symbolic:
    """Return the terms of a mechanism as CasADi functions: `ckc_pin.codegen.symbolic.symbolic`."""
    from ckc_pin.codegen.symbolic import symbolic as generate

    return generate(mechanism)
