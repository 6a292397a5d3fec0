"""Warnings of a run, and the cause of a stop where a desired motion explains it."""

from __future__ import annotations

from ckc_pin.control.controllers import Tracking
from ckc_pin.control.point_path import Circle, Line, PointPath
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.errors import NumericalError
from ckc_pin.run.checks import desired_warnings, start_warnings
from ckc_pin.run.prepare import Prepared
from ckc_pin.run.stop_reasons import STEP_TOO_SMALL

__all__ = ["add_cause", "find_exit", "known_warnings"]

LEAD = 1e-3  # of the time of a stop: a motion may stop so long before the exit of its desired motion
EXIT_PHRASE = "leaves the workspace"  # in the error of a path of a point, which names the time itself


def known_warnings(prepared: Prepared) -> list[str]:
    """Return the warnings of a scene's mechanism and start, which are known without following the desired motion."""
    return [*prepared.mechanism.warnings, *start_warnings(prepared.scene, prepared.mechanism, prepared.start)]


def find_exit(prepared: Prepared, t: float) -> DesiredCheck | None:
    """Return when the desired motion of a tracking controller left the workspace until a stop at t (s); None if not."""
    law = prepared.controller.controller if isinstance(prepared.controller, Sampled) else prepared.controller
    if not isinstance(law, Tracking):
        return None
    t_end = prepared.scene.spec.t_end
    horizon = min(t + LEAD * max(t, t_end), t_end)
    try:
        desired = follow_desired(prepared.mechanism, law.desired, horizon, prepared.start.at)
    except NumericalError:  # The path of a point cannot be followed up to there, and its own message says so.
        return None
    return None if desired.leaves_at is None else desired


def add_cause(error: NumericalError, prepared: Prepared, exit_: DesiredCheck | None) -> tuple[str, list[str]]:
    """Return the message of a stop that begins with its cause, and the warnings about the cause.

    Parameters
    ----------
    error : NumericalError
        Why the loop stopped.
    prepared : Prepared
    exit_ : DesiredCheck or None
        As from `find_exit`.
    """
    text = str(error)
    if exit_ is None:
        return text, []
    warnings = desired_warnings(prepared.mechanism, exit_, prepared.scene.spec.t_end)
    if EXIT_PHRASE in text:
        return text, warnings
    cause = f"{_name_desired(prepared)} left the workspace at t = {exit_.leaves_at:.4f} s"
    detail = text.removesuffix(STEP_TOO_SMALL).removesuffix("; ")
    return (f"{cause}; {detail}" if detail else cause), warnings


def _name_desired(prepared: Prepared) -> str:
    law = prepared.controller.controller if isinstance(prepared.controller, Sampled) else prepared.controller
    desired = getattr(law, "desired", None)
    if not isinstance(desired, PointPath):
        return "the desired motion"
    shapes = {Circle: "circle", Line: "line"}
    return f"the desired {shapes.get(type(desired.path), 'path')} of the point {desired.point.name!r}"
