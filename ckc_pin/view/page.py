"""The page that holds meshcat's viewer, and the viewer itself from meshcat's installed files."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path

from ckc_pin.errors import InputError

__all__ = ["START_SCRIPT", "page", "viewer_script"]

# Strings from files only ever come in as escaped text; the scripts are two fixed ones.
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>
body {{ margin: 0; font: 14px/1.5 system-ui, sans-serif; color: #222; }}
#meshcat-pane {{ width: 100vw; height: 100vh; overflow: hidden; }}
#caption {{ position: absolute; left: 16px; top: 12px; pointer-events: none; }}
#caption h1 {{ font-size: 17px; margin: 0; }}
#caption p {{ margin: 0; }}
</style>
</head>
<body>
<div id="meshcat-pane"></div>
<div id="caption"><h1>{title}</h1>{lines}</div>
<script src="main.min.js"></script>
<script src="start.js"></script>
</body>
</html>
"""

# The viewer's controls hold the time slider: open them.
START_SCRIPT = """"use strict";
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
viewer.gui.open();
viewer.connect();
"""


def page(title: str, lines: Sequence[str]) -> str:
    """Return the page; title and lines are plain text."""
    return _PAGE.format(title=escape(title), lines="".join(f"<p>{escape(line)}</p>" for line in lines))


def viewer_script() -> bytes:
    """Return meshcat's viewer with three.js in it.

    Raises
    ------
    InputError
        meshcat is not installed.
    """
    found = find_spec("meshcat")  # finds it without importing it
    for folder in (found.submodule_search_locations or ()) if found else ():
        script = Path(folder) / "viewer" / "dist" / "main.min.js"
        if script.is_file():
            return script.read_bytes()
    raise InputError("playback needs meshcat: pip install 'ckc_pin[view]'")
