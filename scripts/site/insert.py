"""Replace lines ``% insert: NAME ARGUMENT`` of a page by text generated from the program when the site is built."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from scripts.site import api, commands, gallery, keys, protocol

__all__ = ["INSERTS", "inserted"]

LINE = re.compile(r"^% insert: (\w+)(?: (\S+))?$", re.MULTILINE)
ROOT = Path(__file__).resolve().parents[2]


def _file(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8").rstrip()


def _change_log(text: str) -> str:
    """Return the change log without its title, with links converted to those of the site."""
    below = text.partition("\n")[2].replace("](docs/", "](/")
    return re.sub(r"\]\(examples/(\w+)\.\w+\)", lambda at: f"](/gallery.md#example-{at[1].replace('_', '-')})", below)


INSERTS: dict[str, Callable[..., str]] = {
    "keys": keys.markdown,
    "commands": commands.markdown,
    "api": api.markdown,
    "protocol": protocol.markdown,
    "gallery": gallery.markdown,
    "python": lambda name: f"```python\n{_file(name)}\n```",
    "toml": lambda name: f"```toml\n{_file(name)}\n```",
    "xml": lambda name: f"```xml\n{_file(name)}\n```",
    "changes": lambda: _change_log(_file("CHANGELOG.md")),
}


def inserted(text: str) -> str:
    """Return a page's text with all insert lines replaced."""
    return LINE.sub(lambda match: INSERTS[match[1]](*filter(None, [match[2]])), text)
