"""What there is to know about a mechanism or a scene before running it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.validation import require_flag, require_table, require_type
from ckc_pin.codegen.library import find_compiled_terms
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.control.workspace import DesiredCheck
from ckc_pin.errors import CkcError, InputError
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import assembly_branches
from ckc_pin.linear.stability import stability
from ckc_pin.linear.stability_result import Stability
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import compute_moving_mass, describe_joints, find_model_warnings
from ckc_pin.run.checks import check_desired, desired_warnings, limit_warnings, require_runnable
from ckc_pin.scene.initial import Start
from ckc_pin.scene.parts import apply_sampling, build_scene_actuation, build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import EXPECTED_OVERRIDES, Scene, is_scene_name, load_scene
from ckc_pin.scene.spec import TermsOf

__all__ = ["Check", "check"]

AXES = tuple(combinations_with_replacement(enumerate("xyz"), 2))


@dataclass(frozen=True, repr=False)
class Check(HasSummary):
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

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return check_summary(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the check as JSON-ready data."""
        arrays = {
            "q_tree": self.q_tree.tolist(),
            "inertia": self.inertia.tolist(),
            "branches": None if self.branches is None else self.branches.tolist(),
            "stability": None if self.stability is None else self.stability.to_dict(),
        }
        return asdict(self) | arrays


def check(
    what: Mechanism | Scene | str | Path, overrides: Mapping[str, Any] | None = None, *, branches: bool = False
) -> Check:
    """Check a mechanism, or a scene with its mechanism.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
        "five_bar" is a mechanism, "five_bar/tracking" and "x.scene.toml" are scenes.
    overrides : mapping, optional
        With a name: of a scene as `load_scene` takes them, of a mechanism as `load` does.
    branches : bool
        List the assembly branches too (small mechanisms).

    Raises
    ------
    InputError, MechanismError
        It cannot exist as described. Findings about one that can are not errors.
    """
    require_type(what, (Mechanism, Scene, str, Path), "check: what", "a mechanism or a scene: itself, its name or path")
    require_flag(branches, "check: branches")
    if overrides is not None:
        require_table(overrides, "check: overrides", EXPECTED_OVERRIDES)
    if isinstance(what, str | Path):
        what = load_scene(what, overrides) if is_scene_name(str(what)) else load(what, overrides)
    elif overrides:
        raise InputError("check: overrides go with a name; a Scene or a Mechanism is complete")
    if isinstance(what, Mechanism):
        outside = limit_warnings(what, what.q_tree, "the assembled configuration")
        found = _mechanism_check(what, None, outside, "auto", what.name)
        return replace(found, branches=_branches(what)) if branches else found
    mechanism = load_scene_mechanism(what)
    controller, actuation = build_scene_controller(what, mechanism), build_scene_actuation(what, mechanism)
    start: Start | None = None
    try:
        start, refused = require_runnable(what, mechanism, apply_sampling(what, controller), actuation), ""
    except CkcError as error:
        refused = str(error)
    desired = check_desired(controller, mechanism, what.spec.t_end, start)
    stable = None
    if isinstance(controller, SetPoint | Tracking):
        stable = _stability(what, controller, actuation, start, desired, refused)
    warnings = [] if start is None else limit_warnings(mechanism, start.at.q_tree, "the start")
    warnings += desired_warnings(mechanism, desired, what.spec.t_end)
    if stable is None:
        warnings += [refused] if refused else []
    elif desired is None or desired.leaves_at is None:
        warnings += stable.list_warnings(mechanism.independent)
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
    library = None if spec.solver.terms == "pinocchio" else find_compiled_terms(mechanism)
    clocked = apply_sampling(scene, controller)
    found = stability(
        mechanism,
        controller,
        spec.t_end,
        smoothing=spec.friction_smoothing,
        sampling=(clocked.sample_time, clocked.delay) if isinstance(clocked, Sampled) else None,
        library=library,
        start=start.at,
        actuation=actuation,
    )
    return replace(found, leaves_out=_leaves_out(scene, actuation))


def _branches(mechanism: Mechanism) -> Array:
    found = assembly_branches(mechanism)
    return np.array([mechanism.tree.to_coordinates(at.q_tree) for at in found])


def _mechanism_check(
    mechanism: Mechanism, desired: DesiredCheck | None, warnings: list[str], terms: TermsOf, name: str
) -> Check:
    if terms == "auto":
        terms = "generated" if find_compiled_terms(mechanism) else "pinocchio"
    at = mechanism.assembled
    values = np.linalg.svd(at.phi_z, compute_uv=False) if mechanism.dependent else np.ones(1)
    mass, inertia = compute_moving_mass(mechanism)
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
        joints=describe_joints(mechanism),
        warnings=(*mechanism.warnings, *find_model_warnings(mechanism), *warnings),
        terms=terms,
        desired=desired,
    )


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


def check_summary(found: Check) -> Summary:
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
        ("assembled at", format_quantities(found.coordinates, found.q_tree, found.units)),
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
        rows.append((f"branch {k + 1}", format_quantities(found.coordinates, numbers, found.units)))
    if found.desired is not None and found.desired.leaves_at is None:
        closest = f"stays inside; closest to singular at t = {found.desired.closest_t:.4f} s"
        rows.append(("desired", f"{closest}, sigma_min(phi_z) = {found.desired.sigma_min:.4g}"))
    elif found.desired is not None:
        rows.append(("desired", f"leaves the workspace at t = {found.desired.leaves_at:.5f} s"))
    if found.stability is not None:
        rows.append(("closed loop", found.stability.describe()))
    units = dict(zip(found.coordinates, found.units, strict=True))
    rows += [(f"joint {name}", _of_joint(joint, units[name])) for name, joint in found.joints.items()]
    rows += [("warning", warning) for warning in found.warnings]
    return Summary(f"{found.name}: {_count(found.d, 'freedom')}, {_count(len(found.warnings), 'warning')}", rows)


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


def _list(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "none"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
