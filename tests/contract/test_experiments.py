"""A smoke of each experiment: it starts, names what it takes, and answers a part of its question."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from scripts.experiments.__main__ import EXPERIMENTS

ROOT = Path(__file__).parents[2]
PARTS = {
    "errata": (["multipliers"], "multipliers: "),
    "stability": (["gain"], "| "),
    "rank_loss": (["--quick"], "0 wrong"),
}


def run(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "scripts.experiments", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", PARTS)
def test_a_part_of_an_experiment(name: str) -> None:
    arguments, says = PARTS[name]
    found = run(name, *arguments)
    assert found.returncode == 0, found.stderr
    assert says in found.stdout


def test_an_unknown_experiment_is_answered_with_the_others() -> None:
    found = run("nothing")
    assert found.returncode == 2
    assert all(name in found.stderr for name in EXPERIMENTS)
