"""The desired motion of a run's controller at the run's output instants."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.desired import Desired
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.point_path import make_desired
from ckc_pin.control.sampled import unwrap_sampled
from ckc_pin.control.spec import ControllerSpec, JointServoSpec, SetPointSpec, TorquesSpec
from ckc_pin.errors import NumericalError

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["DesiredPath", "compute_desired_path", "find_target", "sample_target"]


class DesiredPath(Struct, frozen=True):
    """Desired independent coordinates q_d along a run.

    Attributes
    ----------
    kind : "set_point" or "tracking"
    q, q_dot : (m, d) arrays
        At the run's output times, in the order of `independent`. NaN where the path of a point has left the workspace.
    """

    kind: str
    q: Array
    q_dot: Array


def compute_desired_path(run: Run) -> DesiredPath | None:
    """Evaluate q_d and its rate at a run's output times. They follow from the scene that the run carries.

    Returns
    -------
    DesiredPath or None
        None if the scene has no controller, or a controller without a desired motion.

    Raises
    ------
    InputError
        The scene does not define the desired motion, for example in a damaged run file.
    """
    if "controller" not in run.scene:
        return None
    spec: ControllerSpec = convert(run.scene["controller"], ControllerSpec, run.scene_name)  # type: ignore[arg-type]
    if isinstance(spec, TorquesSpec):
        return None
    target: Desired | Array | None
    if isinstance(spec, SetPointSpec):
        target = run.mechanism.vector(spec.q_d, run.independent, f"{run.scene_name}: controller.q_d")
    elif isinstance(spec, JointServoSpec):
        target = JointServo(run.mechanism, spec.motor).desired_q
    else:
        sources = Sources(run.scene_name, None, run.texts)
        target = make_desired(spec.desired, run.mechanism, sources, float(run.t[-1]))
    return None if target is None else sample_target(target, run.t, len(run.independent))


def find_target(controller: Any) -> Desired | Array | None:
    """Return the desired motion of a controller, or q_d of a `SetPoint`, also of a sampled one; None of others."""
    law = unwrap_sampled(controller)
    if isinstance(law, Tracking):
        return law.desired
    if isinstance(law, JointServo):
        return law.desired_q
    return law.q_d if isinstance(law, SetPoint) else None


def sample_target(target: Desired | Array, t: Array, d: int) -> DesiredPath:
    """Return a desired motion of d coordinates, or a constant q_d, at some times."""
    if isinstance(target, np.ndarray):
        return DesiredPath("set_point", np.tile(target, (len(t), 1)), np.zeros((len(t), d)))
    samples = np.full((len(t), 2, d), np.nan)
    for k, time in enumerate(t.tolist()):
        with suppress(NumericalError):  # The path of a point has left the workspace.
            samples[k] = target(time)[:2]
    return DesiredPath("tracking", samples[:, 0], samples[:, 1])
