"""One-screen summary of a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ckc_pin.base.summary import Row, Summary
from ckc_pin.control.spec import ControllerSpec, SetPointSpec, TorquesSpec, TrackingSpec
from ckc_pin.mechanism.library import GeneratorSpec

if TYPE_CHECKING:
    from ckc_pin.scene.scene import Scene

__all__ = ["formulation_of", "scene_summary"]


def scene_summary(scene: Scene) -> Summary:
    """Return what a scene says."""
    spec = scene.spec
    made = f"{spec.mechanism.generator}, N = {spec.mechanism.N}" if isinstance(spec.mechanism, GeneratorSpec) else ""
    start = spec.initial.at or [f"{name} = {value:g}" for name, value in spec.initial.q.items()]
    rows: list[Row] = [
        ("mechanism", made or str(spec.mechanism)),
        ("formulation", formulation_of(scene.to_dict(), exact=not any(spec.initial.w or ()))),
        ("t_end", f"{spec.t_end:g} s"),
        ("starts", f"at {start}" if isinstance(start, str) else start),
    ]
    rates = [f"{name} = {value:g}" for name, value in spec.initial.q_dot.items() if value]
    rows += [("with rates", rates)] if rates else []
    rows += [("method", f"{spec.solver.method}, rtol = {spec.solver.rtol:g}"), ("control", _control(spec.controller))]
    rows += [("event", f"{event.of} of {event.coordinate or 'the mechanism'}") for event in spec.event]
    return Summary(f"Scene {scene.name}", rows)


def _control(spec: ControllerSpec | None) -> str:
    match spec:
        case None:
            return "none"
        case SetPointSpec():
            return f"set point, K_P = {spec.K_P}, K_V = {spec.K_V}"
        case TrackingSpec():
            return f"tracking, Lambda = {spec.Lambda}, K_D = {spec.K_D}, of {', '.join(spec.desired)}"
        case TorquesSpec():
            return f"torques of {spec.file}"


def formulation_of(scene: dict[str, Any], *, exact: bool) -> str:
    """Say which formulation a scene takes; `exact`: the SPF starts on its manifold."""
    if scene["formulation"] != "spf":
        return str(scene["formulation"])
    coordinates = scene["spf_coordinates"]
    exact = exact and coordinates == "w"  # epsilon stands only in w = w(0) exp(-t / epsilon)
    same = ": from w(0) = 0 bit for bit the reduced model, whatever epsilon" if exact else ""
    return f"spf in (q, q_dot, {coordinates}), epsilon = {scene['epsilon']:g}{same}"
