"""Opening the user's browser, where there is one to be seen."""

from __future__ import annotations

import os
import sys

__all__ = ["open_in_browser"]


def open_in_browser(url: str) -> None:
    """Open an address; where that cannot be, say so and leave it to the user."""
    import webbrowser

    if not _has_display():  # else a browser for terminals would take ours
        print(f"no display here; open {url} in a browser on this machine", file=sys.stderr)
    elif not webbrowser.open(url):
        print(f"no browser could be opened; open {url} in yours", file=sys.stderr)


def _has_display() -> bool:
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
