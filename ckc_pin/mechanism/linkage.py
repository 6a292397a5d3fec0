"""The `Linkage`: what a mechanism's files say, before it is assembled."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.base.sources import Sources
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.closure import Closure, ClosureBuilder
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.joints import Joints
from ckc_pin.mechanism.motors import motors_of
from ckc_pin.mechanism.parameters import Overrides, changed
from ckc_pin.mechanism.spec import CouplingSpec, MechanismSpec
from ckc_pin.mechanism.springs import Springs
from ckc_pin.mechanism.tree import Tree
from ckc_pin.mechanism.urdf import TreeText, merge

__all__ = ["Linkage"]

LARGEST = 1e100  # m: squares of what is larger overflow, and their products


class Linkage:
    """A tree and the loops that close it.

    Parameters
    ----------
    spec : MechanismSpec
        The content of ``mechanism.toml``.
    sources : Sources
        Where the texts of its URDFs come from.
    overrides : mapping
        Numbers that are other ones, by name (`mechanism.parameters`).

    Raises
    ------
    MechanismError
        Unknown names, a tree or loops that cannot exist.

    Attributes
    ----------
    urdf : UrdfTree
        All trees in one.
    tree, closure, frames, joints, springs : Tree, Closure, Frames, Joints, Springs
    motors : Motors or None
        None where the file names none.
    points : dict of str to Frame
    urdf : UrdfTree
        All trees in one.
    size : float
        Characteristic length, metres.
    warnings : list of str
    """

    def __init__(self, spec: MechanismSpec, sources: Sources, overrides: Overrides | None = None) -> None:
        text, urdf = merge(_tree_texts(spec, sources))
        self.warnings = list(urdf.warnings)
        if overrides:
            spec, warnings = changed(spec, urdf.root, overrides, sources.name)
            self.warnings += warnings
            text = ElementTree.tostring(urdf.root, encoding="unicode")
        self.spec, self.sources, self.urdf = spec, sources, urdf
        self.tree = Tree(_build_model(text, sources.name))
        self.tree.model.gravity.linear = np.array(spec.gravity)
        self.frames = Frames(self.tree.model)
        builder = ClosureBuilder(self.tree, self.frames)
        for loop in spec.loop:
            builder.add_loop(loop)
        mimic = [CouplingSpec(joint=a, other=b, ratio=r, offset=c) for a, b, r, c in urdf.mimic]
        for coupling in [*spec.coupling, *mimic]:
            builder.add_coupling(coupling)
        self.closure: Closure = builder.build()
        self.joints = Joints(self.tree, spec.joint)
        self.motors = motors_of(spec, self.tree)
        self.springs = Springs(self.tree, self.frames, spec.spring, spec.force)
        self.points = {p.name: self.frames.find(p.frame, f"point {p.name!r}") for p in spec.point}
        if len(self.points) < len(spec.point):
            raise MechanismError("point: two points have the same name")
        self.size = _size(self.tree, self.closure, sources.name)
        self.tree.measure(self.size)
        self.warnings += self.joints.warnings


def _tree_texts(spec: MechanismSpec, sources: Sources) -> list[TreeText]:
    if (spec.urdf is None) == (not spec.tree):
        raise InputError(f'{sources.name}: give either urdf = "FILE" or [[tree]] entries')
    if spec.urdf is not None:
        return [TreeText(sources.text(spec.urdf), spec.urdf)]
    return [TreeText(sources.text(t.file), t.file, t.prefix, t.root, t.parent, t.xyz, t.rpy) for t in spec.tree]


def _build_model(text: str, source: str) -> pin.Model:
    try:
        return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise MechanismError(f"{source}: Pinocchio cannot build this tree: {error}") from None


def _size(tree: Tree, closure: Closure, source: str) -> float:
    """Characteristic length: the largest offset between joints, or from a joint to a loop's point, metres."""
    offsets = [placement.translation for placement in tree.model.jointPlacements]
    parts = np.array([*offsets, *closure.anchors.point_local]).reshape(-1, 3)
    if not np.abs(parts).max(initial=0.0) <= LARGEST:
        raise MechanismError(
            f"{source}: offsets of joints or loops of {np.abs(parts).max():g} m, more than {LARGEST:g}: units?"
        )
    return float(np.linalg.norm(parts, axis=1).max(initial=0.0)) or 1.0
