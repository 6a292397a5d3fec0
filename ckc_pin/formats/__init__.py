"""Import from and export to the file formats of other programs.

A reader of each format (`mjcf`, `sdf`, `urdf`) returns a `robot.Robot`, a graph of links and joints. `tree.make_draft`
cuts it into a tree with loop closures, a `draft.Draft`. `importing.write` writes a draft as a mechanism, and
`import_texts` returns the texts. `exporting.export` converts a mechanism to another program's format.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["import_texts"]


def import_texts(path: Path) -> dict[str, str]:
    """Import a file in memory: return the texts of its mechanism, URDF and scenes by file name."""
    from ckc_pin.formats import importing

    return importing.import_texts(path)
