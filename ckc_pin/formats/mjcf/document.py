"""Parse and check the XML of a MuJoCo model before MuJoCo reads it, and remove elements that mechanisms do not use.

MuJoCo's compiler opens any file that a model names and allocates any size that a model asks for. A model from an
untrusted source is therefore prepared here:

- Included and attached models are read here, only from the model's own repository.
- Mesh files are replaced by tokens. MuJoCo gets their content, never a path.
- The numbers of bodies and elements are bounded.
- Elements that neither move nor have mass (textures, cameras, sensors, contacts) are removed. A note names each removed
  element that would change the motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from stat import S_ISREG
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from ckc_pin.base.sources import MAX_XML_DEPTH, parse_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError
from ckc_pin.formats.repository import repository_of, resolve_links

__all__ = ["MAX_MAGNITUDE", "Document"]

MAX_MAGNITUDE = 1e100  # of any number in a model; squares of larger numbers overflow
MAX_BODIES, MAX_ELEMENTS = 1000, 20_000  # after <replicate> and <attach>; MuJoCo needs seconds to compile these
MAX_MESH_PARAMETER = 1000  # a built-in mesh has as many vertices as its parameters say
MAX_MESH_BYTES = 64 * 2**20

SECTION_NOTES = {  # sections that are removed with a note
    "contact": "contact pairs and exclusions, because contact is not supported",
    "deformable": "deformable bodies",
    "extension": "plugins",
}
IRRELEVANT_SECTIONS = ("custom", "sensor", "size", "statistic", "visual")
IRRELEVANT_ELEMENTS = ("camera", "light", "texture", "material", "skin", "hfield", "lengthrange")
UNSUPPORTED_ELEMENTS = ("composite", "flexcomp", "plugin")  # of bodies
SUPPORTED_EQUALITIES = ("connect", "weld", "joint", "tendon")
TRANSMISSION_KEYS = (
    *("name", "gear", "joint", "jointinparent", "tendon", "site", "refsite", "body"),
    *("cranksite", "slidersite", "cranklength"),
)
FOLDER_SETTINGS = ("assetdir", "meshdir", "texturedir", "strippath")
NAME_LOSING_SETTINGS = ("fusestatic", "discardvisual")  # they would remove named bodies and shapes
TEXT_ATTRIBUTES = {  # their text may look like a number
    *("name", "class", "childclass", "dclass", "model", "prefix", "file", "mesh", "hfield", "content_type", "target"),
    *(f"{kind}{k}" for kind in ("body", "geom", "joint", "site", "tendon") for k in ("", "1", "2")),
    *("jointinparent", "refsite", "sidesite", "cranksite", "slidersite"),
}


# --- files ---------------------------------------------------------------------------------------------------------


@dataclass
class _ModelFiles:
    """Tokens for the files of a model and of the models that it attaches."""

    folder: Path  # the model's repository; no file outside it is opened
    paths: dict[str, Path] = field(default_factory=dict)  # mesh file of each token; it need not exist
    models: int = 0  # number of attached models so far

    def add_mesh(self, path: Path) -> str:
        """Return a new token for a mesh file."""
        token = f"mesh_{len(self.paths)}{path.suffix.lower()}"
        self.paths[token] = path
        return token

    def add_model(self) -> str:
        """Return a new token for an attached model."""
        self.models += 1
        return f"model_{self.models}.xml"

    def resolve(self, folder: Path, file: str, where: str) -> Path:
        """Return the path of a file, relative to a folder."""
        path = resolve_links(folder / file)
        if not file or path is None or not path.is_relative_to(self.folder):
            raise InputError(f"{where}: expected a file in the model's repository {self.folder.name!r}")
        return path

    def read_mesh(self, token: str) -> bytes | None:
        """Return the content of a mesh file; None if it is not readable or not in the model's repository."""
        path = resolve_links(self.paths[token])
        if path is None or not path.is_relative_to(self.folder):
            return None
        try:
            status = path.stat()
            if not S_ISREG(status.st_mode):
                return None
            if status.st_size > MAX_MESH_BYTES:
                raise InputError(f"{path}: more than {MAX_MESH_BYTES // 2**20} MiB, too large for a mesh")
            return path.read_bytes()
        except OSError:
            return None


def _expand_includes(
    element: Element, folder: Path, files: _ModelFiles, seen: set[Path], source: str, depth: int = 0
) -> None:
    """Replace each <include> by the content of its file. A file may be included once."""
    if depth > MAX_XML_DEPTH:
        raise InputError(f"{source}: elements nested more than {MAX_XML_DEPTH} deep are not accepted")
    position = 0
    while position < len(element):
        child = element[position]
        if child.tag != "include":
            _expand_includes(child, folder, files, seen, source, depth + 1)
            position += 1
            continue
        file = child.get("file", "")
        path = files.resolve(folder, file, f"{source}: <include file={file!r}>")
        if path in seen:
            raise InputError(f"{source}: {file!r} is included twice")
        seen.add(path)
        element[position : position + 1] = list(parse_xml(read_text(path, "MuJoCo model"), file))


# --- document ------------------------------------------------------------------------------------------------------


@dataclass
class Document:
    """The prepared XML of a model, with its files and attached models."""

    source: str  # name of the model in messages
    root: Element  # <mujoco>, without any <include>
    files: _ModelFiles  # of the model and of all models that it attaches
    models: dict[str, Document] = field(default_factory=dict)  # attached models by token
    left_out: list[str] = field(default_factory=list)  # removed elements that would change the motion

    @classmethod
    def read(cls, text: str, path: Path) -> Document:
        """Parse and prepare a model, with the files that it includes and attaches."""
        document = cls._read(text, path.absolute(), str(path), _ModelFiles(repository_of(path.absolute().parent)), ())
        bodies, elements = document._count()
        if bodies > MAX_BODIES or elements > MAX_ELEMENTS:
            raise InputError(
                f"{path}: {bodies} bodies and {elements} elements after <replicate> and <attach>; "
                f"at most {MAX_BODIES} and {MAX_ELEMENTS} are accepted"
            )
        return document

    def text(self) -> str:
        """Return the XML for MuJoCo, with each tag on its own line."""
        return tostring(self.root, encoding="unicode")

    def element_at(self, line: int) -> Element | None:
        """Return the element whose opening tag is on a line of `text`."""
        lines = self.text().split("\n")
        opening = [number for number, content in enumerate(lines, 1) if not content.lstrip().startswith("</")]
        return dict(zip(opening, self.root.iter(), strict=True)).get(line)

    @classmethod
    def _read(cls, text: str, path: Path, source: str, files: _ModelFiles, attached_by: tuple[Path, ...]) -> Document:
        root = parse_xml(text, source)
        if root.tag != "mujoco":
            raise InputError(f"{source}: the root element is <{root.tag}>; expected <mujoco>")
        _expand_includes(root, path.parent, files, {path.resolve()}, source)
        for element in root.iter():
            element.text = element.tail = None
            _check_numbers(element, source)
        document = cls(source, root, files)
        document._remove_sections(keep_keys=not attached_by)
        document._remove_elements()
        document._replace_meshes(path.parent)
        document._read_attached_models(path.parent, (*attached_by, path.resolve()))
        indent(root)
        return document

    def _remove_sections(self, keep_keys: bool) -> None:
        """Remove sections without influence on a mechanism, and note those with influence on MuJoCo's motion."""
        for section in list(self.root):
            if section.tag in SECTION_NOTES and len(section):
                self._add_note(SECTION_NOTES[section.tag])
            if section.tag in SECTION_NOTES or section.tag in IRRELEVANT_SECTIONS:
                self.root.remove(section)
        for keyframe in self.root.findall("keyframe") if not keep_keys else ():
            self._add_note("key frames of attached models")
            self.root.remove(keyframe)
        for equality in self.root.findall("equality"):
            for element in [e for e in equality if e.tag not in SUPPORTED_EQUALITIES]:
                self._add_note(f"equality <{element.tag}> {element.get('name', '')}".rstrip())
                equality.remove(element)

    def _remove_elements(self) -> None:
        """Remove visual elements, and parts of bodies that are not rigid."""
        for parent in list(self.root.iter()):
            parent.attrib.pop("material", None)
            for element in list(parent):
                if element.tag in IRRELEVANT_ELEMENTS:
                    parent.remove(element)
                elif element.tag == "plugin" and parent.tag == "mesh":
                    parent.set("file", "")  # treated like a mesh whose file is missing
                    parent.remove(element)
                elif element.tag in UNSUPPORTED_ELEMENTS and parent.tag != "actuator":
                    self._add_note(f"<{element.tag}> {element.get('name', '')}".rstrip() + " (not read)")
                    parent.remove(element)
        for element in self.root.iterfind("actuator/plugin"):  # its target is read, its force law is not
            element.tag = "general"
            for key in set(element.attrib) - set(TRANSMISSION_KEYS):
                element.attrib.pop(key)
            for child in list(element):
                element.remove(child)

    def _replace_meshes(self, folder: Path) -> None:
        """Replace mesh files by tokens, and set the compiler's options for names, threads and muscles."""
        meshdir, strip_path = "", False
        for compiler in self.root.findall("compiler"):
            meshdir = compiler.get("meshdir", compiler.get("assetdir", meshdir))
            strip_path = compiler.get("strippath", str(strip_path)).lower() == "true"
            for setting in (*FOLDER_SETTINGS, *NAME_LOSING_SETTINGS):
                compiler.attrib.pop(setting, None)
        SubElement(SubElement(self.root, "compiler", usethread="false"), "lengthrange", mode="none")
        for mesh in self.root.iterfind("asset/mesh"):
            if "builtin" in mesh.attrib and any(x > MAX_MESH_PARAMETER for x in _parse_numbers(mesh.get("params", ""))):
                where = f"{self.source}: mesh {mesh.get('name', '')!r}"
                raise InputError(f"{where}: params={mesh.get('params')!r}: at most {MAX_MESH_PARAMETER} are accepted")
            if "file" in mesh.attrib:
                file = Path(mesh.attrib["file"])
                mesh.attrib.setdefault("name", file.stem)
                mesh.set("file", self.files.add_mesh(folder / meshdir / (file.name if strip_path else file)))

    def _read_attached_models(self, folder: Path, attached_by: tuple[Path, ...]) -> None:
        """Read the attached models, and replace their files by tokens."""
        for asset in self.root.iterfind("asset/model"):
            file = asset.get("file", "")
            where = f"{self.source}: <model file={file!r}>"
            path = self.files.resolve(folder, file, where)
            if path in attached_by:
                raise InputError(f"{where}: a model cannot contain itself")
            model = Document._read(read_text(path, "MuJoCo model"), path, file, self.files, attached_by)
            asset.attrib.setdefault("name", model.root.get("model", "MuJoCo Model"))
            asset.set("file", self.files.add_model())
            self.models[asset.attrib["file"]] = model
            for note in model.left_out:
                self._add_note(note)

    def _add_note(self, note: str) -> None:
        if note not in self.left_out:
            self.left_out.append(note)

    def _count(self) -> tuple[int, int]:
        """Return the numbers of bodies and elements after replication and attachment."""
        counts = {a.get("name"): self.models[a.attrib["file"]]._count() for a in self.root.iterfind("asset/model")}

        def count(element: Element) -> tuple[int, int]:
            bodies, elements = counts.get(element.get("model"), (0, 0)) if element.tag == "attach" else (0, 0)
            for child in element:
                child_bodies, child_elements = count(child)
                bodies, elements = bodies + child_bodies, elements + child_elements
            copies = 1
            if element.tag == "replicate":
                copies = int(max([1.0, *_parse_numbers(element.get("count", "1"))]))
            return copies * (bodies + (element.tag == "body")), copies * (elements + 1)

        return count(self.root)


def _parse_numbers(text: str) -> list[float]:
    """Return the numbers of a text; an empty list if a word is not a number."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _check_numbers(element: Element, source: str) -> None:
    for key, text in element.attrib.items():
        values = [] if key in TEXT_ATTRIBUTES else _parse_numbers(text)
        if not all(math.isfinite(x) and abs(x) < MAX_MAGNITUDE for x in values):
            where = f"{source}: <{element.tag}> {element.get('name', '')!r}"
            raise InputError(f"{where}: expected finite numbers below {MAX_MAGNITUDE:g}, got {key}={text!r}")
