"""Parameters of a mechanism by name, `link.rod.mass`, and overrides of their values.

Overrides are applied to the data of the files: the elements of the URDF and the tables of the mechanism's file. Checks,
loops and assembly then use the new values as if they had been read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

from ckc_pin.base.toml import convert
from ckc_pin.base.validation import suggest_name
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
SIDES = ("lower", "upper")  # of a torque limit with two sides
OF_JOINT = ("armature", "damping", "friction", "restitution")  # keys of [[joint]]
OF_LINK = ("mass", "com", *(f"inertia.{entry}" for entry in INERTIA))
INERTIA_ENTRIES = {entry: ("xyz".index(entry[1]), "xyz".index(entry[2])) for entry in INERTIA}  # rows and columns
VECTORS = ("gravity", "com", "xyz", "rpy")  # keys of three numbers each
UNBOUNDED = 1e300  # absolute value of a limit of the URDF that stands for no limit
OF_ENTRY = {
    "loop": ("frame_a.xyz", "frame_a.rpy", "frame_b.xyz", "frame_b.rpy", "length"),
    "coupling": ("ratio", "offset", "joints"),
    "spring": ("stiffness", "damping", "rest_length", "rest", "frame_a.xyz", "frame_b.xyz"),
    "force": ("value",),
    "motor": ("ratio", "rotor_inertia", "torque_limit", "torque_limit.lower", "torque_limit.upper", "speed_limit"),
}  # keys of the file's other tables


def is_parameter(key: str) -> bool:
    """Whether a dotted key names a number of the mechanism, not one of the scene, whose key ``force`` has no dot."""
    return key.partition(".")[0] in ROOTS and key != "force"


def plain_values(values: Mapping[str, Any]) -> dict[str, Value]:
    """Return values with lists, as JSON has them, converted to tuples."""
    return {name: tuple(x) if isinstance(x, list) else x for name, x in values.items()}


def values_of(spec: MechanismSpec, urdf: ElementTree.Element) -> dict[str, Value]:
    """Return the values of all parameters by name; points and vectors as tuples of three.

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
    """Apply overrides of parameters: to the elements of `urdf` in place, and to a copy of `spec`.

    A new mass scales the inertia of the link, as another density would, unless entries of that inertia are overridden
    too. A new centre of mass moves the inertia with it.

    Returns
    -------
    MechanismSpec
    list of str
        Warnings about the inertias of changed bodies.

    Raises
    ------
    InputError, MechanismError
        Unknown names (similar names are listed), invalid values, or bodies that are not physical.
    """
    present = values_of(spec, urdf)
    require_known(overrides, with_components(present), f"{source}: parameters")
    merged = _merge_components(present, overrides, source)
    data = spec.to_dict()
    links = {link.attrib["name"]: link for link in urdf.findall("link")}
    joints = {joint.attrib["name"]: joint for joint in urdf.findall("joint")}
    warnings: list[str] = []
    touched, limited = set(), set()
    # Masses come first: they scale inertias, whose entries may be overridden too.
    for name, value in sorted(merged.items(), key=lambda item: not item[0].endswith(".mass")):
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
    """Return values with the components of points and vectors added: `gravity.x`."""
    all_values: dict[str, Value] = {}
    for name, value in values.items():
        all_values[name] = value
        if isinstance(value, tuple):
            all_values.update({f"{name}.{axis}": x for axis, x in zip(AXES, value, strict=True)})
    return all_values


def parts_of(name: str, values: Mapping[str, Value]) -> list[str]:
    """Return the names of the components of a vector; of a scalar, its name."""
    return [f"{name}.{axis}" for axis in AXES] if isinstance(values[name], tuple) else [name]


def require_known(names: Iterable[str], values: Mapping[str, Value], where: str, roots: Sequence[str] = ROOTS) -> None:
    """Raise InputError if a name is no parameter; the message lists similar names.

    Parameters
    ----------
    names : iterable of str
    values : mapping
        The parameters, as `with_components` returns them.
    where : str
        Prefix of the message.
    roots : sequence of str
        First words that names may have.
    """
    for name in names:
        if name in values:
            continue
        root = name.partition(".")[0]
        if root not in roots:
            raise InputError(
                f"{where}: {name!r} names nothing; names begin with {', '.join(roots)}{suggest_name(root, roots)}"
            )
        carriers = dict.fromkeys(_carrier(other) for other in values if other.partition(".")[0] == root)
        matches = [c for c in carriers if name == c or name.startswith(f"{c}.")]
        if matches:
            best = max(matches, key=len)
            choices = [other for other in values if _carrier(other) == best]
        else:
            choices = list(carriers)
        whose = "mechanism" if root in ROOTS else "scene"
        there = f"there are {', '.join(choices)}" if choices else f"nothing of this {whose} is a {root}"
        raise InputError(f"{where}: no {name!r}; {there}{suggest_name(name, choices)}")


def _merge_components(present: Mapping[str, Value], overrides: Overrides, source: str) -> dict[str, Value]:
    """Replace overrides of components by overrides of their vectors. Check the number of values of each name."""
    merged: dict[str, Value] = {}
    for name, value in overrides.items():
        _require_numbers(name, value, source)
        if name in present:
            three = isinstance(present[name], tuple)
            if three != isinstance(value, tuple):
                raise InputError(f"{source}: parameters: {name} takes {'three numbers' if three else 'one number'}")
            merged[name] = value
    for name, value in overrides.items():
        if name in present:
            continue
        of, _, axis = name.rpartition(".")
        if of in overrides:
            raise InputError(f"{source}: parameters: {of} and {name} are both given; give one of them")
        if isinstance(value, tuple):
            raise InputError(f"{source}: parameters: {name} takes one number")
        vector = list(merged.get(of, present[of]))  # type: ignore[arg-type]
        vector[AXES.index(axis)] = value
        merged[of] = (vector[0], vector[1], vector[2])
    return merged


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
    entries = {entry.name: entry for entry in spec.joint}
    for joint in urdf.findall("joint"):
        name = joint.attrib["name"]
        for key in ("xyz", "rpy"):
            yield f"joint.{name}.{key}", _three(_read(joint, "origin", key, 3))
        if joint.attrib["type"] in ("fixed", "floating"):
            continue
        entry_ = entries.get(name)
        for key in OF_JOINT:
            value = None if entry_ is None else getattr(entry_, key)
            if key == "restitution" and not (entry_ and entry_.stops):
                continue
            of_urdf = _read(joint, "dynamics", key, 1)[0] if key in ("damping", "friction") else 0.0
            yield f"joint.{name}.{key}", of_urdf if value is None else float(value)
        if entry_ and entry_.stops:  # other limits do nothing
            for key in LIMITS:
                at = _read(joint, "limit", key, 1)[0]
                if abs(at) < UNBOUNDED:
                    yield f"joint.{name}.{key}", at
    yield from _of_file(spec)


def _of_file(spec: MechanismSpec) -> Iterator[tuple[str, Value]]:
    """Parameters of the tables [[loop]], [[coupling]], [[spring]], [[force]] and [[motor]]."""
    data = spec.to_dict()
    for kind, keys in OF_ENTRY.items():
        for k, entry in enumerate(data[kind]):
            for key in keys:
                table, _, last = key.rpartition(".")
                if table == "torque_limit":
                    if not isinstance(entry[table], float | None):
                        yield f"{kind}.{_called(kind, k, entry)}.{key}", float(entry[table][SIDES.index(last)])
                elif table:
                    frame = entry.get(table)
                    if frame is not None:
                        at = (0.0, 0.0, 0.0) if isinstance(frame, str) else frame[last]
                        yield f"{kind}.{_called(kind, k, entry)}.{key}", _three(at)
                elif key == "joints":
                    for joint, coefficient in entry[key].items():
                        yield f"{kind}.{_called(kind, k, entry)}.{key}.{joint}", float(coefficient)
                elif _has(kind, entry, key):
                    yield f"{kind}.{_called(kind, k, entry)}.{key}", float(entry[key] or 0.0)


def _has(kind: str, entry: Mapping[str, Any], key: str) -> bool:
    """Whether an entry has this parameter."""
    if kind == "spring":
        on_joint = entry["joint"] is not None
        return key in ("stiffness", "damping") or key == ("rest" if on_joint else "rest_length")
    return isinstance(entry[key], int | float)


def _called(kind: str, k: int, entry: Mapping[str, Any]) -> str:
    """Name of an entry: loops and motors have names, couplings may have one, and other tables are numbered from 0."""
    names = {"loop": entry.get("name"), "motor": entry.get("name") or entry.get("joint"), "coupling": entry.get("name")}
    return str(names.get(kind) or k)


def _carrier(name: str) -> str:
    """Return a parameter's name without the key at its end: ``link.rod`` of ``link.rod.mass``."""
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
    """Split the name of a component into its vector and the index of the component; of a scalar: its name and 0."""
    of, _, axis = name.rpartition(".")
    if axis in AXES and of and of.rpartition(".")[2] in VECTORS:
        return of, AXES.index(axis)
    return name, 0


def split_name(name: str) -> tuple[str, str, str]:
    """Split the name of a parameter into root, carrier and key: ("link", "rod", "mass")."""
    root, _, rest = name.partition(".")
    if root == "coupling" and ".joints." in rest:
        carrier, _, joint = rest.partition(".joints.")
        return root, carrier, f"joints.{joint}"
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
    child = element.find(tag)
    return ElementTree.SubElement(element, tag) if child is None else child


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
    table, _, last = key.partition(".")
    if not last:
        entry[key] = value
        return
    if table == "torque_limit":
        entry[table][SIDES.index(last)] = value
        return
    if isinstance(entry[table], str):
        entry[table] = {"link": entry[table]}
    entry[table][last] = value
