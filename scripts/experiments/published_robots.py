"""Make the tables of docs/published_robots.md: `ckc import`, `ckc check`, a motion, and MuJoCo's masses.

    ./scripts/experiment robots FOLDER

published_robots.toml lists the repositories with their commits and files. FOLDER holds a checkout of each of them at
that commit, in a folder OWNER+NAME. Robots of example-robot-data come from its package (pip install
example-robot-data). A missing file stops the script.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import msgspec

import ckc_pin
from ckc_pin.base.sources import resolve_path
from ckc_pin.formats.importing import Draft, read, write
from scripts.experiments.published_robots_motion import measure_reproduction_error
from scripts.experiments.published_robots_peers import compare_masses

PACKAGE = "package://example-robot-data/robots"
LIST = Path(__file__).with_name("published_robots.toml")
COLUMNS = ("robot", "format", "closed", "motors", "n", "rows", "rank", "d", "by file", "kg", "D'", "back", "remarks")


class Description(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file to import, and how many freedoms it means, if that is known from elsewhere."""

    path: str
    format: str
    freedoms: int | None = None


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A repository of robots, its commit and its files."""

    repository: str
    commit: str
    robot: list[Description]


class Robots(msgspec.Struct, frozen=True):
    """Content of published_robots.toml."""

    origin: list[Origin]


def row(name: str, path: Path, description: Description) -> str:
    """Import, check and move one robot; return its line of the table."""
    by_file = "" if description.freedoms is None else str(description.freedoms)
    try:
        draft = read(path)
    except ckc_pin.CkcError as error:
        return _line(name, description.format, "refused", *[""] * 5, by_file, *[""] * 3, _shorten(error, path))
    motors = str(len(draft.actuated)) if draft.actuated else ""
    joints = [spec for spec, _ in draft.joints]
    counts = {"rotor": sum(spec.armature is not None for spec in joints), "stop": sum(spec.stops for spec in joints)}
    counted = [f"{count} {what}{'s' * (count > 1)}" for what, count in counts.items() if count]
    remarks = counted + _remarks([*draft.guessed, *draft.left_out])
    with tempfile.TemporaryDirectory() as folder:
        file = write(draft, Path(folder))[0]
        try:
            checked = ckc_pin.check(file)
        except ckc_pin.MechanismError as error:
            what = str(error).partition("mechanism.toml: ")[2].partition(". Check")[0]
            return _line(
                name, description.format, "no", motors, *[""] * 4, by_file, *[""] * 3, "; ".join([*remarks, what])
            )
        masses = _format(compare_masses(ckc_pin.load(file), path))
    numbers = [str(x) for x in (checked.n, checked.rows, checked.rank, checked.d)]
    back = _measure_back(draft, path)
    said = "; ".join([*remarks, *_remarks(checked.warnings)])
    return _line(name, description.format, "yes", motors, *numbers, by_file, f"{checked.mass:.4g}", masses, back, said)


def _measure_back(draft: Draft, path: Path) -> str:
    try:
        return _format(measure_reproduction_error(draft))
    except ckc_pin.CkcError as error:
        print(f"{path}: {error}", file=sys.stderr)
        return "none"


def _format(error: float | None) -> str:
    return "" if error is None else f"{error:.0e}"


def _shorten(error: Exception, path: Path) -> str:
    text = str(error).replace(f"{path}: ", "")
    for folder in path.parents[:-1]:
        text = text.replace(f"{folder}/", "")
    return " ".join(text.split())


# Part of a note or warning -> its short form. {n}: number of names after the colon; {m}: number of names before it;
# {first}: the text before it.
REMARKS = {
    "point_2d for loop": "point_2d guessed ({m})",
    "hinge for loop": "hinge guessed ({m})",
    "point for loop": "point guessed ({m})",
    "joints called spherical": "joints called spherical stay hinges",
    "ball joint": "ball joints as three hinges",
    "the three slides": "slides and a ball as a free root",
    "masses of shapes": "masses of meshes left out",
    "actuator ": "actuator on a tendon left out",
    "coupling ": "coupling of three joints left out",
    " follows '": "mimic of no joint left out",
    "robot.yaml: joint_name": "joint_name of no joint left out",
    "idle freedoms": "{n} idle",
    "links that move without mass": "{n} without mass",
    "from q_guess: ": "assembled far from the guess",
    "leads beyond joints' stops": "{n} moved within stops",
    "outside joint limits": "{n} beyond limits",
    "the assembled configuration is singular": "singular where it is drawn",
    "the loops close to": "{first}",
}


def _remarks(notes: Iterable[str]) -> list[str]:
    remarks = []
    for note in notes:
        short = next((short for long, short in REMARKS.items() if long in note), "")
        first, _, names = note.partition(":")
        remarks.append(short.format(n=names.count(",") + 1, m=first.count(",") + 1, first=first.partition(", not")[0]))
    return list(dict.fromkeys(filter(None, remarks)))


def _line(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def main(root: Path) -> None:
    """Print the tables of all robots under a folder."""
    for origin in msgspec.toml.decode(LIST.read_bytes(), type=Robots).origin:
        print(f"\n## {origin.repository} ({origin.commit[:8]})\n")
        print(_line(*COLUMNS))
        print(_line(*["---"] * len(COLUMNS)))
        for description in origin.robot:
            if origin.repository == "example-robot-data":
                path = resolve_path(f"{PACKAGE}/{description.path}", Path(), description.path)
            else:
                path = root / origin.repository.replace("/", "+") / description.path
            if not path.is_file():
                raise FileNotFoundError(f"{path}: not there")
            stem = path.parent.name if path.stem in ("robot", "model", "scene") else path.stem
            print(row(stem, path, description), flush=True)
