"""Texts of all pages as a script, from which the search page takes its excerpts without requests.

Sphinx's own search requests every page of a result from a server. A browser refuses that for pages opened from disk.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from docutils import nodes

__all__ = ["PageText", "read_page_text", "setup_search"]

SCRIPTS = ("page_texts.js", "search.js")
UNREADABLE = (nodes.math, nodes.math_block, nodes.raw, nodes.comment)

PageText = dict[str, Any]


def setup_search(app: Any) -> None:
    """Add the texts and the script that shows results to the search page of a Sphinx application."""
    app.connect("html-page-context", _add_scripts)
    app.connect("build-finished", _write_texts)


def _add_scripts(app: Any, pagename: str, templatename: str, context: Any, doctree: Any) -> None:
    if pagename == "search":
        for name in SCRIPTS:  # Deferred: after Sphinx has defined its search, before it starts.
            app.add_js_file(name, loading_method="defer")


def _write_texts(app: Any, exception: Exception | None) -> None:
    if exception is None and app.builder.format == "html":
        pages = {name: read_page_text(app.env.get_doctree(name)) for name in sorted(app.env.found_docs)}
        # JSON is a part of JavaScript.
        script = f"const pageTexts = {json.dumps(pages, ensure_ascii=False, separators=(',', ':'))};\n"
        (Path(app.outdir) / "_static" / SCRIPTS[0]).write_text(script, encoding="utf-8")


def read_page_text(doctree: nodes.document) -> PageText:
    """Return the text of a page, and where in it each anchor is.

    Returns
    -------
    dict
        `text`, one line for each block, and `anchors`, the offsets in it by name.
    """
    parts: list[str] = []
    anchors: dict[str, int] = {}
    length = 0

    def append(text: str) -> None:
        nonlocal length
        parts.append(text)
        length += len(text)

    def walk(node: nodes.Node) -> None:
        if isinstance(node, nodes.Text):
            append(re.sub(r"\s+", " ", node.astext()))
            return
        if isinstance(node, UNREADABLE):
            return
        is_block = not isinstance(node, nodes.Inline)
        is_fact = isinstance(node, nodes.inline) and "ckc-fact" in node["classes"]
        if is_block and parts and not parts[-1].endswith("\n"):
            append("\n")
        elif is_fact:
            append(" ")
        anchors.update(dict.fromkeys(getattr(node, "attributes", {}).get("ids", ()), length))
        for child in node.children:
            walk(child)

    walk(doctree)
    return {"text": "".join(parts), "anchors": anchors}
