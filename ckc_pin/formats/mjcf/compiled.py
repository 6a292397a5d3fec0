"""Compile a MuJoCo model with MuJoCo, which resolves defaults, frames, replicas, attached models and masses.

MuJoCo gets only the meshes from which a mass is computed. Other meshes are not drawn, and their files may be missing.
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
from ckc_pin.formats.conversion import list_names, make_unique
from ckc_pin.formats.mjcf.document import MAX_MAGNITUDE, Document

__all__ = ["Compiled"]

MIN_MUJOCO_VERSION = 4  # major version
PLACEHOLDER_MASS = 1e-9  # kg and kg m^2; MuJoCo refuses moving bodies without mass, and the import removes it again
MAX_QUOTED_CHARACTERS = 80  # of an element's attributes in a message
CHECKED_ARRAYS = (
    *("body_pos", "body_quat", "body_mass", "body_ipos", "body_iquat", "body_inertia"),
    *("jnt_pos", "jnt_axis"),
)


@dataclass
class Compiled:
    """A compiled model, with names for bodies and joints that have none."""

    mujoco: Any
    source: str  # name of the model in messages
    model: Any = None
    bodies: list[str] = field(default_factory=list)  # names by MuJoCo's number
    joints: list[str] = field(default_factory=list)
    unweighed: list[str] = field(default_factory=list)  # shapes that should have mass and whose mesh is missing
    weightless: set[int] = field(default_factory=set)  # bodies that have no other mass
    undrawn: int = 0  # number of shapes that only MuJoCo can draw
    warnings: list[str] = field(default_factory=list)  # MuJoCo's

    @classmethod
    def of(cls, document: Document) -> Compiled:
        """Compile a document."""
        compiled = cls(_import_mujoco(document.source), document.source)
        with compiled._collecting_warnings():
            spec = compiled._parse(document)
            spec.assets, missing = compiled._remove_unneeded_meshes(spec, document)
            try:
                compiled.model = compiled._compile(spec)
            except (ValueError, RuntimeError) as error:
                raise _explain_error(document, error) from None
        compiled._check_numbers()
        compiled._choose_names()
        for body, shapes, is_weightless in missing:
            compiled.unweighed += [f"{compiled.bodies[body.id]} (mesh {shape})" for shape in shapes]
            compiled.weightless |= {body.id} if is_weightless else set()
        return compiled

    def name(self, kind: str, number: int) -> str:
        """Return the name of a site, tendon, actuator or other object by its number; empty if it has none."""
        name: str = getattr(self.model, kind)(int(number)).name
        return name

    def _compile(self, spec: Any) -> Any:
        """Compile a model, without its key frames if they do not fit to it."""
        try:
            return spec.compile()
        except (ValueError, RuntimeError) as error:
            if not spec.keys or "key" not in str(error):
                raise
            self.warnings.append(f"key frames are left out: {_join_lines(str(error))}")
            for key in list(spec.keys):
                spec.delete(key)
            return spec.compile()

    def _parse(self, document: Document) -> Any:
        """Parse the XML. Attached models are parsed on their own first, so that a message names the right model."""
        texts: dict[str, bytes] = {}
        for token, model in document.models.items():
            self._parse(model)
            texts |= _attached_texts(model) | {token: model.text().encode()}
        try:
            return self.mujoco.MjSpec.from_string(document.text(), include=texts)
        except (ValueError, RuntimeError) as error:
            raise _explain_error(document, error) from None

    def _remove_unneeded_meshes(self, spec: Any, document: Document) -> tuple[dict[str, bytes], list[Any]]:
        """Remove meshes without influence on masses, and meshes whose files are missing.

        Returns the other files' content by token, and the bodies with missing meshes: (body, meshes, has no mass).
        """
        files = {mesh.name: mesh.file for mesh in spec.meshes}
        assets: dict[str, bytes] = {}
        bodies_with_missing = []
        for body in spec.bodies:
            missing: list[str] = []
            for geom in list(body.geoms):
                geom.contype = geom.conaffinity = 0  # without contact MuJoCo computes no convex hull
                if not geom.meshname and geom.type != self.mujoco.mjtGeom.mjGEOM_HFIELD:
                    continue
                token = files.get(geom.meshname, "")
                if self._has_mass(geom, body):
                    if token and token not in assets and (content := document.files.read_mesh(token)) is not None:
                        assets[token] = content
                    if not token or token in assets:
                        continue
                    missing.append(geom.name or geom.meshname)
                self.undrawn += 1
                spec.delete(geom)
            is_weightless = bool(missing) and not any(self._has_mass(geom, body) for geom in body.geoms)
            if is_weightless:
                body.explicitinertial = True
                body.mass, body.inertia = PLACEHOLDER_MASS, np.full(3, PLACEHOLDER_MASS)
            bodies_with_missing += [(body, missing, is_weightless)] if missing else []
        for site in spec.sites:
            if site.meshname:
                site.meshname, site.type = "", self.mujoco.mjtGeom.mjGEOM_SPHERE
        needed = {geom.meshname for geom in spec.geoms}
        for mesh in list(spec.meshes):
            if mesh.name not in needed:
                spec.delete(mesh)
        return assets, bodies_with_missing

    def _has_mass(self, geom: Any, body: Any) -> bool:
        """Whether a shape contributes to its body's mass, by the rules of MuJoCo's compiler."""
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
        for key in CHECKED_ARRAYS:
            values = np.atleast_2d(getattr(self.model, key).T).T
            invalid = np.flatnonzero(~(np.abs(values) < MAX_MAGNITUDE).all(axis=1))
            if len(invalid):
                kind = "body" if key.startswith("body") else "joint"
                where = f"{self.source}: {kind} {self.name(kind, invalid[0])!r}"
                raise InputError(f"{where}: {key.partition('_')[2]} = {values[invalid[0]].tolist()}: not finite")

    def _choose_names(self) -> None:
        """Collect the names of bodies and joints, and choose names for those without one."""
        model = self.model
        self.bodies = [self.name("body", k) for k in range(model.nbody)]
        self.joints = [self.name("joint", k) for k in range(model.njnt)]
        for k, name in enumerate(self.bodies):
            if not name:
                self.bodies[k] = make_unique(f"body_{k}", self.bodies)
        free = self.mujoco.mjtJoint.mjJNT_FREE
        kinds = ("free", "ball", "slide", "hinge")
        for k, name in enumerate(self.joints):
            if not name:
                body, kind = self.bodies[model.jnt_bodyid[k]], model.jnt_type[k]
                self.joints[k] = make_unique("root" if int(kind) == free else f"{body}_{kinds[kind]}", self.joints)

    @contextmanager
    def _collecting_warnings(self) -> Iterator[None]:
        """Collect MuJoCo's warnings, which it would otherwise write to a file in the current folder."""
        before = self.mujoco.get_mju_user_warning()
        self.mujoco.set_mju_user_warning(lambda text: self.warnings.append(_join_lines(str(text))))
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                yield
        finally:
            self.mujoco.set_mju_user_warning(before)
        self.warnings += [_join_lines(str(warning.message)) for warning in caught]


def _import_mujoco(source: str) -> Any:
    try:
        import mujoco
    except ImportError:
        raise InputError(
            f"{source}: reading MuJoCo's models needs MuJoCo; install it with `pip install 'ckc_pin[mujoco]'`"
        ) from None
    if int(mujoco.__version__.partition(".")[0]) < MIN_MUJOCO_VERSION:
        raise InputError(
            f"{source}: MuJoCo {MIN_MUJOCO_VERSION} or later is needed, {mujoco.__version__} is installed; "
            "update it with `pip install --upgrade 'ckc_pin[mujoco]'`"
        )
    return mujoco


def _attached_texts(document: Document) -> dict[str, bytes]:
    """Return the texts of all models that a model attaches, directly or indirectly, by token."""
    texts: dict[str, bytes] = {}
    for token, model in document.models.items():
        texts |= {token: model.text().encode()} | _attached_texts(model)
    return texts


def _explain_error(document: Document, error: Exception) -> InputError:
    """Return MuJoCo's error as an InputError that names the element.

    MuJoCo counts lines of the prepared XML, so its line numbers are replaced by the element on that line.
    """
    text = str(error)
    line, element_name = re.search(r", line (\d+)", text), re.search(r"Element name '([^\n]+)'", text)
    message = re.sub(r"^(XML )?(Error: )+", "", text.partition("\nElement")[0])
    for token, path in document.files.paths.items():
        message = message.replace(token, path.name)
    element = document.element_at(int(line[1])) if line else None
    where = f": {element_name[1]!r}" if element_name else ""
    if element is not None and (not document.models or text.startswith("XML")):
        message += _list_choices(document, element, message)
        attributes = " ".join(f"{key}={value!r}" for key, value in element.attrib.items() if key != "name")
        quoted = f" ({attributes[:MAX_QUOTED_CHARACTERS]})" if attributes else ""
        where = f": <{element.tag}> {element.get('name', '')!r}{quoted}"
    return InputError(f"{document.source}{where}: MuJoCo refuses it: {_join_lines(message)}")


def _list_choices(document: Document, element: Element, message: str) -> str:
    """Return the end of a message about an unknown name: the names that exist, and the elements that were not read."""
    unknown = re.search(r"unknown (?:element|transmission target) '([^\n]+?)'", message)
    keys = [key.rstrip("12") for key, value in element.attrib.items() if unknown and value == unknown[1]]
    if not keys:
        return ""
    path = "tendon/*" if keys[0] == "tendon" else f"worldbody//{keys[0]}"
    names = [name for target in document.root.iterfind(path) if (name := target.get("name"))]
    not_read = [note.removesuffix(" (not read)") for note in document.left_out if note.endswith("(not read)")]
    return f"; there are {list_names(names) or 'none'}" + (f"; not read: {list_names(not_read)}" if not_read else "")


def _join_lines(text: str) -> str:
    return " ".join(text.split())
