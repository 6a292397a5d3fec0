"""docs/reference.md says what the program does: keys with their types and defaults, commands, JSON, errors."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import msgspec
import pytest

import ckc_pin
from ckc_pin import errors
from ckc_pin.control.point_path import CircleSpec, LineSpec, PointPathSpec
from ckc_pin.control.spec import (
    AllocationSpec,
    DriveSpec,
    HarmonicsSpec,
    SensorSpec,
    SetPointSpec,
    TorquesSpec,
    TrackingSpec,
)
from ckc_pin.mechanism.faults import expected
from ckc_pin.mechanism.generators import GeneratorSpec
from ckc_pin.mechanism.spec import (
    CouplingSpec,
    ForceSpec,
    FrameSpec,
    JointSpec,
    LoopSpec,
    LoopType,
    MechanismSpec,
    MotorSpec,
    PointSpec,
    SpringSpec,
    TreeSpec,
)
from ckc_pin.simulation.ensembles.spec import GridSpec, OutputSpec, SweepSpec, VariableSpec
from ckc_pin.simulation.run_file import ARRAYS, OPTIONAL, OTHERS
from ckc_pin.simulation.scene import EventSpec, InitialSpec, SceneSpec, SolverSpec
from tests.contract.helpers.command import ckc
from tests.contract.test_cli import CHECK, RUN, STATS, TERMS
from tests.contract.test_linearize_command import KEYS

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")

# in the order of the page
SPECS = [MechanismSpec, TreeSpec, LoopSpec, FrameSpec, CouplingSpec, SpringSpec, ForceSpec, JointSpec, MotorSpec,
         PointSpec, SceneSpec, GeneratorSpec, InitialSpec, SolverSpec, EventSpec, SetPointSpec, TrackingSpec,
         TorquesSpec, AllocationSpec, SensorSpec, DriveSpec, HarmonicsSpec, PointPathSpec, CircleSpec,
         LineSpec, SweepSpec, VariableSpec, GridSpec, OutputSpec]  # fmt: skip


@cache
def tables() -> list[dict[str, list[str]]]:
    """The page's tables of keys: key to [type, default, unit, meaning]."""
    found = re.findall(
        r"^\| key \| type \| default \| unit \| meaning \|\n\|[-|]+\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE
    )
    lines = [[[cell.strip() for cell in row.strip("|").split(" | ")] for row in rows.splitlines()] for rows in found]
    return [{cells[0].strip("` "): cells[1:] for cells in rows} for rows in lines]


def default(field: Any) -> str:
    """What the page says of a field's default."""
    if field.required:
        return "needed"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if isinstance(value, msgspec.Struct):
        return "its keys' defaults"
    if value is None:
        return "absent"
    written = list(value) if isinstance(value, tuple) else value
    shown = str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(written)
    return f"`{shown}`"


def choices(kind: Any) -> tuple[Any, ...]:
    literals = [member for member in (kind, *get_args(kind)) if get_origin(member) is Literal]
    return get_args(literals[0]) if literals else ()


def test_there_is_a_table_for_each_structure() -> None:
    assert [list(table) for table in tables()] == [
        [field.encode_name for field in msgspec.structs.fields(spec)] for spec in SPECS
    ]


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.__name__)
def test_types_and_defaults_are_those_of_the_program(spec: Any) -> None:
    table = tables()[SPECS.index(spec)]
    for field in msgspec.structs.fields(spec):
        kind, said, _, meaning = table[field.encode_name]
        assert said == default(field), field.encode_name
        assert meaning
        if choices(field.type):
            named = {f'`"{value}"`' if isinstance(value, str) else f"`{value}`" for value in choices(field.type)}
            assert set(kind.split(", ")) == named, field.encode_name
        else:
            assert kind.startswith(re.sub(r"^an? ", "", expected(field.type))), field.encode_name


def test_every_loop_type_has_its_rows() -> None:
    rows = re.search(r"\| type \| rows of φ.*\n\|[-|]+\|\n((?:\|.*\n)+)", PAGE)
    assert rows
    assert re.findall(r"^\| `(\w+)`", rows[1], re.MULTILINE) == list(get_args(LoopType))


def test_every_command_json_key_array_and_error_is_named() -> None:
    commands = re.findall(r"^  (\w+) ", ckc("--help").out.partition("\nCommands:\n")[2], re.MULTILINE)
    assert "run" in commands
    assert [name for name in commands if f"| `ckc {name}" not in PAGE] == []
    keys = {"check": CHECK, "terms": TERMS, "run": RUN, "stats": STATS, "linearize": " ".join(KEYS)}
    for name, wanted in keys.items():
        row = next(line for line in PAGE.partition("### JSON")[2].splitlines() if line.startswith(f"| `{name}`"))
        assert [key for key in wanted.split() if not re.search(rf"\b{key}\b", row)] == []
    file = PAGE.partition("## run.npz")[2].partition("##")[0]
    assert [name for name in (*ARRAYS, *OPTIONAL, *OTHERS) if not re.search(rf"\b{name}\b", file)] == []
    assert [name for name in errors.__all__ if f"| `{name}`" not in PAGE] == []


def test_every_public_name_is_in_the_table() -> None:
    table = PAGE.partition("## Python")[2].partition("## ")[0]
    named = [name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)", row)]
    assert sorted(named) == sorted(ckc_pin.__all__)


def test_change_log_and_citation_are_of_this_version() -> None:
    assert f"\n## [{ckc_pin.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {ckc_pin.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", ["README.md", "CITATION.cff", "docs/reference.md"])
def test_the_paper_is_cited_with_author_and_title(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "Balaji" in text
    assert "Dynamics & Control of Closed Kinematic Chains" in text


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/reference.md"])
def test_links_between_the_pages_lead_somewhere(page: str) -> None:
    path = ROOT / page
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
    assert links
    assert [link for link in links if not (path.parent / link).exists()] == []
