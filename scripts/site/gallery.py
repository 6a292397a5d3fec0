"""Generate the gallery page: title, picture and text of each example."""

from __future__ import annotations

import ast
import json
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Example", "examples", "markdown"]

ROOT = Path(__file__).resolve().parents[2]
PICTURES = "images/gallery"


@dataclass(frozen=True)
class Example:
    """A file of examples/ with its title and description."""

    path: Path
    title: str
    about: str

    @property
    def name(self) -> str:
        """File name without its ending."""
        return self.path.stem

    @property
    def picture(self) -> Path:
        """Path of its picture in docs/."""
        return ROOT / "docs" / PICTURES / f"{self.name}.png"

    @property
    def thumbnail(self) -> Path:
        """Path of its thumbnail in docs/."""
        return ROOT / "docs" / PICTURES / "small" / f"{self.name}.png"


def examples() -> list[Example]:
    """Return the examples in the order of their names."""
    return [
        _example(path)
        for path in sorted((ROOT / "examples").iterdir())
        if path.suffix in (".py", ".ipynb") and path.stem != "__init__"
    ]


def _example(path: Path) -> Example:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        text = ast.get_docstring(ast.parse(text)) or ""
    else:
        text = "".join(json.loads(text)["cells"][0]["source"]).removeprefix("# ")
    title, _, about = text.partition("\n")
    return Example(path, title.rstrip("."), about.strip())


def markdown() -> str:
    """Return a grid of links to sections, and a section for each example, in MyST."""
    gallery = examples()
    if not gallery:
        return ""
    lines = ["::::{grid} 1 2 3 3", ":gutter: 2", ""]
    for example in gallery:
        lines += [f":::{{grid-item-card}} {example.title}", f":img-top: {PICTURES}/small/{example.name}.png"]
        lines += [f":link: example-{example.name}", ":link-type: ref", ":::", ""]
    lines += ["::::", ""]
    for example in gallery:
        lines += [f"(example-{example.name})=", f"## {example.title}", "", example.about, ""]
        lines += [f"![{example.title}]({PICTURES}/{example.name}.png)", "", f"`examples/{example.path.name}`:", ""]
        lines += ["````python", _code(example.path), "````", ""]
    return "\n".join(lines)


def _code(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return text.split('"""\n', 1)[1].strip()  # without the docstring, which is displayed above
    cells = json.loads(text)["cells"][1:]
    return "\n\n".join(
        "".join(c["source"]) if c["cell_type"] == "code" else "# " + "".join(c["source"]).replace("\n", "\n# ")
        for c in cells
    )
