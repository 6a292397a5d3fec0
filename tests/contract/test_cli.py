"""What the commands promise to people and programs: keys, shapes and order of the JSON, streams, exit codes, help."""

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


def test_check_of_a_mechanism() -> None:
    answer = ckc("check", "five_bar", "--json")
    assert (answer.code, answer.err) == (0, "")
    found = answer.json
    assert set(CHECK.split()) <= set(found)
    assert (found["n"], found["d"], found["rows"], found["rank"]) == (4, 2, 2, 2)
    assert found["coordinates"] == ["theta_1", "theta_2", "theta_3", "theta_4"]
    assert found["independent"] == ["theta_1", "theta_3"]
    assert found["dependent"] == ["theta_2", "theta_4"]
    assert found["redundant"] == found["warnings"] == []
    assert found["desired"] is None
    assert found["q_tree"][0] == -1.434, "the independent coordinates stay at their guess"
    assert found["q_tree"][2] == -1.707
    assert found["det_phi_z"] > 0
    assert found["cond_phi_z"] > 1


def test_check_of_a_scene_follows_its_trajectory() -> None:
    desired = ckc("check", "five_bar/tracking", "--json").json["desired"]
    assert set(desired) == {"leaves_at", "closest_t", "sigma_min", "until"}
    assert desired["leaves_at"] is None
    assert 0 <= desired["closest_t"] <= 9.5
    assert desired["sigma_min"] > 0


def test_a_finding_is_no_error() -> None:
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
    found = ckc("check", "bar", "--json").json
    assert (found["rows"], found["rank"], found["d"]) == (3, 2, 2)
    assert found["redundant"] == ["elbow.z"]
    assert found["det_phi_z"] is None


def test_check_for_people() -> None:
    answer = ckc("check", "five_bar/tracking")
    assert answer.code == 0
    for words in ("freedoms d", "theta_1, theta_3", "theta_2, theta_4", "stays inside"):
        assert words in answer.out


# --- terms -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    answer = ckc("terms", "five_bar", "--q", Q, "--v", V, "--json")
    assert (answer.code, answer.err) == (0, "")
    return answer.json


def test_terms_have_the_promised_keys(found: dict[str, Any]) -> None:
    assert set(found) >= set(TERMS.split())


def test_terms_have_the_promised_shapes(found: dict[str, Any]) -> None:
    shapes = {key: np.shape(found[key]) for key in TERMS.split()[3:]}
    tree, own = ("D_tree", "C_tree"), ("D", "C")
    assert all(shapes[key] == (4, 4) for key in tree)
    assert all(shapes[key] == (2, 2) for key in (*own, "phi_q", "phi_z"))
    assert all(shapes[key] == (4,) for key in ("q_tree", "v_tree", "h_tree"))
    assert all(shapes[key] == (4, 2) for key in ("rho", "rho_dot"))
    assert shapes["h"] == shapes["phi"] == (2,)
    assert shapes["energy"] == ()


def test_terms_are_in_the_order_of_their_names(found: dict[str, Any]) -> None:
    """phi_q by independent, phi_z by dependent, rho coordinates by independent: against differences of phi."""

    def phi(name: str, by: float) -> Any:
        q = dict(zip(found["coordinates"], found["q_tree"], strict=True))
        q[name] += by
        return np.array(ckc("terms", "five_bar", "--q", to_json(q), "--json").json["phi"])

    step = 1e-6
    J = {name: (phi(name, step) - phi(name, -step)) / (2 * step) for name in found["coordinates"]}
    assert_close(np.transpose(found["phi_q"]), [J[name] for name in found["independent"]], 1e-9)
    assert_close(np.transpose(found["phi_z"]), [J[name] for name in found["dependent"]], 1e-9)
    columns = np.transpose([J[name] for name in found["coordinates"]])
    assert_close(columns @ found["rho"], 0.0, 1e-9)
    rows = [found["coordinates"].index(name) for name in found["independent"]]
    assert_close(np.array(found["rho"])[rows], np.eye(2), 0.0)
    assert_close(found["v_tree"], np.array(found["rho"]) @ [0.4, -0.3], 1e-14)


def test_independent_keeps_the_order_of_the_user(found: dict[str, Any], bar: Path) -> None:
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    old, new = 'independent = ["theta_1", "theta_3"]', 'independent = ["theta_3", "theta_1"]'
    assert old in text
    (bar / "mechanism.toml").write_text(text.replace(old, new), encoding="utf-8")
    other = ckc("terms", "bar", "--q", Q, "--v", V, "--json").json
    assert other["independent"] == ["theta_3", "theta_1"]
    assert other["coordinates"] == found["coordinates"]
    for key in ("phi_q", "rho", "rho_dot"):
        assert_close(other[key], np.array(found[key])[:, ::-1], 1e-12)
    for key in ("D", "C"):
        assert_close(other[key], np.array(found[key])[::-1, ::-1], 1e-12)
    assert_close(other["h"], found["h"][::-1], 1e-12)
    for key in ("phi_z", "D_tree", "v_tree"):
        assert_close(other[key], found[key], 1e-12)


def test_all_coordinates_are_taken_as_they_are() -> None:
    q = '{"theta_1": -1.2, "theta_2": 0.1, "theta_3": -1.9, "theta_4": 0.2}'
    v = '{"theta_1": 1, "theta_2": 2, "theta_3": 3, "theta_4": 4}'
    found = ckc("terms", "five_bar", "--q", q, "--v", v, "--json").json
    assert found["q_tree"] == [-1.2, 0.1, -1.9, 0.2]
    assert found["v_tree"] == [1, 2, 3, 4]
    assert max(map(abs, found["phi"])) > 0.01, "off the closure, and said so"


def test_terms_for_people() -> None:
    answer = ckc("terms", "five_bar", "--q", Q)
    assert answer.code == 0
    for words in ("theta_4", "D_tree", "rho_dot", "phi_q | phi_z", "energy"):
        assert words in answer.out
    assert "-0" not in answer.out.split(), "a zero has no sign"


# --- run -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["reduced", "spf", "dae"])
def test_run(formulation: str) -> None:
    answer = ckc("run", "five_bar/tracking", "--json", "--set", f"formulation={formulation}", "--set", "t_end=0.05")
    assert (answer.code, answer.err) == (0, "")
    found = answer.json
    assert set(found) >= set(RUN.split())
    assert (found["status"], found["t"], found["formulation"]) == ("done", 0.05, formulation)
    assert found["epsilon"] == (1e-4 if formulation == "spf" else None)
    assert len(found["q_tree"]) == len(found["v_tree"]) == len(found["coordinates"]) == 4
    assert len(found["u"]) == len(found["tau"]) == 2
    assert list(found["points"]) == ["tip"]
    assert len(found["points"]["tip"]) == 3
    assert found["max_abs_u"] >= max(map(abs, found["u"])) > 0
    assert 0 <= found["max_phi"] <= 1e-12
    assert found["max_phi_dot"] < 1e-12
    assert set(found["stats"]) >= set(STATS.split())
    assert found["stats"]["method"] in found["stats"]["steps_by_method"]
    assert sum(found["stats"]["steps_by_method"].values()) == found["stats"]["steps"]
    assert found["stats"]["python_calls"] == 0
    assert found["stats"]["terms"] == "pinocchio"
    assert all(isinstance(found["stats"][key], int) for key in STATS.split()[:8])


def test_the_point_is_where_the_angles_put_it() -> None:
    found = ckc("run", "five_bar/swing", "--json", "--set", "t_end=0.2").json
    a, b = found["q_tree"][0], found["q_tree"][0] + found["q_tree"][1]
    tip = [0.2794 * math.cos(a) + 0.3048 * math.cos(b), 0.2794 * math.sin(a) + 0.3048 * math.sin(b), 0.0]
    assert_close(found["points"]["tip"], tip, 1e-14)
    assert found["u"] == found["tau"] == [0.0, 0.0], "zeros without a controller"
    assert abs(found["energy_end"] - found["energy_start"]) < 1e-8


def test_a_run_that_stops_is_kept_and_printed(tmp_path: Path) -> None:
    """On the links as printed theta_1 and theta_3 run into a singular configuration before the trajectory leaves."""
    words = ("run", "five_bar_as_printed/tracking", "--set", "formulation=reduced", "--set", "solver.rtol=1e-6")
    answer = ckc(*words, "--json", "--out", str(tmp_path))
    assert answer.code == 3
    found = answer.json
    assert found["status"] == "stopped"
    assert found["message"].startswith("stopped at t = 4.34")
    assert "phi_z is singular" in found["message"]
    assert set(found) >= set(RUN.split())
    assert 4.3 < found["t"] < 4.4
    assert answer.err.splitlines() == [answer.err.splitlines()[0], found["message"]]
    assert answer.err.startswith("warning: the desired trajectory leaves the workspace")
    kept = ckc_pin.Run.load(tmp_path)
    assert kept.status == "stopped"
    assert kept.t[-1] == found["t"]


def test_a_budget_stops_a_run() -> None:
    answer = ckc("run", "five_bar/swing", "--json", "--set", "solver.max_rhs=300")
    assert answer.code == 3
    found = answer.json
    assert found["status"] == "stopped"
    assert "the budget of max_rhs = 300 right-hand sides is used up" in found["message"]
    assert 0 < found["t"] < 2
    assert found["stats"]["rhs"] <= 301


def test_run_for_people(tmp_path: Path) -> None:
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


def test_profile_does_not_disturb_json() -> None:
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
def test_what_happens_to_a_command_is_said_in_one_line(
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


def test_our_own_mistakes_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(ckc_pin, "simulate", fail)
    with pytest.raises(ZeroDivisionError):
        ckc("run", "five_bar/swing")


def test_a_run_without_matplotlib_is_kept_without_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    answer = ckc("run", "five_bar/swing", "--set", "t_end=0.01", "--out", str(tmp_path), "--figures")
    assert answer.code == 0
    assert "no figures: figures need matplotlib: pip install" in answer.err
    assert ckc_pin.Run.load(tmp_path).status == "done"
