"""A MuJoCo model's XML made plain: includes expanded, default classes applied, the compiler's settings read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats import orientation
from ckc_pin.formats.draft import checked_direction
from ckc_pin.mechanism.strict_xml import MAX_DEPTH, strict_xml
from ckc_pin.mechanism.toml import read_text
from ckc_pin.mechanism.tree import Array

__all__ = ["Attributes", "Child", "Document"]

MAIN = "main"
LARGEST = 1e100  # squares of what is larger overflow
IN_BODIES = ("joint", "freejoint", "inertial", "geom", "site", "body", "frame", "camera", "light", "plugin")


@dataclass(frozen=True)
class Attributes:
    """An element's attributes with its defaults, and where it stands for messages."""

    values: dict[str, str]
    where: str

    def get(self, key: str, default: str = "") -> str:
        """Return the text of an attribute."""
        return self.values.get(key, default)

    def __contains__(self, key: str) -> bool:
        """Whether the attribute is given, here or in a default class."""
        return key in self.values

    def numbers(self, key: str, default: str = "", least: int = 0) -> list[float]:
        """Return the finite numbers of an attribute, `least` of them or more."""
        text = self.values.get(key, default)
        try:
            found = [float(word) for word in text.split()]
        except ValueError:
            raise InputError(f"{self.where}: {key}={text!r} is not a list of numbers") from None
        if len(found) < least or not all(abs(x) < LARGEST for x in found):
            raise InputError(f"{self.where}: {key}={text!r}: {least} finite numbers are needed")
        return found

    def number(self, key: str, default: float = 0.0) -> float:
        """Return the first number of an attribute."""
        return self.numbers(key, repr(default), 1)[0]

    def point(self, key: str) -> Array:
        """Return three numbers, zeros when absent."""
        return np.array(self.numbers(key, "0 0 0", 3)[:3])

    def flag(self, key: str, default: str) -> str:
        """Return true, false or auto."""
        text = self.values.get(key, default)
        if text not in ("true", "false", "auto"):
            raise InputError(f"{self.where}: {key}={text!r} is not true, false or auto")
        return text


@dataclass(frozen=True)
class Child:
    """A child of a body: its attributes, and the pose of the <frame> elements around it."""

    element: Element
    frame: pin.SE3
    childclass: str


@dataclass
class Document:
    """A model ready to be walked through.

    Attributes
    ----------
    source : str
    root : Element
        <mujoco>, no <include> left.
    compiler, option, flag : Attributes
    left_out : list of str
        What was met and not understood.
    """

    source: str
    root: Element
    compiler: Attributes = field(init=False)
    option: Attributes = field(init=False)
    flag: Attributes = field(init=False)
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._classes: dict[str, dict[str, dict[str, str]]] = {MAIN: {}}
        for section in self.root.findall("default"):
            self._add_class(section, None)
        self.compiler = self._merged("compiler")
        self.option = self._merged("option")
        self.flag = self._merged("option/flag")
        if self.compiler.get("coordinate", "local") != "local":
            raise InputError(f"{self.source}: coordinate='global' went out of MJCF; save it with an older MuJoCo first")
        unit = self.compiler.get("angle", "degree")
        if unit not in ("degree", "radian"):
            raise InputError(f"{self.compiler.where}: angle={unit!r} is not degree or radian")
        self.radians = 1.0 if unit == "radian" else math.pi / 180.0
        self.eulerseq = self.compiler.get("eulerseq", "xyz")
        if len(self.eulerseq) != 3 or set(self.eulerseq.lower()) - set("xyz"):
            raise InputError(f"{self.compiler.where}: eulerseq={self.eulerseq!r} is not three of x, y, z, X, Y, Z")

    @classmethod
    def read(cls, text: str, path: Path) -> Document:
        """Parse a model and the files that it includes.

        Raises
        ------
        InputError
            Malformed XML, an include outside the model's folder or one that comes twice, a bad setting.
        """
        root = strict_xml(text, str(path))
        if root.tag != "mujoco":
            raise InputError(f"{path}: the root element is <{root.tag}>, a MuJoCo model's is <mujoco>")
        _expand(root, path.absolute().parent, {path.resolve()}, str(path), 0)
        return cls(str(path), root)

    def attributes(self, element: Element, childclass: str = MAIN, name: str = "") -> Attributes:
        """Return an element's attributes over those of its class."""
        where = f"{self.source}: <{element.tag}> {name or element.get('name', '')!r}"
        chosen = element.get("class") or childclass
        if chosen not in self._classes:
            known = ", ".join(self._classes)
            raise InputError(f"{where}: no default class {chosen!r}; there are {known}")
        return Attributes({**self._classes[chosen].get(element.tag, {}), **element.attrib}, where)

    def children(self, body: Element, childclass: str) -> Iterator[Child]:
        """Walk over a body's children in their order, <frame> elements dissolved."""
        yield from self._children(body, pin.SE3.Identity(), childclass)

    def _children(self, parent: Element, pose: pin.SE3, childclass: str) -> Iterator[Child]:
        for element in parent:
            if element.tag == "frame":
                inner = pose * self.pose(self.attributes(element, childclass))
                yield from self._children(element, inner, element.get("childclass", childclass))
            elif element.tag in ("replicate", "attach"):
                raise InputError(
                    f"{self.source}: <{element.tag}> is not read; have MuJoCo write the model out as compiled "
                    "(mj_saveLastXML) and import that"
                )
            elif element.tag in IN_BODIES:
                yield Child(element, pose, childclass)
            else:
                self.left_out.append(f"<{element.tag}> {element.get('name', '')}".rstrip())

    def pose(self, a: Attributes) -> pin.SE3:
        """Return the pose that an element's pos and orientation say."""
        return pin.SE3(self.rotation(a), a.point("pos"))

    def rotation(self, a: Attributes) -> Array:
        """Return an element's orientation, in whichever of the five ways it is given."""
        if "axisangle" in a:
            *axis, angle = a.numbers("axisangle", least=4)[:4]
            return orientation.from_axis_angle(checked_direction(axis, a.where), angle * self.radians)
        if "xyaxes" in a:
            x, y = np.array(a.numbers("xyaxes", least=6)[:6]).reshape(2, 3)
            checked_direction(np.cross(x, y), f"{a.where}: xyaxes, their cross product")
            return orientation.from_x_and_y(x, y)
        if "zaxis" in a:
            return orientation.from_z(checked_direction(a.point("zaxis"), f"{a.where}: zaxis"))
        if "euler" in a:
            return orientation.euler([x * self.radians for x in a.point("euler")], self.eulerseq)
        quaternion = a.numbers("quat", "1 0 0 0", 4)[:4]
        if not any(quaternion):
            raise InputError(f"{a.where}: quat is zero")
        return orientation.from_quaternion(quaternion)

    def _add_class(self, element: Element, parent: str | None) -> None:
        """Take in one <default>: what its parent says, then what it says, then its own children."""
        name = element.get("class", MAIN if parent is None else "")
        if not name:
            raise InputError(f"{self.source}: a nested <default> has no class")
        own = self._classes.setdefault(name, {})
        for tag, values in self._classes[parent].items() if parent else ():
            own[tag] = dict(values)
        for child in element:
            if child.tag != "default":
                own.setdefault(child.tag, {}).update(child.attrib)
        for child in element.findall("default"):
            self._add_class(child, name)

    def _merged(self, path: str) -> Attributes:
        values: dict[str, str] = {}
        for element in self.root.findall(path):
            values.update(element.attrib)
        return Attributes(values, f"{self.source}: <{path}>")


def _expand(element: Element, folder: Path, seen: set[Path], source: str, depth: int) -> None:
    """Put included files in place of <include>, each at most once and none from outside the folder."""
    if depth > MAX_DEPTH:
        raise InputError(f"{source}: elements nested more than {MAX_DEPTH} deep are not accepted")
    position = 0
    while position < len(element):
        child = element[position]
        if child.tag != "include":
            _expand(child, folder, seen, source, depth + 1)
            position += 1
            continue
        file = child.get("file", "")
        path = (folder / file).resolve()
        if not file or not path.is_relative_to(folder.resolve()):
            raise InputError(f"{source}: <include file={file!r}>: a file in the model's own folder is needed")
        if path in seen:
            raise InputError(f"{source}: {file!r} is included twice")
        seen.add(path)
        included = strict_xml(read_text(path, "MuJoCo model"), file)
        element[position : position + 1] = list(included)
