"""Mutated robot files are imported or refused with a message, never with another exception."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest

from ckc_pin.errors import CkcError
from ckc_pin.formats.importing import read
from tests.contract import test_import_loops as urdf
from tests.contract import test_import_sdf as sdf

MUTATIONS = 250  # of each format
WORDS = ("nan", "inf", "1e400", "-1", "0", "", "x", "a", "b", "world", "revolute", "ball", "fixed", "screw", "::", "名")
ELEMENT = re.compile(r"<([\w:]+)[^<>]*/>|<([\w:]+)[^<>]*>[^<>]*</\2>")
VALUE = re.compile(r'(?<==")[^"]*(?=")|(?<=>)[^<]+(?=<)')
ATTRIBUTE = re.compile(r'[\w:]+="[^"]*"')

URDFS = [f'<robot name="t">{urdf.LINKS}{urdf.JOINTS}{content}</robot>' for content, _, _ in urdf.DIALECTS.values()]
URDFS.append(f'<robot name="t">{urdf.LINKS}{urdf.UPRIGHT}{urdf.GAZEBO.format("")}</robot>')
SDFS = [sdf.sdf(sdf.Random(k).model(["", "revolute", "ball", "universal", "screw"])) for k in range(3)]
SDFS.append(sdf.model(sdf.FOUR_BAR + sdf.CLOSING))


def mutate(text: str, choose: random.Random) -> str:
    """Replace a value, remove or repeat an element, remove an attribute, or rename a tag or name."""
    kind = choose.choice(["value", "element", "attribute", "name"])
    if kind == "name":
        one, other = (choose.choice(re.findall(r"<([\w:]+)", text)) for _ in range(2))
        return re.sub(rf"\b{one}\b", other, text, count=choose.choice([0, 2]))
    pattern = {"value": VALUE, "element": ELEMENT, "attribute": ATTRIBUTE}[kind]
    match = choose.choice(list(pattern.finditer(text)))
    replacement = {"value": choose.choice(WORDS), "element": match[0] * choose.choice([0, 2]), "attribute": ""}[kind]
    return text[: match.start()] + replacement + text[match.end() :]


@pytest.mark.parametrize(("suffix", "originals"), [("urdf", URDFS), ("sdf", SDFS)])
def test_mutated_files_are_imported_or_refused(suffix: str, originals: list[str], tmp_path: Path) -> None:
    choose, path = random.Random(0), tmp_path / f"thing.{suffix}"
    imported, messages = 0, []
    for _ in range(MUTATIONS):
        path.write_text(mutate(choose.choice(originals), choose), encoding="utf-8")
        try:
            read(path)
            imported += 1
        except CkcError as error:
            messages.append(str(error))
    assert min(imported, len(messages)) > MUTATIONS / 10
    assert [message for message in messages if not message.startswith(str(path))] == []
