"""Load and build what a scene names: its mechanism, its controller with sampling, and its actuation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from os.path import exists
from pathlib import Path
from typing import TYPE_CHECKING

from ckc_pin.base.sources import Sources
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.build import make_controller
from ckc_pin.control.controllers import Controller, TorqueController
from ckc_pin.control.desired import Desired, find_rate_jump, make_motion
from ckc_pin.control.forces import BodyForce, read_forces
from ckc_pin.control.sampled import Sampled, unwrap_sampled
from ckc_pin.control.spec import FeedbackSpec, SampledSpec
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import build, load
from ckc_pin.mechanism.library import MECHANISM_FILE, mechanism_file
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides
from ckc_pin.scene.initial import find_branch, is_chart
from ckc_pin.scene.spec import PrescribedSpec

if TYPE_CHECKING:
    from ckc_pin.scene.scene import Scene

__all__ = [
    "apply_sampling",
    "build_scene_actuation",
    "build_scene_controller",
    "build_scene_forces",
    "load_controller_model",
    "load_scene_mechanism",
    "prescribed_motions",
    "prescribed_positions",
    "rebuild_scene_mechanism",
]


def load_scene_mechanism(scene: Scene) -> Mechanism:
    """Load a scene's mechanism with the scene's parameters: a file beside the scene, a shipped one, or a generated one.

    Raises
    ------
    InputError, MechanismError
    """
    return rebuild_scene_mechanism(scene, scene.spec.parameters)


def rebuild_scene_mechanism(scene: Scene, overrides: Overrides) -> Mechanism:
    """Load a scene's mechanism with other parameters than the scene's."""
    positions = prescribed_positions(scene.spec.prescribed, scene.spec.initial.q)
    if scene.mechanism_sources is not None:
        sources = scene.mechanism_sources.with_texts({})
        return build(sources.text(MECHANISM_FILE), sources, overrides, positions)
    mechanism = scene.spec.mechanism
    name = _resolve_path(scene, mechanism) if isinstance(mechanism, str) else mechanism
    return load(name, overrides, positions)


def load_controller_model(scene: Scene, name: str) -> Mechanism:
    """Load the mechanism that a controller of a scene has for its model: from the scene's texts, or by name or path."""
    texts, prefix = scene.sources.available, name.removesuffix(MECHANISM_FILE)
    if name not in texts:
        return load(_resolve_path(scene, name))
    files = {file.removeprefix(prefix): text for file, text in texts.items() if file.startswith(prefix)}
    return build(texts[name], Sources(scene.sources.name, None, files))


def prescribed_motions(prescribed: Sequence[PrescribedSpec]) -> list[Desired]:
    """Return the motion of each prescribed joint over the time since it began, in their order.

    Raises
    ------
    InputError
        Keys that do not go together, or a rate that jumps, which no finite torque can follow.
    """
    motions: list[Desired] = []
    for one in prescribed:
        where = f"prescribed, joint {one.joint!r}"
        if isinstance(one.begins, float) and isinstance(one.ends, float) and not one.begins < one.ends:
            raise InputError(f"{where}: ends = {one.ends} has to be greater than begins = {one.begins}")
        motion = make_motion([one], [where])
        jump = find_rate_jump(motion, math.inf)
        if jump is not None:
            raise InputError(
                f"{where}: the rate jumps at t = {jump:.6g} s, where no finite torque follows it; "
                'use profile = "quintic", "cubic" or "trapezoidal"'
            )
        motions.append(motion)
    return motions


def prescribed_positions(
    prescribed: Sequence[PrescribedSpec], initial_q: Mapping[str, float]
) -> dict[str, float | None]:
    """Return the positions of the prescribed joints at t = 0 by name, rad or m.

    A joint that moves freely at first has its initial position, None if it has none: then that of the assembly.

    Raises
    ------
    InputError
        A joint is prescribed twice.
    """
    joints = [one.joint for one in prescribed]
    twice = next((name for k, name in enumerate(joints) if name in joints[:k]), None)
    if twice is not None:
        raise InputError(f"prescribed: joint {twice!r} is prescribed twice")
    return {
        one.joint: float(motion(0.0)[0][0]) if one.begins is None else initial_q.get(one.joint)
        for one, motion in zip(prescribed, prescribed_motions(prescribed), strict=True)
    }


def _resolve_path(scene: Scene, name: str) -> str | Path:
    """Return the path of a mechanism relative to the scene's folder, or its shipped name."""
    folder = scene.sources.folder
    if folder is not None and (name.endswith(".toml") or exists(folder / name)):
        return mechanism_file(folder / name)
    return name


def build_scene_controller(
    scene: Scene, mechanism: Mechanism, texts: dict[str, str] | None = None
) -> Controller | TorqueController | None:
    """Return a scene's controller, without its sampling: built from the scene's table, or the object that it has.

    Parameters
    ----------
    texts : dict of str to str, optional
        Receives the files of the controller's own model, by name.

    Raises
    ------
    InputError, MechanismError
    """

    def load_model(name: str) -> Mechanism:
        model = load_controller_model(scene, name)
        if texts is not None:
            texts.update({f"model/{file}": text for file, text in model.sources.texts.items()})
        return model

    spec = scene.spec
    if scene.controller is not None:
        return unwrap_sampled(scene.controller)
    if spec.controller is None:
        return None
    with scene.sources.prefix_errors():
        q = {name: x for name, x in spec.initial.q.items() if name in mechanism.coordinates}
        reference = find_branch(mechanism, q)
        if not is_chart(reference):  # The start itself is refused later, with a better message.
            reference = mechanism.assembled
        return make_controller(
            spec.controller, mechanism, spec.coriolis_velocity, spec.t_end, scene.sources, reference, load_model
        )


def build_scene_actuation(scene: Scene, mechanism: Mechanism) -> Actuation:
    """Return how motors with a scene's torque limits and allocation produce u."""
    spec = scene.spec.controller
    allocation = spec.allocation if isinstance(spec, FeedbackSpec) else None
    with scene.sources.prefix_errors():
        return Actuation(mechanism, spec.torque_limit if spec else None, allocation)


def build_scene_forces(scene: Scene, mechanism: Mechanism) -> list[BodyForce]:
    """Return the forces of a scene on the mechanism's bodies.

    Raises
    ------
    InputError, MechanismError
    """
    with scene.sources.prefix_errors():
        return read_forces(scene.spec.force, scene.forces, mechanism, scene.sources)


def apply_sampling(
    scene: Scene, controller: Controller | TorqueController | None
) -> Controller | TorqueController | Sampled | None:
    """Return a scene's controller with the scene's sample time, delay, sensors and drives, if it is sampled."""
    spec = scene.spec.controller
    if scene.controller is not None:
        return scene.controller
    if controller is None or not isinstance(spec, SampledSpec) or spec.sample_time is None:
        return controller
    with scene.sources.prefix_errors():
        return Sampled(controller, spec.sample_time, spec.delay, spec.sensor, spec.drive)
