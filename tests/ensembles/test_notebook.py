"""An ensemble in a notebook says how far it is: one element below the cell that is changed as chunks are finished."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

CELL = """import ckc_pin

found = ckc_pin.ensemble(
    "five_bar/swing", {"initial.q.theta_1": {"uniform": [-1.3, -1.0]}}, {"end": "q_tree"}, members=24, seed=1, chunk=8,
    overrides={"t_end": 0.1, "solver.terms": "pinocchio"},
)
found.sizes["member"]"""


class Listener(NotebookClient):
    """A client that keeps what a kernel shows, in order, and not its last state alone."""

    def process_message(self, msg: dict[str, Any], cell: Any, cell_index: int) -> Any:
        if msg["msg_type"] in ("display_data", "update_display_data"):
            self.shown.append((msg["msg_type"], msg["content"]["data"]))
        return super().process_message(msg, cell, cell_index)


def test_it_says_how_far_it_is_and_how_fast(tmp_path: Path) -> None:
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    client = Listener(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}})
    client.shown = []
    client.execute()
    assert [kind for kind, _ in client.shown] == ["display_data", *["update_display_data"] * 2]
    said = [re.fullmatch(r"five_bar/swing: (\d+) of 24 members, [\d.e+]+ a second(, \d+ s left)?", data["text/plain"])
            for _, data in client.shown]  # fmt: skip
    assert [int(match[1]) for match in said] == [8, 16, 24]
    assert [bool(match[2]) for match in said] == [True, True, False]
    below = notebook.cells[0].outputs
    assert [output.output_type for output in below] == ["display_data", "execute_result"], "and no warning"
    assert '<progress value="24" max="24"></progress>' in below[0]["data"]["text/html"]
    assert below[1]["data"]["text/plain"] == "24"
