"""A MuJoCo model's XML before MuJoCo sees it: parsed strictly, its paths and sizes checked, reduced to what moves.

MuJoCo's compiler opens any file that a model names, and allocates what it asks for. So included and attached models
are read here, a mesh becomes a token for a path that was checked, and what neither moves nor weighs (textures,
cameras, sensors, contacts) is taken out; what would change the motion is named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from ckc_pin.base.sources import strict_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError
from ckc_pin.formats.mjcf.files import Files, expand

__all__ = ["ASSEMBLED", "LARGEST", "Document"]

ASSEMBLED = "assembled"  # the key frame that `ckc export` writes
LARGEST = 1e100  # squares of what is larger overflow
MAX_BODIES, MAX_ELEMENTS = 1000, 20_000  # after <replicate> and <attach>; MuJoCo takes seconds for that many
MAX_PARAMETER = 1000  # of a built-in mesh, whose vertices are as many as its parameters say

KEY_FRAMES = "key frames; one of them may be a better [q_guess]"
SAID = {
    "contact": "contact pairs and exclusions: there is no contact here",
    "deformable": "deformable bodies",
    "extension": "plugins",
}
SILENT = ("custom", "sensor", "size", "statistic", "visual")  # sections that do not move anything
IMMATERIAL = ("camera", "light", "texture", "material", "skin", "hfield", "lengthrange")
UNREAD = ("composite", "flexcomp", "plugin")  # in bodies
EQUALITIES = ("connect", "weld", "joint", "tendon")
TRANSMISSION = (
    *("name", "gear", "joint", "jointinparent", "tendon", "site", "refsite", "body"),
    *("cranksite", "slidersite", "cranklength"),
)
FOLDERS = ("assetdir", "meshdir", "texturedir", "strippath")
FUSION = ("fusestatic", "discardvisual")  # would take names away
WORDS = {  # attributes whose text may look like a number
    *("name", "class", "childclass", "dclass", "model", "prefix", "file", "mesh", "hfield", "content_type", "target"),
    *(f"{of}{k}" for of in ("body", "geom", "joint", "site", "tendon") for k in ("", "1", "2")),
    *("jointinparent", "refsite", "sidesite", "cranksite", "slidersite"),
}


@dataclass
class Document:
    """A model and what it consists of.

    Attributes
    ----------
    source : str
        What messages call it.
    root : Element
        <mujoco>, no <include> left.
    files : Files
        Of the model and of all that it attaches.
    models : dict of str to Document
        Models to attach, by token.
    left_out : list of str
        What would change the motion and was taken out.
    """

    source: str
    root: Element
    files: Files
    models: dict[str, Document] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, text: str, path: Path) -> Document:
        """Parse a model and the files that it includes and attaches.

        Raises
        ------
        InputError
            Malformed XML, a file outside the model's folder or one that comes twice, a number that is none, more
            bodies than can be computed with.
        """
        document = cls._read(text, path.absolute(), str(path), Files(path.absolute().parent.resolve()), ())
        bodies, elements = document._size()
        if bodies > MAX_BODIES or elements > MAX_ELEMENTS:
            raise InputError(
                f"{path}: {bodies} bodies and {elements} elements after <replicate> and <attach>; "
                f"{MAX_BODIES} and {MAX_ELEMENTS} are accepted"
            )
        return document

    def text(self) -> str:
        """Return the XML for MuJoCo, a tag a line."""
        return tostring(self.root, encoding="unicode")

    def opened_at(self, line: int) -> Element | None:
        """Return the element whose tag opens on a line of `text`."""
        lines = self.text().split("\n")
        opening = [number for number, content in enumerate(lines, 1) if not content.lstrip().startswith("</")]
        return dict(zip(opening, self.root.iter(), strict=True)).get(line)

    @classmethod
    def _read(cls, text: str, path: Path, source: str, files: Files, above: tuple[Path, ...]) -> Document:
        root = strict_xml(text, source)
        if root.tag != "mujoco":
            raise InputError(f"{source}: the root element is <{root.tag}>, a MuJoCo model's is <mujoco>")
        expand(root, path.parent, files, {path.resolve()}, source)
        for element in root.iter():
            element.text = element.tail = None
            _check_numbers(element, source)
        document = cls(source, root, files)
        document._reduce_sections(keep_key=not above)
        document._reduce_elements()
        document._take_meshes(path.parent)
        document._take_models(path.parent, (*above, path.resolve()))
        indent(root)
        return document

    def _reduce_sections(self, keep_key: bool) -> None:
        """Take out sections that move nothing, and name those that would have."""
        for section in list(self.root):
            if section.tag in SAID and len(section):
                self._leave_out(SAID[section.tag])
            if section.tag in SAID or section.tag in SILENT:
                self.root.remove(section)
        for keyframe in self.root.findall("keyframe"):
            for key in keyframe.findall("key"):
                if not keep_key or key.get("name") != ASSEMBLED:
                    self._leave_out(KEY_FRAMES)
                    keyframe.remove(key)
        for equality in self.root.findall("equality"):
            for element in [e for e in equality if e.tag not in EQUALITIES]:
                self._leave_out(f"equality <{element.tag}> {element.get('name', '')}".rstrip())
                equality.remove(element)

    def _reduce_elements(self) -> None:
        """Take out what is only looked at, and what bodies consist of that is not rigid."""
        for parent in list(self.root.iter()):
            parent.attrib.pop("material", None)
            for element in list(parent):
                if element.tag in IMMATERIAL:
                    parent.remove(element)
                elif element.tag == "plugin" and parent.tag == "mesh":
                    parent.set("file", "")  # as if it were not there
                    parent.remove(element)
                elif element.tag in UNREAD and parent.tag != "actuator":
                    self._leave_out(f"<{element.tag}> {element.get('name', '')}".rstrip() + " (not read)")
                    parent.remove(element)
        for element in self.root.iterfind("actuator/plugin"):  # what it moves is read, not how
            element.tag = "general"
            for key in set(element.attrib) - set(TRANSMISSION):
                element.attrib.pop(key)
            for child in list(element):
                element.remove(child)

    def _take_meshes(self, folder: Path) -> None:
        """Put tokens in place of meshes' files, and settle what the compiler does with names and muscles."""
        meshdir, strip = "", False
        for compiler in self.root.findall("compiler"):
            meshdir = compiler.get("meshdir", compiler.get("assetdir", meshdir))
            strip = compiler.get("strippath", str(strip)).lower() == "true"
            for setting in (*FOLDERS, *FUSION):
                compiler.attrib.pop(setting, None)
        SubElement(SubElement(self.root, "compiler", usethread="false"), "lengthrange", mode="none")
        for mesh in self.root.iterfind("asset/mesh"):
            if "builtin" in mesh.attrib and any(x > MAX_PARAMETER for x in _numbers(mesh.get("params", ""))):
                where = f"{self.source}: mesh {mesh.get('name', '')!r}"
                raise InputError(f"{where}: params={mesh.get('params')!r}: at most {MAX_PARAMETER} are accepted")
            if "file" in mesh.attrib:
                file = Path(mesh.attrib["file"])
                mesh.attrib.setdefault("name", file.stem)
                mesh.set("file", self.files.mesh(folder / meshdir / (file.name if strip else file)))

    def _take_models(self, folder: Path, above: tuple[Path, ...]) -> None:
        """Read the models that are attached, and put tokens in place of their files."""
        for asset in self.root.iterfind("asset/model"):
            file = asset.get("file", "")
            where = f"{self.source}: <model file={file!r}>"
            path = self.files.inside(folder, file, where)
            if path in above:
                raise InputError(f"{where}: a model cannot contain itself")
            model = Document._read(read_text(path, "MuJoCo model"), path, file, self.files, above)
            asset.attrib.setdefault("name", model.root.get("model", "MuJoCo Model"))
            asset.set("file", self.files.model())
            self.models[asset.attrib["file"]] = model
            for said in model.left_out:
                self._leave_out(said)

    def _leave_out(self, what: str) -> None:
        if what not in self.left_out:
            self.left_out.append(what)

    def _size(self) -> tuple[int, int]:
        """Bodies and elements, each as often as it is replicated and attached."""
        sizes = {a.get("name"): self.models[a.attrib["file"]]._size() for a in self.root.iterfind("asset/model")}

        def count(element: Element) -> tuple[int, int]:
            bodies, elements = sizes.get(element.get("model"), (0, 0)) if element.tag == "attach" else (0, 0)
            for child in element:
                more = count(child)
                bodies, elements = bodies + more[0], elements + more[1]
            times = 1
            if element.tag == "replicate":
                times = int(max([1.0, *_numbers(element.get("count", "1"))]))
            return times * (bodies + (element.tag == "body")), times * (elements + 1)

        return count(self.root)


def _numbers(text: str) -> list[float]:
    """Return the numbers of a text, none if one of its words is none."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _check_numbers(element: Element, source: str) -> None:
    for key, text in element.attrib.items():
        values = [] if key in WORDS else _numbers(text)
        if not all(math.isfinite(x) and abs(x) < LARGEST for x in values):
            where = f"{source}: <{element.tag}> {element.get('name', '')!r}"
            raise InputError(f"{where}: {key}={text!r}: finite numbers below {LARGEST:g} are needed")
