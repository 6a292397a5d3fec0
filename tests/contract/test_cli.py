"""Command line: keys, shapes and order of the JSON, streams, exit codes."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin.base.summary import to_json
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc

# docs/reference/json.md, in its order; more keys may be added, none may go
CHECK = """n d rows rank redundant independent dependent coordinates q_tree det_phi_z sigma_min_phi_z cond_phi_z
           mass inertia joints warnings desired stability"""
TERMS = """coordinates independent dependent q_tree v_tree D_tree C_tree h_tree phi phi_q phi_z rho rho_dot D C h
           energy"""
RUN = """status message t coordinates q_tree v_tree u tau points max_abs_u max_abs_tau max_phi max_phi_dot energy_start
         energy_end dissipated formulation epsilon stats too_fast"""
STATS = """rhs steps rejected newton factorizations jacobians differences switches python_calls wall_s method
           steps_by_method terms rhs_by_terms"""

Q, V = '{"theta_1": -1.2, "theta_3": -1.9}', '{"theta_1": 0.4, "theta_3": -0.3}'


# --- check -----------------------------------------------------------------------------------------


def test_check_reports_a_mechanism() -> None:
    answer = ckc("check", "five_bar", "--json")
    assert (answer.code, answer.err) == (0, "")
    result = answer.json
    assert set(CHECK.split()) <= set(result)
    assert (result["n"], result["d"], result["rows"], result["rank"]) == (4, 2, 2, 2)
    assert result["coordinates"] == ["theta_1", "theta_2", "theta_3", "theta_4"]
    assert result["independent"] == ["theta_1", "theta_3"]
    assert result["dependent"] == ["theta_2", "theta_4"]
    assert result["redundant"] == result["warnings"] == []
    assert result["desired"] is None
    assert result["q_tree"][0] == -1.434, "the independent coordinates stay at their guess"
    assert result["q_tree"][2] == -1.707
    assert result["det_phi_z"] > 0
    assert result["cond_phi_z"] > 1


def test_check_of_a_scene_follows_its_desired_trajectory() -> None:
    desired = ckc("check", "five_bar/tracking", "--json").json["desired"]
    assert set(desired) == {"leaves_at", "closest_t", "sigma_min", "until"}
    assert desired["leaves_at"] is None
    assert 0 <= desired["closest_t"] <= 9.5
    assert desired["sigma_min"] > 0


def test_warnings_of_a_check_are_no_errors() -> None:
    answer = ckc("check", "five_bar_as_printed/tracking", "--json")
    assert answer.code == 0
    assert answer.json["desired"]["leaves_at"] == pytest.approx(4.393, abs=5e-4)
    assert answer.err == ""
    [warning] = answer.json["warnings"]
    assert "leaves the workspace at t = 4.393" in warning
    assert " ".join(ckc("check", "five_bar_as_printed/tracking").out.split()).endswith(f"warning {warning}")


def test_det_phi_z_is_null_unless_square(bar: Path) -> None:
    """The elbow closed in space: its third row is zero on a planar mechanism."""
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    (bar / "mechanism.toml").write_text(text.replace('"point_2d"', '"point"'), encoding="utf-8")
    result = ckc("check", "bar", "--json").json
    assert (result["rows"], result["rank"], result["d"]) == (3, 2, 2)
    assert result["redundant"] == ["elbow.z"]
    assert result["det_phi_z"] is None


def test_check_prints_a_readable_summary() -> None:
    answer = ckc("check", "five_bar/tracking")
    assert answer.code == 0
    for words in ("freedoms d", "theta_1, theta_3", "theta_2, theta_4", "stays inside"):
        assert words in answer.out


# --- terms -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    answer = ckc("terms", "five_bar", "--q", Q, "--v", V, "--json")
    assert (answer.code, answer.err) == (0, "")
    return answer.json


def test_terms_have_the_documented_keys(result: dict[str, Any]) -> None:
    assert set(result) >= set(TERMS.split())


def test_terms_have_the_documented_shapes(result: dict[str, Any]) -> None:
    shapes = {key: np.shape(result[key]) for key in TERMS.split()[3:]}
    tree, reduced = ("D_tree", "C_tree"), ("D", "C")
    assert all(shapes[key] == (4, 4) for key in tree)
    assert all(shapes[key] == (2, 2) for key in (*reduced, "phi_q", "phi_z"))
    assert all(shapes[key] == (4,) for key in ("q_tree", "v_tree", "h_tree"))
    assert all(shapes[key] == (4, 2) for key in ("rho", "rho_dot"))
    assert shapes["h"] == shapes["phi"] == (2,)
    assert shapes["energy"] == ()


def test_terms_follow_the_order_of_coordinates(result: dict[str, Any]) -> None:
    """phi_q by independent, phi_z by dependent, rho coordinates by independent: against differences of phi."""

    def phi(name: str, by: float) -> Any:
        q = dict(zip(result["coordinates"], result["q_tree"], strict=True))
        q[name] += by
        return np.array(ckc("terms", "five_bar", "--q", to_json(q), "--json").json["phi"])

    step = 1e-6
    J = {name: (phi(name, step) - phi(name, -step)) / (2 * step) for name in result["coordinates"]}
    assert_close(np.transpose(result["phi_q"]), [J[name] for name in result["independent"]], 1e-9)
    assert_close(np.transpose(result["phi_z"]), [J[name] for name in result["dependent"]], 1e-9)
    columns = np.transpose([J[name] for name in result["coordinates"]])
    assert_close(columns @ result["rho"], 0.0, 1e-9)
    rows = [result["coordinates"].index(name) for name in result["independent"]]
    assert_close(np.array(result["rho"])[rows], np.eye(2), 0.0)
    assert_close(result["v_tree"], np.array(result["rho"]) @ [0.4, -0.3], 1e-14)


def test_independent_keeps_the_users_order(result: dict[str, Any], bar: Path) -> None:
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    old, new = 'independent = ["theta_1", "theta_3"]', 'independent = ["theta_3", "theta_1"]'
    assert old in text
    (bar / "mechanism.toml").write_text(text.replace(old, new), encoding="utf-8")
    other = ckc("terms", "bar", "--q", Q, "--v", V, "--json").json
    assert other["independent"] == ["theta_3", "theta_1"]
    assert other["coordinates"] == result["coordinates"]
    for key in ("phi_q", "rho", "rho_dot"):
        assert_close(other[key], np.array(result[key])[:, ::-1], 1e-12)
    for key in ("D", "C"):
        assert_close(other[key], np.array(result[key])[::-1, ::-1], 1e-12)
    assert_close(other["h"], result["h"][::-1], 1e-12)
    for key in ("phi_z", "D_tree", "v_tree"):
        assert_close(other[key], result[key], 1e-12)


def test_terms_use_all_coordinates_as_given() -> None:
    q = '{"theta_1": -1.2, "theta_2": 0.1, "theta_3": -1.9, "theta_4": 0.2}'
    v = '{"theta_1": 1, "theta_2": 2, "theta_3": 3, "theta_4": 4}'
    result = ckc("terms", "five_bar", "--q", q, "--v", v, "--json").json
    assert result["q_tree"] == [-1.2, 0.1, -1.9, 0.2]
    assert result["v_tree"] == [1, 2, 3, 4]
    assert max(map(abs, result["phi"])) > 0.01, "off the constraint manifold, and said so"


def test_terms_print_readable_matrices() -> None:
    answer = ckc("terms", "five_bar", "--q", Q)
    assert answer.code == 0
    for words in ("theta_4", "D_tree", "rho_dot", "phi_q | phi_z", "energy"):
        assert words in answer.out
    assert "-0" not in answer.out.split(), "a zero has no sign"


# --- run -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["reduced", "spf", "dae"])
def test_run_prints_its_outcome_as_json(formulation: str) -> None:
    answer = ckc("run", "five_bar/tracking", "--json", "--set", f"formulation={formulation}", "--set", "t_end=0.05")
    assert (answer.code, answer.err) == (0, "")
    result = answer.json
    assert set(result) >= set(RUN.split())
    assert (result["status"], result["t"], result["formulation"]) == ("done", 0.05, formulation)
    assert result["epsilon"] == (1e-4 if formulation == "spf" else None)
    assert len(result["q_tree"]) == len(result["v_tree"]) == len(result["coordinates"]) == 4
    assert len(result["u"]) == len(result["tau"]) == 2
    assert list(result["points"]) == ["tip"]
    assert len(result["points"]["tip"]) == 3
    assert result["max_abs_u"] >= max(map(abs, result["u"])) > 0
    assert 0 <= result["max_phi"] <= 1e-12
    assert result["max_phi_dot"] < 1e-12
    assert set(result["stats"]) >= set(STATS.split())
    assert result["stats"]["method"] in result["stats"]["steps_by_method"]
    assert sum(result["stats"]["steps_by_method"].values()) == result["stats"]["steps"]
    assert result["stats"]["python_calls"] == 0
    assert result["stats"]["terms"] == "pinocchio"
    assert all(isinstance(result["stats"][key], int) for key in STATS.split()[:8])


def test_named_point_agrees_with_forward_kinematics() -> None:
    result = ckc("run", "five_bar/swing", "--json", "--set", "t_end=0.2").json
    a, b = result["q_tree"][0], result["q_tree"][0] + result["q_tree"][1]
    tip = [0.2794 * math.cos(a) + 0.3048 * math.cos(b), 0.2794 * math.sin(a) + 0.3048 * math.sin(b), 0.0]
    assert_close(result["points"]["tip"], tip, 1e-14)
    assert result["u"] == result["tau"] == [0.0, 0.0], "zeros without a controller"
    assert abs(result["energy_end"] - result["energy_start"]) < 1e-8


def test_stopped_run_is_saved_and_printed(tmp_path: Path) -> None:
    """On the links as printed theta_1 and theta_3 run into a singular configuration before the trajectory leaves."""
    words = ("run", "five_bar_as_printed/tracking", "--set", "formulation=reduced", "--set", "solver.rtol=1e-6")
    answer = ckc(*words, "--json", "--out", str(tmp_path))
    assert answer.code == 3
    result = answer.json
    assert result["status"] == "stopped"
    assert result["message"].startswith("stopped at t = 4.34")
    assert "phi_z is singular" in result["message"]
    assert set(result) >= set(RUN.split())
    assert 4.3 < result["t"] < 4.4
    assert answer.err.splitlines() == [answer.err.splitlines()[0], result["message"]]
    assert answer.err.startswith("warning: the desired trajectory leaves the workspace")
    kept = ckc_pin.Run.load(tmp_path)
    assert kept.status == "stopped"
    assert kept.t[-1] == result["t"]


def test_wall_clock_budget_stops_a_run() -> None:
    answer = ckc("run", "five_bar/swing", "--json", "--set", "solver.max_rhs=300")
    assert answer.code == 3
    result = answer.json
    assert result["status"] == "stopped"
    assert "the budget of max_rhs = 300 right-hand sides is used up" in result["message"]
    assert 0 < result["t"] < 2
    assert result["stats"]["rhs"] <= 301


def test_run_prints_a_readable_summary(tmp_path: Path) -> None:
    answer = ckc("run", "five_bar/swing", "--set", "t_end=0.1", "--profile", "--out", str(tmp_path / "new" / "folder"))
    assert answer.code == 0
    assert "reached t_end" in answer.out
    assert f"written to {tmp_path / 'new' / 'folder'}" in answer.out
    assert "evaluated" in answer.err
    assert "D_tree" in answer.err
    names = {path.name for path in (tmp_path / "new" / "folder").iterdir()}
    assert names >= {"run.npz", "scene.json"}
    assert not any(name.endswith(".png") for name in names), "figures are drawn when they are asked for"
    assert not any(name.startswith(".") for name in names)


def test_profile_is_not_part_of_json() -> None:
    answer = ckc("run", "five_bar/swing", "--set", "t_end=0.05", "--profile", "--json")
    assert answer.json["status"] == "done"
    assert "evaluated" in answer.err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "by Ctrl-C"),
        (KeyboardInterrupt("SIGTERM"), 143, "by SIGTERM"),
        (OSError(28, "No space left on device", "disk"), 2, "disk: No space left on device"),
    ],
)
def test_errors_and_interrupts_are_reported_in_one_line(
    error: BaseException, code: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(ckc_pin, "simulate", fail)
    answer = ckc("run", "five_bar/swing", "--json")
    assert answer.code == code
    assert answer.json["status"] == ("interrupted" if code > 100 else "error")
    assert message in answer.json["message"]
    assert answer.err.count("\n") == 1


def test_internal_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(ckc_pin, "simulate", fail)
    with pytest.raises(ZeroDivisionError):
        ckc("run", "five_bar/swing")


def test_run_is_saved_without_figures_if_matplotlib_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    answer = ckc("run", "five_bar/swing", "--set", "t_end=0.01", "--out", str(tmp_path), "--figures")
    assert answer.code == 0
    assert "no figures: figures need matplotlib: pip install" in answer.err
    assert ckc_pin.Run.load(tmp_path).status == "done"
