"""Smoke tests of the experiments: help, a small part of each, and messages for wrong arguments."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from scripts.experiments.__main__ import app, main
from tests.contract.helpers.command import Outcome, run_main

ROOT = Path(__file__).parents[2]
SCIPY_PEER = ROOT / "scripts" / "experiments" / "benchmark" / "peer_examples" / "scipy_peer.py"
EXPERIMENTS = tuple(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
# Arguments of a part that takes seconds, and a text in its output. Other experiments take longer or need more programs.
PARTS = {
    "paper": (["no-singularities"], "**The statement holds with a condition.**"),
    "errata": (["multipliers", "type-1-points"], "## type-1-points"),
    "stability": (["length"], "| length | 21 | 21 | 0 | 0 |"),
    "rank_loss": (["--quick", "--formulation", "dae"], "0 wrong"),
    "generated_sizes": (["1"], "| 1 | 3 |"),
    "ensembles": (["--quick"], "starts in the proved set"),
    "fuzz": (["--runs", "1", "--mechanism", "five_bar"], "five_bar"),
    "planning": (["five_bar", "--tasks", "2"], "| five_bar | 2 | 2 |"),
    "identification": (["leg", "--trials", "2"], "| leg | 2 | 10 |"),
    "peer": ([f"{sys.executable} {SCIPY_PEER}", "tracking_1e-04"], "tracking_1e-04: not compared, the law of"),
    "bench": (["--only", "Simulator.step of 1 ms, five_bar"], "| Simulator.step of 1 ms, five_bar |"),
}
HAS_OUT = {"paper", "ensembles"}
NOT_RUN = {
    "map", "scenes", "stream", "allocations", "robots", "pictures", "benchmark", "bench_ensembles", "iftomm",
    "right_hand_sides", "time_optimal", "importers", "exported_code",
}  # fmt: skip


def run(*arguments: str) -> Outcome:
    return run_main(main, "./scripts/experiment", *arguments)


def test_all_experiments_are_listed() -> None:
    assert set(PARTS) | NOT_RUN == set(EXPERIMENTS)


@pytest.mark.parametrize("name", PARTS)
def test_experiment_runs_in_part(name: str, tmp_path: Path) -> None:
    arguments, says = PARTS[name]
    options = ["--out", str(tmp_path)] if name in HAS_OUT else []
    result = run(name, *arguments, *options)
    assert result.code == 0 or name == "bench", result.err  # bench may exceed a bound on a busy machine
    assert says in result.out


def test_benchmark_page_is_written_without_measuring(tmp_path: Path) -> None:
    """The tables are the committed ones, reduced to a single work."""
    import pandas as pd

    source = ROOT / "docs" / "report"
    shutil.copy(source / "about.json", tmp_path)
    for path in source.glob("*.csv.gz"):
        table = pd.read_csv(path)
        table = table[table.work == "swing"] if "work" in table else table
        table.to_csv(tmp_path / path.name, index=False)
    result = run("benchmark", "--page", "--out", str(tmp_path))
    assert result.code == 0, result.err
    assert {path.name for path in tmp_path.glob("*.png")} == {"swing.png", "report.png", "growth.png"}
    assert "](swing.png)" in (tmp_path / "report.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_help_of_experiment_has_an_example(name: str) -> None:
    result = run(name, "--help")
    assert result.code == 0
    assert f"\n  ./scripts/experiment {name}" in result.out.partition("Examples:")[2].replace("\n    ", "\n  ")


def test_missing_tables_are_wrong_input(tmp_path: Path) -> None:
    result = run("benchmark", "--page", "--out", str(tmp_path))
    assert (result.code, result.out) == (2, "")
    assert "about.json" in result.err


@pytest.mark.parametrize(
    ("line", "choices"),
    [
        (["nothing"], EXPERIMENTS),
        (["rank_loss", "--formulation", "nothing"], ("dae", "reduced", "spf")),
        (["stability", "nothing"], ("method", "gain", "long")),
    ],
)
def test_unknown_name_lists_valid_names(line: list[str], choices: tuple[str, ...]) -> None:
    result = run(*line)
    assert (result.code, result.out) == (2, "")
    assert all(name in result.err for name in choices)


def test_help_imports_no_experiment() -> None:
    """Run in a separate process, as ./scripts/experiment does."""
    command = [sys.executable, "-X", "importtime", "-m", "scripts.experiments", "--help"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert all(name in result.stdout for name in EXPERIMENTS)
    loaded = {line.rpartition("|")[2].strip() for line in result.stderr.splitlines()}
    assert "typer" in loaded
    assert loaded.isdisjoint({"numpy", "pandas", "jinja2", "joblib", "pinocchio", "matplotlib"})
