"""Scenes: what to run, as a typed structure, by shipped name or by path, with keys changed on the way."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from os.path import isdir, isfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ckc_pin.base.sources import Sources
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.base.toml import convert, join_dotted_keys, read_text, read_toml
from ckc_pin.base.validation import require_table, require_type
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import MECHANISM_FILE, describe_mechanism, first_comment, is_path, library, shipped
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import is_parameter
from ckc_pin.scene.spec import EventSpec, SceneSpec, SolverSpec
from ckc_pin.scene.summary import scene_summary

__all__ = ["Scene", "SceneSpec", "SolverSpec", "apply_overrides", "as_scene", "as_toml", "load_scene", "scene_names"]

SUFFIX = ".scene.toml"
DEFAULT = "default"
BY_NAME = (("initial", "q"), ("initial", "q_dot"), ("controller", "q_d"), ("parameters",))  # tables with dots in keys
TAKES = 'a scene: its shipped name, as "five_bar/swing", its path, or what load_scene returns'
OVERRIDES = 'a table of values by dotted key, as {"solver.rtol": 1e-10}'


@dataclass(frozen=True, repr=False)
class Scene(HasSummary):
    """A checked scene and where its files are.

    Attributes
    ----------
    spec : SceneSpec
    name : str
        As the user called it.
    sources : Sources
        For the mechanism file, trajectories and models that the scene names.
    """

    spec: SceneSpec
    name: str
    sources: Sources

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return scene_summary(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the scene as resolved, as plain data without absent values."""
        found: dict[str, Any] = msgspec.msgpack.decode(self._packed)
        return found

    @cached_property
    def _packed(self) -> bytes:
        return msgspec.msgpack.encode(_present(msgspec.to_builtins(self.spec)))


def scene_names(mechanism: str) -> list[str]:
    """Names of a shipped mechanism's scenes."""
    return sorted(p.name.removesuffix(SUFFIX) for p in (library() / mechanism).glob(f"*{SUFFIX}"))


def scene_file(name: str | Path) -> Path:
    """Return the path of a scene given as MECHANISM, MECHANISM/SCENE, a path, or one without its ending.

    Raises
    ------
    InputError
        No such scene; the message lists those there are.
    """
    if isinstance(name, Path) or is_path(name):
        path = Path(name)
        if isdir(path) or path.name == MECHANISM_FILE:
            path = _default(path if isdir(path) else path.parent)
        return path
    if isfile(f"{name}{SUFFIX}"):
        return Path(f"{name}{SUFFIX}")
    mechanism, _, scene = name.partition("/")
    path = library() / mechanism / f"{scene or DEFAULT}{SUFFIX}"
    if Path(name).parts in ((mechanism,), (mechanism, scene)) and isfile(path):
        return path
    if mechanism not in shipped():
        raise InputError(
            f"no mechanism {mechanism!r}; shipped: {', '.join(shipped())}; or give the path of a *{SUFFIX} file"
        )
    raise InputError(f"{mechanism} has no scene {scene!r}; it has {', '.join(scene_names(mechanism))}")


def _default(folder: Path) -> Path:
    path = folder / f"{DEFAULT}{SUFFIX}"
    others = sorted(p.name for p in folder.glob(f"*{SUFFIX}"))
    if isfile(path):
        return path
    if len(others) == 1:
        return folder / others[0]
    if others:
        raise InputError(f"{folder}: no {path.name}; name one of its scenes: {', '.join(others)}")
    if isfile(folder / "run.npz"):
        raise InputError(f"{folder}: the folder of a run, which is over; ckc play, plot and inverse take it")
    raise InputError(f"{folder}: no scene, *{SUFFIX}, says what to run; ckc new NAME makes a folder with one to copy")


def load_scene(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene by shipped name or path.

    Parameters
    ----------
    name : str or Path
        ``"five_bar/tracking"``, ``"five_bar"`` (its default scene), or a path.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"solver.rtol": 1e-10}``; names of the mechanism's numbers too, e.g.
        ``{"link.link_2.mass": 0.3}``.

    Raises
    ------
    InputError
        A missing file, malformed TOML, an unknown key, a wrong type or value.
    """
    require_type(name, (str, Path), "load_scene: name", "a scene's shipped name or its path")
    if overrides is not None:
        require_table(overrides, "load_scene: overrides", OVERRIDES)
    path = scene_file(name)
    called = str(path) if isinstance(name, Path) or is_path(name) else name
    data = read_toml(read_text(path, "scene"), called)
    return make_scene(apply_overrides(data, overrides or {}), _called(name, path), Sources(called, path.parent))


def _called(name: str | Path, path: Path) -> str:
    """Return what a scene is called: as the user did; of a folder, the folder's own name, with the scene's."""
    if not isdir(name):
        return str(name)
    scene = path.name.removesuffix(SUFFIX)
    return path.parent.resolve().name + ("" if scene == DEFAULT else f"/{scene}")


def as_scene(given: Any, overrides: Mapping[str, Any] | None, who: str) -> Scene:
    """Return the scene that a public function was given: as it is, or loaded by name or path, with overrides.

    Parameters
    ----------
    given
        What it was given.
    overrides : mapping or None
        They go with a name or path.
    who : str
        The function.

    Raises
    ------
    InputError, MechanismError
        No scene; overrides for a Scene, which is complete; what `load_scene` raises.
    """
    if isinstance(given, Mechanism):
        folder = given.sources.folder
        beside = [] if folder is None else sorted(path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}"))
        known = folder is not None and folder.parent == library()
        names = ", ".join(f"{folder.name}/{name}" if known and folder else f"{name}{SUFFIX}" for name in beside)
        raise InputError(
            f"{who}: a Mechanism was given, which does not say from where and how long it moves; it takes {TAKES}"
            + (f"; those of {given.name}: {names}" if names else "")
        )
    require_type(given, (Scene, str, Path), f"{who}: scene", TAKES)
    if overrides is not None:
        require_table(overrides, f"{who}: overrides", OVERRIDES)
    if not isinstance(given, Scene):
        return load_scene(given, overrides)
    if overrides:
        raise InputError(f"{who}: overrides go with the name of a scene; a Scene is complete")
    return given


def make_scene(data: dict[str, Any], name: str, sources: Sources) -> Scene:
    """Check parsed data; where msgspec's checks end, ours begin."""
    for table in BY_NAME:
        join_dotted_keys(data, *table)
    spec = convert(data, SceneSpec, sources.name)
    if spec.initial.at is not None and spec.initial.q:
        raise InputError(f'{sources.name}: initial: give either at = "{spec.initial.at}" or q, not both')
    if spec.initial.at is None and not spec.initial.q:
        raise InputError(
            f'{sources.name}: initial: give q (a table by coordinate), at = "equilibrium" or at = "assembled"'
        )
    if spec.initial.w is not None and spec.formulation != "spf":
        raise InputError(f"{sources.name}: initial.w: only the SPF can start off phi = 0, not {spec.formulation!r}")
    if isinstance(spec.controller, FeedbackSpec) and spec.controller.sample_time is None:
        for key, why in (("delay", "what is sampled is delayed"), ("sensor", "it looks at samples"),
                         ("drive", "it acts on what is sampled")):  # fmt: skip
            if getattr(spec.controller, key):
                raise InputError(f"{sources.name}: controller.{key}: give sample_time too; {why}")
    for k, event in enumerate(spec.event):
        _check_event(event, f"{sources.name}: event[{k}]")
    if spec.solver.baumgarte and spec.formulation != "dae":
        raise InputError(f'{sources.name}: solver: baumgarte is for formulation = "dae", not {spec.formulation!r}')
    if spec.solver.baumgarte and spec.solver.projection:
        raise InputError(f"{sources.name}: solver.baumgarte takes the place of projection: give projection = false too")
    shortest, longest = spec.solver.min_step, spec.solver.max_step
    if longest is not None and shortest > longest:
        raise InputError(f"{sources.name}: solver: min_step = {shortest:g} is above max_step = {longest:g}")
    return Scene(spec, name, sources)


def _check_event(event: EventSpec, where: str) -> None:
    """Refuse keys that do not go together."""
    margin = event.of.startswith("sigma_min")
    if event.coordinate is None and event.of in ("q", "q_dot"):
        raise InputError(f"{where}: the key 'coordinate' is missing; of = {event.of!r} needs one")
    if event.coordinate is not None and margin:
        raise InputError(f"{where}: of = {event.of!r} has no key 'coordinate'; it is the whole mechanism's")
    if event.value is not None and event.of == "limit":
        raise InputError(f"{where}: of = 'limit' has no key 'value'; the limits are those of the URDF")
    if margin and not (event.value or 0.0) > 0:
        raise InputError(f"{where}: of = {event.of!r} needs a value greater than 0: no singular value is ever below 0")


def apply_overrides(data: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene's data with values replaced by dotted key; None removes a key.

    A name of the mechanism's numbers stands for its entry in the table of parameters; so does a coordinate's in those
    by coordinate, whatever dots are in it.
    """
    changed = deepcopy(data)
    for path in BY_NAME:
        join_dotted_keys(changed, *path)
    for key, value in overrides.items():
        *tables, last = _place_of(f"parameters.{key}" if is_parameter(key) else key)
        at = changed
        for k, table in enumerate(tables):
            at = at.setdefault(table, {})
            if not isinstance(at, dict):
                raise InputError(f"{key}: {'.'.join(tables[: k + 1])} is a value, not a table")
        if value is None:
            at.pop(last, None)
        else:
            at[last] = as_toml(value)
    return changed


def _place_of(key: str) -> list[str]:
    """Take a dotted key apart, but for the name of what a table by name has."""
    for path in BY_NAME:
        start = ".".join([*path, ""])
        if key.startswith(start):
            return [*path, key.removeprefix(start)]
    return key.split(".")


def as_toml(value: Any) -> Any:
    """Return a value that a Python program gave as TOML would: NumPy's numbers and arrays as Python's."""
    if isinstance(value, Mapping):
        return {key: as_toml(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [as_toml(inner) for inner in value]
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _present(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _present(v) for k, v in value.items() if v is not None}
    return [_present(v) for v in value] if isinstance(value, list | tuple) else value


def catalogue() -> list[tuple[str, str, dict[str, str]]]:
    """Return (name, what it is, {scene: what it shows}) of each shipped mechanism.

    What a file is about is its first comment, so that the list cannot drift from the files.
    """
    return [
        (
            name,
            describe_mechanism(name),
            {scene: first_comment(_scene_text(name, scene)) for scene in scene_names(name)},
        )
        for name in shipped()
    ]


def _scene_text(mechanism: str, scene: str) -> str:
    return read_text(library() / mechanism / f"{scene}{SUFFIX}", "scene")


def names_a_scene(name: str) -> bool:
    """Whether a name or path is meant as a scene's, not a mechanism's."""
    if is_path(name):
        return name.endswith(SUFFIX)
    return "/" in name or isfile(f"{name}{SUFFIX}")
