"""A functional mock-up unit of a scene: model description, C sources, and a library compiled for this platform."""

from __future__ import annotations

import platform
import re
from functools import partial
from hashlib import sha256
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from msgspec.structs import replace
from scipy.integrate import DOP853

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import temporary_folder
from ckc_pin.codegen.compiler import EXACT, FLAGS, compile_c, find_compiler
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.formats.c.names import initializer
from ckc_pin.formats.c.writer import TEMPLATES as C_TEMPLATES
from ckc_pin.formats.c.writer import fill_templates, make_prefix, require_exportable
from ckc_pin.formats.fmu.model_description import build_description, describe_model
from ckc_pin.formats.fmu.variables import list_stops, list_variables, to_xml_name
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.initial import Start, find_start
from ckc_pin.scene.names import shorten_scene_name
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import Scene

__all__ = ["FMI_VERSIONS", "to_fmu"]

FMI_VERSIONS = ("2.0", "3.0")
TEMPLATES = Path(__file__).parent / "templates"
INCLUDED = ("fmu.c", "stops.c", "directional_derivatives.c", "co_simulation.c")  # by the source of either version
SYSTEMS = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib")}
MACHINES = {"AMD64": "x86_64", "arm64": "aarch64"}
ZERO_ACCELERATION = 1e-10  # rad/s^2, or sizes of the mechanism per s^2: smaller forces of stops count as zero
EARLIEST_ZIP_DATE = (1980, 1, 1, 0, 0, 0)  # a fixed date, so that the same scene gives the same file


def to_fmu(scene: Scene, fmi: str = "2.0") -> tuple[dict[str, str | bytes], list[str]]:
    """Return the FMU of a scene by file name, and notes on how it differs from a run.

    Parameters
    ----------
    scene : Scene
    fmi : "2.0" or "3.0"

    Raises
    ------
    InputError
        A part of the scene or the mechanism has no counterpart, it is too large for compiled terms, or CasADi is
        missing.
    """
    if fmi not in FMI_VERSIONS:
        raise InputError(f"export to fmu: fmi = {fmi!r}: expected one of {', '.join(FMI_VERSIONS)}")
    mechanism = load_scene_mechanism(scene)
    where = f"{scene.name}: export to fmu"
    _require_plant(scene, mechanism, where)
    require_exportable(mechanism, where)
    start = find_start(mechanism, scene)
    name = shorten_scene_name(scene.name)
    stem = re.sub(r"[^\w.-]+", "_", name)
    prefix, spec = make_prefix(stem), scene.spec
    epsilon = spec.epsilon if spec.formulation == "spf" else None
    variables, renamed = list_variables(mechanism, start.at.q_tree, start.q_dot, epsilon)
    source = f"fmi{fmi[0]}.c"
    sources = _write_sources(mechanism, prefix, source, start, epsilon, spec.solver.rtol)
    text = "".join([fmi, *sources.values(), repr(variables)])
    identity = f"{{{sha256(text.encode()).hexdigest()[:32]}}}"
    sources = {name: content.replace("@IDENTITY@", identity) for name, content in sources.items()}
    experiment = {"stopTime": repr(spec.t_end), "tolerance": repr(spec.solver.rtol)}
    tool = f"ckc_pin {version('ckc_pin')}"
    entries: dict[str, str | bytes] = {
        "modelDescription.xml": describe_model(
            fmi, to_xml_name(name), prefix, identity, tool, variables, experiment, source
        ),
        **{f"sources/{name}": content for name, content in sources.items()},
    }
    if fmi != "2.0":
        entries["sources/buildDescription.xml"] = build_description(prefix, source)
    notes = [f"the variable {old} is called {new}" for old, new in renamed.items()]
    notes += _describe_differences(scene)
    library = _compile(scene.name, sources, source)
    if library is None:
        notes.append("no compiler `cc` on PATH: the FMU has sources only, which the importer must compile")
    else:
        folder, suffix = _platform(fmi)
        entries[f"binaries/{folder}/{prefix}{suffix}"] = library
    return {f"{stem}.fmu": _zip(entries)}, notes


def _require_plant(scene: Scene, mechanism: Mechanism, where: str) -> None:
    """Raise InputError for parts of a scene that an FMU of the mechanism alone would leave out."""
    spec = scene.spec
    law = scene.controller or spec.controller
    if law is not None:
        sampled = "a sampled controller" if getattr(spec.controller, "sample_time", None) else "a controller"
        raise InputError(
            f"{where}: {sampled} is not exported, since motor torques are inputs of the FMU; export the scene without "
            "it (--unset controller), and control the FMU in the importer, for example with the C code of --to c"
        )
    if spec.prescribed:
        raise InputError(
            f"{where}: prescribed joints are not supported; remove them (--unset prescribed), and use motor torques as "
            "inputs"
        )
    if spec.force or scene.forces:
        names = ", ".join(str(force.frame) for force in spec.force) or "Python functions"
        raise InputError(
            f"{where}: forces on links ({names}) are not supported; remove them (--unset force), and use the inputs "
            "force.COORDINATE"
        )
    if spec.initial.w is not None and np.any(spec.initial.w):
        raise InputError(f"{where}: initial.w: an FMU starts with closed loops; remove it (--unset initial.w)")
    if spec.formulation == "spf" and mechanism.tree.free_roots:
        raise InputError(
            f"{where}: model exchange by the SPF is not supported for free roots, whose quaternions need length 1; "
            'set formulation = "reduced" (--set formulation=reduced)'
        )


def _describe_differences(scene: Scene) -> list[str]:
    notes = []
    if events := [*scene.spec.event, *scene.events]:
        stops = any(event.stop for event in events)
        notes.append(f"the scene's events are left out{': the FMU goes on where a run stops' if stops else ''}")
    if scene.spec.work:
        notes.append("work is left out")
    if scene.spec.formulation == "spf":
        notes.append(f"model exchange integrates eq. 8 with epsilon = {scene.spec.epsilon:g} s, co-simulation eq. 6")
    return notes


def _write_sources(
    mechanism: Mechanism, prefix: str, source: str, start: Start, epsilon: float | None, rtol: float
) -> dict[str, str]:
    paths = [C_TEMPLATES / "mech.c", C_TEMPLATES / "mech.h", *(TEMPLATES / name for name in (*INCLUDED, source))]
    texts = {path.name: path.read_text(encoding="ascii") for path in paths}
    stops, tree = list_stops(mechanism), mechanism.tree
    inertia = np.diag(Terms(mechanism, start.at, np.zeros(mechanism.n)).D_tree) * tree.step_scale
    more = {
        "STOPS": str(len(stops)),
        "STOPPED": initializer(k for k, _, _ in stops),
        "STOPPED_PLACE": initializer(int(tree.q_index[k]) for k, _, _ in stops),
        "SIDE": initializer(side for _, side, _ in stops),
        "STOP": initializer(x for _, _, x in stops),
        "RESTITUTION": initializer(mechanism.joints.restitution[k] for k, _, _ in stops),
        "NO_FORCE": initializer(ZERO_ACCELERATION * inertia[k] for k, _, _ in stops),
        "IS_SPF": str(int(epsilon is not None)),
        "EPSILON": repr(epsilon or 1.0),
        "RTOL": repr(rtol),
        "START": initializer(start.at.q_tree),
        "START_RATES": initializer(start.q_dot),
        "STATE": initializer(sorted(mechanism.partition.q.tolist())),
        "STAGES": str(len(DOP853.B)),
        "DOP853_A": _matrix(DOP853.A[: len(DOP853.B), : len(DOP853.B)]),
        "DOP853_B": initializer(DOP853.B),
        "DOP853_E3": initializer(DOP853.E3),
        "DOP853_E5": initializer(DOP853.E5),
    }
    return fill_templates(mechanism, prefix, texts, more, derivatives=True)


def _matrix(rows: Array) -> str:
    return "{" + ",\n    ".join(initializer(row) for row in rows) + "}"


def _compile(name: str, sources: dict[str, str], source: str) -> bytes | None:
    """Return the shared library, or None without a compiler."""
    compiler = find_compiler(fuses=False)
    if compiler is None:
        return None
    portable = replace(compiler, flags=(*FLAGS, EXACT, "-fvisibility=hidden"))
    with temporary_folder() as folder:
        for file, content in sources.items():
            (folder / file).write_text(content, encoding="ascii")
        compile_c(portable, folder / source, folder / "library", name)
        return (folder / "library").read_bytes()


def _platform(fmi: str) -> tuple[str, str]:
    """Return the folder of binaries for this platform, and the suffix of shared libraries."""
    system, suffix = SYSTEMS[platform.system()]
    machine = MACHINES.get(platform.machine(), platform.machine())
    return (f"{system}64" if fmi == "2.0" else f"{machine}-{system}"), suffix


def _zip(entries: dict[str, str | bytes]) -> bytes:
    buffer = BytesIO()
    with ZipFile(buffer, "w", ZIP_DEFLATED) as archive:
        make_entry = partial(ZipInfo, date_time=EARLIEST_ZIP_DATE)
        for name, content in entries.items():
            info = make_entry(name)
            info.compress_type = ZIP_DEFLATED
            archive.writestr(info, content)
    return buffer.getvalue()
