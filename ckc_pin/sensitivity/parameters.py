"""Parameters for which sensitivities can be computed, by name: `link.rod.mass`, `initial.q.theta_1`.

`mechanism.parameters` defines the names of the mechanism's parameters, and `parameter_derivatives` computes how they
act. The gains of the controller and the start are parameters of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
import pinocchio as pin
from msgspec.structs import replace

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
from ckc_pin.control.sampled import Sampled, unwrap_sampled
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
from ckc_pin.native.control import law_table
from ckc_pin.native.sensitivity_tables import (
    ParameterDerivative,
    SensitivityParameter,
    argument_directions,
    sensitivity_table,
)
from ckc_pin.run.compiled_terms import select_derivative_library
from ckc_pin.run.prepare import SensitivitySetup, SetUpSensitivities
from ckc_pin.scene.initial import Start
from ckc_pin.scene.parts import rebuild_scene_mechanism
from ckc_pin.scene.scene import Scene
from ckc_pin.sensitivity.parameter_derivatives import find_parameter_derivatives

__all__ = ["find_sensitivity_parameters", "sensitivity_setup"]

MOBILITY_STEP = 1e-3  # rad, or relative to the mechanism's size; the mechanism must still move after such a step
STOP_STEP = 1e-7  # the same; the assembled start follows a stop if it moves with such a step of the stop
STEPS_AT_STOP = (1e-4, 1e-5, 1e-6)  # the same, if the start is at the stop
SCENE_ROOTS = ("controller", "initial")


def sensitivity_setup(
    names: Sequence[str], directions: Mapping[str, Mapping[str, float]] | None = None
) -> SetUpSensitivities:
    """Return the function with which `prepare` sets up the sensitivities to some parameters, and along directions."""

    def setup(
        scene: Scene,
        mechanism: Mechanism,
        controller: Controller | TorqueController | Sampled | None,
        actuation: Actuation,
        start: Start,
    ) -> SensitivitySetup:
        overrides, rebuild = scene.spec.parameters, partial(rebuild_scene_mechanism, scene)
        law = unwrap_sampled(controller)
        parameters = find_sensitivity_parameters(mechanism, scene, law, actuation, names, rebuild, start.at.q_tree)
        if directions:
            members = list(dict.fromkeys(name for direction in directions.values() for name in direction))
            of = {
                x.name: x
                for x in find_sensitivity_parameters(
                    mechanism, scene, law, actuation, members, rebuild, start.at.q_tree
                )
            }
            parameters += [_combine_inertial(name, direction, of) for name, direction in directions.items()]
        require_supported_scene(mechanism, scene, controller, parameters)
        require_movable(mechanism, overrides, parameters, rebuild)
        if scene.spec.initial.at == "assembled":
            parameters = [at_assembled_stop(mechanism, overrides, x, rebuild) for x in parameters]
        arguments, slopes = argument_directions(mechanism, parameters) or (None, None)
        library = select_derivative_library(mechanism, scene.spec.solver.terms, arguments)
        table = sensitivity_table(
            mechanism, parameters, slopes, at_equilibrium=scene.spec.initial.at == "equilibrium",
            target=find_compensated_target(mechanism, law), controlled=controller is not None,
        )  # fmt: skip
        return SensitivitySetup(tuple(parameters), table, library, arguments if library is None else None)

    return setup


def find_compensated_target(mechanism: Mechanism, controller: object) -> Array:
    """Return q' of the target whose h the controller compensates with this mechanism's terms, or an empty array."""
    if isinstance(controller, SetPoint) and controller.target.mechanism is mechanism:
        return controller.target.q_tree
    return np.zeros(0)


def require_supported_scene(
    mechanism: Mechanism,
    scene: Scene,
    controller: Controller | TorqueController | Sampled | None,
    parameters: Sequence[SensitivityParameter],
) -> None:
    """Refuse a scene whose derivatives are not supported (InputError)."""
    spec = scene.spec
    if isinstance(controller, Sampled):
        for key in ("sensor", "drive"):
            if getattr(controller, key) is not None:
                raise InputError(
                    f"sensitivities: controller.{key}: quantization, rate limits and filters of samples are not "
                    "supported; remove the table"
                )
        controller = controller.controller
    if controller is not None and type(controller) is not RecordedTorques and is_torque_controller(controller):
        raise InputError(
            f"sensitivities: {type(controller).__name__} gives tau, whose derivatives are unknown; use a controller "
            "that gives u"
        )
    scene.refuse_forces("sensitivities")
    if spec.formulation == "spf" and spec.spf_coordinates == "z":
        raise InputError('sensitivities support spf_coordinates = "w" only')
    if spec.initial.w is not None and any(spec.initial.w):
        raise InputError("sensitivities support starts on phi = 0 only; remove initial.w")
    if spec.formulation == "dae" and (spec.solver.baumgarte or not spec.solver.projection):
        raise InputError("sensitivities need closed loops; remove solver.baumgarte, and set solver.projection = true")
    shaping = next(
        (x.name for x in parameters if any(derivative.changes_closure for derivative in x.derivatives)), None
    )
    if shaping is not None and type(controller) is Tracking and isinstance(controller.desired, PointPath):
        raise InputError(
            f"sensitivities: {shaping}: the controller makes a point follow a path, so q_d depends on the mechanism's "
            "lengths, and this is not supported; give controller.desired by joint"
        )
    if shaping is not None and spec.initial.at == "assembled":
        raise InputError(
            f'sensitivities: {shaping}: the derivative of a start with initial.at = "assembled" with respect to a '
            "length is unknown; give initial.q"
        )
    if not spec.friction_smoothing:
        # Joints that cannot move have no stick-slip events, so their friction needs no monitor.
        frictionless = (mechanism.joints.friction == 0) & ~mechanism.freedoms.immobile
        for x in parameters:
            if any(
                contribution.kind == "friction" and frictionless[contribution.index] for contribution in x.derivatives
            ):
                raise InputError(
                    f"sensitivities: {x.name} is 0, so stick-slip events are not monitored; give a small value, "
                    f"{x.name} = 1e-6 in [parameters], or friction_smoothing"
                )
    plant = [x.name for x in parameters if any(derivative.changes_terms for derivative in x.derivatives)]
    if type(controller) is Tracking and controller.model is None and plant:
        raise InputError(
            f"sensitivities: {plant[0]}: tracking computes u from the mechanism's terms, whose derivatives are not "
            "supported; give controller.model, or choose parameters of the start"
        )
    free = [name for name in mechanism.independent if name in mechanism.tree.free_coordinates]
    if type(controller) is Tracking and free:
        raise InputError(
            f"sensitivities: tracking of {free[0]}, a coordinate of a free root, is not supported; choose joints as "
            "independent coordinates"
        )


def require_movable(
    mechanism: Mechanism,
    overrides: Overrides,
    parameters: Sequence[SensitivityParameter],
    rebuild: Callable[[Overrides], Mechanism],
) -> None:
    """Refuse a length that redundant rows determine: the mechanism would not move with any other value.

    Parameters
    ----------
    mechanism : Mechanism
    overrides : mapping
        The scene's own overrides of parameters.
    parameters : sequence of SensitivityParameter
    rebuild : callable
        Rebuilds the mechanism with other overrides.

    Raises
    ------
    InputError
    """
    if not mechanism.redundant:
        return
    present = values_of(mechanism.spec, mechanism.urdf)
    for x in parameters:
        if not any(derivative.changes_closure for derivative in x.derivatives):
            continue
        whole, k = split_component(x.name)
        value = present[whole]
        step = MOBILITY_STEP * (1.0 if whole.endswith("rpy") else mechanism.size)
        step_value: Value = value + step if not isinstance(value, tuple) else _step_component(value, k, step)
        remaining = {name: x for name, x in overrides.items() if name.rpartition(".")[0] != whole}
        try:
            freedoms = rebuild({**remaining, whole: step_value}).d
        except CkcError:
            freedoms = 0
        if freedoms != mechanism.d:
            raise InputError(
                f"sensitivities: {x.name}: with another value the redundant rows of {mechanism.name}, "
                f"{', '.join(mechanism.redundant)}, are not redundant, and it loses freedoms; choose another parameter"
            )


def at_assembled_stop(
    mechanism: Mechanism, overrides: Overrides, x: SensitivityParameter, rebuild: Callable[[Overrides], Mechanism]
) -> SensitivityParameter:
    """Mark the parameter of a stop that the assembled start touches: the start follows the stop in one direction only.

    Parameters
    ----------
    mechanism : Mechanism
    overrides : mapping
        The scene's own overrides of parameters.
    x : SensitivityParameter
    rebuild : callable
        Rebuilds the mechanism with other overrides.

    Raises
    ------
    InputError
        q_guess is beyond the stop, so the start follows the stop in both directions.
    """
    stop = next((contribution for contribution in x.derivatives if contribution.kind in ("lower", "upper")), None)
    if stop is None:
        return x
    k, reach = stop.index, mechanism.tree.step_scale
    value = float(getattr(mechanism.joints, stop.kind)[k])
    if not np.isfinite(value):  # a joint that cannot move has no stops
        return x
    at_stop = abs(float(mechanism.tree.to_coordinates(mechanism.q_tree)[k]) - value) <= STOP_STEP * reach[k]
    # An assembly may leave a joint slightly beyond its stop, and does not move if it cannot return to the stop.
    steps = STEPS_AT_STOP if at_stop else (STOP_STEP,)

    def follows(step: float) -> bool:
        try:
            rebuilt = rebuild({**overrides, x.name: value + step * float(reach[k])})
        except CkcError:
            return True
        return bool(np.abs(rebuilt.tree.difference(mechanism.q_tree, rebuilt.q_tree) / reach).max() > 0.1 * abs(step))

    follows_by_side = [any(follows(side * step) for step in steps) for side in (-1, 1)]
    if all(follows_by_side):
        raise InputError(
            f"sensitivities: {x.name}: q_guess is beyond this stop, so the derivative of the assembled start with "
            "respect to the stop is unknown; give initial.q"
        )
    return replace(x, assembled_at=k) if any(follows_by_side) else x


def _step_component(value: tuple[float, float, float], k: int, step: float) -> Value:
    x, y, z = (component + step * (i == k) for i, component in enumerate(value))
    return x, y, z


def find_sensitivity_parameters(
    mechanism: Mechanism,
    scene: Scene,
    controller: object,
    actuation: Actuation,
    names: Sequence[str],
    rebuild: Callable[[Overrides], Mechanism],
    q_tree: Array,
) -> list[SensitivityParameter]:
    """Return the parameters of some names; the name of a vector stands for its three components.

    `rebuild` creates the mechanism with other overrides; `q_tree` is q' at the start.

    Raises
    ------
    InputError
        An unknown name (similar names are listed), a repeated name, or a parameter without derivative.
    """
    of_scene = {
        x.name: x
        for x in (*_controller_parameters(mechanism, scene, controller), *_start_parameters(mechanism, scene, q_tree))
    }
    values = with_components(values_of(mechanism.spec, mechanism.urdf)) | dict.fromkeys(of_scene, 0.0)
    at = scene.spec.initial.at
    position = next((name for name in names if name.startswith("initial.q.") and at is not None), None)
    if position is not None:
        raise InputError(f'sensitivities: {position}: the scene has initial.at = "{at}"; give its start as [initial.q]')
    require_known(names, values, "sensitivities", (*ROOTS, *SCENE_ROOTS))
    labels = [part for name in names for part in parts_of(name, values)]
    if len(set(labels)) < len(labels):
        raise InputError(f"sensitivities: a parameter is repeated in {', '.join(names)}; name each of them once")
    slopes = ParameterMap(mechanism, scene.spec.parameters, rebuild).derivatives(
        [name for name in labels if is_parameter(name)]
    )
    return [
        _mechanism_parameter(mechanism, actuation, name, slopes[name]) if is_parameter(name) else of_scene[name]
        for name in labels
    ]


def _mechanism_parameter(
    mechanism: Mechanism, actuation: Actuation, name: str, slopes: Mapping[str, Array]
) -> SensitivityParameter:
    """Return a parameter of the mechanism. Derivatives of reported points only do not act on the motion."""
    derivatives = find_parameter_derivatives(mechanism, actuation, name, slopes)
    placed = ["" if derivative.placement is None else derivative.placement.placed for derivative in derivatives]
    by_place = list(zip(placed, derivatives, strict=True))
    return SensitivityParameter(
        name,
        tuple(derivative for place, derivative in by_place if place != "reported"),
        placements=tuple(derivative for place, derivative in by_place if place in ("joint", "reported")),
        slopes=slopes,
    )


def _combine_inertial(
    name: str, direction: Mapping[str, float], parameters: Mapping[str, SensitivityParameter]
) -> SensitivityParameter:
    """Return the directional derivative along inertial parameters with these coefficients (InputError)."""
    inertias: dict[int, Array] = {}
    slopes: dict[str, Array] = {}
    for member, coefficient in direction.items():
        for derivative in parameters[member].derivatives:
            if derivative.kind != "inertia":
                raise InputError(f"sensitivities: directions: {member} is no mass, centre of mass or inertia of a link")
            step = coefficient * derivative.values
            inertias[derivative.index] = inertias.get(derivative.index, np.zeros(len(step))) + step
        for key, slope in parameters[member].slopes.items():
            slopes[key] = slopes.get(key, np.zeros_like(slope)) + coefficient * slope
    derivatives = tuple(ParameterDerivative("inertia", joint, values) for joint, values in inertias.items())
    return SensitivityParameter(name, derivatives, slopes=slopes)


def _controller_parameters(mechanism: Mechanism, scene: Scene, controller: object) -> Iterator[SensitivityParameter]:
    """Yield the gains, as one number and by diagonal entry, and the target of eq. 14."""
    spec, unit = None if scene.controller is not None else scene.spec.controller, np.eye(mechanism.d)
    if not isinstance(controller, SetPoint | Tracking) or law_table(controller) is None:
        return  # derivatives with respect to the gains of a controller in Python are unknown
    gains = {"K_P": "gain_q", "K_V": "gain_q_dot"} if type(controller) is SetPoint else {}
    gains = {"Lambda": "gain_q", "K_D": "gain_q_dot"} if type(controller) is Tracking else gains
    for key, kind in gains.items():
        derivatives = {f"controller.{key}": unit} if isinstance(getattr(spec, key, None), float | int) else {}
        derivatives |= {f"controller.{key}.{name}": np.diag(unit[k]) for k, name in enumerate(mechanism.independent)}
        for name, gain in derivatives.items():
            yield SensitivityParameter(name, (ParameterDerivative(kind, 0, gain.ravel(order="F")),))
    if type(controller) is SetPoint and find_compensated_target(mechanism, controller).size:
        for k, name in enumerate(mechanism.independent):
            yield SensitivityParameter(
                f"controller.q_d.{name}", (ParameterDerivative("target", k, controller.K_P[:, k]),)
            )


def _start_parameters(mechanism: Mechanism, scene: Scene, q_tree: Array) -> Iterator[SensitivityParameter]:
    """Yield the coordinates and rates of the start."""
    tree, tangents = mechanism.tree, np.eye(mechanism.tree.n)
    for q, v in tree.free_roots:  # coordinates are in world axes, tangent vectors in body axes
        tangents[v : v + 3, v : v + 3] = pin.Quaternion(q_tree[q + 3 : q + 7]).matrix().T
        tangents[v + 3 : v + 6, v + 3 : v + 6] = pin.Jexp3(tree.to_coordinates(q_tree)[v + 3 : v + 6])
    roots = (mechanism.coordinates[v : v + 6] for _, v in tree.free_roots)
    split_roots = {name for root in roots if not set(root) <= set(mechanism.independent) for name in root}
    for k, name in enumerate(mechanism.independent):
        if name not in split_roots and scene.spec.initial.at is None:
            yield SensitivityParameter(f"initial.q.{name}", q=tangents[:, tree.index[name]])
        yield SensitivityParameter(f"initial.q_dot.{name}", q_dot=np.eye(mechanism.d)[k])
