"""The page that holds meshcat's viewer, and the viewer itself from meshcat's installed files."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from html import escape
from importlib.util import find_spec
from pathlib import Path

import msgspec

from ckc_pin.errors import InputError
from ckc_pin.view.commands import Command, several

__all__ = ["START_SCRIPT", "page", "standalone", "viewer_script"]

# Strings from files only ever come in as escaped text, or in a scene as base64; the scripts are fixed.
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">{head}
<title>{title}</title>
<link rel="icon" href="data:,">
<style>
body {{ margin: 0; font: 14px/1.5 system-ui, sans-serif; color: #222; }}
#meshcat-pane {{ width: 100vw; height: 100vh; overflow: hidden; }}
#caption {{ position: absolute; left: 16px; top: 12px; pointer-events: none; }}
#caption h1 {{ font-size: 17px; margin: 0; }}
#caption p {{ margin: 0; }}
#said {{ font-variant-numeric: tabular-nums; }}
</style>
</head>
<body>
<div id="meshcat-pane"></div>
<div id="caption"><h1>{title}</h1>{lines}<p id="said"></p></div>
{scripts}
</body>
</html>
"""

# The viewer knows most commands. Ours are "several" in one message, "say", and a speed for the animation.
# Its controls hold the time slider: they are opened, and the long list of objects is closed.
_PREPARE = """"use strict";
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
function say(text) { document.getElementById("said").textContent = text; }
viewer.handle_command = function (command) {
  if (command.type === "several") {
    command.commands.forEach(viewer.handle_command);
    if (viewer.connection) { requestAnimationFrame(function () { viewer.connection.send("shown"); }); }
    return;
  }
  if (command.type === "say") { say(command.text); return; }
  MeshCat.Viewer.prototype.handle_command.call(viewer, command);
  if (command.type === "set_animation") {
    viewer.animator.mixer.timeScale = command.options.timeScale;
    viewer.animator.folder.__folders["default"].__controllers.forEach(function (controller) {
      if (controller.property === "time") { controller.name("time, s"); }
      if (controller.property === "timeScale") { controller.name("speed").updateDisplay(); }
    });
  }
};
viewer.gui.open();
viewer.gui.__folders["Scene"].close();
"""

START_SCRIPT = (
    _PREPARE
    + """viewer.connect();
viewer.connection.onclose = function () { say("the program that sent this has ended"); };
"""
)

_START_FROM_PAGE = (
    _PREPARE
    + """viewer.handle_command_bytearray(Uint8Array.from(
  atob(document.getElementById("scene").textContent), function (letter) { return letter.charCodeAt(0); }));
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
    data = b64encode(msgspec.msgpack.encode(several(drawing))).decode()
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
    return _PAGE.format(title=escape(title), lines=shown, scripts=scripts, head=head)
