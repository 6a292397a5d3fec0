"""Measurements of the benchmark of compiled terms by size."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import load, load_scene
from ckc_pin.codegen.term_functions import TermFunctions
from scripts.experiments.generated_sizes import Size, measure, ring


def test_measurement_uses_a_separate_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    size = measure("1")
    assert list(tmp_path.iterdir()) == []
    assert os.environ["XDG_CACHE_HOME"] == str(tmp_path)
    mechanism = load(load_scene("n_four_bar", {"mechanism.N": 1}).spec.mechanism)
    code = TermFunctions.of(mechanism)
    assert (size.name, size.n, size.reason) == ("1", 3, "")
    assert (size.operations, size.bytes) == (code.functions["acceleration"].n_instructions(), len(code.c_source()))
    assert min(size.expressions_s, size.compiled_rhs_s, size.pinocchio_rhs_s) > 0
    assert size.compile_s > size.expressions_s


def test_repaid_is_break_even_number_of_right_hand_sides() -> None:
    size = Size("mine", 4, 1000, 2000, 0.5, 3.0, 1e-6, 4e-6)
    assert size.repaid == pytest.approx(1e6)
    assert size.row() == "| mine | 4 | 1,000 | 2 | 0.50 | 3.0 | 1.00 | 4.00 | 4.0 | 1.0e+06 |"
    refused = replace(size, reason="refused").row()
    assert "refused" in refused
    assert refused.count("|") == size.row().count("|")


def test_ring_is_one_closed_branch(tmp_path: Path) -> None:
    scene = ring(12, tmp_path)
    mechanism = load(scene.parent / "mechanism.toml")
    parents = [mechanism.tree.model.parents[k] for k in range(1, 13)]
    assert (mechanism.n, mechanism.rank, parents) == (12, 3, list(range(12)))
    assert np.abs(mechanism.assembled.phi).max() < 1e-12
