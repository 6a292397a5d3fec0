"""One word for one meaning: unique names of public classes, and no name or phrase for which there is a better word.

The vocabulary of names and phrases, the rooms that still use them and the command that lowers their bounds are in
`language.py`.
"""

from __future__ import annotations

import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

from tests.contract import language

ROOT = Path(__file__).resolve().parents[2]
TOPS = ("ckc_pin", "examples", "scripts", "tests")

# what to say instead of each word; no name may have one
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

# classes of the experiments that have the name of another class
TWICE = {"Approach", "Case", "Crossing", "Frame", "Locus", "Motion", "Record", "Reference", "Setting",
         "Track", "Tree"}  # fmt: skip


@cache
def files() -> tuple[str, ...]:
    """Python files of the project, as paths from its top."""
    paths = (path.relative_to(ROOT) for top in TOPS for path in (ROOT / top).rglob("*.py"))
    return tuple(sorted(path.as_posix() for path in paths))


# --- classes ---------------------------------------------------------------------------------------


def test_no_two_public_classes_have_one_name() -> None:
    where = defaultdict(list)
    for file in files():
        if file.startswith(("ckc_pin/", "scripts/experiments/")) and "/tests/" not in file:
            for name in language.read_module(file).classes:
                where[name].append(file)
    assert len(where) > 100
    in_package = {name: sum(file.startswith("ckc_pin/") for file in places) for name, places in where.items()}
    assert {name: where[name] for name, count in in_package.items() if count > 1} == {}
    assert {name for name, places in where.items() if len(places) > 1} == TWICE


# --- words -----------------------------------------------------------------------------------------


def words(name: str) -> list[str]:
    """``_WatchedEvent_of`` is made of watched, event, of."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


@cache
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
    under_top = [file for file in files() if file.startswith(f"{top}/")]
    assert under_top
    faults = [f"{file}: {fault}" for file in under_top for fault in forbidden(Path(file).stem)]
    for file in under_top:
        module = language.read_module(file)
        faults += [f"{file}:{line}: {fault}" for line, name in module.identifiers for fault in forbidden(name)]
    assert sorted(set(faults)) == []


# --- vocabulary ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["found", "_own", "wanted_", "given2", "every", "what_acts", "joint_card", "Sway", "JointChange", "strangers",
     "written_rates", "run_plain", "LoopWithinLimits", "test_what_is_refused"],
)  # fmt: skip
def test_vocabulary_rejects_names_without_a_quantity(name: str) -> None:
    assert language.check_name(name)


@pytest.mark.parametrize(
    "name",
    ["solution", "config", "founded", "owner", "discard", "least_squares", "joint_mode", "whatever", "settling_time",
     "nonLinearEffects", "closest", "MAX_STEPS"],
)  # fmt: skip
def test_vocabulary_accepts_terms_of_the_field(name: str) -> None:
    assert language.check_name(name, function=True) is None
    assert language.check_name(name, constant=True) is None


def test_vocabulary_tells_functions_and_constants_from_variables() -> None:
    assert language.check_name("back") is None
    assert language.check_name("back", function=True)
    assert language.check_name("flat") is None
    assert language.check_name("FLAT", constant=True)
    assert language.check_name("MOST_STEPS", constant=True)
    assert language.check_name("look", cpp=True)
    assert language.check_name("back", cpp=True) is None  # std::vector has it


def test_vocabulary_finds_phrases_across_lines() -> None:
    text = "# Terms are written\n# out here, and the\n# least singular value of J."
    assert [(line, phrase) for line, phrase, _ in language.check_prose(text)] == [
        (0, "written out"),
        (2, "least singular"),
    ]
    assert language.check_prose("Close a loop by least squares near the equilibrium.") == []


@pytest.mark.parametrize("room", sorted(language.rooms().keys() | language.bounds().keys()))
def test_room_has_exactly_the_bounded_number_of_names_and_phrases_to_avoid(room: str) -> None:
    """A room that is not in `language_bounds.toml` has none; a bound is lowered as soon as the count is."""
    counts = language.count().get(room, {"names": 0, "phrases": 0})
    bounds = language.bounds().get(room, {"names": 0, "phrases": 0})
    for kind, count in counts.items():
        listed = "\n".join(str(hit) for hit in language.hits()[room][kind]) if room in language.hits() else ""
        assert count <= bounds[kind], f"{room}: {count} {kind} to avoid, at most {bounds[kind]}:\n{listed}"
        assert count == bounds[kind], (
            f"{room}: {count} {kind} to avoid, fewer than the bound {bounds[kind]}; "
            "lower it by `python -m tests.contract.language`"
        )
