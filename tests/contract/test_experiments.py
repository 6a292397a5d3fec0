"""A smoke of each experiment: it starts, says what it takes, and answers a part of its question."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from scripts.experiments.__main__ import app, main
from tests.contract.helpers.command import Outcome, called

ROOT = Path(__file__).parents[2]
EXPERIMENTS = tuple(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
# What takes seconds, and what is then on standard output. The others take longer, or need what is not here.
PARTS = {
    "paper": (["no-singularities"], "**The statement holds with a condition.**"),
    "errata": (["multipliers", "type-1-points"], "## type-1-points"),
    "stability": (["length"], "| length | 21 | 21 | 0 | 0 |"),
    "rank_loss": (["--quick", "--formulation", "dae"], "0 wrong"),
    "generated_sizes": (["1"], "| 1 | 3 |"),
    "ensembles": (["--quick"], "starts within what is proved"),
    "fuzz": (["--runs", "1", "--mechanism", "five_bar"], "five_bar"),
    "bench": (["--only", "Simulator.step of 1 ms, five_bar"], "| Simulator.step of 1 ms, five_bar |"),
}
WRITES = {"paper", "ensembles"}
NEEDY = {"map", "scenes", "stream", "allocations", "robots", "pictures", "benchmark", "bench_ensembles"}


def run(*arguments: str) -> Outcome:
    return called(main, "./scripts/experiment", *arguments)


def test_every_experiment_is_here() -> None:
    assert set(PARTS) | NEEDY == set(EXPERIMENTS)


@pytest.mark.parametrize("name", PARTS)
def test_a_part_of_an_experiment(name: str, tmp_path: Path) -> None:
    arguments, says = PARTS[name]
    options = ["--out", str(tmp_path)] if name in WRITES else []
    found = run(name, *arguments, *options)
    assert found.code == 0 or name == "bench", found.err  # a busy machine misses a bound
    assert says in found.out


def test_the_benchmarks_page_is_made_without_measuring(tmp_path: Path) -> None:
    """Of a single work: its tables are the committed ones, thinned."""
    import pandas as pd

    source = ROOT / "docs" / "report"
    shutil.copy(source / "about.json", tmp_path)
    for path in source.glob("*.csv.gz"):
        table = pd.read_csv(path)
        table = table[table.work == "swing"] if "work" in table else table
        table.to_csv(tmp_path / path.name, index=False)
    found = run("benchmark", "--page", "--out", str(tmp_path))
    assert found.code == 0, found.err
    assert {path.name for path in tmp_path.glob("*.png")} == {"swing.png", "report.png", "growth.png"}
    assert "](swing.png)" in (tmp_path / "report.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_what_an_experiment_takes_is_named_with_an_example(name: str) -> None:
    found = run(name, "--help")
    assert found.code == 0
    assert f"\n  ./scripts/experiment {name}" in found.out.partition("Examples:")[2].replace("\n    ", "\n  ")


def test_what_a_folder_lacks_is_wrong_input(tmp_path: Path) -> None:
    found = run("benchmark", "--page", "--out", str(tmp_path))
    assert (found.code, found.out) == (2, "")
    assert "about.json" in found.err


@pytest.mark.parametrize(
    ("line", "choices"),
    [
        (["nothing"], EXPERIMENTS),
        (["rank_loss", "--formulation", "nothing"], ("dae", "reduced", "spf")),
        (["stability", "nothing"], ("method", "gain", "long")),
    ],
)
def test_a_wrong_name_is_answered_with_the_right_ones(line: list[str], choices: tuple[str, ...]) -> None:
    found = run(*line)
    assert (found.code, found.out) == (2, "")
    assert all(name in found.err for name in choices)


def test_the_list_loads_no_experiment() -> None:
    """In a process of its own, as ./scripts/experiment starts it."""
    command = [sys.executable, "-X", "importtime", "-m", "scripts.experiments", "--help"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert all(name in found.stdout for name in EXPERIMENTS)
    loaded = {line.rpartition("|")[2].strip() for line in found.stderr.splitlines()}
    assert "typer" in loaded
    assert loaded.isdisjoint({"numpy", "pandas", "jinja2", "joblib", "pinocchio", "matplotlib"})
