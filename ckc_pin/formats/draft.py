"""What every reader makes of a file and the writer writes down: a URDF, the loops beside it, and notes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.base.sources import Sources
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.orientation import to_rpy
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

__all__ = ["Draft", "checked_direction", "frame", "number", "safe_name", "some", "unique", "vector"]

T = TypeVar("T")
Noted = list[tuple[T, str]]  # with a comment for the file, or ""

WORDS_WITHOUT_MEANING = ("robot", "model", "scene", "main", "urdf", "mjcf")


@dataclass
class Draft:
    """A mechanism as a reader understood it.

    Attributes
    ----------
    name : str
        Of the mechanism and of its files.
    origin : str
        What it was made from, for the head of the file.
    robot : Element
        The tree as a URDF's <robot>.
    loops, couplings, springs, forces, joints, motors, points : list of (spec, comment)
    independent, actuated : list of str, or None
        None leaves it to the program; `actuated` names the joints of motors too.
    why_independent : str
        Comment on `independent`.
    gravity : (3,) tuple
    q_guess : dict of str to float
    guessed : list of str
        What the file does not say, and what was assumed.
    left_out : list of str
        What the file says and the mechanism does not have.
    """

    name: str
    origin: str
    robot: ElementTree.Element
    loops: Noted[LoopSpec] = field(default_factory=list)
    couplings: Noted[CouplingSpec] = field(default_factory=list)
    springs: Noted[SpringSpec] = field(default_factory=list)
    forces: Noted[ForceSpec] = field(default_factory=list)
    joints: Noted[JointSpec] = field(default_factory=list)
    motors: Noted[MotorSpec] = field(default_factory=list)
    points: Noted[PointSpec] = field(default_factory=list)
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

    def urdf(self) -> str:
        """Return the text of the URDF."""
        ElementTree.indent(self.robot)
        return '<?xml version="1.0"?>\n' + ElementTree.tostring(self.robot, encoding="unicode") + "\n"

    def spec(self) -> MechanismSpec:
        """Return the content of ``mechanism.toml``."""
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

    def tree(self) -> tuple[Tree, Frames, UrdfTree]:
        """Build the tree alone, its frames, and what its checks found."""
        text, urdf = merge([TreeText(self.urdf(), self.urdf_file)])
        try:
            tree = Tree(pin.buildModelFromXML(text))
        except MechanismError as error:
            raise MechanismError(f"{self.name}: {error}") from None
        except (ValueError, RuntimeError) as error:
            raise MechanismError(f"{self.name}: Pinocchio cannot build this tree: {error}") from None
        return tree, Frames(tree.model), urdf

    def mechanism(self) -> Mechanism:
        """Build the mechanism, as `ckc check` will.

        Raises
        ------
        MechanismError
            Loops that do not close, `independent` that cannot serve.
        """
        return assemble_mechanism(self.spec(), Sources(self.name, None, {self.urdf_file: self.urdf()}))


def frame(link: str, pose: pin.SE3) -> Frame:
    """Return a frame at a pose in a link; the link's name alone where that says it all."""
    xyz, rpy = vector(pose.translation), vector(to_rpy(pose.rotation))
    return FrameSpec(link=link, xyz=xyz, rpy=rpy) if any((*xyz, *rpy)) else link


def number(x: float) -> float:
    """Round away what conversions left in the last digits: lengths and angles, not inertias."""
    return 0.0 if abs(x) < 1e-15 else float(f"{x:.15g}")


def vector(values: Iterable[float]) -> Vector3:
    """Return three rounded numbers."""
    x, y, z = (number(float(value)) for value in values)
    return (x, y, z)


def safe_name(path: Path, declared: str = "") -> str:
    """Name a mechanism after its file; after its folder, or as declared, when the file's name says nothing."""
    for candidate in (path.stem, path.absolute().parent.name, declared):
        cleaned = re.sub(r"[^\w-]+", "_", candidate).strip("_-")[:80]
        if cleaned and cleaned.lower() not in WORDS_WITHOUT_MEANING:
            return cleaned
    return "imported"


def some(names: Sequence[str]) -> str:
    """Return a few of many names."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def unique(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number behind it when it is taken."""
    used = set(taken)
    return next(n for n in (name, *(f"{name}_{k}" for k in range(2, len(used) + 3))) if n not in used)


def checked_direction(values: Iterable[float], where: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return a direction, not normalised; InputError when it is none."""
    direction = np.array([float(x) for x in values])
    if not np.linalg.norm(direction) > 0:
        raise InputError(f"{where}: {direction.tolist()} is no direction, all three are zero")
    return direction
