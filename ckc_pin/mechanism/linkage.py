"""The `Linkage`: tree, loops, springs and motors of a mechanism file, before the loops are assembled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec, MechanismSpec
from ckc_pin.mechanism.springs import Springs
from ckc_pin.mechanism.tree import Tree
from ckc_pin.mechanism.urdf import TreeText, merge

__all__ = ["Linkage", "tree_texts"]

MAX_OFFSET_M = 1e100  # products of squares of larger lengths overflow


class Linkage:
    """The parts of a mechanism that do not depend on its assembled configuration.

    Parameters
    ----------
    spec : MechanismSpec
        The content of ``mechanism.toml``.
    sources : Sources
        The texts of its URDFs.
    overrides : mapping
        Parameter values by name (`mechanism.parameters`) that replace those of the files.

    Raises
    ------
    MechanismError
        Unknown names, or a tree or loops that cannot exist.

    Attributes
    ----------
    urdf : UrdfTree
        All trees of the file, merged into one.
    tree, closure, frames, joints, springs : Tree, Closure, Frames, Joints, Springs
    overrides : dict
        Parameter values that replace those of the files.
    prescribed : tuple of str
        Names of the prescribed joints.
    motors : Motors or None
        None if the file names no motors.
    couplings : tuple of CouplingSpec
        Of the mechanism file, then those of the URDFs' mimic joints.
    points : dict of str to Frame
    size : float
        Characteristic length, metres.
    warnings : list of str
    """

    def __init__(
        self,
        spec: MechanismSpec,
        sources: Sources,
        overrides: Overrides | None = None,
        prescribed: Mapping[str, float] | None = None,
    ) -> None:
        urdf = merge(tree_texts(spec, sources))
        self.warnings = list(urdf.warnings)
        if overrides:
            spec, warnings = changed(spec, urdf.root, overrides, sources.name)
            self.warnings += warnings
        self.spec, self.sources, self.urdf, self.overrides = spec, sources, urdf, dict(overrides or {})
        model = _build_model(ElementTree.tostring(urdf.root, encoding="unicode"), sources.name)
        model.gravity.linear = np.array(spec.gravity)
        self.frames = Frames(model)
        self.size = _characteristic_length(model, self.frames, spec.loop, sources.name)
        self.tree = Tree(model, self.size)
        builder = ClosureBuilder(self.tree, self.frames)
        for loop in spec.loop:
            builder.add_loop(loop)
        mimic = [CouplingSpec(joint=a, other=b, ratio=r, offset=c) for a, b, r, c in urdf.mimic]
        self.couplings = (*spec.coupling, *mimic)
        names = [loop.name for loop in spec.loop]
        names += [coupling.name for coupling in self.couplings if coupling.name is not None]
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice is not None:
            raise MechanismError(f"coupling: two couplings, or a coupling and a loop, have the same name {twice!r}")
        for coupling in self.couplings:
            builder.add_coupling(coupling)
        for joint, value in (prescribed or {}).items():
            builder.add_prescribed(joint, value)
        self.prescribed = tuple(prescribed or ())
        self.closure: Closure = builder.build()
        self.joints = Joints(self.tree, spec.joint)
        self.motors = motors_of(spec, self.tree)
        self.springs = Springs(self.tree, self.frames, spec.spring, spec.force)
        self.points = {p.name: self.frames.find(p.frame, f"point {p.name!r}") for p in spec.point}
        if len(self.points) < len(spec.point):
            raise MechanismError("point: two points have the same name")
        self.warnings += self.joints.warnings


def tree_texts(spec: MechanismSpec, sources: Sources) -> list[TreeText]:
    """Return the texts of a mechanism's URDFs (InputError if the file names none, or both ways)."""
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


def _characteristic_length(model: pin.Model, frames: Frames, loops: Sequence[LoopSpec], source: str) -> float:
    """Return the largest distance between neighbouring joints, or from a joint to a loop's frame, metres."""
    offsets = [placement.translation for placement in model.jointPlacements]
    for loop in loops:
        for key, frame in (("frame_a", loop.frame_a), ("frame_b", loop.frame_b)):
            offsets.append(frames.find(frame, f"loop {loop.name!r}, {key}").translation)
    vectors = np.array(offsets).reshape(-1, 3)
    largest = np.abs(vectors).max(initial=0.0)
    if not largest <= MAX_OFFSET_M:
        raise MechanismError(
            f"{source}: joints or loop frames are {largest:g} m apart, more than {MAX_OFFSET_M:g} m; check units"
        )
    return float(np.linalg.norm(vectors, axis=1).max(initial=0.0)) or 1.0
