"""A scene: what to run, loaded by shipped name or path and checked, with the caller's overrides applied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources, write_files
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.toml import convert, read_text, read_toml
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import (
    require_path,
    require_table,
    require_type,
)
from ckc_pin.control.controllers import Controller, TorqueController, as_controller
from ckc_pin.control.forces import Force, LinkForceSpec
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import ControllerSpec, JointServoSpec, SampledSpec, SetPointSpec, TorquesSpec, TrackingSpec
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.mechanism.files import mechanism_sources
from ckc_pin.mechanism.foreign import is_foreign, read_foreign
from ckc_pin.mechanism.library import (
    MECHANISM_FILE,
    GeneratorSpec,
    is_path,
    library,
)
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.arguments import embed_file, embed_files, name_arrays
from ckc_pin.scene.names import DEFAULT, SUFFIX, describe_scene_name, find_scene_file
from ckc_pin.scene.overrides import EXPECTED_OVERRIDES, apply_overrides, join_names
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.saving import scene_texts
from ckc_pin.scene.spec import EventSpec, SceneSpec, SolverSpec

__all__ = ["Scene", "SceneSpec", "SolverSpec", "as_scene", "describe_formulation", "load_scene", "make_scene"]

EXPECTED_SCENE = 'a scene: a Scene, its shipped name, as "five_bar/swing", or its path'
DEFAULT_OUTPUT_INTERVALS = 500  # where a scene gives no output_dt
MAX_OUTPUT_INSTANTS = 1_000_000


@dataclass(frozen=True, repr=False, eq=False, init=False)
class Scene(HasSummary):
    """What to run: mechanism, formulation, start, solver, controller and events. `load_scene` reads one from a file.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
        A mechanism, or its name or path as for `load`. Its parameter values become those of the scene.
    t_end : float
        End time, s.
    formulation : "reduced", "dae" or "spf"
    initial : mapping, optional
        The keys of [initial]. Default: at rest, as assembled.
    controller : mapping or object, optional
        The keys of [controller], or a controller as for `simulate`.
    events : sequence of mapping or Event, optional
        Tables with the keys of [[event]], and event functions.
    forces : sequence of mapping or Force, optional
        Tables with the keys of [[force]], and forces.
    name : str, optional
        Name of the scene and its runs. Default: the mechanism's.
    **keys
        Other keys of a scene file: solver, parameters, prescribed, epsilon, spf_coordinates, coriolis_velocity and
        friction_smoothing.

    Raises
    ------
    InputError, MechanismError
        A wrong argument, an unknown key, or a mechanism that cannot be loaded.

    Attributes
    ----------
    spec : SceneSpec
        The scene file's content.
    name : str
        The name or path that the user gave.
    sources : Sources
        Where the files that the scene names are found: trajectories, controller models and, of a scene file, the
        mechanism.
    mechanism_sources : Sources or None
        The mechanism's files, of a scene made in Python.
    controller : Controller, TorqueController, Sampled or None
        A controller that is an object of Python, instead of one that `spec` describes.
    events : tuple of Event
        Event functions in addition to the events of `spec`.
    forces : tuple of Force
        Forces that are functions of the state, in addition to those of `spec`.

    Notes
    -----
    Wherever a table by coordinate or motor is taken, an array may stand for it, in the order of `independent` or
    `actuated`; `q` of `initial` may also have all coordinates. The `model` of a controller may be a mechanism. Each
    `file` is a path relative to the working directory, or a table of columns, such as a DataFrame.

    Examples
    --------
    >>> drive = {"type": "set_point", "K_P": 10.0, "K_V": 1.0, "q_d": [-1.0, -2.0]}
    >>> scene = Scene("five_bar", t_end=1.0, initial={"q": [-1.4, -1.9]}, controller=drive)
    >>> run = simulate(scene)
    """

    spec: SceneSpec
    name: str
    sources: Sources
    mechanism_sources: Sources | None
    controller: Controller | TorqueController | Sampled | None
    events: tuple[Any, ...]
    forces: tuple[Force, ...]

    def __init__(
        self,
        mechanism: Mechanism | str | Path,
        *,
        t_end: float,
        formulation: str = "reduced",
        initial: Mapping[str, Any] | None = None,
        controller: Any = None,
        events: Sequence[Any] = (),
        forces: Sequence[Any] = (),
        name: str | None = None,
        **keys: Any,
    ) -> None:
        mechanism = as_mechanism(mechanism, "Scene")
        if mechanism.prescribed:
            raise InputError(
                f"Scene: mechanism: its joints {', '.join(mechanism.prescribed)} are held at a position; give it "
                "without them, and their motion as prescribed"
            )
        for key, argument in (("event", "events"), ("force", "forces")):
            if key in keys:
                raise InputError(f"Scene: {key}: the argument is called {argument}")
        start = to_toml_value({} if initial is None else initial)
        if isinstance(start, Mapping) and not {"q", "at"} & set(start):
            start = {"at": "assembled", **start}
        data = to_toml_value(
            {"mechanism": MECHANISM_FILE, "formulation": formulation, "t_end": t_end, "initial": start, **keys}
        )
        if mechanism.overrides and isinstance(data.get("parameters", {}), Mapping):
            data["parameters"] = {**to_toml_value(mechanism.overrides), **data.get("parameters", {})}
        if name is not None:
            require_type(name, str, "Scene: name", "a string")
        scene = make_scene(data, name or mechanism.name, Sources("Scene", None), mechanism_sources(mechanism))
        self.__dict__.update(scene.with_control(controller, events, forces).__dict__)

    def with_overrides(self, overrides: Mapping[str, Any] | None) -> Scene:
        """Return the scene with values replaced by dotted key, as in `load_scene`.

        Raises
        ------
        InputError
            An unknown key, or a wrong type or value.
        """
        if not overrides:
            return self
        data = apply_overrides(self.to_dict(), overrides)
        is_other_mechanism = any(key.partition(".")[0] == "mechanism" for key in overrides)
        scene = make_scene(data, self.name, self.sources, None if is_other_mechanism else self.mechanism_sources)
        controller = None if "controller" in overrides else self.controller
        return _create(scene, events=self.events, forces=self.forces, controller=controller)

    def with_control(self, controller: Any, events: Sequence[Any], forces: Sequence[Any] = ()) -> Scene:
        """Return the scene with another controller, and with further events and forces.

        Parameters
        ----------
        controller : mapping, object or None
            A table replaces the scene's controller. An object acts instead of it, within its torque limits. None keeps
            the scene's controller.
        events : sequence of mapping or Event
        forces : sequence of mapping or Force

        Raises
        ------
        InputError
            A controller or a table that is not valid.
        """
        require_type(events, (list, tuple), "events", "a list of Event objects and of tables as a scene's [[event]]")
        require_type(forces, (list, tuple), "forces", "a list of Force objects and of tables as a scene's [[force]]")
        if controller is None and not events and not forces:
            return self
        source, scene = self.sources.name, self
        overrides: dict[str, Any] = {}
        if isinstance(controller, Mapping | msgspec.Struct):
            table, texts = to_toml_value(controller), dict(self.sources.available)
            embed_files(table, texts, reads_paths=self.sources.folder is None)
            overrides["controller"], scene = table, _create(self, sources=self.sources.with_texts(texts))
        elif controller is not None:
            law = controller if isinstance(controller, Sampled) else as_controller(controller)
            scene = _create(self, controller=law)
        tables = [to_toml_value(event) for event in events if isinstance(event, Mapping | msgspec.Struct)]
        if tables:
            convert(tables, list[EventSpec], source, "events")
            overrides["event"] = [*scene.to_dict()["event"], *tables]
        functions = tuple(event for event in events if not isinstance(event, Mapping | msgspec.Struct))
        scene = _create(scene.with_overrides(overrides), events=(*self.events, *functions))
        return scene._with_forces(forces) if forces else scene

    def _with_forces(self, forces: Sequence[Any]) -> Scene:
        """Return the scene with further forces; those with constant values become tables."""
        texts, tables, functions = dict(self.sources.available), [], []
        for k, force in enumerate(forces):
            if isinstance(force, Force):
                spec = force.as_spec()
                tables += [] if spec is None else [to_toml_value(spec)]
                functions += [force] if spec is None else []
                continue
            require_type(force, (Mapping, msgspec.Struct), f"forces[{k}]", "a Force, or a table as a scene's [[force]]")
            table = to_toml_value(force)
            embed_file(table, f"force_{k}.csv", texts, f"forces[{k}].file", reads_paths=self.sources.folder is None)
            tables.append(table)
        convert(tables, list[LinkForceSpec], self.sources.name, "forces")
        scene = _create(self, sources=self.sources.with_texts(texts), forces=(*self.forces, *functions))
        return scene.with_overrides({"force": [*scene.to_dict()["force"], *tables]}) if tables else scene

    def save(self, folder: str | Path, name: str = DEFAULT, *, overwrite: bool = False) -> Path:
        """Write the scene and all its files into a folder, so that ``ckc run`` does the same.

        The files are NAME.scene.toml, mechanism.toml with its URDFs, CSV files, and the folder ``model`` of the
        controller's own model. Mesh files are not copied; playback takes their folder as ``meshes``.

        Parameters
        ----------
        folder : str or Path
            Created if it does not exist.
        name : str
            Of the scene in its file's name.
        overwrite : bool
            Whether existing files may be replaced.

        Returns
        -------
        Path
            Of the scene file.

        Raises
        ------
        InputError
            A file exists already, the folder cannot be written to, or the scene's controller or an event is an object
            of Python.
        """
        require_path(folder, "Scene.save: folder")
        require_type(name, str, "Scene.save: name", "a string")
        if Path(name).name != name:
            raise InputError(f"Scene.save: name = {name!r:.80}: expected a file name without {SUFFIX}")
        file = f"{name}{SUFFIX}"
        write_files(Path(folder), scene_texts(self, file), overwrite)
        return Path(folder) / file

    def summary(self) -> Summary:
        """Return a one-screen summary: mechanism, formulation, start, method, control and events."""
        spec = self.spec
        mechanism, start = spec.mechanism, spec.initial.at
        if isinstance(mechanism, GeneratorSpec):
            mechanism = f"{mechanism.generator}, N = {mechanism.N}"
        if self.mechanism_sources is not None:
            mechanism = self.mechanism_sources.name
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
        is_object = self.controller is not None
        rows.append(("control", type(self.controller).__name__ if is_object else _describe_controller(spec.controller)))
        rows += [("force", f"on {force.name or force.frame}") for force in spec.force]
        rows += [("force", f"on {force.name or force.frame}, a function of the state") for force in self.forces]
        rows += [("event", f"{event.of} of {event.coordinate or 'the mechanism'}") for event in spec.event]
        rows += [("event", "a function of the state") for _ in self.events]
        return Summary(f"Scene {self.name}", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the scene with all defaults filled in, as JSON-ready data; absent values have no key."""
        data: dict[str, Any] = msgspec.msgpack.decode(self._packed)
        return data

    @cached_property
    def _packed(self) -> bytes:
        return msgspec.msgpack.encode(_drop_absent(msgspec.to_builtins(self.spec)))

    @property
    def has_forces(self) -> bool:
        """Whether the scene has forces on links."""
        return bool(self.spec.force or self.forces)

    def refuse_forces(self, function: str) -> None:
        """Raise InputError if the scene has forces on links, for a function that does not support them."""
        if self.has_forces:
            raise InputError(f"{function}: forces on links are not supported; remove [[force]]")

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
        case JointServoSpec():
            return f"servos of {', '.join(spec.motor)}"
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


def load_scene(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene by shipped name or path.

    Parameters
    ----------
    name : str or Path
        ``"five_bar/tracking"``, ``"five_bar"`` (its default scene), or a path. A file in the format of another program
        is imported in memory, with its notes as a warning, and moves freely from its assembled configuration.
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
    if is_foreign(name):
        sources = read_foreign(Path(name))
        data = read_toml(sources.text(f"{DEFAULT}{SUFFIX}"), sources.name)
        scene_data = apply_overrides(data, overrides or {})
        return make_scene(scene_data, Path(name).stem, sources, sources.with_texts({}))
    path = find_scene_file(name)
    source = str(path) if isinstance(name, Path) or is_path(name) else name
    data = read_toml(read_text(path, "scene"), source)
    return make_scene(
        apply_overrides(data, overrides or {}), describe_scene_name(name, path), Sources(source, path.parent)
    )


def as_scene(scene: Any, overrides: Mapping[str, Any] | None, caller: str) -> Scene:
    """Return a public function's scene argument as a `Scene`: itself, or loaded by name or path, with overrides.

    Parameters
    ----------
    scene : Scene, str or Path
    overrides : mapping or None
        Values by dotted key.
    caller : str
        The public function, for messages.

    Raises
    ------
    InputError, MechanismError
        Another type, or an error of `load_scene`.
    """
    if isinstance(scene, Mechanism):
        folder = scene.sources.folder
        names = [] if folder is None else sorted(path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}"))
        is_shipped = folder is not None and folder.parent == library()
        examples = ", ".join(f"{folder.name}/{name}" if is_shipped and folder else f"{name}{SUFFIX}" for name in names)
        raise InputError(
            f"{caller}: expected {EXPECTED_SCENE}; got a Mechanism, which has no start and no end time; make a scene "
            "of it, ckc_pin.Scene(mechanism, t_end=1.0)" + (f"; scenes of {scene.name}: {examples}" if examples else "")
        )
    require_type(scene, (Scene, str, Path), f"{caller}: scene", EXPECTED_SCENE)
    if overrides is not None:
        require_table(overrides, f"{caller}: overrides", EXPECTED_OVERRIDES)
    return scene.with_overrides(overrides) if isinstance(scene, Scene) else load_scene(scene, overrides)


def make_scene(data: dict[str, Any], name: str, sources: Sources, plant_sources: Sources | None = None) -> Scene:
    """Return a scene of parsed data, checked for types by msgspec and then for keys that exclude or need each other.

    Parameters
    ----------
    data : dict
        The keys of a scene file. It is changed: lists become tables by coordinate or motor.
    name : str
        Name of the scene.
    sources : Sources
        The files that it names.
    plant_sources : Sources, optional
        The mechanism's files, if they are not found by the key `mechanism`.

    Raises
    ------
    InputError
        An invalid scene.
    MechanismError
        There are lists, and the mechanism, whose coordinates they are of, cannot be loaded.
    """

    def load() -> Mechanism:
        part = {key: data[key] for key in ("mechanism", "parameters", "prescribed") if key in data}
        spec = convert({**part, "formulation": "dae", "t_end": 1.0}, SceneSpec, sources.name)
        return load_scene_mechanism(_create(spec=spec, name=name, sources=sources, mechanism_sources=plant_sources))

    join_names(data)
    if isinstance(data.get("controller"), dict):
        texts: dict[str, str] = {}
        embed_files(data["controller"], texts, reads_paths=False)
        sources = sources.with_texts(texts) if texts else sources
    name_arrays(data, load, sources.name)
    spec = convert(data, SceneSpec, sources.name)
    if spec.initial.at is not None and spec.initial.q:
        raise InputError(f'{sources.name}: initial: give either at = "{spec.initial.at}" or q, not both')
    if spec.initial.at is None and not spec.initial.q:
        raise InputError(
            f'{sources.name}: initial: give q (a table by coordinate), at = "equilibrium" or at = "assembled"'
        )
    if spec.initial.w is not None and spec.formulation != "spf":
        raise InputError(f"{sources.name}: initial.w: only the SPF can start off phi = 0, not {spec.formulation!r}")
    if isinstance(spec.controller, SampledSpec) and spec.controller.sample_time is None:
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
    return _create(spec=spec, name=name, sources=sources, mechanism_sources=plant_sources)


def _create(scene: Scene | None = None, **attributes: Any) -> Scene:
    """Return a scene with these attributes. The others are those of `scene`, or absent."""
    names = [field.name for field in fields(Scene)]  # without cached properties
    defaults = (
        {"controller": None, "events": (), "forces": ()}
        if scene is None
        else {name: getattr(scene, name) for name in names}
    )
    new = object.__new__(Scene)
    new.__dict__.update({**defaults, **attributes})
    return new


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


def _drop_absent(value: Any) -> Any:
    """Remove keys whose value is None, at every depth."""
    if isinstance(value, dict):
        return {key: _drop_absent(x) for key, x in value.items() if x is not None}
    return [_drop_absent(x) for x in value] if isinstance(value, list | tuple) else value
