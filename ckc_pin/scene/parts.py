"""What a scene names: a mechanism, a controller, the clock that it is on, and how it moves the motors."""

from __future__ import annotations

from os.path import exists
from pathlib import Path

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.build import make_controller
from ckc_pin.control.controllers import RecordedTorques, SetPoint, Tracking
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.library import mechanism_file
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides
from ckc_pin.scene.initial import branch, is_chart
from ckc_pin.scene.scene import Scene

__all__ = ["changed_mechanism", "in_samples", "scene_actuation", "scene_controller", "scene_mechanism"]


def scene_mechanism(scene: Scene) -> Mechanism:
    """Load the mechanism that a scene names, relative to its own folder or by shipped name, or has made by rule."""
    return changed_mechanism(scene, scene.spec.parameters)


def changed_mechanism(scene: Scene, overrides: Overrides) -> Mechanism:
    """Load the mechanism that a scene names with these parameters in the place of the scene's own."""
    mechanism = scene.spec.mechanism
    return load(_beside(scene, mechanism) if isinstance(mechanism, str) else mechanism, overrides)


def _beside(scene: Scene, name: str) -> str | Path:
    folder = scene.sources.folder
    if folder is not None and (name.endswith(".toml") or exists(folder / name)):
        return mechanism_file(folder / name)
    return name


def scene_controller(
    scene: Scene, mechanism: Mechanism, texts: dict[str, str] | None = None
) -> SetPoint | Tracking | RecordedTorques | None:
    """Build a scene's controller; the texts of its own model are added to `texts`."""

    def load_model(name: str) -> Mechanism:
        model = load(_beside(scene, name))
        if texts is not None:
            texts.update({f"model/{file}": text for file, text in model.sources.texts.items()})
        return model

    spec = scene.spec
    if spec.controller is None:
        return None
    of = spec.controller, mechanism, spec.coriolis_velocity, spec.t_end, scene.sources
    with scene.sources.prefix_errors():
        start = {name: x for name, x in spec.initial.q.items() if name in mechanism.coordinates}
        near = branch(mechanism, start)
        if not is_chart(near):  # between branches; the start itself is refused
            near = mechanism.assembled
        return make_controller(*of, near, load_model)


def scene_actuation(scene: Scene, mechanism: Mechanism) -> Actuation:
    """Return how a scene's controller, or who stands in for it, moves the motors."""
    spec = scene.spec.controller
    allocation = spec.allocation if isinstance(spec, FeedbackSpec) else None
    with scene.sources.prefix_errors():
        return Actuation(mechanism, spec.torque_limit if spec else None, allocation)


def in_samples(
    scene: Scene, controller: SetPoint | Tracking | RecordedTorques | None
) -> SetPoint | Tracking | RecordedTorques | Sampled | None:
    """Return a scene's controller on the clock that the scene gives it, if it does."""
    spec = scene.spec.controller
    if controller is None or not isinstance(spec, FeedbackSpec) or spec.sample_time is None:
        return controller
    with scene.sources.prefix_errors():
        return Sampled(controller, spec.sample_time, spec.delay, spec.sensor, spec.drive)
