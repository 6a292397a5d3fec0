"""The numbers that the change of a motion with can be asked for, by name: `link.rod.mass`, `initial.q.theta_1`.

Those of the mechanism are named by `mechanism.parameters`, and what they do is said by `sensitivity.effects`; the
controller's gains and the start are the scene's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import (
    Controller,
    RecordedTorques,
    SetPoint,
    TorqueController,
    Tracking,
    is_torque_controller,
)
from ckc_pin.control.point_path import PointPath
from ckc_pin.control.sampled import Sampled
from ckc_pin.errors import CkcError, InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import ParameterMap
from ckc_pin.mechanism.parameters import (
    ROOTS,
    Overrides,
    Value,
    is_parameter,
    parts_of,
    require_known,
    split_component,
    values_of,
    with_components,
)
from ckc_pin.native.variation import Effect, SensitivityParameter, directions_of, variation_table
from ckc_pin.run.compiled_terms import select_derivative_library
from ckc_pin.run.prepare import DerivativeSetup, ParameterDerivatives
from ckc_pin.scene.initial import Start
from ckc_pin.scene.parts import rebuild_scene_mechanism
from ckc_pin.scene.scene import Scene
from ckc_pin.sensitivity.effects import effects_of

__all__ = ["derivatives_of", "find_sensitivity_parameters"]

OTHERWISE = 1e-3  # rad, or of the mechanism's size: another value, to see whether it moves with that too
NEARBY = 1e-7  # the same: how far a stop is moved to see whether the assembled start follows
STEPS_AT_STOP = (1e-4, 1e-5, 1e-6)  # the same where the start is at the stop
SCENE_ROOTS = ("controller", "initial")


def derivatives_of(names: Sequence[str]) -> DerivativeSetup:
    """Return the setup of derivatives with respect to these parameters, for `prepare`."""

    def setup(
        scene: Scene,
        mechanism: Mechanism,
        controller: Controller | TorqueController | Sampled | None,
        actuation: Actuation,
        start: Start,
    ) -> ParameterDerivatives:
        given, changed = scene.spec.parameters, partial(rebuild_scene_mechanism, scene)
        law = controller.controller if isinstance(controller, Sampled) else controller
        parameters = find_sensitivity_parameters(mechanism, scene, law, actuation, names, changed, start.at.q_tree)
        require_known_motion(mechanism, scene, controller, parameters)
        require_movable(mechanism, given, parameters, changed)
        if scene.spec.initial.at == "assembled":
            parameters = [at_assembled_stop(mechanism, given, x, changed) for x in parameters]
        arguments, directions = directions_of(mechanism, parameters) or (None, None)
        library = select_derivative_library(mechanism, scene.spec.solver.terms, arguments)
        table = variation_table(
            mechanism, parameters, directions, at_equilibrium=scene.spec.initial.at == "equilibrium",
            target=compensated_at(mechanism, law), controlled=controller is not None,
        )  # fmt: skip
        return ParameterDerivatives(tuple(parameters), table, library, arguments if library is None else None)

    return setup


def compensated_at(mechanism: Mechanism, controller: object) -> Array:
    """Return q' where a controller compensates what this mechanism needs there; empty where it compensates none."""
    if isinstance(controller, SetPoint) and controller.target.mechanism is mechanism:
        return controller.target.q_tree
    return np.zeros(0)


def require_known_motion(
    mechanism: Mechanism,
    scene: Scene,
    controller: Controller | TorqueController | Sampled | None,
    parameters: Sequence[SensitivityParameter],
) -> None:
    """Refuse a scene whose motion has no known derivatives (InputError)."""
    spec = scene.spec
    if isinstance(controller, Sampled):
        for key in ("sensor", "drive"):
            if getattr(controller, key) is not None:
                raise InputError(
                    f"sensitivities: controller.{key}: steps, limits of rates and filters of samples have no known "
                    "derivatives; leave it out"
                )
        controller = controller.controller
    if controller is not None and type(controller) is not RecordedTorques and is_torque_controller(controller):
        raise InputError(
            f"sensitivities: {type(controller).__name__}: how torques that a function gives change is not known; let "
            "it give u"
        )
    if spec.formulation == "spf" and spec.spf_coordinates == "z":
        raise InputError('sensitivities: spf_coordinates = "z": eq. 8 as printed is another motion; take "w"')
    if spec.initial.w is not None and any(spec.initial.w):
        raise InputError("sensitivities: initial.w: they are known on phi = 0; leave it out")
    if spec.formulation == "dae" and (spec.solver.baumgarte or not spec.solver.projection):
        raise InputError(
            "sensitivities: solver.baumgarte, solver.projection: the loops have to be closed; leave them out"
        )
    shaping = next((x.name for x in parameters if any(effect.is_shape for effect in x.effects)), None)
    if shaping is not None and type(controller) is Tracking and isinstance(controller.desired, PointPath):
        raise InputError(
            f"sensitivities: {shaping}: q_d is where the mechanism's own lengths bring the point that is to follow a "
            "path, and how it moves with them is not known; give controller.desired by joint"
        )
    if shaping is not None and spec.initial.at == "assembled":
        raise InputError(
            f'sensitivities: {shaping}: a start that is "assembled" follows from where things are placed in a way of '
            "its own; give initial.q"
        )
    if not spec.friction_smoothing:
        # joints that cannot move do not turn round
        frictionless = (mechanism.joints.friction == 0) & ~mechanism.freedoms.immobile
        for x in parameters:
            if any(effect.kind == "friction" and frictionless[effect.index] for effect in x.effects):
                raise InputError(
                    f"sensitivities: {x.name}: it is 0, and where the joint turns round is not looked for then; give a "
                    f"small one, {x.name} = 1e-6 in [parameters], or friction_smoothing"
                )
    plant = [x.name for x in parameters if any(effect.is_term for effect in x.effects)]
    if type(controller) is Tracking and controller.model is None and plant:
        raise InputError(
            f"sensitivities: {plant[0]}: tracking compensates the mechanism's own terms, and how u changes with "
            "them is not known; give controller.model, or parameters of the start"
        )
    free = [name for name in mechanism.independent if name in mechanism.tree.free_coordinates]
    if type(controller) is Tracking and free:
        raise InputError(
            f"sensitivities: tracking of {free[0]}: it is a free root's, and how u changes with those is not known; "
            "take joints as independent coordinates"
        )


def require_movable(
    mechanism: Mechanism,
    given: Overrides,
    parameters: Sequence[SensitivityParameter],
    changed: Callable[[Overrides], Mechanism],
) -> None:
    """Refuse a length that redundant rows allow no other value of: the changed mechanism would not move at all.

    Parameters
    ----------
    mechanism : Mechanism
    given : mapping
        The scene's own overrides of parameters.
    parameters : sequence of SensitivityParameter
    changed : callable
        Rebuilds the mechanism with other overrides.

    Raises
    ------
    InputError
    """
    if not mechanism.redundant:
        return
    present = values_of(mechanism.spec, mechanism.urdf)
    for x in parameters:
        if not any(effect.is_shape for effect in x.effects):
            continue
        whole, k = split_component(x.name)
        value = present[whole]
        step = OTHERWISE * (1.0 if whole.endswith("rpy") else mechanism.size)
        other: Value = value + step if not isinstance(value, tuple) else _moved(value, k, step)
        kept = {name: own for name, own in given.items() if name.rpartition(".")[0] != whole}
        try:
            freedoms = changed({**kept, whole: other}).d
        except CkcError:
            freedoms = 0
        if freedoms != mechanism.d:
            raise InputError(
                f"sensitivities: {x.name}: with another value the rows of {mechanism.name} that follow from others, "
                f"{', '.join(mechanism.redundant)}, no longer do, and it does not move as it did"
            )


def at_assembled_stop(
    mechanism: Mechanism, given: Overrides, x: SensitivityParameter, changed: Callable[[Overrides], Mechanism]
) -> SensitivityParameter:
    """Mark the parameter of a stop that the assembled start touches: the start then follows the stop one way only.

    Parameters
    ----------
    mechanism : Mechanism
    given : mapping
        The scene's own overrides of parameters.
    x : SensitivityParameter
    changed : callable
        Rebuilds the mechanism with other overrides.

    Raises
    ------
    InputError
        The start is held beyond q_guess by that stop: it follows it both ways.
    """
    stop = next((effect for effect in x.effects if effect.kind in ("lower", "upper")), None)
    if stop is None:
        return x
    k, reach = stop.index, mechanism.tree.step_scale
    value = float(getattr(mechanism.joints, stop.kind)[k])
    if not np.isfinite(value):  # the stop of a joint that cannot move
        return x
    at_stop = abs(float(mechanism.tree.to_coordinates(mechanism.q_tree)[k]) - value) <= NEARBY * reach[k]
    # An assembly may leave a joint beyond its stop by a little, and does not move where it cannot come back to it.
    steps = STEPS_AT_STOP if at_stop else (NEARBY,)

    def follows(step: float) -> bool:
        try:
            there = changed({**given, x.name: value + step * float(reach[k])})
        except CkcError:
            return True
        return bool(np.abs(there.tree.difference(mechanism.q_tree, there.q_tree) / reach).max() > 0.1 * abs(step))

    ways = [any(follows(side * step) for step in steps) for side in (-1, 1)]
    if all(ways):
        raise InputError(
            f"sensitivities: {x.name}: q_guess leads beyond this stop, and how the configuration that is assembled "
            "at it moves with it is not known; give initial.q"
        )
    return replace(x, assembled_at=k) if any(ways) else x


def _moved(value: tuple[float, float, float], k: int, step: float) -> Value:
    x, y, z = (own + step * (i == k) for i, own in enumerate(value))
    return x, y, z


def find_sensitivity_parameters(
    mechanism: Mechanism,
    scene: Scene,
    controller: object,
    actuation: Actuation,
    names: Sequence[str],
    changed: Callable[[Overrides], Mechanism],
    q_tree: Array,
) -> list[SensitivityParameter]:
    """Look names up; a vector's stands for its three components.

    `changed` rebuilds the mechanism with other overrides; `q_tree` is q' at the start.

    Raises
    ------
    InputError
        A name that is none (those there are near it are listed), is given twice, or on which nothing has a derivative.
    """
    of_scene = {
        x.name: x for x in (*_of_controller(mechanism, scene, controller), *_of_start(mechanism, scene, q_tree))
    }
    known = with_components(values_of(mechanism.spec, mechanism.urdf)) | dict.fromkeys(of_scene, 0.0)
    at = scene.spec.initial.at
    placed = next((name for name in names if name.startswith("initial.q.") and at is not None), None)
    if placed is not None:
        raise InputError(f'sensitivities: {placed}: the scene starts "{at}"; give its start as [initial.q]')
    require_known(names, known, "sensitivities", (*ROOTS, *SCENE_ROOTS))
    labels = [part for name in names for part in parts_of(name, known)]
    if len(set(labels)) < len(labels):
        raise InputError(f"sensitivities: a parameter is named twice in {', '.join(names)}")
    parameters = ParameterMap(mechanism, scene.spec.parameters, changed)
    return [_of_mechanism(mechanism, actuation, name, parameters.derivative(name)) if is_parameter(name)
            else of_scene[name] for name in labels]  # fmt: skip


def _of_mechanism(
    mechanism: Mechanism, actuation: Actuation, name: str, slopes: Mapping[str, Array]
) -> SensitivityParameter:
    """Separate effects that move only reported points from those that the motion depends on."""
    effects = effects_of(mechanism, actuation, name, slopes)
    placed = ["" if effect.lock is None else effect.lock.placed for effect in effects]
    by_place = list(zip(placed, effects, strict=True))
    return SensitivityParameter(
        name,
        tuple(effect for place, effect in by_place if place != "reported"),
        places=tuple(effect for place, effect in by_place if place in ("joint", "reported")),
        slopes=slopes,
    )


def _of_controller(mechanism: Mechanism, scene: Scene, controller: object) -> Iterator[SensitivityParameter]:
    """Gains, a number for all or one of the diagonal, and where eq. 14 holds."""
    spec, each = scene.spec.controller, np.eye(mechanism.d)
    gains = {"K_P": "gain_q", "K_V": "gain_q_dot"} if type(controller) is SetPoint else {}
    gains = {"Lambda": "gain_q", "K_D": "gain_q_dot"} if type(controller) is Tracking else gains
    for key, kind in gains.items():
        overrides = {f"controller.{key}": each} if isinstance(getattr(spec, key), float | int) else {}
        overrides |= {f"controller.{key}.{name}": np.diag(each[k]) for k, name in enumerate(mechanism.independent)}
        for name, gain in overrides.items():
            yield SensitivityParameter(name, (Effect(kind, 0, gain.ravel(order="F")),))
    if type(controller) is SetPoint and compensated_at(mechanism, controller).size:
        for k, name in enumerate(mechanism.independent):
            yield SensitivityParameter(f"controller.q_d.{name}", (Effect("target", k, controller.K_P[:, k]),))


def _of_start(mechanism: Mechanism, scene: Scene, q_tree: Array) -> Iterator[SensitivityParameter]:
    tree, moved = mechanism.tree, np.eye(mechanism.tree.n)
    for q, v in tree.free_roots:  # numbers in the world's axes, tangent in the body's
        moved[v : v + 3, v : v + 3] = pin.Quaternion(q_tree[q + 3 : q + 7]).matrix().T
        moved[v + 3 : v + 6, v + 3 : v + 6] = pin.Jexp3(tree.to_coordinates(q_tree)[v + 3 : v + 6])
    roots = (mechanism.coordinates[v : v + 6] for _, v in tree.free_roots)
    parted = {name for root in roots if not set(root) <= set(mechanism.independent) for name in root}
    for k, name in enumerate(mechanism.independent):
        if name not in parted and scene.spec.initial.at is None:
            yield SensitivityParameter(f"initial.q.{name}", q=moved[:, tree.index[name]])
        yield SensitivityParameter(f"initial.q_dot.{name}", q_dot=np.eye(mechanism.d)[k])
