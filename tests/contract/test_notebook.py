"""The example notebook, executed in a kernel: every cell, and what its values display."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def displayed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What each cell of code shows, by its last line."""
    notebook = nbformat.read(ROOT / "examples" / "five_bar.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "kept without what it shows"
    client = NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path_factory.mktemp("n"))}})
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    client.execute()
    outputs = {}
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert all(output.output_type == "execute_result" for output in cell.outputs), cell.source
            outputs[cell.source.splitlines()[-1]] = cell.outputs[0].data if cell.outputs else {}
    return outputs


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("mechanism", "Mechanism five_bar: 4 coordinates, 2 freedoms"),
        ("run", "Run of five_bar/tracking, done: reached t_end"),
        ("run.sel(t=0.5)", "State of five_bar at t = 0.5 s"),
        ("simulator", "Simulator of five_bar/swing at t = 1.2 s"),
    ],
)
def test_values_are_displayed_as_tables(cell: str, words: str, displayed: dict[str, dict[str, Any]]) -> None:
    assert f"<strong>{words}</strong><table>" in displayed[cell]["text/html"]
    assert displayed[cell]["text/plain"].startswith(words)


def test_figures_and_playback_are_displayed_inline(displayed: dict[str, dict[str, Any]]) -> None:
    figures = displayed["run.plot()"]["text/html"]
    assert figures.count('<img src="data:image/png;base64,') == 3
    assert displayed["run.plot()"]["text/plain"] == "Figures(tracking, tracking_checks, tracking_snapshots)"
    page = displayed["run.play(speed=0.5)"]["text/html"]
    assert page.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert 'sandbox="allow-scripts"' in page


def test_displayed_numbers_agree_with_the_run(displayed: dict[str, dict[str, Any]]) -> None:
    rest = displayed["calm.q_tree[-1, [0, 2]]"]["text/plain"]
    assert [round(float(x), 3) for x in re.findall(r"-?\d\.\d+", rest)] == [-1.2, -1.9]
    assert "xarray.DataArray" in displayed['data.q_tree.sel(coordinate="theta_1").max()']["text/html"]
    assert "tau.theta_1" in displayed['run.to_pandas()[["theta_1", "tau.theta_1", "tip.x"]].describe()']["text/html"]
