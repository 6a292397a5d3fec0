"""The page that holds meshcat's viewer, and the viewer itself from meshcat's installed files."""

from __future__ import annotations

import gzip
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from ckc_pin.errors import InputError
from ckc_pin.view.commands import Command, several
from ckc_pin.view.controls import BAR, CONTROLS, STYLE

__all__ = ["START_SCRIPT", "packed", "page", "standalone", "viewer_script"]

SHORT = 64  # bytes of an array that is not worth a table's entry

# Strings from files only ever come in as escaped text, or in a scene as base64; the scripts are fixed.
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">{head}
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
</head>
<body>
<div id="meshcat-pane"></div>
<div id="caption"><h1>{title}</h1>{lines}<p id="said"></p></div>
{bar}
{scripts}
</body>
</html>
"""

START_SCRIPT = (
    CONTROLS
    + """viewer.connect();
viewer.connection.onclose = function () { say("the program that sent this has ended"); };
"""
)

# The scene is compressed, and arrays that occur several times are in it once, in a table that is resolved here.
_START_FROM_PAGE = (
    CONTROLS
    + """var packed = Uint8Array.from(atob(document.getElementById("scene").textContent), function (letter) {
  return letter.charCodeAt(0);
});
new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer()
  .then(function (found) {
    function resolved(value, arrays) {
      if (value === null || typeof value !== "object" || ArrayBuffer.isView(value)) { return value; }
      if (typeof value.shared === "number") { return arrays[value.shared]; }
      for (var key of Object.keys(value)) { value[key] = resolved(value[key], arrays); }
      return value;
    }
    var handle = viewer.handle_command;
    viewer.handle_command = function (whole) {
      viewer.handle_command = handle;
      handle({type: "several", commands: resolved(whole.commands, whole.arrays)});
    };
    viewer.handle_command_bytearray(new Uint8Array(found));
  }).catch(function (error) { say("this browser cannot read the scene: " + error); });
"""
)


def page(title: str, lines: Sequence[str]) -> str:
    """Return the page that a server shows; title and lines are plain text."""
    scripts = '<script src="main.min.js"></script>\n<script src="start.js"></script>'
    return _page(title, lines, scripts)


def standalone(title: str, lines: Sequence[str], drawing: Sequence[Command]) -> str:
    """Return a page with its scene and the viewer in it, which needs no server and no network.

    Its own policy lets it run its two scripts and load nothing.

    Raises
    ------
    InputError
        meshcat is not installed.
    """
    viewer = viewer_script().decode()
    data = b64encode(packed(drawing)).decode()
    scripts = "\n".join(
        [
            f'<script type="text/plain" id="licenses">\n{_licenses()}</script>',
            f'<script type="text/plain" id="scene">{data}</script>',
            f"<script>{viewer}</script>",
            f"<script>{_START_FROM_PAGE}</script>",
        ]
    )
    allowed = " ".join(
        f"'sha256-{b64encode(sha256(s.encode()).digest()).decode()}'" for s in (viewer, _START_FROM_PAGE)
    )
    policy = f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:"
    return _page(title, lines, scripts, f'\n<meta http-equiv="Content-Security-Policy" content="{policy}">')


def packed(drawing: Sequence[Command]) -> bytes:
    """Return commands as one compressed message, in which each array is once: meshes and times occur in every run."""
    arrays: dict[bytes, int] = {}
    table: list[msgspec.msgpack.Ext] = []

    def shared(value: Any) -> Any:
        if isinstance(value, msgspec.msgpack.Ext) and memoryview(value.data).nbytes > SHORT:
            key = bytes([value.code]) + bytes(value.data)
            if key not in arrays:
                arrays[key] = len(table)
                table.append(value)
            return {"shared": arrays[key]}
        if isinstance(value, dict):
            return {name: shared(one) for name, one in value.items()}
        return [shared(one) for one in value] if isinstance(value, list) else value

    commands = [shared(command) for command in drawing]
    return gzip.compress(msgspec.msgpack.encode(several(commands) | {"arrays": table}), 9, mtime=0)


def viewer_script() -> bytes:
    """Return meshcat's viewer with three.js in it.

    Raises
    ------
    InputError
        meshcat is not installed.
    """
    return (_viewer_folder() / "dist" / "main.min.js").read_bytes()


def _licenses() -> str:
    """Return the viewer's licenses, which go where a copy of it goes, as text that ends no script."""
    folder = _viewer_folder()
    files = (folder / "LICENSE", folder / "dist" / "main.min.js.LICENSE.txt")
    return "\n".join(f.read_text(encoding="utf-8") for f in files if f.is_file()).replace("</", "<\\/")


def _viewer_folder() -> Path:
    found = find_spec("meshcat")  # finds it without importing it
    for folder in (found.submodule_search_locations or ()) if found else ():
        viewer = Path(folder) / "viewer"
        if (viewer / "dist" / "main.min.js").is_file():
            return viewer
    raise InputError("playback needs meshcat: pip install 'ckc_pin[view]'")


def _page(title: str, lines: Sequence[str], scripts: str, head: str = "") -> str:
    shown = "".join(f"<p>{escape(line)}</p>" for line in lines)
    return _PAGE.format(title=escape(title), lines=shown, scripts=scripts, head=head, style=STYLE, bar=BAR)
