"""Draw the imports between the rooms of the package: ``python -m scripts.site.rooms`` writes docs/images/rooms.png."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.view import style
from ckc_pin.view.style import figure_style

__all__ = ["count_imports", "draw_rooms", "main", "room_layers", "room_order"]

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ckc_pin"


def room_layers() -> list[list[str]]:
    """Return the layers of rooms from top to bottom, as import-linter checks them."""
    layers = re.search(r"layers = \[(.*?)\]", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.DOTALL)
    assert layers is not None
    return [line.split(" | ") for line in re.findall(r'"([^"]+)"', layers[1]) if line != "__main__"]


def room_order() -> list[str]:
    """Return the rooms from top to bottom."""
    return [room for layer in room_layers() for room in layer]


def count_imports() -> Counter[tuple[str, str]]:
    """Count imports by importing and imported room, without those that only a type checker sees."""
    counts: Counter[tuple[str, str]] = Counter()
    for room in room_order():
        files = [PACKAGE / f"{room}.py"] if (PACKAGE / f"{room}.py").exists() else (PACKAGE / room).rglob("*.py")
        for file in files:
            for module in _imported_modules(ast.parse(file.read_text(encoding="utf-8"))):
                if module.startswith("ckc_pin."):
                    counts[room, module.split(".")[1]] += 1
    return counts


def _imported_modules(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.ImportFrom):
        yield node.module or ""
    elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
        for child in ast.iter_child_nodes(node):
            yield from _imported_modules(child)


def draw_rooms() -> Any:
    """Plot the matrix of imports; rooms stand in the order of the layers, so that it is triangular."""
    from matplotlib.figure import Figure

    rooms, counts = room_order(), count_imports()
    figure = Figure(figsize=(style.WIDTH_IN, style.WIDTH_IN), dpi=style.DPI, layout="constrained")
    ax = figure.subplots()
    matrix = np.array([[counts[a, b] if a != b else 0 for b in rooms] for a in rooms], dtype=float)
    ax.imshow(np.log1p(matrix), cmap="Blues", vmax=2 * np.log1p(matrix.max()))
    for i, j in zip(*np.nonzero(matrix), strict=True):
        ax.text(j, i, f"{matrix[i, j]:.0f}", ha="center", va="center", fontsize=style.NOTE_SIZE_PT)
    ax.set_xticks(range(len(rooms)), rooms, rotation=60, ha="left", rotation_mode="anchor")
    ax.set_yticks(range(len(rooms)), rooms)
    ax.grid(visible=False)
    ax.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    ax.set_ylabel("this room imports ...")
    ax.set_xlabel("... so many times from this room")
    for side in ax.spines.values():
        side.set_visible(False)
    return figure


def main() -> None:
    """Write the figure."""
    with figure_style():
        draw_rooms().savefig(ROOT / "docs" / "images" / "rooms.png")


if __name__ == "__main__":
    main()
