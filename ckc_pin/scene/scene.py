"""A scene: what to run, loaded by shipped name or path and checked, with the caller's overrides applied."""

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

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.toml import convert, find_faults, join_dotted_keys, read_text, read_toml
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import MIN_SIMILARITY, find_nearest_name, require_table, require_type, suggest_name
from ckc_pin.control.spec import ControllerSpec, FeedbackSpec, SetPointSpec, TorquesSpec, TrackingSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import (
    MECHANISM_FILE,
    GeneratorSpec,
    describe_mechanism,
    first_comment,
    is_path,
    library,
    shipped,
)
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import ROOTS, is_parameter
from ckc_pin.scene.spec import EventSpec, SceneSpec, SolverSpec

__all__ = [
    "Scene",
    "SceneSpec",
    "SolverSpec",
    "apply_overrides",
    "as_scene",
    "describe_formulation",
    "list_catalogue",
    "list_scene_names",
    "load_scene",
]

SUFFIX = ".scene.toml"
DEFAULT = "default"
TABLES_BY_NAME = (("initial", "q"), ("initial", "q_dot"), ("controller", "q_d"), ("parameters",))  # keys contain dots
EXPECTED_SCENE = 'a scene: its shipped name, as "five_bar/swing", its path, or what load_scene returns'
EXPECTED_OVERRIDES = 'a table of values by dotted key, as {"solver.rtol": 1e-10}'
DEFAULT_OUTPUT_INTERVALS = 500  # where a scene gives no output_dt
MAX_OUTPUT_INSTANTS = 1_000_000


@dataclass(frozen=True, repr=False)
class Scene(HasSummary):
    """A checked scene: mechanism, formulation, start, solver, controller and events of a run.

    Attributes
    ----------
    spec : SceneSpec
        The scene file's content.
    name : str
        The name or path that the user gave.
    sources : Sources
        Where the files that the scene names are found: mechanism, trajectories, controller models.
    """

    spec: SceneSpec
    name: str
    sources: Sources

    def summary(self) -> Summary:
        """Return a one-screen summary: mechanism, formulation, start, method, control and events."""
        spec = self.spec
        mechanism, start = spec.mechanism, spec.initial.at
        if isinstance(mechanism, GeneratorSpec):
            mechanism = f"{mechanism.generator}, N = {mechanism.N}"
        q = [f"{name} = {value:g}" for name, value in spec.initial.q.items()]
        rows: list[Row] = [
            ("mechanism", mechanism),
            ("formulation", describe_formulation(self.to_dict(), exact=not any(spec.initial.w or ()))),
            ("t_end", f"{spec.t_end:g} s"),
            ("starts", q if start is None else f"at {start}"),
        ]
        rates = [f"{name} = {value:g}" for name, value in spec.initial.q_dot.items() if value]
        rows += [("with rates", rates)] if rates else []
        rows.append(("method", f"{spec.solver.method}, rtol = {spec.solver.rtol:g}"))
        rows.append(("control", _describe_controller(spec.controller)))
        rows += [("event", f"{event.of} of {event.coordinate or 'the mechanism'}") for event in spec.event]
        return Summary(f"Scene {self.name}", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the scene with all defaults filled in, as JSON-ready data; absent values have no key."""
        data: dict[str, Any] = msgspec.msgpack.decode(self._packed)
        return data

    @cached_property
    def _packed(self) -> bytes:
        return msgspec.msgpack.encode(_drop_absent(msgspec.to_builtins(self.spec)))

    def output_instants(self) -> Array:
        """Return the times at which a run of this scene is recorded, shape (m,), s, from 0 to t_end.

        Raises
        ------
        InputError
            `solver.output_dt` asks for more than 1,000,000 instants.
        """
        t_end, output_dt = self.spec.t_end, self.spec.solver.output_dt
        if output_dt is None:
            # A t_end of a few denormal numbers has fewer than 501 different instants.
            return np.unique(np.linspace(0.0, t_end, DEFAULT_OUTPUT_INTERVALS + 1, dtype=float))
        if t_end / output_dt > MAX_OUTPUT_INSTANTS:
            raise InputError(
                f"{self.sources.name}: solver.output_dt = {output_dt:g} gives more than {MAX_OUTPUT_INSTANTS} output "
                f"instants in {t_end:g} s"
            )
        times = np.arange(int(t_end / output_dt * (1 + 1e-12)) + 1, dtype=float) * output_dt
        if t_end - times[-1] > 1e-9 * min(output_dt, t_end):
            return np.append(times, t_end)
        times[-1] = t_end
        return times


def _describe_desired(desired: dict[str, Any]) -> str:
    """Return the file or the point that a desired motion comes from, or the coordinates that it names."""
    for key in ("point", "file"):
        if isinstance(desired.get(key), str):
            return f"the {key} {desired[key]}"
    return ", ".join(desired)


def _describe_controller(spec: ControllerSpec | None) -> str:
    match spec:
        case None:
            return "none"
        case SetPointSpec():
            return f"set point, K_P = {spec.K_P}, K_V = {spec.K_V}"
        case TrackingSpec():
            return f"tracking, Lambda = {spec.Lambda}, K_D = {spec.K_D}, of {_describe_desired(spec.desired)}"
        case TorquesSpec():
            return f"torques of {spec.file}"


def describe_formulation(scene: dict[str, Any], *, exact: bool) -> str:
    """Return a scene's formulation as text.

    Parameters
    ----------
    scene : dict
        `Scene.to_dict`.
    exact : bool
        Whether the SPF starts on phi = 0. In the coordinates of eq. 17 it then equals the reduced model.
    """
    if scene["formulation"] != "spf":
        return str(scene["formulation"])
    coordinates = scene["spf_coordinates"]
    # In eq. 17's coordinates epsilon occurs only in w = w(0) exp(-t / epsilon).
    same = ": from w(0) = 0 bit for bit the reduced model, whatever epsilon" if exact and coordinates == "w" else ""
    return f"spf in (q, q_dot, {coordinates}), epsilon = {scene['epsilon']:g}{same}"


def list_scene_names(mechanism: str) -> list[str]:
    """Return the names of a shipped mechanism's scenes."""
    return sorted(p.name.removesuffix(SUFFIX) for p in (library() / mechanism).glob(f"*{SUFFIX}"))


def find_scene_file(name: str | Path) -> Path:
    """Return the path of a scene given as MECHANISM, MECHANISM/SCENE, a path, or a path without ``.scene.toml``.

    Raises
    ------
    InputError
        There is no such scene. The message lists the existing ones.
    """
    if isinstance(name, Path) or is_path(name):
        path = Path(name)
        if isdir(path) or path.name == MECHANISM_FILE:
            path = _find_default(path if isdir(path) else path.parent)
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
    raise InputError(f"{mechanism} has no scene {scene!r}; it has {', '.join(list_scene_names(mechanism))}")


def _find_default(folder: Path) -> Path:
    """Return a folder's default scene, or its only one."""
    path = folder / f"{DEFAULT}{SUFFIX}"
    others = sorted(p.name for p in folder.glob(f"*{SUFFIX}"))
    if isfile(path):
        return path
    if len(others) == 1:
        return folder / others[0]
    if others:
        raise InputError(f"{folder}: no {path.name}; name one of its scenes: {', '.join(others)}")
    if isfile(folder / "run.npz"):
        raise InputError(f"{folder}: a finished run, not a scene; ckc play, plot and inverse accept this folder")
    raise InputError(f"{folder}: it contains no scene, *{SUFFIX}; ckc new NAME makes a folder with an example")


def load_scene(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene by shipped name or path.

    Parameters
    ----------
    name : str or Path
        ``"five_bar/tracking"``, ``"five_bar"`` (its default scene), or a path.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"solver.rtol": 1e-10}``, and by the names of the mechanism's parameters, e.g.
        ``{"link.link_2.mass": 0.3}``.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        A missing file, malformed TOML, an unknown key, a wrong type or value.
    """
    require_type(name, (str, Path), "load_scene: name", "a scene's shipped name or its path")
    if overrides is not None:
        require_table(overrides, "load_scene: overrides", EXPECTED_OVERRIDES)
    path = find_scene_file(name)
    source = str(path) if isinstance(name, Path) or is_path(name) else name
    data = read_toml(read_text(path, "scene"), source)
    return make_scene(apply_overrides(data, overrides or {}), _display_name(name, path), Sources(source, path.parent))


def _display_name(name: str | Path, path: Path) -> str:
    """Return the user's name for a scene, or FOLDER/SCENE if the user gave a folder."""
    if not isdir(name):
        return str(name)
    scene = path.name.removesuffix(SUFFIX)
    return path.parent.resolve().name + ("" if scene == DEFAULT else f"/{scene}")


def as_scene(scene: Any, overrides: Mapping[str, Any] | None, caller: str) -> Scene:
    """Return a public function's scene argument as a `Scene`: unchanged, or loaded by name or path.

    Parameters
    ----------
    scene : Scene, str or Path
    overrides : mapping or None
        Values by dotted key. They are accepted only with a name or path.
    caller : str
        The public function, for messages.

    Raises
    ------
    InputError, MechanismError
        Another type, overrides beside a `Scene`, or an error of `load_scene`.
    """
    if isinstance(scene, Mechanism):
        folder = scene.sources.folder
        names = [] if folder is None else sorted(path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}"))
        is_shipped = folder is not None and folder.parent == library()
        examples = ", ".join(f"{folder.name}/{name}" if is_shipped and folder else f"{name}{SUFFIX}" for name in names)
        raise InputError(
            f"{caller}: expected {EXPECTED_SCENE}; got a Mechanism, which has no start and no end time"
            + (f"; scenes of {scene.name}: {examples}" if examples else "")
        )
    require_type(scene, (Scene, str, Path), f"{caller}: scene", EXPECTED_SCENE)
    if overrides is not None:
        require_table(overrides, f"{caller}: overrides", EXPECTED_OVERRIDES)
    if not isinstance(scene, Scene):
        return load_scene(scene, overrides)
    if overrides:
        raise InputError(f"{caller}: overrides are accepted only with the name or path of a scene, not with a Scene")
    return scene


def make_scene(data: dict[str, Any], name: str, sources: Sources) -> Scene:
    """Return a scene of parsed data, checked for types by msgspec and then for keys that exclude or need each other.

    Raises
    ------
    InputError
    """
    for table in TABLES_BY_NAME:
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
        for key in ("delay", "sensor", "drive"):
            if getattr(spec.controller, key):
                raise InputError(
                    f"{sources.name}: controller.{key}: it needs a sampled controller; give controller.sample_time too"
                )
    for k, event in enumerate(spec.event):
        _check_event(event, f"{sources.name}: event[{k}]")
    if spec.solver.baumgarte and spec.formulation != "dae":
        raise InputError(f'{sources.name}: solver: baumgarte is for formulation = "dae", not {spec.formulation!r}')
    if spec.solver.baumgarte and spec.solver.projection:
        raise InputError(f"{sources.name}: solver.baumgarte replaces projection; give solver.projection = false too")
    min_step, max_step = spec.solver.min_step, spec.solver.max_step
    if max_step is not None and min_step > max_step:
        raise InputError(f"{sources.name}: solver: min_step = {min_step:g} is above max_step = {max_step:g}")
    return Scene(spec, name, sources)


def _check_event(event: EventSpec, where: str) -> None:
    """Raise InputError for keys of an event that exclude or need each other."""
    is_margin = event.of.startswith("sigma_min")
    if event.coordinate is None and event.of in ("q", "q_dot"):
        raise InputError(f"{where}: the key 'coordinate' is missing; of = {event.of!r} needs one")
    if event.coordinate is not None and is_margin:
        raise InputError(f"{where}: of = {event.of!r} belongs to the whole mechanism; remove the key 'coordinate'")
    if event.value is not None and event.of == "limit":
        raise InputError(f"{where}: of = 'limit' takes the limits of the URDF; remove the key 'value'")
    if is_margin and not (event.value or 0.0) > 0:
        raise InputError(f"{where}: of = {event.of!r} needs a value greater than 0, because singular values are >= 0")


def apply_overrides(data: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a scene's data with values replaced by dotted key; None removes a key.

    The name of a mechanism parameter, as ``link.rod.mass``, stands for its entry in the table ``parameters``. Names of
    parameters and coordinates may contain dots.
    """
    result = deepcopy(data)
    for path in TABLES_BY_NAME:
        join_dotted_keys(result, *path)
    for key, value in overrides.items():
        _check_root(key)
        *tables, last = _split_key(f"parameters.{key}" if is_parameter(key) else key)
        if value is None:
            _remove_key(result, key, tables, last)
            continue
        target = result
        for k, table in enumerate(tables):
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise InputError(f"{key}: {'.'.join(tables[: k + 1])} is a value, not a table")
        target[last] = to_toml_value(value)
    return result


def _remove_key(data: dict[str, Any], key: str, tables: list[str], last: str) -> None:
    """Remove a key from a scene's data, in place. A key that a scene may have and this one has not is no error.

    Raises
    ------
    InputError
        No scene has such a key, or the scene's table of names has no such entry.
    """
    target: Any = data
    for table in tables:
        target = target.get(table) if isinstance(target, dict) else None
    if isinstance(target, dict) and last in target:
        del target[last]
        return
    where = ".".join(tables)
    if tuple(tables) in TABLES_BY_NAME:
        names = ", ".join(target or {}) or "nothing"
        raise InputError(
            f"{key}: the scene has no such entry to remove; {where} has {names}{suggest_name(last, target or {})}"
        )
    probe: dict[str, Any] = deepcopy(data)
    inner = probe
    for table in tables:
        inner[table] = inner.get(table) if isinstance(inner.get(table), dict) else {}
        inner = inner[table]
    inner[last] = None
    for fault in find_faults(probe, SceneSpec):
        *path, name = [*fault.path, fault.value]
        if fault.kind == "unknown key" and [*tables, last][: len(path) + 1] == [*path, name]:
            raise InputError(f"{key}: a scene has no such key to remove: {fault.sentence()}")


def _check_root(key: str) -> None:
    """Raise InputError if a key begins almost like the name of a mechanism parameter, and not like a scene's key."""
    root, keys = key.partition(".")[0], SceneSpec.__struct_fields__
    if root in keys or is_parameter(key):
        return
    nearest = find_nearest_name(root, [*keys, *ROOTS], MIN_SIMILARITY)
    if nearest in ROOTS:
        raise InputError(
            f"{key}: neither a key of a scene nor a parameter of a mechanism, which begins with {', '.join(ROOTS)}"
            f"{suggest_name(key, [nearest + key.removeprefix(root)])}"
        )


def _split_key(key: str) -> list[str]:
    """Split a dotted key into tables and key. Names in `TABLES_BY_NAME` keep their dots."""
    for path in TABLES_BY_NAME:
        start = ".".join([*path, ""])
        if key.startswith(start):
            return [*path, key.removeprefix(start)]
    return key.split(".")


def _drop_absent(value: Any) -> Any:
    """Remove keys whose value is None, at every depth."""
    if isinstance(value, dict):
        return {key: _drop_absent(x) for key, x in value.items() if x is not None}
    return [_drop_absent(x) for x in value] if isinstance(value, list | tuple) else value


def list_catalogue() -> list[tuple[str, str, dict[str, str]]]:
    """Return (name, description, {scene: description}) of each shipped mechanism.

    The description is the first comment of the file, so that it is kept in one place.
    """
    return [
        (
            name,
            describe_mechanism(name),
            {scene: first_comment(_read_scene(name, scene)) for scene in list_scene_names(name)},
        )
        for name in shipped()
    ]


def _read_scene(mechanism: str, scene: str) -> str:
    return read_text(library() / mechanism / f"{scene}{SUFFIX}", "scene")


def is_scene_name(name: str) -> bool:
    """Whether a name or path denotes a scene, not a mechanism."""
    if is_path(name):
        return name.endswith(SUFFIX)
    return "/" in name or isfile(f"{name}{SUFFIX}")
