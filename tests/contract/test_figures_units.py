"""Units have one notation, θ₁ (rad), in figures and text; and the contents of ensemble figures."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from ckc_pin.view import ensemble_figures

ROOT = Path(__file__).parents[2]
UNIT = r"(?:s|ms|m|mm|rad|rad/s|deg|N|N m|kg|J|W|Hz|1/s|2 pi s)"
OTHER = re.compile(rf"^\D.* / {UNIT}$|\[{UNIT}(?:, {UNIT})*\]|^[\w ]+, {UNIT}$")  # t / s, t [s], at t, s
PLACES = ("examples", "ckc_pin", "scripts")


@pytest.mark.parametrize(
    "said", ["t / s", "rate [rad/s]", "q, q̇ [rad, rad/s]", "at t, s", "stable at / rad", "tau [N m]"]
)
def test_other_unit_notations_are_detected(said):
    assert OTHER.search(said)


@pytest.mark.parametrize("place", PLACES)
def test_units_are_in_parentheses(place):
    matches = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.value}"
        for path in sorted((ROOT / place).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if "\n" not in node.value and OTHER.search(node.value)
    ]
    assert not matches


@pytest.fixture
def drawn(monkeypatch):
    """Figures instead of files."""
    figures = []
    monkeypatch.setattr(ensemble_figures, "write_figure", lambda figure, *_: [figures.append(figure)])
    return figures


def test_basin_figure_shows_every_member(drawn):
    """More basins than there are colours: those that have none are shown in one that says so."""
    basins, each = 9, 4
    ends = np.repeat(np.arange(basins, dtype=float), each)
    extra = 3
    count = len(ends) + extra
    x = np.linspace(-1, 1, count)
    results = xr.Dataset({
        "initial.q.theta_1": ("member", x, {"units": "rad"}), "key": ("member", x**2),
        "end": ("member", np.append(ends, np.full(extra, np.nan))),
        "status": ("member", np.append(np.ones(len(ends)), [1, 2, 3])),
    })  # fmt: skip
    ensemble_figures.draw_basins(results, ("initial.q.theta_1", "key"), "end", Path("basins.png"))
    (ax,) = drawn[0].axes
    assert sum(len(line.get_xdata()) for line in ax.lines) == count
    labels = [line.get_label() for line in ax.lines]
    assert labels[:6] == [f"settles: {each}"] * 6
    assert labels[6:] == ["settles elsewhere: 12", "does not settle: 1", "stopped or cannot begin: 2"]
    assert ax.get_xlabel() == r"$\theta_{1}$ at the start (rad)"
    assert ax.get_ylabel() == "key"


def test_quantile_figure_has_bands_and_units():
    values = np.arange(101.0)[:, np.newaxis, np.newaxis] * np.ones((1, 2, 5))
    x = xr.DataArray(values, dims=("member", "coordinate", "time"), name="error", attrs={"units": "rad"},
                     coords={"coordinate": ["theta_1", "theta_3"], "time": np.linspace(0, 1, 5)})  # fmt: skip
    upper, lower = ensemble_figures.draw_quantiles(x).axes
    assert [ax.get_ylabel() for ax in (upper, lower)] == [r"$\theta_{1}$ (rad)", r"$\theta_{3}$ (rad)"]
    assert lower.get_xlabel() == "$t$ (s)"
    heights = [sorted(set(band.get_paths()[0].vertices[:, 1].tolist())) for band in upper.collections]
    assert heights == [[5.0, 95.0], [25.0, 75.0]]
    assert np.all(upper.lines[0].get_ydata() == 50.0)
