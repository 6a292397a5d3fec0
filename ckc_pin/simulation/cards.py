"""What a person sees of a check, a scene, a run and its like: in Python, in a notebook and from the commands."""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.control.spec import ControllerSpec, SetPointSpec, TorquesSpec, TrackingSpec
from ckc_pin.errors import CkcError, InputError
from ckc_pin.generated.library import too_large
from ckc_pin.mechanism.card import Card, Row, quantities
from ckc_pin.mechanism.generators import GeneratorSpec
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.mechanism.units import joined
from ckc_pin.simulation.linear_report import eigenvalues_text, multipliers_say, stability_text
from ckc_pin.simulation.units import key_unit, per, quantity_units

if TYPE_CHECKING:
    from ckc_pin.simulation.check import Check
    from ckc_pin.simulation.floquet import Floquet
    from ckc_pin.simulation.locus import GainLocus
    from ckc_pin.simulation.motion_forces import MotionForces
    from ckc_pin.simulation.run import Run
    from ckc_pin.simulation.scene import Scene
    from ckc_pin.simulation.sensitivities import Sensitivities
    from ckc_pin.simulation.simulator import Simulator
    from ckc_pin.simulation.state import State

__all__ = [
    "check_card",
    "floquet_card",
    "forces_card",
    "locus_card",
    "run_card",
    "scene_card",
    "sensitivities_card",
    "simulator_card",
    "state_card",
]

MOST_EVENTS = 10
LONG = 10.0  # s: what compiling a mechanism's terms takes at most, as a rule
AXES = tuple(combinations_with_replacement(enumerate("xyz"), 2))


# --- before a run ----------------------------------------------------------------------------------


def check_card(found: Check) -> Card:
    """Return what a check found."""
    redundant = f", redundant: {', '.join(found.redundant)}" if found.redundant else ""
    about = [f"i{a}{b} = {found.inertia[i, j]:.6g}" for (i, a), (j, b) in AXES]
    rows: list[Row] = [
        ("coordinates n", str(found.n)),
        ("freedoms d", str(found.d)),
        ("closure rows, rank", f"{found.rows}, {found.rank}{redundant}"),
        ("singular values", f"{found.gap[0]:.2e} | {found.gap[1]:.2e} around the cut (relative, scaled J)"),
        ("independent q", _list(found.independent)),
        ("dependent z", _list(found.dependent)),
        ("assembled at", quantities(found.coordinates, found.q_tree, found.units)),
    ]
    if found.det_phi_z is not None:
        rows.append(("det phi_z", f"{found.det_phi_z:.6g}"))
    rows += [
        ("sigma_min(phi_z), cond", f"{found.sigma_min_phi_z:.6g}, {found.cond_phi_z:.4g}"),
        ("moving mass", f"{found.mass:.6g} kg"),
        ("its inertia, kg m²", about),
        ("", "as assembled, about its centre of mass, world's axes"),
        ("terms", found.terms),
    ]
    for k, numbers in enumerate(found.branches if found.branches is not None else ()):
        rows.append((f"branch {k + 1}", quantities(found.coordinates, numbers, found.units)))
    if found.desired is not None and found.desired.leaves_at is None:
        closest = f"stays inside; closest to singular at t = {found.desired.closest_t:.4f} s"
        rows.append(("desired", f"{closest}, sigma_min(phi_z) = {found.desired.sigma_min:.4g}"))
    elif found.desired is not None:
        rows.append(("desired", f"leaves the workspace at t = {found.desired.leaves_at:.5f} s"))
    if found.stability is not None:
        rows.append(("closed loop", stability_text(found.stability)))
    units = dict(zip(found.coordinates, found.units, strict=True))
    rows += [(f"joint {name}", _of_joint(joint, units[name])) for name, joint in found.joints.items()]
    rows += [("warning", warning) for warning in found.warnings]
    return Card(f"{found.name}: {_count(found.d, 'freedom')}, {_count(len(found.warnings), 'warning')}", rows)


def _of_joint(joint: dict[str, float], unit: str) -> list[str]:
    """Say what a joint itself does, beside moving freely."""
    turns = unit == "rad"
    units = {
        "armature": "kg m²" if turns else "kg",
        "damping": "N m s/rad" if turns else "N s/m",
        "friction": "N m" if turns else "N",
    }
    items = [f"{key} {joint[key]:g} {shown}" for key, shown in units.items() if joint[key]]
    if math.isfinite(joint["lower"]) or math.isfinite(joint["upper"]):
        items += [f"stops {joint['lower']:.6g} to {joint['upper']:.6g} {unit}", f"restitution {joint['restitution']:g}"]
    return items


def scene_card(scene: Scene) -> Card:
    """Return what a scene says."""
    spec = scene.spec
    made = f"{spec.mechanism.generator}, N = {spec.mechanism.N}" if isinstance(spec.mechanism, GeneratorSpec) else ""
    start = spec.initial.at or [f"{name} = {value:g}" for name, value in spec.initial.q.items()]
    rows: list[Row] = [
        ("mechanism", made or str(spec.mechanism)),
        ("formulation", formulation_of(scene.plain(), exact=not any(spec.initial.w or ()))),
        ("t_end", f"{spec.t_end:g} s"),
        ("starts", f"at {start}" if isinstance(start, str) else start),
    ]
    rates = [f"{name} = {value:g}" for name, value in spec.initial.q_dot.items() if value]
    rows += [("with rates", rates)] if rates else []
    rows += [("method", f"{spec.solver.method}, rtol = {spec.solver.rtol:g}"), ("control", _control(spec.controller))]
    rows += [("event", f"{event.of} of {event.coordinate or 'the mechanism'}") for event in spec.event]
    return Card(f"Scene {scene.name}", rows)


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


# --- a run -----------------------------------------------------------------------------------------


def run_card(run: Run) -> Card:
    """Return the outcome of a run."""
    mechanism = _mechanism(run)
    units = ([], []) if mechanism is None else (mechanism.tree.units(), mechanism.tree.units("/s"))
    rows: list[Row] = [
        ("formulation", formulation_of(run.scene, exact=not run.w[0].any())),
        ("instants", f"{len(run.t)}, from t = {run.t[0]:g} to {run.t[-1]:g} s"),
        ("q_tree at the end", quantities(run.coordinates, run.q_tree[-1], units[0], 9)),
        ("v_tree at the end", quantities(run.coordinates, run.v_tree[-1], units[1])),
    ]
    if np.any(run.u) or np.any(run.tau) or "controller" in run.scene:
        u_unit, tau_unit = ("", "") if mechanism is None else _efforts(mechanism)
        rows.append(("largest |u|, |tau|", f"{_largest(run.u):.4g}{u_unit}, {_largest(run.tau):.4g}{tau_unit}"))
    for name, rate in ({} if mechanism is None else run.too_fast()).items():
        limit = run.mechanism.motors.speed_limit[run.actuated.index(name)]
        rows.append(("warning", f"{name} turns at {rate:.4g}, its speed_limit is {limit:.4g}"))
    rows.append(("energy start, end", f"{run.energy[0]:.9g}, {run.energy[-1]:.9g} J"))
    if run.dissipated is not None:
        rows.append(("friction, impacts took", f"{run.dissipated[-1]:.9g} J"))
    rows.append(("largest |phi - w|", f"{run.max_phi:.2g} (its rate {run.max_phi_dot:.2g})"))
    rows += _work(run.stats, _would_pay(run))
    rows += [("event", f"t = {event['t']:.9g} s: {event['name']}") for event in run.events[:MOST_EVENTS]]
    if len(run.events) > MOST_EVENTS:
        rows.append(("", f"and {len(run.events) - MOST_EVENTS} more events"))
    said = run.message if run.message.startswith(run.status) else f"{run.status}: {run.message}"
    return Card(f"Run of {run.scene_name}, {said}", rows)


def formulation_of(scene: dict[str, Any], *, exact: bool) -> str:
    """Say which formulation a scene takes; `exact`: the SPF starts on its manifold."""
    if scene["formulation"] != "spf":
        return str(scene["formulation"])
    coordinates = scene["spf_coordinates"]
    exact = exact and coordinates == "w"  # epsilon stands only in w = w(0) exp(-t / epsilon)
    same = ": from w(0) = 0 bit for bit the reduced model, whatever epsilon" if exact else ""
    return f"spf in (q, q_dot, {coordinates}), epsilon = {scene['epsilon']:g}{same}"


def _work(stats: dict[str, Any], would_pay: str = "") -> list[Row]:
    steps = ", ".join(f"{name} {count} steps" for name, count in stats["steps_by_method"].items())
    work = f"{stats['rhs']} right-hand sides, {stats['newton']} Newton iterations"
    called = f", {stats['python_calls']} calls of your functions" if stats["python_calls"] else ""
    spent = f", {stats['wall_s']:.2g} s" if "wall_s" in stats else ""
    terms = stats.get("terms", "pinocchio")  # a file may be from before there were others
    before = stats.get("rhs_by_terms", {}).get("pinocchio", 0)
    late = f", compiled after {before} right-hand sides" if terms == "generated" and before else ""
    return [
        ("method", f"{steps or stats['method']}, {stats['rejected']} rejected"),
        ("terms", terms + late + would_pay),
        ("work", f"{work}, {stats['factorizations']} factorizations{called}{spent}"),
    ]


def _would_pay(run: Run) -> str:
    """Say of a long run that compiled terms would have made it a short one."""
    if run.stats.get("terms", "pinocchio") != "pinocchio" or run.stats["wall_s"] < LONG:
        return ""
    mechanism = _mechanism(run)
    if mechanism is None or too_large(mechanism):
        return ""
    return "; compiled ones are several times faster: ckc compile"


def _mechanism(run: Run) -> Mechanism | None:
    """Return a run's mechanism; None where its texts are damaged, which no look at it is to stop at."""
    try:
        return run.mechanism
    except CkcError:
        return None


def forces_card(found: MotionForces) -> Card:
    """Return what a motion asks of motors, loops and joints."""
    rows: list[Row] = [
        ("instants", f"{len(found.t)}, from t = {found.t[0]:g} to {found.t[-1]:g} s"),
        ("largest |tau|", quantities(found.actuated, np.abs(found.tau).max(axis=0))),
        ("loop_forces", list(found.loop_forces)),
        ("joint_forces", list(found.joint_forces)),
    ]
    rows += [("exceeded", f"{x['motor']}: {x['most']:.4g} at t = {x['t_most']:.4g} s, its limit is {x['limit']:.4g}")
             for x in found.exceeded]  # fmt: skip
    return Card(f"MotionForces of {found.name}, {found.status}: {found.message}", rows)


def floquet_card(found: Floquet) -> Card:
    """Return the multipliers of a periodic motion, and what they say."""
    return Card(f"Floquet of {found.run.scene_name}, period {found.period:.9g} s", [
        ("states", list(found.states)),
        ("multipliers", eigenvalues_text(found.multipliers)),
        ("verdict", multipliers_say(found)),
    ])  # fmt: skip


def locus_card(found: GainLocus) -> Card:
    """Return where the eigenvalues of a closed loop are at the ends of a locus, and as the scene has the gain."""
    rows: list[Row] = [
        (f"{found.gain} times {found.factors[k]:.4g}", f"{eigenvalues_text(found.eigenvalues[k])} 1/s")
        for k in sorted({0, found.own, len(found.factors) - 1})
    ]
    return Card(f"GainLocus of {found.name}, {found.at}: {len(found.factors)} factors on {found.gain}", rows)


def sensitivities_card(found: Sensitivities) -> Card:
    """Return how far each parameter moves the independent coordinates, and the points, at most along the run."""
    run = found.run
    tree, at = run.mechanism.tree, [run.coordinates.index(name) for name in run.independent]
    names = [*run.independent, *found.points]
    units = [*(tree.units()[k] for k in at), *("m" for _ in found.points)]
    rows: list[Row] = [
        ("instants", f"{len(found.t)}, from t = {found.t[0]:g} to {found.t[-1]:g} s"),
        ("largest along it", ""),
    ]
    for k, name in enumerate(found.parameters):
        unit = key_unit(run.mechanism, name)
        most = [np.abs(found.q_tree[:, j, k]).max() for j in at]
        most += [np.linalg.norm(moved[:, :, k], axis=1).max() for moved in found.points.values()]
        rows.append((f"by {name}", quantities(names, np.array(most), [per(one, unit) for one in units], 4)))
    if found.end_time is not None:
        shown = [f"{x:.4g} {per('s', key_unit(run.mechanism, name))}" for name, x in
                 zip(found.parameters, found.end_time.tolist(), strict=True)]  # fmt: skip
        rows.append(("the end comes later by", shown))
    said = run.message if run.message.startswith(run.status) else f"{run.status}: {run.message}"
    return Card(f"Sensitivities of {run.scene_name}, {said}", rows)


# --- step by step ----------------------------------------------------------------------------------


def state_card(state: State) -> Card:
    """Return where a simulator is, or a run was."""
    mechanism = state.mechanism
    tree = mechanism.tree
    rows: list[Row] = [
        ("q_tree", quantities(mechanism.coordinates, state.q_tree, tree.units())),
        ("v_tree", quantities(mechanism.coordinates, state.v_tree, tree.units("/s"))),
        ("independent q", _list(mechanism.independent)),
    ]
    rows += [("w", f"up to {_largest(state.w):.3g}")] if np.any(state.w) else []
    return Card(f"State of {mechanism.name} at t = {state.t:g} s", rows)


def simulator_card(simulator: Simulator) -> Card:
    """Return what a simulator steps, and where it is."""
    scene = simulator.scene
    motors = simulator.mechanism.actuated
    rows: list[Row] = [
        ("formulation", formulation_of(scene.plain(), exact=not np.any(simulator.state.w))),
        *state_card(simulator.state).rows,
        ("motors", _list(motors)),
    ]
    with suppress(InputError):  # within a step, as from an event's function, it counts on
        stats = simulator.stats
        rows += _work(stats) if stats["rhs"] else []
    return Card(f"Simulator of {scene.name} at t = {simulator.state.t:g} s", rows)


# --- words -----------------------------------------------------------------------------------------


def _list(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "none"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _efforts(mechanism: Mechanism) -> tuple[str, str]:
    """Return the units of u and of tau."""
    units = quantity_units(mechanism)
    return f" {joined(units['u'])}", f" {joined(units['tau'])}"


def _largest(values: Array) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
