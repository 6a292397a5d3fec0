"""What the study of sizes measures is what it says."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import load, load_scene
from ckc_pin.codegen.term_functions import TermFunctions
from scripts.experiments.generated_sizes import Size, measure, ring


def test_a_row_of_squares_is_measured_in_a_cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = measure("1")
    assert list(tmp_path.iterdir()) == []
    assert os.environ["XDG_CACHE_HOME"] == str(tmp_path)
    mechanism = load(load_scene("n_four_bar", {"mechanism.N": 1}).spec.mechanism)
    code = TermFunctions.of(mechanism)
    assert (found.name, found.n, found.reason) == ("1", 3, "")
    assert (found.operations, found.bytes) == (code.functions["acceleration"].n_instructions(), len(code.c_source()))
    assert min(found.expressions_s, found.written_s, found.general_s) > 0
    assert found.compile_s > found.expressions_s


def test_what_is_saved_repays_the_compiler() -> None:
    size = Size("mine", 4, 1000, 2000, 0.5, 3.0, 1e-6, 4e-6)
    assert size.repaid == pytest.approx(1e6)
    assert size.row() == "| mine | 4 | 1,000 | 2 | 0.50 | 3.0 | 1.00 | 4.00 | 4.0 | 1.0e+06 |"
    refused = replace(size, reason="refused").row()
    assert "refused" in refused
    assert refused.count("|") == size.row().count("|")


def test_a_ring_is_one_branch_that_closes(tmp_path: Path) -> None:
    scene = ring(12, tmp_path)
    mechanism = load(scene.parent / "mechanism.toml")
    parents = [mechanism.tree.model.parents[k] for k in range(1, 13)]
    assert (mechanism.n, mechanism.rank, parents) == (12, 3, list(range(12)))
    assert np.abs(mechanism.assembled.phi).max() < 1e-12
