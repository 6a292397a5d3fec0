"""The gallery: each example's first line, its picture and its text."""

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
    """One file of examples/."""

    path: Path
    title: str
    about: str

    @property
    def name(self) -> str:
        """What the file is called."""
        return self.path.stem

    @property
    def picture(self) -> Path:
        """Where its picture is, under docs/."""
        return ROOT / "docs" / PICTURES / f"{self.name}.png"


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
        said = ast.get_docstring(ast.parse(text)) or ""
    else:
        said = "".join(json.loads(text)["cells"][0]["source"]).removeprefix("# ")
    title, _, about = said.partition("\n")
    return Example(path, title.rstrip("."), about.strip())


def markdown() -> str:
    """Return cards that lead to sections, and a section an example, in MyST."""
    found = examples()
    if not found:
        return ""
    lines = ["::::{grid} 2 2 3 3", ":gutter: 2", ""]
    for example in found:
        lines += [f":::{{grid-item-card}} {example.title}", f":img-top: {PICTURES}/{example.name}.png"]
        lines += [f":link: example-{example.name}", ":link-type: ref", ":::", ""]
    lines += ["::::", ""]
    for example in found:
        lines += [f"(example-{example.name})=", f"## {example.title}", "", example.about, ""]
        lines += [f"![{example.title}]({PICTURES}/{example.name}.png)", "", f"`examples/{example.path.name}`:", ""]
        lines += ["````python", _code(example.path), "````", ""]
    return "\n".join(lines)


def _code(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return text.split('"""\n', 1)[1].strip()  # what the docstring says stands above
    cells = json.loads(text)["cells"][1:]
    return "\n\n".join(
        "".join(c["source"]) if c["cell_type"] == "code" else "# " + "".join(c["source"]).replace("\n", "\n# ")
        for c in cells
    )
