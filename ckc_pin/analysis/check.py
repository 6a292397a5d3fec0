"""Check a mechanism or a scene before running it: freedoms, rank, partition, warnings, workspace, stability."""

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
from ckc_pin.control.spec import SampledSpec
from ckc_pin.control.workspace import DesiredCheck
from ckc_pin.errors import CkcError, InputError
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import assembly_branches
from ckc_pin.linear.closed_loop import LAWS
from ckc_pin.linear.stability import stability
from ckc_pin.linear.stability_result import Stability
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import compute_moving_mass, describe_joints
from ckc_pin.run.checks import check_desired, desired_warnings, limit_warnings, require_runnable, start_warnings
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.initial import Start
from ckc_pin.scene.names import is_scene_name
from ckc_pin.scene.overrides import EXPECTED_OVERRIDES
from ckc_pin.scene.parts import apply_sampling, build_scene_actuation, build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["Check", "check"]

INERTIA_AXES = tuple(combinations_with_replacement(enumerate("xyz"), 2))


@dataclass(frozen=True, repr=False)
class Check(HasSummary):
    """Properties of a mechanism, warnings, and for a scene its desired trajectory and closed loop.

    Attributes
    ----------
    name : str
        Of the mechanism or scene.
    n, d, rows, rank : int
        Coordinates, freedoms, rows of phi, rank of J at the assembled configuration.
    redundant : tuple of str
        Rows that depend on the others, one admissible choice.
    independent, dependent, coordinates : tuple of str
    units : tuple of str
        "rad" or "m", by coordinate.
    q_tree : (n,) array
        The assembled configuration.
    det_phi_z : float or None
        None unless phi_z is square.
    sigma_min_phi_z, cond_phi_z : float
        Smallest singular value and condition number of phi_z.
    size : float
        Largest distance between neighbouring joints, or from a joint to a loop's frame, m.
    gap : (above, below)
        Relative singular values of the scaled J on both sides of the rank decision.
    mass : float
        Of all moving bodies, kg.
    inertia : (3, 3) array
        Of all moving bodies as assembled, about their centre of mass, in the world's axes, kg m^2.
    joints : dict of str to dict
        By name, the armature, damping, friction, stops and restitution of joints with armature, dry friction or stops.
    warnings : tuple of str
    terms : "pinocchio" or "generated"
        Terms that a run uses: the scene's choice. Without a scene, "generated" if a compiled library exists.
    desired : DesiredCheck or None
        For a scene with a controller.
    stability : Stability or None
        Of the closed loop, for a scene with a set point or tracking.
    branches : (k, n) array or None
        Closed configurations at the assembled q, if requested; the assembled one first.
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
    size: float
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
        """Return the properties and warnings, with the numbers of freedoms and warnings as title."""
        redundant = f", redundant: {', '.join(self.redundant)}" if self.redundant else ""
        inertia = [f"i{a}{b} = {self.inertia[i, j]:.6g}" for (i, a), (j, b) in INERTIA_AXES]
        rows: list[Row] = [
            ("coordinates n", str(self.n)),
            ("freedoms d", str(self.d)),
            ("closure rows, rank", f"{self.rows}, {self.rank}{redundant}"),
            ("singular values", f"{self.gap[0]:.2e} | {self.gap[1]:.2e} around the cut (relative, scaled J)"),
            ("independent q", _join(self.independent)),
            ("dependent z", _join(self.dependent)),
            ("assembled at", format_quantities(self.coordinates, self.q_tree, self.units)),
        ]
        if self.det_phi_z is not None:
            rows.append(("det phi_z", f"{self.det_phi_z:.6g}"))
        rows += [
            ("sigma_min(phi_z), cond", f"{self.sigma_min_phi_z:.6g}, {self.cond_phi_z:.4g}"),
            ("size, moving mass", f"{self.size:.4g} m, {self.mass:.6g} kg"),
            ("its inertia, kg m²", inertia),
            ("", "as assembled, about its centre of mass, world's axes"),
            ("terms", self.terms),
        ]
        for k, branch in enumerate(self.branches if self.branches is not None else ()):
            rows.append((f"branch {k + 1}", format_quantities(self.coordinates, branch, self.units)))
        if self.desired is not None and self.desired.leaves_at is None:
            closest = f"stays inside; closest to singular at t = {self.desired.closest_t:.4f} s"
            rows.append(("desired", f"{closest}, sigma_min(phi_z) = {self.desired.sigma_min:.4g}"))
        elif self.desired is not None:
            rows.append(("desired", f"leaves the workspace at t = {self.desired.leaves_at:.5f} s"))
        if self.stability is not None:
            rows.append(("closed loop", self.stability.describe()))
        units = dict(zip(self.coordinates, self.units, strict=True))
        rows += [(f"joint {name}", _describe_joint(joint, units[name])) for name, joint in self.joints.items()]
        rows += [("warning", warning) for warning in self.warnings]
        title = f"{self.name}: {_count(self.d, 'freedom')}, {_count(len(self.warnings), 'warning')}"
        return Summary(title, rows)

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
        Values by dotted key, for a scene as in `load_scene`, for a mechanism's name or path as in `load`.
    branches : bool
        List the assembly branches, too. Small mechanisms only.

    Returns
    -------
    Check
        With warnings, which are not errors.

    Raises
    ------
    InputError, MechanismError
        The mechanism or scene is invalid.
    """
    require_type(what, (Mechanism, Scene, str, Path), "check: what", "a mechanism or a scene: itself, its name or path")
    require_flag(branches, "check: branches")
    if overrides is not None:
        require_table(overrides, "check: overrides", EXPECTED_OVERRIDES)
    if isinstance(what, str | Path):
        what = load_scene(what, overrides) if is_scene_name(str(what)) else load(what, overrides)
    elif isinstance(what, Scene):
        what = what.with_overrides(overrides)
    elif overrides:
        raise InputError("check: overrides: expected none with a Mechanism; give its name or path instead")
    if isinstance(what, Mechanism):
        mechanism = what
        warnings = limit_warnings(mechanism, mechanism.q_tree, "the assembled configuration")
        result = _check_mechanism(mechanism, warnings)
    else:
        mechanism = load_scene_mechanism(what)
        result = _check_scene(what, mechanism)
    if branches:
        configurations = [mechanism.tree.to_coordinates(at.q_tree) for at in assembly_branches(mechanism)]
        result = replace(result, branches=np.array(configurations))
    return result


def _check_mechanism(mechanism: Mechanism, warnings: list[str]) -> Check:
    """Return the properties of a mechanism, its own warnings, and further warnings."""
    terms = "generated" if find_compiled_terms(mechanism) else "pinocchio"
    at = mechanism.assembled
    singular_values = np.linalg.svd(at.phi_z, compute_uv=False) if mechanism.dependent else np.ones(1)
    largest, smallest = float(singular_values[0]), float(singular_values[-1])
    mass, inertia = compute_moving_mass(mechanism)
    is_square = at.phi_z.shape[0] == at.phi_z.shape[1]
    return Check(
        name=mechanism.name,
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
        det_phi_z=float(np.linalg.det(at.phi_z)) if is_square else None,
        sigma_min_phi_z=smallest,
        cond_phi_z=largest / smallest if smallest > 0 else float("inf"),
        size=mechanism.size,
        gap=(mechanism.freedoms.rank.above, mechanism.freedoms.rank.below),
        mass=mass,
        inertia=inertia,
        joints=describe_joints(mechanism),
        warnings=(*mechanism.warnings, *warnings),
        terms=terms,
    )


def _check_scene(scene: Scene, mechanism: Mechanism) -> Check:
    spec = scene.spec
    controller, actuation = build_scene_controller(scene, mechanism), build_scene_actuation(scene, mechanism)
    start, error_message = None, ""
    try:
        start = require_runnable(scene, mechanism, apply_sampling(scene, controller), actuation)
    except CkcError as error:
        error_message = str(error)
    desired = check_desired(controller, mechanism, spec.t_end, start)
    leaves_workspace = desired is not None and desired.leaves_at is not None
    warnings = [] if start is None else start_warnings(scene, mechanism, start)
    warnings += desired_warnings(mechanism, desired, spec.t_end)
    if mechanism.prescribed and mechanism.d == 0 and start is not None:  # the motion does not depend on any force
        run = simulate(scene, {"formulation": "reduced"})
        if run.status == "stopped":
            warnings.append(f"the prescribed motion cannot be followed beyond t = {run.t[-1]:.5g} s: {run.message}")
    closed_loop = None
    if isinstance(controller, SetPoint | Tracking) and type(controller) in LAWS:
        closed_loop = _check_stability(scene, controller, actuation, start, desired, error_message)
    if closed_loop is None:
        warnings += [error_message] if error_message else []
    elif not leaves_workspace:
        warnings += closed_loop.list_warnings(mechanism.independent)
    result = _check_mechanism(mechanism, warnings)
    terms = result.terms if spec.solver.terms == "auto" else spec.solver.terms
    return replace(result, name=scene.name, terms=terms, desired=desired, stability=closed_loop)


def _check_stability(
    scene: Scene,
    controller: SetPoint | Tracking,
    actuation: Actuation,
    start: Start | None,
    desired: DesiredCheck | None,
    error_message: str,
) -> Stability:
    mechanism, spec = actuation.mechanism, scene.spec
    if start is None:
        return Stability(None, f"a run cannot start: {error_message}")
    if scene.has_forces:
        return Stability(None, "the linear model has no forces on links")
    if desired is not None and desired.leaves_at is not None:
        return Stability(None, f"the desired trajectory leaves the workspace at t = {desired.leaves_at:.5f} s")
    sampled = apply_sampling(scene, controller)
    result = stability(
        mechanism,
        controller,
        spec.t_end,
        smoothing=spec.friction_smoothing,
        sampling=(sampled.sample_time, sampled.delay) if isinstance(sampled, Sampled) else None,
        library=None if spec.solver.terms == "pinocchio" else find_compiled_terms(mechanism),
        start=start.at,
        actuation=actuation,
    )
    return replace(result, leaves_out=_omitted_parts(scene, actuation))


def _omitted_parts(scene: Scene, actuation: Actuation) -> tuple[str, ...]:
    """Return the parts of a scene that the linear model of its closed loop leaves out."""
    spec, joints = scene.spec.controller, actuation.mechanism.joints
    parts = {
        "sensor and drive": isinstance(spec, SampledSpec) and (spec.sensor or spec.drive) is not None,
        "torque limits": bool(np.isfinite(actuation.limit).any()),
        "stops": bool(joints.stopped.any()),
        "dry friction": bool(joints.friction.any()) and scene.spec.friction_smoothing is None,
    }
    return tuple(name for name, is_present in parts.items() if is_present)


def _describe_joint(joint: dict[str, float], unit: str) -> list[str]:
    """Return armature, damping, friction, stops and restitution of a joint with their units."""
    is_angle = unit == "rad"
    units = {
        "armature": "kg m²" if is_angle else "kg",
        "damping": "N m s/rad" if is_angle else "N s/m",
        "friction": "N m" if is_angle else "N",
    }
    items = [f"{key} {joint[key]:g} {key_unit}" for key, key_unit in units.items() if joint[key]]
    if math.isfinite(joint["lower"]) or math.isfinite(joint["upper"]):
        items += [f"stops {joint['lower']:.6g} to {joint['upper']:.6g} {unit}", f"restitution {joint['restitution']:g}"]
    return items


def _join(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "none"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
