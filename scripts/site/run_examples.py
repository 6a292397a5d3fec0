"""Run the examples, and draw the gallery's pictures: ``python -m scripts.site.run_examples [NAME...]``."""

from __future__ import annotations

import ast
import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from scripts.experiments.chart import shrink
from scripts.site.gallery import Example, examples
from scripts.site.thumbnail import reduce_to_thumbnail

__all__ = ["main", "run", "write_pictures"]

DPI = 150  # makes a figure of seven inches slightly sharper than a page's column needs
THUMBNAIL_DPI = 200  # sharp where the gallery shows 300 pixels, also on screens with two pixels for each


def run(example: Example) -> Any:
    """Run an example and return its figure, of a notebook the first one; AssertionError if the example is invalid."""
    if example.path.suffix == ".ipynb":
        return _run_notebook(example.path)
    return import_module(f"examples.{example.name}").main()


def _run_notebook(path: Path) -> Any:
    """Run the cells of a notebook up to the first whose last value is figures."""
    from ckc_pin.view.inline import Figures

    namespace: dict[str, Any] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body[-1]
        if not isinstance(last, ast.Expr):
            exec(compile(tree, str(path), "exec"), namespace)
            continue
        exec(compile(ast.Module(tree.body[:-1], []), str(path), "exec"), namespace)
        value = eval(compile(ast.Expression(last.value), str(path), "eval"), namespace)
        if isinstance(value, Figures):
            return next(iter(value.values()))
    raise AssertionError(f"{path}: a notebook shows a figure")


def write_pictures(example: Example) -> list[Path]:
    """Run an example, write its picture and its thumbnail, and return their paths."""
    figure = run(example)
    example.thumbnail.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(example.picture, dpi=DPI)
    reduce_to_thumbnail(figure)
    figure.savefig(example.thumbnail, dpi=THUMBNAIL_DPI)
    paths = [example.picture, example.thumbnail]
    for path in paths:
        shrink(path)
    return paths


def main() -> None:
    """Draw the pictures of the named examples, or of all."""
    import matplotlib as mpl

    mpl.use("Agg")
    for example in examples():
        if not sys.argv[1:] or example.name in sys.argv[1:]:
            for path in write_pictures(example):
                print(f"written: {path}")


if __name__ == "__main__":
    main()
