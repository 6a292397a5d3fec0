"""The C++ core is divided into rooms, and includes run downwards only."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[2] / "ckc_pin" / "native" / "src"
ROOMS = ("tree", "loops", "control", "motion", "sensitivity", "bind")  # bottom to top
FILES = sorted(path.relative_to(SOURCES).as_posix() for path in SOURCES.rglob("*.[ch]pp"))
INCLUDE = re.compile(r'^#include "([^"]+)"', re.MULTILINE)


def test_every_source_file_is_in_a_room() -> None:
    assert {file.partition("/")[0] for file in FILES} == set(ROOMS)


def test_every_source_file_is_compiled() -> None:
    text = (SOURCES / "CMakeLists.txt").read_text()
    listed = re.findall(r"\b[a-z_]+/[a-z_]+\.cpp\b", text.partition("nanobind_add_module")[2].partition(")")[0])
    assert sorted(listed) == [file for file in FILES if file.endswith(".cpp")]


@pytest.mark.parametrize("room", ROOMS)
def test_room_includes_only_itself_and_rooms_below(room: str) -> None:
    allowed = ROOMS[: ROOMS.index(room) + 1]
    for file in FILES:
        if file.startswith(f"{room}/"):
            for included in INCLUDE.findall((SOURCES / file).read_text()):
                assert included in FILES, f"{file} includes {included}, which must be named with its room"
                assert included.partition("/")[0] in allowed, f"{file} includes {included} of a room above {room}"
