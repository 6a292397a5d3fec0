"""One word for one meaning: no two public classes of one name, and none of the words that another one stands for."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOPS = ("ckc_pin", "examples", "scripts", "tests")

# what to say instead of each
WORDS = {
    "watch": "monitor, event function, output callback",
    "guard": "monitor, event function",
    "tally": "monitor, count",
    "book": "monitor, count",
    "leap": "collocation step",
    "trail": "predictor",
    "burst": "native loop, segment, restart",
    "aim": "segment",
    "doubt": "stiffness check, step safety, growth pending",
    "caution": "step safety",
    "growing": "growth pending",
    "held": "zero-order hold, constrained directions, deferred signals",
    "sheet": "aspect",
    "told": "prescribed motion",
    "following": "prescribed motion",
}
FORMS = {f"{word}{end}": word for word in WORDS for end in ("", "s", "ed", "er", "es", "ing")} | {"tallies": "tally"}
del FORMS["trailing"]  # as a newline is

# classes of the experiments that are called as others are
TWICE = {"Approach", "Case", "Crossing", "Frame", "Locus", "Model", "Motion", "Record", "Reference", "Setting", "Steps",
         "Track", "Tree"}  # fmt: skip


@cache
def files() -> tuple[str, ...]:
    """Python files of the project, as paths from its top."""
    found = (path.relative_to(ROOT) for top in TOPS for path in (ROOT / top).rglob("*.py"))
    return tuple(sorted(path.as_posix() for path in found))


@cache
def tree(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text(encoding="utf-8"))


# --- classes ---------------------------------------------------------------------------------------


def classes(parsed: ast.Module) -> Iterator[str]:
    """Names of the public classes at the top of a module."""
    yield from (n.name for n in parsed.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_"))


def test_no_two_public_classes_have_one_name() -> None:
    where = defaultdict(list)
    for file in files():
        if file.startswith(("ckc_pin/", "scripts/experiments/")) and "/tests/" not in file:
            for name in classes(tree(file)):
                where[name].append(file)
    assert len(where) > 100
    own = {name: sum(file.startswith("ckc_pin/") for file in found) for name, found in where.items()}
    assert {name: where[name] for name, count in own.items() if count > 1} == {}
    assert {name for name, found in where.items() if len(found) > 1} == TWICE


# --- words -----------------------------------------------------------------------------------------


def names(parsed: ast.Module) -> Iterator[tuple[int, str]]:
    """Every identifier that a module makes or uses, with its line."""
    for node in ast.walk(parsed):
        line = getattr(node, "lineno", 0)
        for field in ("id", "attr", "arg", "name", "asname"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                yield line, value


def words(name: str) -> list[str]:
    """``_WatchedEvent_of`` is made of watched, event, of."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


def forbidden(name: str) -> list[str]:
    """What to say instead of the words of a name that are not to be used."""
    return [f"{name}: say {WORDS[FORMS[word]]}" for word in words(name) if word in FORMS]


@pytest.mark.parametrize(
    ("name", "count"),
    [("watch", 1), ("Watched", 1), ("_is_told_what", 1), ("SheetOf", 1), ("guards", 1), ("burst_aim", 2),
     ("worksheet", 0), ("claim", 0), ("Holdings", 0), ("spreadsheet_booking", 1), ("followed", 0), ("legs", 0)],
)  # fmt: skip
def test_words_of_a_name(name: str, count: int) -> None:
    assert len(forbidden(name)) == count


@pytest.mark.parametrize("top", TOPS)
def test_no_name_has_a_word_that_another_stands_for(top: str) -> None:
    mine = [file for file in files() if file.startswith(f"{top}/")]
    assert mine
    found = [f"{file}: {says}" for file in mine for says in forbidden(Path(file).stem)]
    for file in mine:
        found += [f"{file}:{line}: {says}" for line, name in names(tree(file)) for says in forbidden(name)]
    assert sorted(set(found)) == []
