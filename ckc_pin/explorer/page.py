"""The explorer's page: meshcat's viewer with a panel of controls. Its HTML, CSS and JavaScript are in `static`.

The controls are elements of HTML, such as sliders, number fields and buttons. Browsers make them work with a keyboard,
a touch screen and a screen reader, and nothing has to be shipped. The viewer's own panel, dat.gui, supports none of
these and is no longer maintained, so the page hides it.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from string import Template

from ckc_pin.view.page import STATIC as VIEW_STATIC

__all__ = ["STATIC", "read_explore_script", "render_explore_page"]

STATIC = Path(__file__).parent / "static"
SCRIPTS = (VIEW_STATIC / "viewer.js", *(STATIC / name for name in ("panel.js", "grab.js", "explore.js")))


def render_explore_page(title: str) -> str:
    """Return the page that the explorer's server sends; the title is plain text."""
    template, style = (_read(STATIC / name) for name in ("explore.html", "explore.css"))
    return Template(template).substitute(title=escape(title), style=style)


def read_explore_script() -> str:
    """Return the script of the page."""
    return "".join(map(_read, SCRIPTS))


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")
