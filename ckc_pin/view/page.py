"""Pages with meshcat's viewer: one that a server sends, and one that is a file with its scene in it.

The page's HTML, CSS and JavaScript are in the folder `static`; the viewer comes from the installed meshcat package.
"""

from __future__ import annotations

import gzip
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from html import escape
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Any

import msgspec

from ckc_pin.errors import InputError
from ckc_pin.view.commands import Command, group_commands

__all__ = ["STATIC", "pack_scene", "read_live_script", "read_viewer_script", "render_saved_page", "render_server_page"]

STATIC = Path(__file__).parent / "static"
MAX_INLINE_BYTES = 64  # of an array; larger arrays go to the table of shared arrays


def render_server_page(title: str, lines: Sequence[str]) -> str:
    """Return the page that a server sends; title and lines are plain text."""
    scripts = '<script src="main.min.js"></script>\n<script src="start.js"></script>'
    return _render(title, lines, scripts)


def render_saved_page(title: str, lines: Sequence[str], drawing: Sequence[Command]) -> str:
    """Return a page that contains its scene and the viewer, and needs no server and no network.

    The page's content security policy allows its two scripts and loads nothing.

    Raises
    ------
    InputError
        meshcat is not installed.
    """
    viewer, start = read_viewer_script().decode(), _read_player("saved.js")
    data = b64encode(pack_scene(drawing)).decode()
    scripts = "\n".join(
        [
            f'<script type="text/plain" id="licenses">\n{_read_licenses()}</script>',
            f'<script type="text/plain" id="scene">{data}</script>',
            f"<script>{viewer}</script>",
            f"<script>{start}</script>",
        ]
    )
    hashes = " ".join(f"'sha256-{b64encode(sha256(s.encode()).digest()).decode()}'" for s in (viewer, start))
    policy = f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:"
    return _render(title, lines, scripts, f'\n<meta http-equiv="Content-Security-Policy" content="{policy}">')


def pack_scene(drawing: Sequence[Command]) -> bytes:
    """Return commands as one compressed message that contains each array once.

    Meshes and times occur in every run. A larger array is therefore replaced by its index in a table, and
    `static/saved.js` restores it.
    """
    indices: dict[bytes, int] = {}
    table: list[msgspec.msgpack.Ext] = []

    def share_arrays(value: Any) -> Any:
        if isinstance(value, msgspec.msgpack.Ext) and memoryview(value.data).nbytes > MAX_INLINE_BYTES:
            key = bytes([value.code]) + bytes(value.data)
            if key not in indices:
                indices[key] = len(table)
                table.append(value)
            return {"shared": indices[key]}
        if isinstance(value, dict):
            return {name: share_arrays(item) for name, item in value.items()}
        return [share_arrays(item) for item in value] if isinstance(value, list) else value

    commands = [share_arrays(command) for command in drawing]
    return gzip.compress(msgspec.msgpack.encode(group_commands(commands) | {"arrays": table}), 9, mtime=0)


def read_live_script() -> str:
    """Return the script of a page that a server sends."""
    return _read_player("live.js")


def read_viewer_script() -> bytes:
    """Return meshcat's viewer, which includes three.js.

    Raises
    ------
    InputError
        meshcat is not installed.
    """
    return (_find_viewer_folder() / "dist" / "main.min.js").read_bytes()


def _read_player(start: str) -> str:
    return "".join(map(_read_static, ("viewer.js", "player.js", start)))


def _read_static(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")


def _read_licenses() -> str:
    """Return the licenses of the viewer as text that cannot end a script element; they accompany every copy of it."""
    folder = _find_viewer_folder()
    files = (folder / "LICENSE", folder / "dist" / "main.min.js.LICENSE.txt")
    return "\n".join(f.read_text(encoding="utf-8") for f in files if f.is_file()).replace("</", "<\\/")


def _find_viewer_folder() -> Path:
    spec = find_spec("meshcat")  # does not import the package
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        viewer = Path(folder) / "viewer"
        if (viewer / "dist" / "main.min.js").is_file():
            return viewer
    raise InputError("playback needs meshcat: pip install 'ckc_pin[view]'")


def _render(title: str, lines: Sequence[str], scripts: str, head: str = "") -> str:
    """Fill the page's template. Text from user files comes in escaped here, or in a scene as base64."""
    paragraphs = "".join(f"<p>{escape(line)}</p>" for line in lines)
    template = Template(_read_static("page.html"))
    style = _read_static("player.css")
    return template.substitute(title=escape(title), lines=paragraphs, scripts=scripts, head=head, style=style)
