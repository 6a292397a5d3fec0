"""What there is to know about a mechanism or a scene before running it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.control.torques import Torques
from ckc_pin.errors import CkcError, InputError
from ckc_pin.generated.library import find
from ckc_pin.kinematics.branches import assembly_branches
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.card import Card, Shown
from ckc_pin.mechanism.findings import acting_joints, findings, moving_mass, outside_limits
from ckc_pin.mechanism.kinds import require_flag, require_kind, require_table
from ckc_pin.mechanism.library import is_path
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.cards import check_card
from ckc_pin.simulation.initial import Start, find_start
from ckc_pin.simulation.linear_report import stability_warning
from ckc_pin.simulation.runnable import require_runnable
from ckc_pin.simulation.scene import CHANGES, SUFFIX, Scene, load_scene
from ckc_pin.simulation.scene_parts import in_samples, scene_actuation, scene_controller, scene_mechanism
from ckc_pin.simulation.scene_spec import TermsOf
from ckc_pin.simulation.stability import stability
from ckc_pin.simulation.stability_result import Stability
from ckc_pin.simulation.workspace import DesiredCheck, follow_desired

__all__ = ["Check", "check", "names_a_scene", "run_warnings"]

MARGIN = 0.1  # of sigma_min(phi_z) at the assembled configuration: nearer to singular than that is worth a warning


@dataclass(frozen=True, repr=False)
class Check(Shown):
    """Findings on a mechanism, and on a scene's desired trajectory.

    Attributes
    ----------
    name : str
        What was checked.
    n, d, rows, rank : int
        Coordinates, freedoms, rows of phi, rank of J at the assembled configuration.
    redundant : tuple of str
        Rows that the others imply, one admissible choice.
    independent, dependent, coordinates : tuple of str
    units : tuple of str
        "rad" or "m", by coordinate.
    q_tree : (n,) array
        The assembled configuration.
    det_phi_z : float or None
        None unless phi_z is square.
    sigma_min_phi_z, cond_phi_z : float
    gap : (above, below)
        Relative singular values of the scaled J around the cut that the rank is.
    mass : float
        Of all bodies that move, kg.
    inertia : (3, 3) array
        Theirs as assembled, about their centre of mass, in the world's axes, kg m^2.
    joints : dict of str to dict
        Joints with armature, dry friction or stops: these, damping and restitution by name.
    warnings : tuple of str
    terms : "pinocchio" or "generated"
        Whose terms a run takes: the scene's choice; without one, "generated" where they were compiled before.
    desired : DesiredCheck or None
        For a scene with a controller.
    stability : Stability or None
        Of its closed loop, for a scene with a set point or tracking.
    branches : (k, n) array or None
        Closed configurations at the assembled q, when asked for; the assembled one first.
    """

    name: str
    n: int
    d: int
    rows: int
    rank: int
    redundant: tuple[str, ...]
    independent: tuple[str, ...]
    dependent: tuple[str, ...]
    coordinates: tuple[str, ...]
    units: tuple[str, ...]
    q_tree: Array
    det_phi_z: float | None
    sigma_min_phi_z: float
    cond_phi_z: float
    gap: tuple[float, float]
    mass: float
    inertia: Array
    joints: dict[str, dict[str, float]]
    warnings: tuple[str, ...]
    terms: str
    desired: DesiredCheck | None = None
    stability: Stability | None = None
    branches: Array | None = None

    def card(self) -> Card:
        """Return what there is to see of it."""
        return check_card(self)


def check(
    what: Mechanism | Scene | str | Path, changes: Mapping[str, Any] | None = None, *, branches: bool = False
) -> Check:
    """Check a mechanism, or a scene with its mechanism.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
        "five_bar" is a mechanism, "five_bar/tracking" and "x.scene.toml" are scenes.
    changes : mapping, optional
        With a name: of a scene as `load_scene` takes them, of a mechanism as `load` does.
    branches : bool
        List the assembly branches too (small mechanisms).

    Raises
    ------
    InputError, MechanismError
        It cannot exist as described. Findings about one that can are not errors.
    """
    require_kind(what, (Mechanism, Scene, str, Path), "check: what", "a mechanism or a scene: itself, its name or path")
    require_flag(branches, "check: branches")
    if changes is not None:
        require_table(changes, "check: changes", CHANGES)
    if isinstance(what, str | Path):
        what = load_scene(what, changes) if names_a_scene(str(what)) else load(what, changes)
    elif changes:
        raise InputError("check: changes go with a name; a Scene or a Mechanism is complete")
    if isinstance(what, Mechanism):
        outside = _limits(what, what.q_tree, "the assembled configuration")
        found = _mechanism_check(what, None, outside, "auto", what.name)
        return replace(found, branches=_branches(what)) if branches else found
    mechanism = scene_mechanism(what)
    controller, actuation = scene_controller(what, mechanism), scene_actuation(what, mechanism)
    start: Start | None = None
    try:
        start, refused = require_runnable(what, mechanism, in_samples(what, controller), actuation), ""
    except CkcError as error:
        refused = str(error)
    desired = _desired(controller, mechanism, what.spec.t_end, start)
    stable = None
    if isinstance(controller, SetPoint | Tracking):
        stable = _stability(what, controller, actuation, start, desired, refused)
    warnings = [] if start is None else _limits(mechanism, start.at.q_tree, "the start")
    warnings += _desired_warnings(mechanism, desired, what.spec.t_end)
    if stable is None:
        warnings += [refused] if refused else []
    elif desired is None or desired.leaves_at is None:
        warnings += stability_warning(stable, mechanism.independent)
    found = _mechanism_check(mechanism, desired, warnings, what.spec.solver.terms, what.name)
    found = replace(found, stability=stable)
    return replace(found, branches=_branches(mechanism)) if branches else found


def _stability(
    scene: Scene,
    controller: SetPoint | Tracking,
    actuation: Actuation,
    start: Start | None,
    desired: DesiredCheck | None,
    refused: str,
) -> Stability:
    mechanism, spec = actuation.mechanism, scene.spec
    if start is None:
        return Stability(None, f"a run does not begin: {refused}")
    if desired is not None and desired.leaves_at is not None:
        return Stability(None, f"the desired trajectory leaves the workspace at t = {desired.leaves_at:.5f} s")
    library = None if spec.solver.terms == "pinocchio" else find(mechanism)
    clocked = in_samples(scene, controller)
    found = stability(
        mechanism,
        controller,
        spec.t_end,
        spec.friction_smoothing,
        (clocked.sample_time, clocked.delay) if isinstance(clocked, Sampled) else None,
        library,
        start.at,
        actuation,
    )
    return replace(found, leaves_out=_leaves_out(scene, actuation))


def run_warnings(scene: Scene) -> list[str]:
    """Return what of a controlled scene's check may spoil a run of it: its start, its desired trajectory."""
    if scene.spec.controller is None:
        return []
    mechanism = scene_mechanism(scene)
    try:
        start = find_start(mechanism, scene)
    except CkcError:  # the run says so itself
        return []
    desired = _desired(scene_controller(scene, mechanism), mechanism, scene.spec.t_end, start)
    outside = _limits(mechanism, start.at.q_tree, "the start")
    return outside + _desired_warnings(mechanism, desired, scene.spec.t_end)


def _branches(mechanism: Mechanism) -> Array:
    found = assembly_branches(mechanism)
    return np.array([mechanism.tree.to_coordinates(at.q_tree) for at in found])


def names_a_scene(name: str) -> bool:
    """Whether a name or path is meant as a scene's, not a mechanism's."""
    if is_path(name):
        return name.endswith(SUFFIX)
    return "/" in name or isfile(f"{name}{SUFFIX}")


def _mechanism_check(
    mechanism: Mechanism, desired: DesiredCheck | None, warnings: list[str], terms: TermsOf, name: str
) -> Check:
    if terms == "auto":
        terms = "generated" if find(mechanism) else "pinocchio"
    at = mechanism.assembled
    values = np.linalg.svd(at.phi_z, compute_uv=False) if mechanism.dependent else np.ones(1)
    mass, inertia = moving_mass(mechanism)
    square = at.phi_z.shape[0] == at.phi_z.shape[1]
    return Check(
        name=name,
        n=mechanism.n,
        d=mechanism.d,
        rows=mechanism.closure.rows,
        rank=mechanism.rank,
        redundant=mechanism.redundant,
        independent=mechanism.independent,
        dependent=mechanism.dependent,
        coordinates=mechanism.coordinates,
        units=tuple(mechanism.tree.units()),
        q_tree=mechanism.tree.to_coordinates(mechanism.q_tree),
        det_phi_z=float(np.linalg.det(at.phi_z)) if square else None,
        sigma_min_phi_z=float(values[-1]),
        cond_phi_z=float(values[0] / values[-1]) if values[-1] > 0 else float("inf"),
        gap=(mechanism.freedoms.rank.above, mechanism.freedoms.rank.below),
        mass=mass,
        inertia=inertia,
        joints=acting_joints(mechanism),
        warnings=(*mechanism.warnings, *findings(mechanism), *warnings),
        terms=terms,
        desired=desired,
    )


def _desired(
    controller: SetPoint | Tracking | Torques | None, mechanism: Mechanism, t_end: float, start: Start | None
) -> DesiredCheck | None:
    near = None if start is None else start.at
    if isinstance(controller, Tracking):
        return follow_desired(mechanism, controller.desired, t_end, near)
    if isinstance(controller, SetPoint):
        target = sigma(mechanism, controller.q_d, near)
        return DesiredCheck(None, 0.0, target.at.sigma_min()) if target.verdict == "converged" else None
    return None


def _leaves_out(scene: Scene, actuation: Actuation) -> tuple[str, ...]:
    """What of a scene stands between a run and the linear model of its closed loop."""
    spec, joints = scene.spec.controller, actuation.mechanism.joints
    there = {
        "sensor and drive": isinstance(spec, FeedbackSpec) and (spec.sensor or spec.drive) is not None,
        "torque limits": bool(np.isfinite(actuation.limit).any()),
        "stops": bool(joints.stopped.any()),
        "dry friction": bool(joints.friction.any()) and scene.spec.friction_smoothing is None,
    }
    return tuple(name for name, is_there in there.items() if is_there)


def _limits(mechanism: Mechanism, q_tree: Array, what: str) -> list[str]:
    outside = outside_limits(mechanism, q_tree)
    return [f"{what} is outside joint limits: {', '.join(outside)}"] if outside else []


def _desired_warnings(mechanism: Mechanism, desired: DesiredCheck | None, t_end: float) -> list[str]:
    if desired is None:
        return []
    if desired.leaves_at is not None:
        return [
            f"the desired trajectory leaves the workspace at t = {desired.leaves_at:.5f} s: "
            f"{', '.join(mechanism.independent)} cannot follow it from there"
        ]
    says = []
    if desired.until < t_end:
        says.append(
            f"the desired trajectory is so quick that it was followed to t = {desired.until:.5g} s only: whether it "
            "leaves the workspace later is not known"
        )
    usual = mechanism.assembled.sigma_min()
    if desired.sigma_min < MARGIN * usual:
        says.append(
            f"the desired trajectory comes close to a singular configuration at t = {desired.closest_t:.5f} s: "
            f"sigma_min(phi_z) = {desired.sigma_min:.3g} there, {usual:.3g} as assembled"
        )
    return says
