"""From a scene to a system that can be stepped: mechanism, controller, start, formulation, solver."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ckc_pin.control.actuation import Actuation, Effort
from ckc_pin.control.build import make_controller
from ckc_pin.control.controllers import Controller, SetPoint, Tracking
from ckc_pin.control.sampled import Held, Sampled
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import load, mechanism_file
from ckc_pin.mechanism.mechanism import HELD_IN_PART, Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.backend import takes_native
from ckc_pin.simulation.initial import Start, find_start
from ckc_pin.simulation.scene import Scene, SolverSpec
from ckc_pin.simulation.systems import Dae, LevelSet, NativeDae, NativeLevelSet, NativePrintedSpf, PrintedSpf, System

__all__ = ["Plant", "Prepared", "make_system", "prepare", "scene_controller", "scene_mechanism"]

DIFFERENCE = 1e-7  # rad/s or m/s
SLACK = 3e-3  # of rtol: how far a right-hand side may be off the closure, relative to the mechanism's size
UNEVEN = 1e4  # ratio of inertias from which heavy links turn what that is into accelerations of light ones


def scene_mechanism(scene: Scene) -> Mechanism:
    """Load the mechanism that a scene names, relative to its own folder or by shipped name, or has made by rule."""
    mechanism = scene.spec.mechanism
    return load(_beside(scene, mechanism) if isinstance(mechanism, str) else mechanism)


def _beside(scene: Scene, name: str) -> str | Path:
    folder = scene.sources.folder
    if folder is not None and (name.endswith(".toml") or (folder / name).exists()):
        return mechanism_file(folder / name)
    return name


def scene_controller(
    scene: Scene, mechanism: Mechanism, texts: dict[str, str] | None = None
) -> SetPoint | Tracking | None:
    """Build a scene's controller; the texts of its own model are added to `texts`."""

    def load_model(name: str) -> Mechanism:
        model = load(_beside(scene, name))
        if texts is not None:
            texts.update({f"model/{file}": text for file, text in model.sources.texts.items()})
        return model

    spec = scene.spec
    if spec.controller is None:
        return None
    return make_controller(spec.controller, mechanism, spec.coriolis_velocity, spec.t_end, scene.sources, load_model)


@dataclass(frozen=True)
class Plant:
    """What acts on the mechanism: a controller through its actuators, or nothing."""

    controller: Controller | None
    actuation: Actuation

    def effort(self, t: float, terms: Terms) -> Effort:
        """What the actuators do at (t, terms)."""
        if self.controller is None:
            return self.actuation.none
        return self.actuation.apply(terms, self.controller.u(t, terms))

    def force(self, t: float, terms: Terms) -> Array:
        """u' on the tree, shape (n,)."""
        return self.effort(t, terms).u_tree

    def u_rate_gradient(self, t: float, terms: Terms) -> Array | None:
        """d u / d q_dot: what the controller knows, or differences of u alone; None behind another actuation."""
        if self.controller is None:
            return np.zeros((len(terms.q), len(terms.q)))
        if not self.actuation.direct:
            return None
        gradient = getattr(self.controller, "u_rate_gradient", None) or self._u_rate_differences
        free = self.actuation.unlimited(self.effort(t, terms).tau)
        return free[:, None] * np.asarray(gradient(t, terms))

    def _u_rate_differences(self, t: float, terms: Terms) -> Array:
        """d u / d q_dot of any controller: its own evaluations at other velocities, none of the mechanism's."""
        u = self.effort(t, terms).u
        gradient = np.empty((len(u), len(u)))
        for k, q_dot in enumerate(terms.q_dot):
            step = np.zeros(len(u))
            step[k] = DIFFERENCE * max(1.0, abs(float(q_dot)))
            moved = Terms(terms.mechanism, terms.at, terms.v_tree + terms.rho @ step)
            gradient[:, k] = (self.effort(t, moved).u - u) / step[k]
        return gradient


@dataclass(frozen=True)
class Prepared:
    """A scene ready to be stepped.

    Attributes
    ----------
    mechanism : Mechanism
    plant : Plant
        What acts on it.
    system : System
        The formulation as a first-order system, at its start.
    method : str
        The solver named, or the one that "auto" stands for here; "auto" where that depends on the motion.
    start : Start
    texts : dict of str to str
        Files that the scene's controller brought along.
    """

    mechanism: Mechanism
    plant: Plant
    system: System
    method: str
    start: Start
    texts: dict[str, str]


def prepare(scene: Scene, controller: Controller | None = None, *, measured: bool = False) -> Prepared:
    """Build everything that a scene needs before its first step.

    Parameters
    ----------
    controller : Controller, optional
        Takes the place of the scene's.
    measured : bool
        What Python evaluates is to be counted: "auto" does not take the native backend.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its start is singular.
    """
    mechanism = scene_mechanism(scene)
    texts: dict[str, str] = {}
    spec = scene.spec.controller
    if controller is None:
        controller = scene_controller(scene, mechanism, texts)
        if controller is not None and spec is not None and spec.sample_time is not None:
            controller = Sampled(controller, spec.sample_time, spec.delay)
    limit = spec.torque_limit if spec else None
    actuation = Actuation(mechanism, limit)
    if mechanism.d == 0:
        raise InputError(f"{mechanism.name}: d = 0, the loops leave no freedom: nothing can move")
    if mechanism.splits_root and (controller is not None or scene.spec.formulation != "dae"):
        raise InputError(f"{mechanism.name}: {HELD_IN_PART}")
    start = find_start(mechanism, scene)
    _refuse_massless(Terms(mechanism, start.at, np.zeros(mechanism.n)))
    if controller is not None:
        actuation.require_transmission(start.at)
    plant = Plant(controller, actuation)
    system = make_system(mechanism, scene, start, plant, measured)
    return Prepared(mechanism, plant, system, _method(scene, system, plant), start, texts)


def again(scene: Scene, ready: Prepared) -> Prepared:
    """Return the same with a system that stands at its start, for another run of the scene."""
    return replace(ready, system=make_system(ready.mechanism, scene, ready.start, ready.plant))


def _refuse_massless(terms: Terms) -> None:
    """Massless links are fine as long as every motion that the loops allow moves some mass.

    Judged on D with its diagonal scaled to one, so that neither units nor ratios of masses matter.
    """
    scale = np.sqrt(np.maximum(np.diagonal(terms.D), 0.0))
    least = int(np.argmin(scale))
    if scale[least] > 1e-12 * scale.max():
        values, directions = np.linalg.eigh(terms.D / np.outer(scale, scale))
        if values[0] > 1e-13:
            return
        least = int(np.argmax(np.abs(directions[:, 0])))
    name = terms.mechanism.independent[least]
    raise InputError(
        f"{terms.mechanism.name}: the motion along {name} moves no mass, so no force can tell its acceleration; "
        "give the links it moves a mass and an inertia, or make the joint fixed"
    )


def make_system(mechanism: Mechanism, scene: Scene, start: Start, plant: Plant, measured: bool = False) -> System:
    """Make the first-order system of a scene's formulation, at a start."""
    spec, force = scene.spec, plant.force
    native = takes_native(mechanism, spec, measured)
    controller, actuation = plant.controller, plant.actuation
    free = controller is None  # of a controller that lives in the mechanism's own q
    slack = SLACK * spec.solver.rtol * mechanism.size * _evenness(mechanism, start)
    if spec.formulation == "dae":
        v_tree = start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree
        projects, baumgarte = _closing(spec.solver)
        dae = partial(NativeDae, controller=controller, actuation=actuation) if native else Dae
        return dae(mechanism, start.at, v_tree, force, projects, baumgarte, plant.u_rate_gradient)
    level_set = partial(NativeLevelSet, controller=controller, actuation=actuation) if native else LevelSet
    if spec.formulation == "reduced":
        return level_set(
            mechanism,
            start.at,
            start.q_dot,
            force,
            u_rate_gradient=plant.u_rate_gradient,
            may_switch=free,
            slack=slack,
        )
    equation = spec.solver.spf_equation or (17 if spec.solver.method == "auto" else 8)
    if equation == 8:
        if mechanism.tree.free:
            raise InputError(
                "solver: eq. 8 as printed integrates q and z as numbers, and the rotation of a free root is none; "
                'give spf_equation = 17, or method = "auto"'
            )
        printed = partial(NativePrintedSpf, controller=controller, actuation=actuation) if native else PrintedSpf
        return printed(mechanism, start.at, start.q_dot, force, spec.epsilon, start.w, spec.coriolis_velocity)
    return level_set(
        mechanism,
        start.at,
        start.q_dot,
        force,
        spec.epsilon,
        spec.coriolis_velocity,
        start.w,
        plant.u_rate_gradient,
        free,
        slack,
    )


def _evenness(mechanism: Mechanism, start: Start) -> float:
    """1, or how much better the closure has to be kept where inertias differ by more than `UNEVEN`."""
    inertias = np.diagonal(Terms(mechanism, start.at, np.zeros(mechanism.n)).D_tree)
    return min(1.0, UNEVEN * float(inertias.min()) / float(inertias.max()))


def _closing(solver: SolverSpec) -> tuple[bool, tuple[float, float] | None]:
    """What keeps a DAE on its closure: projection, Baumgarte's terms, or the method itself."""
    return solver.projection and solver.method != "IDA", solver.baumgarte


def _method(scene: Scene, system: System, plant: Plant) -> str:
    """What "auto" means: closed loops are stiff through gains and dampers, unless u is held; eq. 8 through epsilon."""
    spec = scene.spec
    if spec.solver.method != "auto":
        return spec.solver.method
    if isinstance(system, PrintedSpf):
        return "Radau"
    feedback = plant.controller is not None and not isinstance(plant.controller, Held)
    return "auto" if feedback or system.mechanism.springs.any_damping else "DOP853"
