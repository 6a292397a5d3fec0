"""A working folder to begin with: new."""

from __future__ import annotations

import re
from os.path import exists, isdir
from pathlib import Path
from shlex import quote

import click

from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.cli import options
from ckc_pin.cli.output import make_folder, print_json
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import InputError

__all__ = ["new"]

FILES = Path(__file__).parent / "new_files"  # NAME stands for the name, in their texts and their names
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@click.command(epilog=options.examples("ckc new mine", "cd mine", "ckc run . --out first", "ckc play first"))
@click.argument("folder", metavar="NAME", type=options.PATH, help="Of the mechanism: a new folder.")
@options.as_json
def new(folder: Path, as_json: bool) -> None:
    """Make a folder with a mechanism of one loop that runs. Its three files are commented: change them into yours."""
    name = folder.resolve().name if folder.name in ("", ".", "..") else folder.name
    if not NAME.fullmatch(name):
        raise InputError(f"{name!r}: a name is of letters, digits, - and _, and begins with a letter or a digit")
    templates = sorted(FILES.iterdir())
    paths = [folder / path.name.replace("NAME", name) for path in templates]
    there = next((path for path in (folder, *paths) if exists(path) and (path != folder or not isdir(folder))), None)
    if there is not None:
        raise InputError(f"{there}: is there already; give another name")
    with interrupts.deferred():  # all files or none
        make_folder(folder, "")
        for path, template in zip(paths, templates, strict=True):
            write_atomic(path, template.read_text(encoding="utf-8").replace("NAME", name))
    if as_json:
        print_json({"status": "done", "written": [str(path) for path in paths]})
        return
    for path in paths:
        print(f"written: {path}")
    print(f"next: cd {quote(str(folder))} && ckc run .")
