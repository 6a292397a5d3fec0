"""Table of invalid input: edited files, a command, and the expected error message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.contract.helpers.command import ckc

WRONG_INPUT, STOPPED = 2, 3
SPEAKS_JSON = ("list", "check", "terms", "run", "inverse", "sensitivities", "import")


@dataclass(frozen=True)
class Bad:
    """One case of invalid input.

    `edits` replaces text in a copy of the five-bar, the folder `bar`. `files` are written next to it, and the command
    runs there. All fragments in `says` must be in the message, which must be one line.
    """

    what: str
    words: Sequence[str]
    says: Sequence[str]
    edits: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    files: Mapping[str, str | bytes] = field(default_factory=dict)
    code: int = WRONG_INPUT


def expect(case: Bad, bar: Path) -> None:
    """Apply the edits, run the command with and without --json, and check message, stream and exit code."""
    for name, (old, new) in case.edits.items():
        text = (bar / name).read_text(encoding="utf-8")
        assert old in text, f"{old!r} is not in {name}"
        (bar / name).write_text(text.replace(old, new, 1), encoding="utf-8")
    for name, content in case.files.items():
        path = bar.parent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    status = "stopped" if case.code == STOPPED else "error"
    outcome = ckc(*case.words)
    assert outcome.code == case.code, outcome.err
    assert outcome.out == ""
    assert outcome.err.startswith(f"{status}: ")
    assert outcome.err.count("\n") == 1, outcome.err
    for fragment in case.says:
        assert fragment in outcome.err
    if case.words and case.words[0] in SPEAKS_JSON:
        as_json = ckc(case.words[0], "--json", *case.words[1:])
        assert as_json.code == case.code
        assert as_json.err == outcome.err
        assert as_json.json == {"status": status, "message": outcome.err.removeprefix(f"{status}: ").rstrip("\n")}
