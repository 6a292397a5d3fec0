"""Run the examples, and draw the gallery's pictures: ``python -m scripts.site.run_examples [NAME...]``."""

from __future__ import annotations

import re
import sys
from base64 import b64decode
from importlib import import_module
from io import BytesIO
from typing import Any

from scripts.experiments.chart import shrink
from scripts.site.gallery import Example, examples

__all__ = ["main", "picture", "run"]

DPI = 150  # makes a figure of seven inches slightly sharper than a page's column needs


def run(example: Example) -> Any:
    """Run an example in Python and return its figure; raise AssertionError if the example is invalid."""
    return import_module(f"examples.{example.name}").main()


def picture(example: Example) -> bytes:
    """Run an example and return its picture as PNG; for a notebook, the first picture of its outputs."""
    if example.path.suffix == ".ipynb":
        return _first_shown(example)
    drawn = BytesIO()
    run(example).savefig(drawn, dpi=DPI)
    return drawn.getvalue()


def _first_shown(example: Example) -> bytes:
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(example.path, as_version=4)  # type: ignore[no-untyped-call]
    NotebookClient(notebook, timeout=120).execute()
    shown = "".join(str(output.get("data", {})) for cell in notebook.cells for output in cell.get("outputs", []))
    match = re.search(r"data:image/png;base64,([\w+/=]+)", shown)
    assert match, "a notebook shows a figure"
    return b64decode(match[1])


def main() -> None:
    """Draw the pictures of the named examples, or of all."""
    import matplotlib as mpl

    mpl.use("Agg")
    for example in examples():
        if not sys.argv[1:] or example.name in sys.argv[1:]:
            example.picture.parent.mkdir(parents=True, exist_ok=True)
            example.picture.write_bytes(picture(example))
            shrink(example.picture)
            print(f"written: {example.picture}")


if __name__ == "__main__":
    main()
