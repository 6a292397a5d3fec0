"""Progress of an ensemble in a notebook: one element below the cell, updated after each chunk."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

CELL = """import ckc_pin

results = ckc_pin.ensemble(
    "five_bar/swing", {"initial.q.theta_1": {"uniform": [-1.3, -1.0]}}, {"end": "q_tree"}, members=24, seed=1, chunk=8,
    overrides={"t_end": 0.1, "solver.terms": "pinocchio"},
)
results.sizes["member"]"""


class Listener(NotebookClient):
    """A client that keeps all display messages of the kernel, in order."""

    def process_message(self, msg: dict[str, Any], cell: Any, cell_index: int) -> Any:
        if msg["msg_type"] in ("display_data", "update_display_data"):
            self.displayed.append((msg["msg_type"], msg["content"]["data"]))
        return super().process_message(msg, cell, cell_index)


def test_a_notebook_shows_progress_and_rate(tmp_path: Path) -> None:
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    client = Listener(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}})
    client.displayed = []
    client.execute()
    assert [kind for kind, _ in client.displayed] == ["display_data", *["update_display_data"] * 2]
    pattern = r"five_bar/swing: (\d+) of 24 members, [\d.e+]+ a second(, \d+ s left)?"
    matches = [re.fullmatch(pattern, data["text/plain"]) for _, data in client.displayed]
    assert [int(match[1]) for match in matches] == [8, 16, 24]
    assert [bool(match[2]) for match in matches] == [True, True, False]
    displayed_outputs = notebook.cells[0].outputs
    assert [output.output_type for output in displayed_outputs] == ["display_data", "execute_result"], (
        "without a warning"
    )
    assert '<progress value="24" max="24"></progress>' in displayed_outputs[0]["data"]["text/html"]
    assert displayed_outputs[1]["data"]["text/plain"] == "24"
