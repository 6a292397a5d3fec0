"""Summaries of results, and indexing and export of runs."""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, Run, Simulator, State, Terms, check, load, load_scene, simulate
from ckc_pin.base.summary import Summary, in_notebook
from ckc_pin.mechanism.library import shipped
from ckc_pin.view.inline import Figures, Playback
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc

LINES, WIDTH = 24, 100  # a screen

SWING = "five_bar/swing"


@pytest.fixture(scope="module")
def swing() -> Run:
    return simulate(SWING, {"t_end": 0.4, "solver.output_dt": 0.01, "solver.rtol": 1e-10})


# --- one screen --------------------------------------------------------------------------------------


def _values(name: str) -> list[Any]:
    """Return the results for a mechanism and its scene."""
    mechanism, scene = load(name), load_scene(name, {"t_end": 0.01})
    run, simulator = simulate(scene), Simulator(scene)
    return [mechanism, scene, check(mechanism), check(scene), run, simulator, simulator.state, simulator.state.terms]


@pytest.mark.parametrize("name", shipped())
def test_repr_fits_on_one_screen(name: str) -> None:
    for value in _values(name):
        shown = repr(value)
        lines = shown.split("\n")
        assert len(lines) <= LINES, shown
        assert max(map(len, lines)) <= WIDTH, shown
        assert name in lines[0], "the title names what it is of"
        assert not re.search(r"0x[0-9a-f]{6}|array\(|object at", shown)
        html = value._repr_html_()
        assert html.startswith("<div><strong>")
        assert html.count("<tr>") == len(value.summary().rows) >= 3


def test_other_reprs_fit_on_one_screen() -> None:
    run = simulate("five_bar/tracking", {"t_end": 0.1})
    for value in (
        ckc_pin.inverse_dynamics(run),
        ckc_pin.singularity_map("five_bar", cells=16),
        ckc_pin.symbolic("five_bar"),
    ):
        lines = repr(value).split("\n")
        assert 3 < len(lines) <= LINES
        assert max(map(len, lines)) <= WIDTH + 10


def test_summary_breaks_between_items_and_counts_omitted_ones() -> None:
    items = [f"joint_{k} = {k}.5 rad" for k in range(40)]
    summary = Summary("a\x1b[2J", [("all", items), ("said", "word " * 60)])
    whole, clipped = summary.text(60, None).split("\n"), summary.text(60).split("\n")
    assert whole[0] == clipped[0] == "a\\x1b[2J"
    assert max(map(len, whole)) <= 60
    assert all(any(item in line for line in whole) for item in items)
    shown = [item for item in items if any(f"{item}" in line for line in clipped)]
    assert 0 < len(shown) < len(items)
    assert f"and {len(items) - len(shown)} more" in "\n".join(clipped)
    assert "<b>" not in Summary("<b>", [("<b>", ["<b>"]), ("x", "<b>")]).html()


def test_summary_keeps_names_whole_with_units(monkeypatch: pytest.MonkeyPatch) -> None:
    for columns in ("80", "100", "140"):
        monkeypatch.setenv("COLUMNS", columns)
        for words in (("check", "two_ur5"), ("run", "two_ur5", "--set", "t_end=0.01")):
            out = ckc(*words).out
            assert max(map(len, out.split("\n"))) <= int(columns)
            assert re.search(r"load_root\.x = \S+ m\b", out)
            assert re.search(r"load_root\.rx = \S+ rad\b", out)
            for name in load("two_ur5").coordinates:
                assert re.search(rf"\b{re.escape(name)} = \S+ (m|rad)\b", out), name


# --- parts -------------------------------------------------------------------------------------------


def test_run_is_indexed_by_coordinate_and_array_name(swing: Run) -> None:
    assert np.array_equal(swing["theta_3"], swing.q_tree[:, 2])
    assert swing["energy"] is swing.energy
    with pytest.raises(
        InputError,
        match=r"run\['theta_9'\]: no such quantity; .* 'theta_1', .* the coordinates theta_1, .*, and the arrays t",
    ):
        swing["theta_9"]
    with pytest.raises(InputError, match=r"run\[3\]: no such quantity"):
        swing[3]  # type: ignore[index]


def test_sel_returns_the_nearest_output(swing: Run) -> None:
    result = swing.sel(t=0.1234)
    assert isinstance(result, State)
    assert result.t == swing.t[12]
    assert_close(result.q_tree, swing.q_tree[12], 1e-15)
    reference = Terms(swing.mechanism, result.terms.at, swing.v_tree[12])
    assert result.terms.energy == pytest.approx(swing.energy[12], abs=1e-12)
    assert_close(result.terms.C, reference.C, 1e-13)
    for t in (-0.1, 0.5, np.nan):
        with pytest.raises(InputError, match=r"the run is from 0 to 0\.4 s"):
            swing.sel(t=t)
    with pytest.raises(InputError, match=r"expected a time, s, or slice\(start, stop\), got"):
        swing.sel(t="end")  # type: ignore[call-overload]


@pytest.mark.parametrize("velocity", ["rho", "actual"])
def test_simulator_continues_from_a_state_of_a_run(velocity: str) -> None:
    """Also off the manifold, where the velocity in C differs from the actual one."""
    overrides = {"formulation": "spf", "epsilon": 0.1, "initial.w": [0.01, -0.02], "coriolis_velocity": velocity,
               "t_end": 0.2, "solver.rtol": 1e-10, "solver.output_dt": 0.1}  # fmt: skip
    run = simulate(SWING, overrides)
    simulator = Simulator(SWING, overrides)
    stepped, theirs = simulator.step(dt=0.1), run.sel(t=0.1)
    assert np.abs(theirs.w).max() > 1e-3
    assert_close(theirs.q_tree, stepped.q_tree, 1e-8)
    assert_close(theirs.v_tree, stepped.v_tree, 1e-7)
    assert_close(theirs.terms.C, stepped.terms.C, 1e-6)
    simulator.reset(theirs)
    assert_close(simulator.step(dt=0.1).q_tree, run.q_tree[-1], 1e-7)


def test_slice_of_a_run_is_a_run(swing: Run, tmp_path: Path) -> None:
    event = {"coordinate": "theta_2", "value": 0.5}
    whole = simulate(SWING, {"t_end": 0.4, "solver.output_dt": 0.01, "event": [event]})
    part = whole.sel(t=slice(0.1, 0.2))
    assert part.t[0] == pytest.approx(0.1)
    assert part.t[-1] == pytest.approx(0.2)
    assert len(part.t) == 11
    assert np.array_equal(part.q_tree, whole.q_tree[10:21])
    assert part.lyapunov is None
    assert len(whole.events) == 1
    assert part.events == []
    assert whole.sel(t=slice(0.2, None)).events == whole.events
    again = Run.load(part.save(tmp_path / "run.npz"))
    assert np.array_equal(again["theta_1"], part["theta_1"])
    with pytest.raises(InputError, match=r"no output instant from 0\.101 to 0\.102 s; the run is from 0 to 0\.4 s"):
        whole.sel(t=slice(0.101, 0.102))
    with pytest.raises(InputError, match="two times, s, without a step"):
        whole.sel(t=slice(0.1, 0.2, 0.01))


# --- other programs ----------------------------------------------------------------------------------


def test_csv_has_all_digits(swing: Run, tmp_path: Path) -> None:
    with swing.to_csv(tmp_path / "run.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    numbers = np.array(rows, dtype=float)
    table = dict(zip(head, numbers.T, strict=True))
    assert head[:6] == ["t", "theta_1", "theta_2", "theta_3", "theta_4", "v.theta_1"]
    assert np.array_equal(table["t"], swing.t)
    for name, column in (
        ("theta_4", swing.q_tree[:, 3]),
        ("v.theta_4", swing.v_tree[:, 3]),
        ("u.theta_3", swing.u[:, 1]),
        ("tau.theta_3", swing.tau[:, 1]),
        ("phi.elbow.y", swing.phi[:, 1]),
        ("energy", swing.energy),
        ("tip.x", swing.points["tip"][:, 0]),
    ):
        assert np.array_equal(table[name], column), name
    with pytest.raises(InputError, match="cannot be written"):
        swing.to_csv(tmp_path / "run.csv" / "run.csv")


def test_xarray_and_pandas_have_the_runs_values(swing: Run) -> None:
    data, frame = swing.to_xarray(), swing.to_pandas()
    one = data.q_tree.sel(coordinate="theta_3").sel(t=0.2, method="nearest")
    assert float(one) == swing.q_tree[20, 2]
    assert frame["theta_3"].to_numpy().tolist() == swing.q_tree[:, 2].tolist()
    assert frame.index.name == "t"
    assert data.tau.sel(motor="theta_3").to_numpy().tolist() == frame["tau.theta_3"].tolist()
    assert data.points.sel(point="tip", axis="y").to_numpy().tolist() == frame["tip.y"].tolist()
    assert data.attrs["scene"] == SWING
    slide = simulate("slider_crank", {"t_end": 0.01}).to_xarray()
    assert slide.q_tree.attrs["units"] == "rad or m"
    assert swing.to_xarray().q_tree.attrs["units"] == "rad"
    assert slide.row_unit.to_numpy().tolist() == ["m", "m"]
    assert "m" in slide.unit.to_numpy().tolist()
    assert "rad" in slide.unit.to_numpy().tolist()


@pytest.mark.parametrize(("method", "package"), [("to_xarray", "xarray"), ("to_pandas", "pandas")])
def test_missing_package_is_named(method: str, package: str, swing: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"{method} needs {package}: pip install 'ckc_pin\[data\]'"):
        getattr(swing, method)()


# --- to look at --------------------------------------------------------------------------------------


def test_run_figures_are_displayed_and_saved(swing: Run, tmp_path: Path) -> None:
    figures = swing.plot()
    assert isinstance(figures, Figures)
    assert set(figures) == {"motion", "motion_snapshots"}
    assert repr(figures) == "Figures(motion, motion_snapshots)"
    html = figures._repr_html_()
    assert html.count('<img src="data:image/png;base64,iVBOR') == len(figures) == 2
    figures["motion"].suptitle("mine")
    assert [path.name for path in figures.save(tmp_path / "drawn", ("svg",))] == ["motion.svg", "motion_snapshots.svg"]
    with pytest.raises(InputError, match="format 'gif'"):
        figures.save(tmp_path, ("gif",))
    assert list(ckc_pin.plot(swing, swing)) == list(figures)


def test_playback_is_an_embedded_page(swing: Run, tmp_path: Path) -> None:
    assert not in_notebook()
    playback = swing.play(inline=True, speed=0.5)
    assert isinstance(playback, Playback)
    assert playback.save(tmp_path / "run.html").read_text(encoding="utf-8") == playback.html
    shown = playback._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert 'sandbox="allow-scripts"' in shown
    assert "<script" not in shown, "it is all within the attribute"
    assert len(shown) < 1.2 * len(playback.html)
    assert SWING in repr(playback)
    server = ckc_pin.play(swing, block=False, inline=False)
    assert server is not None
    assert not isinstance(server, Playback)
    server.stop()


def test_dir_lists_public_names_only() -> None:
    assert {name for name in dir(ckc_pin) if not name.startswith("__")} == set(ckc_pin.__all__)


def test_a_point_prints_its_body_and_position() -> None:
    text = repr(ckc_pin.Point(ckc_pin.load("five_bar"), "tip"))
    assert text.startswith("Point tip of five_bar")
    assert "link_2" in text
    assert "x, y" in text
