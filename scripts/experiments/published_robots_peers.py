"""Compare the mass matrix of an imported robot with MuJoCo's of the same file."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin import Mechanism
from ckc_pin.base.arrays import Array

__all__ = ["compare_masses"]

CONFIGURATIONS = 3
UNDRAWN = ("visual", "collision")  # elements of a URDF that MuJoCo would open meshes for
TREE = ("link", "joint")


def compare_masses(mechanism: Mechanism, path: Path) -> float | None:
    """Return the relative difference of the mass matrices of the joints that both programs have by name.

    None if MuJoCo does not read the file, or if it has no such joints. Both programs are at the same coordinates by
    name, and MuJoCo's other joints, such as free roots and balls, at the pose of its file. Only files whose joints all
    have one freedom are therefore compared.
    """
    model = _load(path)
    if model is None:
        return None
    import mujoco

    tree = mechanism.tree
    theirs = {model.joint(k).name: k for k in range(model.njnt)}
    names = [name for name in mechanism.coordinates if name in theirs]
    if len(names) != mechanism.n or len(names) != model.nv:
        return None
    dofs, random, largest = [int(model.jnt_dofadr[theirs[name]]) for name in names], np.random.default_rng(1), 0.0
    data: Any = mujoco.MjData(model)
    for _ in range(CONFIGURATIONS):
        numbers = random.uniform(-0.5, 0.5, mechanism.n)
        for name, value in zip(names, numbers, strict=True):
            data.qpos[model.jnt_qposadr[theirs[name]]] = value
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        D = np.array(tree.evaluate(pin.crba, tree.from_coordinates(numbers)))
        D = np.triu(D) + np.triu(D, 1).T
        largest = max(largest, _difference(mass[np.ix_(dofs, dofs)], D))
    return largest


def _difference(one: Array, two: Array) -> float:
    return float(np.abs(one - two).max() / np.abs(two).max())


def _load(path: Path) -> Any:
    """Return MuJoCo's model of an MJCF file or of the tree of a URDF; None if it does not read the file."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _text: None)
    try:
        if path.suffix == ".xml":
            return mujoco.MjModel.from_xml_path(str(path))
        if path.suffix != ".urdf":
            return None
        root = ElementTree.parse(path).getroot()
        for element in list(root):
            if element.tag not in TREE:
                root.remove(element)
        for link in root.iter("link"):
            for tag in UNDRAWN:
                for element in link.findall(tag):
                    link.remove(element)
        compiler = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
        compiler.attrib.update(fusestatic="false", discardvisual="false", balanceinertia="false", boundmass="0")
        return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    except (ValueError, ElementTree.ParseError, UnicodeError):
        return None
