"""The numbers of a mechanism by name, `link.rod.mass`, and how they are changed without writing a file.

What is changed is what was read: the elements of the URDF and the tables of the mechanism's file. Everything that
follows from them (checks, loops, assembly) is then done as if the files had said so.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

from ckc_pin.base.toml import convert
from ckc_pin.errors import InputError
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.mechanism.urdf import INERTIA, LIMITS, check_inertial, check_range, floats

__all__ = [
    "AXES",
    "INERTIA_ENTRIES",
    "ROOTS",
    "Overrides",
    "Value",
    "changed",
    "is_parameter",
    "parts_of",
    "plain_values",
    "require_known",
    "split_component",
    "split_name",
    "values_of",
    "with_components",
]

Value = float | tuple[float, float, float]
Overrides = Mapping[str, Value]

ROOTS = ("gravity", "link", "joint", "loop", "coupling", "spring", "force", "motor")
AXES = "xyz"
OF_JOINT = ("armature", "damping", "friction", "restitution")  # keys of [[joint]]
OF_LINK = ("mass", "com", *(f"inertia.{entry}" for entry in INERTIA))
INERTIA_ENTRIES = {entry: ("xyz".index(entry[1]), "xyz".index(entry[2])) for entry in INERTIA}  # rows and columns
VECTORS = ("gravity", "com", "xyz", "rpy")  # keys of three numbers each
UNBOUNDED = 1e300  # what the URDF's limits are where there is none
OF_ENTRY = {
    "loop": ("frame_a.xyz", "frame_a.rpy", "frame_b.xyz", "frame_b.rpy", "length"),
    "coupling": ("ratio", "offset"),
    "spring": ("stiffness", "damping", "rest_length", "rest", "frame_a.xyz", "frame_b.xyz"),
    "force": ("value",),
    "motor": ("ratio", "rotor_inertia", "torque_limit", "speed_limit"),
}  # keys of the file's other tables


def is_parameter(key: str) -> bool:
    """Whether a dotted key names a number of the mechanism, not one of the scene."""
    return key.partition(".")[0] in ROOTS


def plain_values(given: Mapping[str, Any]) -> dict[str, Value]:
    """Return values as they are after a file: lists of three as tuples."""
    return {name: tuple(x) if isinstance(x, list) else x for name, x in given.items()}


def values_of(spec: MechanismSpec, urdf: ElementTree.Element) -> dict[str, Value]:
    """Return every number that has a name, with its value; three of them (a point, a vector) as one.

    Parameters
    ----------
    spec : MechanismSpec
    urdf : Element
        All trees in one <robot>.
    """
    return dict(_all(spec, urdf))


def changed(
    spec: MechanismSpec, urdf: ElementTree.Element, overrides: Overrides, source: str
) -> tuple[MechanismSpec, list[str]]:
    """Change numbers of a mechanism: the elements of `urdf` in place, its file's in what is returned.

    A new mass scales the link's inertia with it, the same body of another density, unless numbers of that inertia are
    given too. A new centre of mass moves the inertia along.

    Returns
    -------
    MechanismSpec
    list of str
        Warnings about the bodies that there are now.

    Raises
    ------
    InputError, MechanismError
        Unknown names (those there are are listed), values that are none, bodies that cannot be.
    """
    present = values_of(spec, urdf)
    require_known(overrides, with_components(present), f"{source}: parameters")
    whole = _whole(present, overrides, source)
    data = spec.to_dict()
    links = {link.attrib["name"]: link for link in urdf.findall("link")}
    joints = {joint.attrib["name"]: joint for joint in urdf.findall("joint")}
    warnings: list[str] = []
    touched, limited = set(), set()
    # masses first: they scale an inertia that may be given too
    for name, value in sorted(whole.items(), key=lambda item: not item[0].endswith(".mass")):
        root, carrier, key = split_name(name)
        if root == "gravity":
            data["gravity"] = value
        elif root == "link":
            _change_link(links[carrier], key, value)
            touched.add(carrier)
        elif root != "joint":
            _change_entry(root, data[root], carrier, key, value)
        elif key in OF_JOINT:
            _entry_of_joint(data, carrier)[key] = value
        elif key in LIMITS:
            _child(joints[carrier], "limit").set(key, _text(value))
            limited.add(carrier)
        else:
            _child(joints[carrier], "origin").set(key, _text(value))
    for name in sorted(touched):
        check_inertial(name, links[name], f"{source}: parameters", warnings)
    for name in sorted(limited):
        check_range(joints[name], f"{source}: parameters: joint {name!r}")
    return convert(data, MechanismSpec, f"{source}: parameters"), warnings


def with_components(values: Mapping[str, Value]) -> dict[str, Value]:
    """Add the components of what has three: `gravity.x`."""
    found: dict[str, Value] = {}
    for name, value in values.items():
        found[name] = value
        if isinstance(value, tuple):
            found.update({f"{name}.{axis}": x for axis, x in zip(AXES, value, strict=True)})
    return found


def parts_of(name: str, known: Mapping[str, Value]) -> list[str]:
    """Return the single numbers that a known name stands for: itself, or a vector's three."""
    return [f"{name}.{axis}" for axis in AXES] if isinstance(known[name], tuple) else [name]


def require_known(names: Iterable[str], known: Mapping[str, Value], where: str, roots: Sequence[str] = ROOTS) -> None:
    """Refuse names that are none of those known (InputError): those there are nearby are listed.

    Parameters
    ----------
    names : iterable of str
    known : mapping
        As `with_components` gives it.
    where : str
        What begins the message.
    roots : sequence of str
        What names may begin with.
    """
    for name in names:
        if name in known:
            continue
        root = name.partition(".")[0]
        if root not in roots:
            raise InputError(f"{where}: {name!r} names nothing; names begin with {', '.join(roots)}")
        carriers = dict.fromkeys(_carrier(other) for other in known if other.partition(".")[0] == root)
        near = [c for c in carriers if name == c or name.startswith(f"{c}.")]
        if near:
            best = max(near, key=len)
            choices = [other for other in known if _carrier(other) == best]
        else:
            choices = list(carriers)
        whose = "mechanism" if root in ROOTS else "scene"
        there = f"there are {', '.join(choices)}" if choices else f"nothing of this {whose} is a {root}"
        raise InputError(f"{where}: no {name!r}; {there}")


def _whole(present: Mapping[str, Value], overrides: Overrides, source: str) -> dict[str, Value]:
    """Put components into what they are of, and check how many numbers each name takes."""
    whole: dict[str, Value] = {}
    for name, value in overrides.items():
        _require_numbers(name, value, source)
        if name in present:
            three = isinstance(present[name], tuple)
            if three != isinstance(value, tuple):
                raise InputError(f"{source}: parameters: {name} takes {'three numbers' if three else 'one number'}")
            whole[name] = value
    for name, value in overrides.items():
        if name in present:
            continue
        of, _, axis = name.rpartition(".")
        if of in overrides:
            raise InputError(f"{source}: parameters: {of} and {name} are both given; give one of them")
        if isinstance(value, tuple):
            raise InputError(f"{source}: parameters: {name} takes one number")
        vector = list(whole.get(of, present[of]))  # type: ignore[arg-type]
        vector[AXES.index(axis)] = value
        whole[of] = (vector[0], vector[1], vector[2])
    return whole


def _require_numbers(name: str, value: Any, source: str) -> None:
    numbers = value if isinstance(value, tuple) else (value,)
    if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers):
        raise InputError(f"{source}: parameters: {name} = {value} is not a finite number")


# --- names -------------------------------------------------------------------------------------------


def _all(spec: MechanismSpec, urdf: ElementTree.Element) -> Iterator[tuple[str, Value]]:
    yield "gravity", spec.gravity
    for link in urdf.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        name = link.attrib["name"]
        yield f"link.{name}.mass", _read(inertial, "mass", "value", 1)[0]
        yield f"link.{name}.com", _three(_read(inertial, "origin", "xyz", 3))
        for entry in INERTIA:
            yield f"link.{name}.inertia.{entry}", _read(inertial, "inertia", entry, 1)[0]
    own = {entry.name: entry for entry in spec.joint}
    for joint in urdf.findall("joint"):
        name = joint.attrib["name"]
        for key in ("xyz", "rpy"):
            yield f"joint.{name}.{key}", _three(_read(joint, "origin", key, 3))
        if joint.attrib["type"] in ("fixed", "floating"):
            continue
        entry_ = own.get(name)
        for key in OF_JOINT:
            given = None if entry_ is None else getattr(entry_, key)
            if key == "restitution" and not (entry_ and entry_.stops):
                continue
            of_urdf = _read(joint, "dynamics", key, 1)[0] if key in ("damping", "friction") else 0.0
            yield f"joint.{name}.{key}", of_urdf if given is None else float(given)
        if entry_ and entry_.stops:  # other limits do nothing
            for key in LIMITS:
                at = _read(joint, "limit", key, 1)[0]
                if abs(at) < UNBOUNDED:
                    yield f"joint.{name}.{key}", at
    yield from _of_file(spec)


def _of_file(spec: MechanismSpec) -> Iterator[tuple[str, Value]]:
    """Numbers of the tables [[loop]], [[coupling]], [[spring]], [[force]] and [[motor]]."""
    data = spec.to_dict()
    for kind, keys in OF_ENTRY.items():
        for k, entry in enumerate(data[kind]):
            for key in keys:
                table, _, last = key.rpartition(".")
                if table:
                    frame = entry.get(table)
                    if frame is not None:
                        at = (0.0, 0.0, 0.0) if isinstance(frame, str) else frame[last]
                        yield f"{kind}.{_called(kind, k, entry)}.{key}", _three(at)
                elif _has(kind, entry, key):
                    yield f"{kind}.{_called(kind, k, entry)}.{key}", float(entry[key] or 0.0)


def _has(kind: str, entry: Mapping[str, Any], key: str) -> bool:
    """Whether an entry has such a number at all."""
    if kind == "spring":
        on_joint = entry["joint"] is not None
        return key in ("stiffness", "damping") or key == ("rest" if on_joint else "rest_length")
    return entry[key] is not None


def _called(kind: str, k: int, entry: Mapping[str, Any]) -> str:
    """Loops and motors have names, the others a number, the first one's is 0."""
    return str({"loop": entry.get("name"), "motor": entry.get("name") or entry.get("joint")}.get(kind) or k)


def _carrier(name: str) -> str:
    """What a number is of: its name without the key at its end."""
    root, _, rest = name.partition(".")
    keys = _keys(root)
    if not keys:
        return root
    at = max(rest.rfind(f".{key}") for key in {key.partition(".")[0] for key in keys})
    return f"{root}.{rest[:at]}"


def _keys(root: str) -> tuple[str, ...]:
    of_urdf = {"link": OF_LINK, "joint": ("xyz", "rpy", *OF_JOINT, *LIMITS)}
    return of_urdf.get(root) or OF_ENTRY.get(root, ())


def split_component(name: str) -> tuple[str, int]:
    """Take a single number's name apart: the vector's that it is of, and which of its three; or itself, and 0."""
    of, _, axis = name.rpartition(".")
    if axis in AXES and of and of.rpartition(".")[2] in VECTORS:
        return of, AXES.index(axis)
    return name, 0


def split_name(name: str) -> tuple[str, str, str]:
    """Take a known name apart, without its component: root, what it is of, and key, ("link", "rod", "mass")."""
    root, _, rest = name.partition(".")
    key = max((key for key in _keys(root) if rest.endswith(f".{key}")), key=len, default="")
    return root, rest.removesuffix(f".{key}"), key


# --- values ------------------------------------------------------------------------------------------


def _read(element: ElementTree.Element, tag: str, attribute: str, count: int) -> list[float]:
    return floats(element.find(tag), attribute, count, " ".join("0" * count), tag)


def _three(numbers: Any) -> tuple[float, float, float]:
    x, y, z = (float(number) for number in numbers)
    return x, y, z


def _text(value: Value) -> str:
    return " ".join(repr(float(x)) for x in (value if isinstance(value, tuple) else (value,)))


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = element.find(tag)
    return ElementTree.SubElement(element, tag) if found is None else found


def _change_link(link: ElementTree.Element, key: str, value: Value) -> None:
    inertial = _child(link, "inertial")
    if key == "com":
        _child(inertial, "origin").set("xyz", _text(value))
    elif key == "mass":
        assert not isinstance(value, tuple)
        before = _read(inertial, "mass", "value", 1)[0]
        _child(inertial, "mass").set("value", _text(value))
        if before > 0 and value >= 0:
            tensor = _child(inertial, "inertia")
            for entry in INERTIA:
                tensor.set(entry, repr(_read(inertial, "inertia", entry, 1)[0] * (value / before)))
    else:
        _child(inertial, "inertia").set(key.removeprefix("inertia."), _text(value))


def _entry_of_joint(data: dict[str, Any], name: str) -> dict[str, Any]:
    entry: dict[str, Any] | None = next((entry for entry in data["joint"] if entry["name"] == name), None)
    if entry is None:
        entry = {"name": name}
        data["joint"].append(entry)
    return entry


def _change_entry(kind: str, entries: list[dict[str, Any]], carrier: str, key: str, value: Value) -> None:
    entry = next(entry for k, entry in enumerate(entries) if _called(kind, k, entry) == carrier)
    table, _, last = key.rpartition(".")
    if not table:
        entry[key] = value
        return
    if isinstance(entry[table], str):
        entry[table] = {"link": entry[table]}
    entry[table][last] = value
