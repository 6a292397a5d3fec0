"""The reference is whole: every key has meaning and an example that fits, every command, option and name its text."""

from __future__ import annotations

import re
import tomllib
from typing import get_args

import msgspec
import pytest

import ckc_pin
from ckc_pin import errors
from ckc_pin.base.key_reference import KeyTable, describe_structure
from ckc_pin.cli.key_tables import FILES, tables
from ckc_pin.explorer import messages
from ckc_pin.mechanism.spec import LoopType
from ckc_pin.run.run_file import ARRAYS, OPTIONAL, OTHERS
from scripts.site import api, commands, keys, protocol, reference_text
from scripts.site.gallery import ROOT
from scripts.site.insert import INSERTS, LINE
from tests.contract.test_cli import CHECK, RUN, STATS, TERMS
from tests.contract.test_linearize_command import KEYS

TABLES = [(file, table) for file in FILES for table in tables(file)]
# Of keys that measure nothing. Every other number has a unit.
WITHOUT_UNIT = {"axis_a", "axis_b", "restitution", "N", "rtol", "atol", "max_rhs", "direction", "seed", "weights",
                "normal", "joints", "members", "count", "intervals", "singularity"}  # fmt: skip


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize(("file", "table"), TABLES, ids=lambda x: x if isinstance(x, str) else x.structure.__name__)
def test_every_key_has_meaning_and_an_example_that_fits(file: str, table: KeyTable) -> None:
    assert table.about
    assert [key.name for key in table.keys if not key.documented] == []
    for key in table.keys:
        example = tomllib.loads(key.example)
        assert list(example) == [key.name]
        msgspec.convert(example[key.name], key.annotation)


@pytest.mark.parametrize(("file", "table"), TABLES, ids=lambda x: x if isinstance(x, str) else x.structure.__name__)
def test_a_docstring_describes_no_key_that_is_not_there(file: str, table: KeyTable) -> None:
    assert set(describe_structure(table.structure)[1]) == {key.name for key in table.keys}


@pytest.mark.parametrize(("file", "table"), TABLES, ids=lambda x: x if isinstance(x, str) else x.structure.__name__)
def test_every_number_has_a_unit(file: str, table: KeyTable) -> None:
    numbers = [key for key in table.keys if "number" in key.kind or "integer" in key.kind]
    assert [
        key.name for key in numbers if not key.unit and key.name not in WITHOUT_UNIT and "ratio" not in key.name
    ] == []


def test_missing_keys_are_detected() -> None:
    class Spec(msgspec.Struct):
        """A table.

        Attributes
        ----------
        a : m
            How long.
            ``a = 0.3``
        b
            No example.
        """

        a: float
        b: str = ""
        c: int = 0

    about, entries = describe_structure(Spec)
    assert about == "A table."
    assert entries == {"a": ("m", "How long.", "a = 0.3"), "b": ("", "No example.", "")}


@pytest.mark.parametrize("file", FILES)
def test_a_page_has_every_key(file: str) -> None:
    text = keys.markdown(file)
    for name, table in TABLES:
        if name == file:
            paths = [".".join(filter(None, (table.path, key.name))) for key in table.keys]
            assert [path for path in paths if f"{{ckc:key}} {path}\n" not in text] == []
    assert f"% insert: keys {file}\n" in page(f"reference/{file}.md")


def test_every_command_and_option_says_what_it_does() -> None:
    assert commands.undocumented() == []
    assert "% insert: commands\n" in page("reference/commands.md")


def test_every_public_name_has_a_docstring() -> None:
    assert api.undocumented() == []
    assert sorted(name for named in api.names().values() for name in named) == sorted(ckc_pin.__all__)
    assert "% insert: api\n" in page("reference/api.md")


@pytest.mark.parametrize("direction", protocol.DIRECTIONS)
def test_every_message_of_the_explorer_and_its_fields_have_a_meaning(direction: str) -> None:
    text = protocol.markdown(direction)
    for table in protocol.message_tables(direction):
        assert table.about
        assert [key.name for key in table.keys if not key.meaning] == []
        assert set(describe_structure(table.structure)[1]) == {key.name for key in table.keys}
        assert [key.name for key in table.keys if f"\n| `{key.name}` | " not in text] == []
    assert f"% insert: protocol {direction}\n" in page("reference/explorer_protocol.md")


def test_messages_of_the_explorer_are_complete() -> None:
    """Every structure of the module is a request, a report or in the field of one."""
    documented = {table.structure for direction in protocol.DIRECTIONS for table in protocol.message_tables(direction)}
    structures = {value for value in vars(messages).values() if isinstance(value, type(messages.Move))}
    assert structures - documented == {messages.Report, messages._FromPage}


@pytest.mark.parametrize("name", reference_text.texts())
def test_committed_text_of_the_reference_is_current(name: str) -> None:
    """If this fails, run `python -m scripts.site.reference_text`."""
    assert (reference_text.FOLDER / name).read_text(encoding="utf-8") == reference_text.texts()[name]


def test_every_insert_is_one_that_there_is() -> None:
    names = {match[1] for path in (ROOT / "docs").rglob("*.md") for match in LINE.finditer(path.read_text("utf-8"))}
    assert names
    assert names <= set(INSERTS)


def test_every_loop_type_has_its_rows() -> None:
    rows = re.search(r"\| type \| rows of φ.*\n\|[-|]+\|\n((?:\|.*\n)+)", page("reference/mechanism.md"))
    assert rows
    assert re.findall(r"^\| `(\w+)`", rows[1], re.MULTILINE) == list(get_args(LoopType))


def test_every_json_key_array_and_error_is_named() -> None:
    expected = {"check": CHECK, "terms": TERMS, "run": RUN, "stats": STATS, "linearize": " ".join(KEYS)}
    for name, named in expected.items():
        row = next(line for line in page("reference/json.md").splitlines() if line.startswith(f"| `{name}`"))
        assert [key for key in named.split() if not re.search(rf"\b{key}\b", row)] == []
    file = page("reference/run_file.md").partition("## run.npz")[2].partition("##")[0]
    assert [name for name in (*ARRAYS, *OPTIONAL, *OTHERS) if not re.search(rf"\b{name}\b", file)] == []
    assert [name for name in errors.__all__ if f"| `{name}`" not in page("reference/errors.md")] == []


def test_install_page_describes_every_extra() -> None:
    """Except the extras that only development of the project needs."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    described = re.findall(r"^\| `(\w+)` \|", page("install.md"), re.MULTILINE)
    assert set(described) == set(extras) - {"dev", "lab", "peers", "sundials"}


def test_troubleshooting_headings_quote_messages_of_the_program() -> None:
    """A message is looked up in the source text, with adjacent string literals joined."""
    source = "".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "ckc_pin").rglob("*.py")))
    joined = re.sub(r'"\s*\n\s*f?"', "", source)
    headings = re.findall(r"^### (.*)$", page("guide/troubleshooting.md"), re.MULTILINE)
    messages = [message for heading in headings for message in re.findall(r"`([^`]+)`", heading)]
    assert len(messages) > 12
    assert [message for message in messages if message not in joined] == []
