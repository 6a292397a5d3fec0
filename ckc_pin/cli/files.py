"""Commands that create mechanism files: new, import; and export to other programs' formats."""

from __future__ import annotations

import os
import re
from importlib.util import find_spec
from pathlib import Path
from shlex import quote
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click

import ckc_pin
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.cli import options
from ckc_pin.cli.output import Spinner, error_console, make_folder, print_json, print_summary, print_written
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from ckc_pin.formats.exporting import Exported

__all__ = ["export", "import_", "new"]

MUJOCO_TIME_STEPS_S = (1e-3, 1e-4, 1e-5)
MAX_MUJOCO_DEVIATION = 1e-3  # rad or m
MAX_COMPARISON_S = 3.0  # a smaller time step is not tried after a longer comparison

TEMPLATES = Path(__file__).parent / "new_files"  # "NAME" in their names and texts is replaced by the mechanism's name
VALID_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@click.command(epilog=options.format_examples("ckc new mine", "cd mine", "ckc run . --out first", "ckc play first"))
@click.argument("folder", metavar="NAME", type=options.PATH, help="Name of the mechanism and its new folder.")
@options.as_json
def new(folder: Path, as_json: bool) -> None:
    """Create a folder with a mechanism of one loop. Its three files can be run and have comments; edit them."""
    name = folder.resolve().name if folder.name in ("", ".", "..") else folder.name
    if not VALID_NAME.fullmatch(name):
        raise InputError(
            f"{name!r}: a name consists of letters, digits, - and _, and begins with a letter or a digit; give another"
        )
    templates = sorted(TEMPLATES.iterdir())
    paths = [folder / path.name.replace("NAME", name) for path in templates]
    existing = [path for path in (folder, *paths) if os.path.exists(path)]
    if os.path.isdir(folder):
        existing.remove(folder)
    if existing:
        raise InputError(f"{existing[0]}: is there already; give another name")
    with interrupts.deferred():  # all files or none
        make_folder(folder, "")
        for path, template in zip(paths, templates, strict=True):
            write_atomic(path, template.read_text(encoding="utf-8").replace("NAME", name))
    if as_json:
        print_json({"status": "done", "written": [str(path) for path in paths]})
        return
    print_written(paths)
    print(f"next: cd {quote(str(folder))} && ckc run .")


@click.command("import", epilog=options.format_examples("ckc import cassie.xml --out mechanisms/cassie"))
@click.argument(
    "file",
    metavar="FILE",
    type=options.PATH,
    help="An MJCF, SDFormat, USD, URDF or xacro file, or a robot.yaml or loop_closures.yaml next to its URDF.",
)
@click.option(
    "--repair",
    is_flag=True,
    help="Replace impossible inertias by the nearest possible ones, and exchange swapped limits.",
)
@options.out(help="Folder to write to; default: the robot's name.")
@options.overwrite
@options.as_json
def import_(file: Path, repair: bool, out: Path | None, overwrite: bool, as_json: bool) -> None:
    """Convert a robot from another format. Writes mechanism.toml and a URDF, and lists guesses and omissions."""
    from ckc_pin.formats import importing

    # MuJoCo imports GLFW for its windows. GLFW starts a Python process, which prints a traceback on Ctrl-C.
    os.environ.setdefault("MUJOCO_GL", "disable")
    with Spinner(f"reading {file.name}"):
        draft = importing.read(file, repair)
    with interrupts.deferred():  # both files or none
        paths = importing.write(draft, out or Path(draft.name), overwrite)
    result, problem = None, ""
    try:
        result = ckc_pin.check(paths[0])
    except ckc_pin.MechanismError as error:  # The files remain, so that the user can correct them.
        problem = str(error)
    if as_json:
        notes = {"warnings": draft.warnings, "left_out": draft.left_out, "guessed": draft.guessed}
        check = {"status": "done", **result.to_dict()} if result else {"status": "error", "message": problem}
        print_json(
            {
                "status": "done",
                "format": draft.origin,
                "written": [str(path) for path in paths],
                **notes,
                "check": check,
            }
        )
        return
    print(f"read as: {draft.origin}")
    lines = (("written", paths), ("warning", draft.warnings), ("guessed", draft.guessed), ("left out", draft.left_out))
    for label, items in lines:
        for item in items:
            print(f"{label}: {item}")
    if result:
        print_summary(result.summary())
    else:
        print(f"check: {problem}")


@click.command(
    epilog=options.format_examples(
        "ckc export five_bar --to mjcf > five_bar.xml",
        "ckc export mine --to mjcf --out models",
        "ckc export five_bar --to c --out controller",
        "ckc export five_bar/swing --to fmu --out units",
    )
)
@click.argument(
    "model",
    metavar="MECHANISM",
    shell_complete=options.complete_scenes,
    help="A shipped name, a folder or a file. With --to fmu, a scene.",
)
@click.option(
    "--to",
    type=click.Choice(["mjcf", "urdf", "sdf", "c", "fmu"]),
    default="mjcf",
    help="mjcf: for MuJoCo; urdf: a tree with <loop> elements; sdf: for Gazebo, with loops as joints; c: C99 of the "
    "dynamics and the controllers, for the computer of a robot; fmu: for Simulink, Dymola, OpenModelica and others.",
)
@click.option("--fmi", type=click.Choice(["2.0", "3.0"]), help="With --to fmu: version of the standard; default 2.0.")
@options.overrides
@options.out(help="Folder to write to; without it the model is printed.")
@options.overwrite
@options.as_json
def export(
    model: str, to: str, fmi: str | None, overrides: dict[str, Any], out: Path | None, overwrite: bool, as_json: bool
) -> None:
    """Convert a mechanism or a scene for another program. Lists how its motion differs there."""
    from ckc_pin.formats import exporting

    if to in ("c", "fmu") and out is None:
        raise InputError(f"export: --to {to} does not write a text that can be printed; give a folder as --out DIR")
    if fmi and to != "fmu":
        raise InputError("export: --fmi is an option of --to fmu; leave it out")
    with Spinner(f"export of {model}"):
        if to == "fmu":
            exported = exporting.export(ckc_pin.load_scene(model, overrides), to, fmi=fmi or "2.0")
        else:
            mechanism = ckc_pin.load(model, overrides or None)
            is_measured = to == "mjcf" and find_spec("mujoco") is not None
            exported = _export_to_mujoco(mechanism) if is_measured else exporting.export(mechanism, to)
    paths = [] if out is None else exporting.write(exported, out, overwrite)
    if as_json:
        text = {} if paths else {"text": exported.text}
        written = [str(path) for path in paths]
        print_json({"status": "done", "written": written, **text, "differs": exported.differences})
        return
    if paths:
        print_written(paths)
    else:
        print(exported.text)
    for difference in exported.differences:
        (print if paths else error_console().print)(f"differs: {difference}")


def _export_to_mujoco(mechanism: ckc_pin.Mechanism) -> Exported:
    """Export to MuJoCo with the largest of a few time steps at which its motion agrees, and say how well it does."""
    from ckc_pin.analysis.precision.mujoco import measure_deviation
    from ckc_pin.formats import exporting

    for time_step in MUJOCO_TIME_STEPS_S:
        exported = exporting.export(mechanism, "mjcf", time_step=time_step)
        started = perf_counter()
        try:
            deviation, duration = measure_deviation(mechanism, exported.text)
        except (ckc_pin.CkcError, ValueError) as error:
            exported.differences.append(f"not compared with MuJoCo's motion: {' '.join(str(error).split())}")
            return exported
        if deviation <= MAX_MUJOCO_DEVIATION or perf_counter() - started > MAX_COMPARISON_S:
            break
    exported.differences.append(
        f"measured within {duration:g} s, from a start at 1 rad/s: {deviation:.1g} rad or m, at the file's time step"
    )
    return exported
