"""Sphinx domain for keys of files, which makes them searchable by name and unit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx import addnodes
from sphinx.directives import ObjectDescription
from sphinx.domains import Domain, ObjType
from sphinx.util.nodes import make_id

__all__ = ["CkcDomain"]


class KeyEntry(ObjectDescription[str]):
    """``ckc:key``: a key with its type, default and unit."""

    option_spec: ClassVar[Any] = ObjectDescription.option_spec | dict.fromkeys(
        ("file", "kind", "default", "unit"), directives.unchanged
    )

    def handle_signature(self, sig: str, signode: Any) -> str:
        table, _, name = sig.rpartition(".")
        if table:
            signode += addnodes.desc_addname("", f"{table}.")
        signode += addnodes.desc_name("", name)
        for what in ("kind", "default", "unit"):
            value = self.options.get(what)
            if value:
                text = {"required": "required", "absent": "absent by default"}.get(value, f"default {value}")
                shown = text if what == "default" else value
                signode += nodes.inline("", shown, classes=["ckc-fact", f"ckc-{what}"])
        return sig

    def add_target_and_index(self, name: str, sig: str, signode: Any) -> None:
        file, unit = self.options.get("file", ""), self.options.get("unit", "")
        anchor = make_id(self.env, self.state.document, f"key-{file}", name)
        signode["ids"].append(anchor)
        self.state.document.note_explicit_target(signode)
        self.env.get_domain("ckc").note(name, file, unit, self.env.docname, anchor)  # type: ignore[attr-defined]
        self.indexnode["entries"].append(("single", f"{name} ({file})", anchor, "", None))


class CkcDomain(Domain):
    """Keys, by (file, path)."""

    name = "ckc"
    label = "ckc_pin"
    object_types: ClassVar[dict[str, ObjType]] = {"key": ObjType("key")}
    directives: ClassVar[dict[str, Any]] = {"key": KeyEntry}
    initial_data: ClassVar[dict[str, Any]] = {"keys": {}}
    data_version = 1

    def note(self, name: str, file: str, unit: str, docname: str, anchor: str) -> None:
        """Add an entry. A key may occur in two structures; links lead to the first one."""
        self.data["keys"].setdefault(f"{file}:{name}", (name, unit, docname, anchor))

    def clear_doc(self, docname: str) -> None:
        self.data["keys"] = {key: entry for key, entry in self.data["keys"].items() if entry[2] != docname}

    def merge_domaindata(self, docnames: Any, otherdata: Any) -> None:
        self.data["keys"] |= {key: entry for key, entry in otherdata["keys"].items() if entry[2] in docnames}

    def get_objects(self) -> Iterator[tuple[str, str, str, str, str, int]]:
        """Yield entries. The displayed name has the unit, so that a search for rad/s finds keys in rad/s."""
        for key, (name, unit, docname, anchor) in self.data["keys"].items():
            yield key, f"{name} [{unit}]" if unit else name, "key", docname, anchor, 1
