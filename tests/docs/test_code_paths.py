"""Pages that say where code is name files and folders that exist."""

from __future__ import annotations

import re

import pytest

from scripts.site.gallery import ROOT
from scripts.site.rooms import count_imports, room_layers, room_order

ROOM = re.compile(r"`((?:native/src|[a-z_]+)/[\w/]*(?:\.py|\.cpp|\.hpp)?)`")


def test_code_of_each_equation_exists() -> None:
    page = (ROOT / "docs" / "theory" / "pipeline.md").read_text(encoding="utf-8")
    paths = ROOM.findall(page)
    assert len(paths) > 15
    assert [path for path in paths if not any((top / path).exists() for top in (ROOT / "ckc_pin", ROOT))] == []


def test_functions_named_by_the_architecture_exist() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    functions = re.findall(r"`([\w/]+\.py)`: `(\w+)`", page)
    assert len(functions) > 9
    missing = [
        f"{path}: {name}"
        for path, name in functions
        if not re.search(
            rf"^(?:def|class) {name}\b", (ROOT / "ckc_pin" / path).read_text(encoding="utf-8"), re.MULTILINE
        )
    ]
    assert missing == []


def test_imports_between_rooms_go_downwards() -> None:
    """What the picture of the rooms shows; import-linter checks the same, and names the module."""
    rooms = room_order()
    upward = [pair for pair in count_imports() if rooms.index(pair[0]) > rooms.index(pair[1])]
    assert upward == []


@pytest.mark.parametrize("page", ["architecture.md", "theory/pipeline.md"])
def test_paths_of_the_core_exist(page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    folders = [ROOT, ROOT / "ckc_pin", ROOT / "ckc_pin" / "native" / "src"]
    paths = re.findall(r"`([\w/]+\.(?:py|cpp|hpp))`", text)
    assert [path for path in paths if not any((top / path).exists() for top in folders)] == []


def test_contributing_lists_every_room_in_the_order_of_the_layers() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("### Rooms")[2].partition("\n#")[0]
    listed = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in page.splitlines() if line.startswith("| `")]
    assert listed == room_layers()


@pytest.mark.parametrize("folder", ["tests", "scripts"])
def test_contributing_names_folders_and_scripts_that_exist(folder: str) -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = re.findall(rf"`(?:\./|\.venv/bin/pytest )?({folder}/[\w./]+)", page)
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []
