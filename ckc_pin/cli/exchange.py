"""From and to other programs' formats: import, export."""

from __future__ import annotations

import os
from pathlib import Path

import click

import ckc_pin
from ckc_pin.cli import options
from ckc_pin.cli.output import Working, errors, print_json, print_summary
from ckc_pin.cli.signals import interrupts
from ckc_pin.formats import exporting, importing

__all__ = ["export", "import_"]


@click.command("import", epilog=options.examples("ckc import cassie.xml --out mechanisms/cassie"))
@click.argument(
    "file",
    metavar="FILE",
    type=options.PATH,
    help="MuJoCo's MJCF, a URDF, or a robot.yaml beside its URDF.",
)
@options.out(help="Folder to write to; absent: one named after it.")
@options.overwrite
@options.as_json
def import_(file: Path, out: Path | None, overwrite: bool, as_json: bool) -> None:
    """Take a robot from another format. Writes a mechanism.toml and a URDF, and says what was guessed and left out."""
    # MuJoCo imports GLFW for its windows. GLFW starts a Python process, which prints a traceback on Ctrl-C.
    os.environ.setdefault("MUJOCO_GL", "disable")
    with Working(f"reading {file.name}"):
        draft = importing.read(file)
    with interrupts.deferred():  # both files or none
        written = importing.write(draft, out or Path(draft.name), overwrite)
    found, problem = None, ""
    try:
        found = ckc_pin.check(written[0])
    except ckc_pin.MechanismError as error:  # a finding: what was written is there to be corrected
        problem = str(error)
    if as_json:
        result = {"status": "done", **found.to_dict()} if found else {"status": "error", "message": problem}
        paths = [str(path) for path in written]
        said = {"left_out": draft.left_out, "guessed": draft.guessed}
        print_json({"status": "done", "written": paths, **said, "check": result})
        return
    for verb, items in (("written", written), ("guessed", draft.guessed), ("left out", draft.left_out)):
        for item in items:
            print(f"{verb}: {item}")
    if found:
        print_summary(found.summary())
    else:
        print(f"check: {problem}")


@click.command(
    epilog=options.examples("ckc export five_bar --to mjcf > five_bar.xml", "ckc export mine --to mjcf --out models")
)
@options.mechanism
@click.option("--to", type=click.Choice(["mjcf"]), default="mjcf", help="mjcf: a model of MuJoCo.")
@options.out(help="Folder to write to; absent: print it.")
@options.overwrite
@options.as_json
def export(mechanism: str, to: str, out: Path | None, overwrite: bool, as_json: bool) -> None:
    """Write a mechanism for another program. Says what moves otherwise there."""
    with Working(f"export of {mechanism}"):
        found = exporting.export(ckc_pin.load(mechanism), to)
    written = [] if out is None else [exporting.write(found, out, overwrite)]
    if as_json:
        text = {} if written else {"text": found.text}
        print_json({"status": "done", "written": [str(path) for path in written], **text, "differs": found.differences})
        return
    print("\n".join(f"written: {path}" for path in written) if written else found.text)
    for difference in found.differences:
        (print if written else errors().print)(f"differs: {difference}")
