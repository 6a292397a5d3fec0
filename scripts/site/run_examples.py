"""Run the examples, and draw the gallery's pictures: ``python -m scripts.site.run_examples [NAME...]``."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

from scripts.site.gallery import Example, examples

__all__ = ["main", "run"]

DPI = 90


def run(example: Example) -> Any:
    """Run an example and return its figure; what is wrong with it is an AssertionError."""
    if example.path.suffix == ".ipynb":
        return _run_cells(example)
    return import_module(f"examples.{example.name}").main()


def _run_cells(example: Example) -> Any:
    space: dict[str, Any] = {}
    for cell in json.loads(example.path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{example.path.name}, {cell['id']}", "exec"), space)
    return space["figure"]


def main() -> None:
    """Draw the pictures of the named examples, or of all."""
    import matplotlib as mpl

    mpl.use("Agg")
    for example in examples():
        if not sys.argv[1:] or example.name in sys.argv[1:]:
            example.picture.parent.mkdir(parents=True, exist_ok=True)
            run(example).savefig(example.picture, dpi=DPI)
            print(f"written: {example.picture}")


if __name__ == "__main__":
    main()
