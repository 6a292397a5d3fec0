"""MuJoCo's own compiler at work on a document: defaults, frames, replicas, attached models and masses are its affair.

Of the meshes it gets those alone that a mass comes from. The others are not drawn here, and need not be there.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.formats.draft import some, unique
from ckc_pin.formats.mjcf.document import LARGEST, Document

__all__ = ["Compiled"]

OLDEST = 4  # major version of MuJoCo whose fields are read
FEATHER = 1e-9  # kg, kg m^2: MuJoCo takes no moving body without; it is none in the end
NUMBERS = ("body_pos", "body_quat", "body_mass", "body_ipos", "body_iquat", "body_inertia", "jnt_pos", "jnt_axis")


@dataclass
class Compiled:
    """A model as MuJoCo compiled it.

    Attributes
    ----------
    mujoco : module
    source : str
    model : MjModel
    bodies, joints : list of str
        Names by MuJoCo's number; those without one got some.
    unweighed : list of str
        Shapes that a mass should come from, and that are not there.
    weightless : set of int
        Bodies that have no mass without them.
    undrawn : int
        Shapes that only MuJoCo could draw.
    warnings : list of str
        What MuJoCo says of the model.
    """

    mujoco: Any
    source: str
    model: Any = None
    bodies: list[str] = field(default_factory=list)
    joints: list[str] = field(default_factory=list)
    unweighed: list[str] = field(default_factory=list)
    weightless: set[int] = field(default_factory=set)
    undrawn: int = 0
    warnings: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, document: Document) -> Compiled:
        """Compile a document.

        Raises
        ------
        InputError
            MuJoCo is not installed, or refuses the model.
        """
        found = cls(_mujoco(document.source), document.source)
        with found._listening():
            spec = found._parsed(document)
            spec.assets, missing = found._shapes_that_weigh(spec, document)
            try:
                found.model = spec.compile()
            except (ValueError, RuntimeError) as error:
                raise _refused(document, error) from None
        found._check_numbers()
        found._name()
        for body, shapes, is_weightless in missing:
            found.unweighed += [f"{found.bodies[body.id]} (mesh {shape})" for shape in shapes]
            found.weightless |= {body.id} if is_weightless else set()
        return found

    def name(self, kind: str, number: int) -> str:
        """Return the name of a site, tendon, actuator or the like by its number; empty if it has none."""
        name: str = getattr(self.model, kind)(int(number)).name
        return name

    def _parsed(self, document: Document) -> Any:
        """Parse the XML; models to attach before it, each alone, so that a message is about the right one."""
        texts: dict[str, bytes] = {}
        for token, model in document.models.items():
            self._parsed(model)
            texts |= _texts(model) | {token: model.text().encode()}
        try:
            return self.mujoco.MjSpec.from_string(document.text(), include=texts)
        except (ValueError, RuntimeError) as error:
            raise _refused(document, error) from None

    def _shapes_that_weigh(self, spec: Any, document: Document) -> tuple[dict[str, bytes], list[Any]]:
        """Take out meshes that no mass comes from, and those that are not there.

        Returns the files of the others, and for each body what is missing and whether it has no mass now.
        """
        files = {mesh.name: mesh.file for mesh in spec.meshes}
        assets: dict[str, bytes] = {}
        lacking = []
        for body in spec.bodies:
            missing: list[str] = []
            for geom in list(body.geoms):
                geom.contype = geom.conaffinity = 0  # MuJoCo needs no convex hull then
                if not geom.meshname and geom.type != self.mujoco.mjtGeom.mjGEOM_HFIELD:
                    continue
                token = files.get(geom.meshname, "")
                if self._weighs(geom, body):
                    if token and token not in assets and (content := document.files.content(token)) is not None:
                        assets[token] = content
                    if not token or token in assets:
                        continue
                    missing.append(geom.name or geom.meshname)
                self.undrawn += 1
                spec.delete(geom)
            is_weightless = bool(missing) and not any(self._weighs(geom, body) for geom in body.geoms)
            if is_weightless:
                body.explicitinertial, body.mass, body.inertia = True, FEATHER, np.full(3, FEATHER)
            lacking += [(body, missing, is_weightless)] if missing else []
        for site in spec.sites:
            if site.meshname:
                site.meshname, site.type = "", self.mujoco.mjtGeom.mjGEOM_SPHERE
        needed = {geom.meshname for geom in spec.geoms}
        for mesh in list(spec.meshes):
            if mesh.name not in needed:
                spec.delete(mesh)
        return assets, lacking

    def _weighs(self, geom: Any, body: Any) -> bool:
        """Whether a body has mass from a shape: the rules of MuJoCo's compiler."""
        rules, kinds = self.mujoco.mjtInertiaFromGeom, self.mujoco.mjtGeom
        rule = body.compiler.inertiafromgeom
        if rule == rules.mjINERTIAFROMGEOM_FALSE or body.name == "world":
            return False
        if rule == rules.mjINERTIAFROMGEOM_AUTO and body.explicitinertial:
            return False
        first, last = body.compiler.inertiagrouprange
        mass = geom.density if np.isnan(geom.mass) else geom.mass
        return bool(first <= geom.group <= last and mass and geom.type not in (kinds.mjGEOM_PLANE, kinds.mjGEOM_HFIELD))

    def _check_numbers(self) -> None:
        for key in NUMBERS:
            values = np.atleast_2d(getattr(self.model, key).T).T
            wrong = np.flatnonzero(~(np.abs(values) < LARGEST).all(axis=1))
            if len(wrong):
                kind = "body" if key.startswith("body") else "joint"
                where = f"{self.source}: {kind} {self.name(kind, wrong[0])!r}"
                raise InputError(f"{where}: {key.partition('_')[2]} = {values[wrong[0]].tolist()}: not finite")

    def _name(self) -> None:
        """Give names to bodies and joints that have none."""
        model = self.model
        self.bodies = [self.name("body", k) for k in range(model.nbody)]
        self.joints = [self.name("joint", k) for k in range(model.njnt)]
        for k, name in enumerate(self.bodies):
            if not name:
                self.bodies[k] = unique(f"body_{k}", self.bodies)
        free = self.mujoco.mjtJoint.mjJNT_FREE
        kinds = ("free", "ball", "slide", "hinge")
        for k, name in enumerate(self.joints):
            if not name:
                body, kind = self.bodies[model.jnt_bodyid[k]], model.jnt_type[k]
                self.joints[k] = unique("root" if int(kind) == free else f"{body}_{kinds[kind]}", self.joints)

    @contextmanager
    def _listening(self) -> Iterator[None]:
        """Collect MuJoCo's warnings, which it would write to a file in the current folder."""
        before = self.mujoco.get_mju_user_warning()
        self.mujoco.set_mju_user_warning(lambda text: self.warnings.append(_line(str(text))))
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                yield
        finally:
            self.mujoco.set_mju_user_warning(before)
        self.warnings += [_line(str(warning.message)) for warning in caught]


def _mujoco(source: str) -> Any:
    try:
        import mujoco
    except ImportError:
        raise InputError(f"{source}: reading MuJoCo's models needs MuJoCo: pip install 'ckc_pin[mujoco]'") from None
    if int(mujoco.__version__.partition(".")[0]) < OLDEST:
        raise InputError(
            f"{source}: MuJoCo {OLDEST} or later is needed, {mujoco.__version__} is installed: "
            "pip install --upgrade 'ckc_pin[mujoco]'"
        )
    return mujoco


def _texts(document: Document) -> dict[str, bytes]:
    """Return the texts of all models that a model attaches, and those attach, by token."""
    texts: dict[str, bytes] = {}
    for token, model in document.models.items():
        texts |= {token: model.text().encode()} | _texts(model)
    return texts


def _refused(document: Document, error: Exception) -> InputError:
    """Say what MuJoCo refuses, about which element; its lines are those of the XML that was made for it."""
    said = str(error)
    line, named = re.search(r", line (\d+)", said), re.search(r"Element name '([^\n]+)'", said)
    message = re.sub(r"^(XML )?(Error: )+", "", said.partition("\nElement")[0])
    for token, path in document.files.paths.items():
        message = message.replace(token, path.name)
    element = document.opened_at(int(line[1])) if line else None
    where = f": {named[1]!r}" if named else ""
    if element is not None and (not document.models or said.startswith("XML")):
        message += _choices(document, element, message)
        given = " ".join(f"{key}={value!r}" for key, value in element.attrib.items() if key != "name")
        where = f": <{element.tag}> {element.get('name', '')!r}" + (f" ({given[:80]})" if given else "")
    return InputError(f"{document.source}{where}: MuJoCo refuses it: {_line(message)}")


def _choices(document: Document, element: Element, message: str) -> str:
    """Return the names that there are, where an element names something that is not there."""
    unknown = re.search(r"unknown (?:element|transmission target) '([^\n]+?)'", message)
    keys = [key.rstrip("12") for key, value in element.attrib.items() if unknown and value == unknown[1]]
    if not keys:
        return ""
    path = "tendon/*" if keys[0] == "tendon" else f"worldbody//{keys[0]}"
    names = [name for found in document.root.iterfind(path) if (name := found.get("name"))]
    unread = [said.removesuffix(" (not read)") for said in document.left_out if said.endswith("(not read)")]
    return f"; there are {some(names) or 'none'}" + (f"; not read: {some(unread)}" if unread else "")


def _line(text: str) -> str:
    return " ".join(text.split())
