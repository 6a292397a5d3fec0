"""Bad input as a table: files as a user might have broken them, a command, and what it must answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.contract.helpers.command import ckc

WRONG_INPUT, STOPPED = 2, 3
SPEAKS_JSON = ("list", "check", "terms", "run", "inverse", "sensitivities", "import")


@dataclass(frozen=True)
class Bad:
    """One wrong thing.

    `edits` replaces text in a copy of the five-bar, which is the folder `bar`; `files` are written beside it;
    the command runs there. `says` must all be in the one message.
    """

    what: str
    words: Sequence[str]
    says: Sequence[str]
    edits: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    files: Mapping[str, str | bytes] = field(default_factory=dict)
    code: int = WRONG_INPUT


def expect(case: Bad, bar: Path) -> None:
    """Break the copy, run the command in both ways: one message, on the right stream, with all it should say."""
    for name, (old, new) in case.edits.items():
        text = (bar / name).read_text(encoding="utf-8")
        assert old in text, f"{old!r} is not in {name}"
        (bar / name).write_text(text.replace(old, new, 1), encoding="utf-8")
    for name, content in case.files.items():
        path = bar.parent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    status = "stopped" if case.code == STOPPED else "error"
    plain = ckc(*case.words)
    assert plain.code == case.code, plain.err
    assert plain.out == ""
    assert plain.err.startswith(f"{status}: ")
    assert plain.err.count("\n") == 1, plain.err
    for fragment in case.says:
        assert fragment in plain.err
    if case.words and case.words[0] in SPEAKS_JSON:
        as_json = ckc(case.words[0], "--json", *case.words[1:])
        assert as_json.code == case.code
        assert as_json.err == plain.err
        assert as_json.json == {"status": status, "message": plain.err.removeprefix(f"{status}: ").rstrip("\n")}
