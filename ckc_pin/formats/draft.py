"""An imported mechanism before it is written: a URDF tree, the loops beside it, and notes for the user.

Every reader returns a `Draft`. The module also has what all readers share: names, rounding, rotations.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import (
    CouplingSpec,
    ForceSpec,
    Frame,
    FrameSpec,
    JointSpec,
    LoopSpec,
    MechanismSpec,
    MotorSpec,
    PointSpec,
    SpringSpec,
    Vector3,
)
from ckc_pin.mechanism.tree import Tree
from ckc_pin.mechanism.urdf import TreeText, UrdfTree, merge

__all__ = [
    "Draft",
    "choose_independent",
    "choose_name",
    "from_axis_angle",
    "from_quaternion",
    "from_rpy",
    "list_names",
    "make_frame",
    "make_unique",
    "require_direction",
    "round_number",
    "round_vector",
    "to_rpy",
]

T = TypeVar("T")
WithComment = list[tuple[T, str]]  # each table with its comment in the file; an empty comment is not written

GENERIC_NAMES = ("robot", "model", "scene", "main", "urdf", "mjcf")  # do not identify a mechanism
MAX_NAME_CHARACTERS = 80
MAX_LISTED_NAMES = 6  # in one message
ZERO_TOLERANCE = 1e-15  # smaller lengths (m) and angles (rad) are rounding errors of a conversion


@dataclass
class Draft:
    """A mechanism as a reader understood it, to be written as ``mechanism.toml`` and a URDF.

    Attributes
    ----------
    name : str
        Name of the mechanism, and of its URDF.
    origin : str
        The file that was imported and its format. The first line of ``mechanism.toml`` quotes it.
    robot : Element
        The tree as a URDF's <robot>.
    loops, couplings, springs, forces, joints, motors, points : list of (spec, comment)
        Tables of ``mechanism.toml``.
    independent, actuated : list of str or None
        None: the program chooses them. `actuated` also lists the joints of `motors`.
    why_independent : str
        Comment on `independent`.
    gravity : (3,) tuple
        m/s^2.
    q_guess : dict of str to float
        Start of the assembly by coordinate, rad or m.
    guessed : list of str
        What the file does not say, and what was assumed.
    left_out : list of str
        Content of the file that the mechanism does not have.
    """

    name: str
    origin: str
    robot: ElementTree.Element
    loops: WithComment[LoopSpec] = field(default_factory=list)
    couplings: WithComment[CouplingSpec] = field(default_factory=list)
    springs: WithComment[SpringSpec] = field(default_factory=list)
    forces: WithComment[ForceSpec] = field(default_factory=list)
    joints: WithComment[JointSpec] = field(default_factory=list)
    motors: WithComment[MotorSpec] = field(default_factory=list)
    points: WithComment[PointSpec] = field(default_factory=list)
    independent: list[str] | None = None
    actuated: list[str] | None = None
    why_independent: str = ""
    gravity: Vector3 = (0.0, 0.0, -9.81)
    q_guess: dict[str, float] = field(default_factory=dict)
    guessed: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def urdf_file(self) -> str:
        """Name of the URDF beside ``mechanism.toml``."""
        return f"{self.name}.urdf"

    def urdf_text(self) -> str:
        """Return the text of the URDF."""
        ElementTree.indent(self.robot)
        return '<?xml version="1.0"?>\n' + ElementTree.tostring(self.robot, encoding="unicode") + "\n"

    def to_spec(self) -> MechanismSpec:
        """Return the content of ``mechanism.toml`` as typed structures."""
        return MechanismSpec(
            name=self.name,
            urdf=self.urdf_file,
            gravity=self.gravity,
            independent=self.independent,
            actuated=None if self.motors else self.actuated,
            q_guess=self.q_guess,
            loop=[spec for spec, _ in self.loops],
            coupling=[spec for spec, _ in self.couplings],
            spring=[spec for spec, _ in self.springs],
            force=[spec for spec, _ in self.forces],
            joint=[spec for spec, _ in self.joints],
            motor=[spec for spec, _ in self.motors],
            point=[spec for spec, _ in self.points],
        )

    def build_tree(self) -> tuple[Tree, Frames, UrdfTree]:
        """Build the tree without its loops, and return it with its frames and the checked URDF.

        Raises
        ------
        MechanismError
            Pinocchio cannot build the tree.
        """
        text, urdf = merge([TreeText(self.urdf_text(), self.urdf_file)])
        try:
            tree = Tree(pin.buildModelFromXML(text))
        except MechanismError as error:
            raise MechanismError(f"{self.name}: {error}") from None
        except (ValueError, RuntimeError) as error:
            raise MechanismError(f"{self.name}: Pinocchio cannot build this tree: {error}") from None
        return tree, Frames(tree.model), urdf

    def build_mechanism(self) -> Mechanism:
        """Build and assemble the mechanism, as `ckc check` does for the written files.

        Raises
        ------
        MechanismError
            The loops cannot be closed, or `independent` does not determine the configuration.
        """
        return assemble_mechanism(self.to_spec(), Sources(self.name, None, {self.urdf_file: self.urdf_text()}))


# --- independent coordinates ---------------------------------------------------------------------------------------


def choose_independent(draft: Draft) -> None:
    """Set `draft.independent`: the file's choice if it determines the configuration, otherwise the actuated joints.

    A draft that cannot be assembled is not changed, because the user needs the file's choice to correct its loops.
    """
    if draft.independent is not None:
        declared = draft.independent
        try:
            draft.build_mechanism()
            return
        except MechanismError as error:
            draft.independent = None
            mechanism = _try_to_build(draft)
            if mechanism is None:
                draft.independent = declared
                return
            reason = str(error).removeprefix(f"{draft.name}: ").removeprefix("independent: ")
            draft.guessed.append(f"independent is chosen by the program; the file's choice does not work: {reason}")
    elif draft.actuated and (draft.loops or draft.couplings):
        mechanism = _try_to_build(draft)
        if mechanism is None:
            return
        names = list(mechanism.independent)
        if not set(draft.actuated) <= set(names):
            return
        draft.independent = names
        others = [name for name in names if name not in draft.actuated]
        draft.why_independent = "the actuated joints" + (
            f"; the program chose {', '.join(others)} in addition" if others else ""
        )
        if _try_to_build(draft) is None:
            draft.independent, draft.why_independent = None, ""


def _try_to_build(draft: Draft) -> Mechanism | None:
    try:
        return draft.build_mechanism()
    except MechanismError:
        return None


# --- names and frames ----------------------------------------------------------------------------------------------


def make_frame(link: str, pose: pin.SE3) -> Frame:
    """Return a frame at a pose in a link; only the link's name where the pose is the identity."""
    xyz, rpy = round_vector(pose.translation), round_vector(to_rpy(pose.rotation))
    return FrameSpec(link=link, xyz=xyz, rpy=rpy) if any((*xyz, *rpy)) else link


def choose_name(path: Path, declared: str = "") -> str:
    """Name a mechanism after its file, or after its folder or its declared name where the file's name is generic."""
    for candidate in (path.stem, path.absolute().parent.name, declared):
        cleaned = re.sub(r"[^\w-]+", "_", candidate).strip("_-")[:MAX_NAME_CHARACTERS]
        if cleaned and cleaned.lower() not in GENERIC_NAMES:
            return cleaned
    return "imported"


def list_names(names: Sequence[str]) -> str:
    """Return the first names as text, with the number of names that are not listed."""
    omitted = len(names) - MAX_LISTED_NAMES
    return ", ".join(names[:MAX_LISTED_NAMES]) + (f" and {omitted} more" if omitted > 0 else "")


def make_unique(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number appended if it is already taken."""
    used = set(taken)
    return next(n for n in (name, *(f"{name}_{k}" for k in range(2, len(used) + 3))) if n not in used)


# --- numbers -------------------------------------------------------------------------------------------------------


def round_number(x: float) -> float:
    """Round a length or angle to 15 digits, which removes the rounding errors of a conversion.

    Masses and inertias are not rounded: small ones are not errors.
    """
    return 0.0 if abs(x) < ZERO_TOLERANCE else float(f"{x:.15g}")


def round_vector(values: Iterable[float]) -> Vector3:
    """Return three numbers, rounded by `round_number`."""
    x, y, z = (round_number(float(value)) for value in values)
    return (x, y, z)


def require_direction(values: Iterable[float], where: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return a direction, not normalized.

    Raises
    ------
    InputError
        All three numbers are zero.
    """
    direction = np.array([float(x) for x in values])
    if not np.linalg.norm(direction) > 0:
        raise InputError(f"{where}: expected a direction, got {direction.tolist()}")
    return direction


# --- rotations -----------------------------------------------------------------------------------------------------


def from_quaternion(quaternion: Sequence[float]) -> Array:
    """Return the rotation matrix of a quaternion (w, x, y, z), which need not be normalized."""
    return np.array(pin.Quaternion(*map(float, quaternion)).normalized().matrix())


def from_axis_angle(axis: Array, angle: float) -> Array:
    """Return the rotation matrix for an angle (rad) about an axis, which need not be normalized."""
    return np.array(pin.AngleAxis(float(angle), np.asarray(axis, dtype=float) / np.linalg.norm(axis)).matrix())


def from_rpy(rpy: Sequence[float]) -> Array:
    """Return the rotation matrix of a URDF's roll, pitch and yaw (rad)."""
    return np.array(pin.rpy.rpyToMatrix(*map(float, rpy)))


def to_rpy(rotation: Array) -> tuple[float, float, float]:
    """Return a URDF's roll, pitch and yaw (rad) of a rotation matrix.

    At a pitch of +-90 degrees only the sum or difference of roll and yaw is determined; one of the solutions is
    returned.
    """
    roll, pitch, yaw = map(float, pin.rpy.matrixToRpy(np.ascontiguousarray(rotation)))
    return roll, pitch, yaw
