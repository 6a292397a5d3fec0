"""Text and files of the explorer's state, read back by the functions that users read them with."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, Mechanism, Scene, load, load_scene, simulate
from ckc_pin.base.toml import read_toml
from ckc_pin.explorer.saving import (
    python_lines,
    q_guess_text,
    save_parameters,
    save_scene,
    scene_at,
    svg,
    write_new_texts,
)
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.scene.parts import load_scene_mechanism
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

NAMES = ["five_bar", "delta", "stewart", "bricard", "two_ur5", "slider_crank"]
LENGTHS = {"link.link_2.mass": 0.5}


def moved(mechanism: Mechanism, by: float = 0.07) -> Kinematics:
    """A pose beside the assembled one."""
    q = mechanism.independent_part(mechanism.q_tree)
    solution = sigma(mechanism, q + by * np.cos(np.arange(mechanism.d)))
    assert solution.verdict == "converged"
    return solution.at


def coordinates(mechanism: Mechanism, at: Kinematics) -> Any:
    return mechanism.tree.to_coordinates(at.q_tree)


@pytest.mark.parametrize("name", NAMES)
def test_q_guess_assembles_the_same_pose(name: str, tmp_path: Path) -> None:
    mechanism = load(name)
    at = moved(mechanism)
    made = Scene(mechanism, t_end=1.0).save(tmp_path)
    file = tmp_path / "mechanism.toml"
    data = read_toml(file.read_text(), "mechanism.toml")
    data["q_guess"] = read_toml(q_guess_text(mechanism, at), "text")["q_guess"]
    assert list(data["q_guess"]) == list(mechanism.coordinates)
    file.write_text(ckc_pin.base.toml_writer.write_toml(data))
    again = load(file)
    assert made.exists()
    assert_close(coordinates(again, again.assembled), coordinates(mechanism, at), 1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_python_lines_reproduce_the_state(name: str) -> None:
    mechanism = load(name)
    at = moved(mechanism)
    space: dict[str, Any] = {}
    exec(python_lines(name, mechanism, at), space)
    assert_close(space["state"].at.q_tree, at.q_tree, 1e-12)
    assert_close(space["state"].h, ckc_pin.Terms(mechanism, at, np.zeros(mechanism.n)).h, 1e-9)


@pytest.mark.parametrize("name", ["five_bar/tracking", "delta/circle", "four_bar/servo"])
def test_python_lines_of_a_scene_begin_at_the_pose(name: str) -> None:
    scene = load_scene(name, LENGTHS if name.startswith("five_bar") else None)
    mechanism = load_scene_mechanism(scene)
    at = moved(mechanism)
    space: dict[str, Any] = {}
    exec(python_lines(name, mechanism, at, scene), space)
    assert_close(space["state"].q_tree, coordinates(mechanism, at), 1e-9)
    assert space["mechanism"].overrides == mechanism.overrides
    assert space["simulator"].step(dt=0.01).t == pytest.approx(0.01)


def test_python_lines_contain_parameters_and_quote_names() -> None:
    mechanism = load("five_bar", LENGTHS)
    space: dict[str, Any] = {}
    text = python_lines("five_bar", mechanism, mechanism.assembled)
    exec(text, space)
    assert space["mechanism"].overrides == LENGTHS
    evil = python_lines('x"); import os; ("', mechanism, mechanism.assembled)
    assert "\nimport os" not in evil
    compile(evil, "lines", "exec")


@pytest.mark.parametrize("name", NAMES)
def test_a_saved_scene_begins_at_the_pose(name: str, tmp_path: Path) -> None:
    mechanism = load(name)
    at = moved(mechanism)
    path = save_scene(tmp_path, "explored", mechanism, None, at)
    assert path == tmp_path / "explored.scene.toml"
    run = simulate(path, {"t_end": 0.01})
    assert_close(run.q_tree[0], coordinates(mechanism, at), 1e-9)
    assert np.array_equal(run.q_tree, simulate(scene_at(mechanism, None, at), {"t_end": 0.01}).q_tree)
    assert_close(run.v_tree[0], 0.0, 0.0)


def test_a_saved_scene_keeps_its_controller_parameters_and_rates(tmp_path: Path) -> None:
    scene = load_scene("five_bar/tracking", LENGTHS)
    mechanism = load_scene_mechanism(scene)
    at = moved(mechanism)
    saved = load_scene(save_scene(tmp_path, "mine", mechanism, scene, at))
    assert saved.spec.parameters == LENGTHS
    assert saved.spec.controller == scene.spec.controller
    assert load_scene_mechanism(saved).overrides == mechanism.overrides
    rates = scene_at(mechanism, scene, at, np.array([0.3, -0.2])).spec.initial.q_dot
    assert rates == {"theta_1": 0.3, "theta_3": -0.2}


def test_parameters_are_a_table_of_a_scene(tmp_path: Path) -> None:
    mechanism = load("five_bar", LENGTHS)
    path = save_parameters(tmp_path, "heavy", mechanism)
    assert path.name == "heavy.parameters.toml"
    table = read_toml(path.read_text(), "heavy")
    assert load_scene("five_bar", table).spec.parameters == LENGTHS
    with pytest.raises(InputError, match="all parameters are those of the files"):
        save_parameters(tmp_path, "same", load("five_bar"))


def test_files_with_other_contents_are_not_overwritten(tmp_path: Path) -> None:
    mechanism = load("five_bar")
    save_scene(tmp_path, "a", mechanism, None, mechanism.assembled)
    save_scene(tmp_path, "a", mechanism, None, mechanism.assembled)  # the same again
    save_scene(tmp_path, "b", mechanism, None, moved(mechanism))  # beside it, with the same mechanism
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert set(before) == {"a.scene.toml", "b.scene.toml", "mechanism.toml", "five_bar.urdf"}
    with pytest.raises(InputError, match=r"a\.scene\.toml: there already, with other contents; choose another name"):
        save_scene(tmp_path, "a", mechanism, None, moved(mechanism))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="there already"):
        write_new_texts(tmp_path, {"binary": "text"})
    with pytest.raises(InputError, match="there already"):
        write_new_texts(tmp_path.parent, {tmp_path.name: "text"})


# --- pictures ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["five_bar", "four_bar", "slider_crank", "three_rrr", "n_four_bar", "andrews"])
def test_svg_of_a_planar_mechanism_shows_its_hinges(name: str) -> None:
    mechanism = load(name)
    at = moved(mechanism, 0.02)
    root = ElementTree.fromstring(svg(mechanism, at))
    width, height = (float(root.get(key, "nan")) for key in ("width", "height"))
    tag = "{http://www.w3.org/2000/svg}"
    circles = np.array([[float(c.get(k, "nan")) for k in ("cx", "cy")] for c in root.iter(f"{tag}circle")])
    numbers = [float(x) for e in root.iter() if e.get("points") for x in e.get("points", "").replace(",", " ").split()]
    corners = np.concatenate([circles, np.array(numbers).reshape(-1, 2)])
    assert len(circles) >= 2
    assert corners.min() >= 0.0
    assert np.all(corners <= [width, height + 1.0])
    assert root.find(f"{tag}title").text == mechanism.name  # type: ignore[union-attr]


def test_svg_places_hinges_as_the_appendix() -> None:
    """All distances of the five-bar's hinges, up to the scale, from the lengths of Table I."""
    mechanism = load("five_bar")
    at = moved(mechanism)
    root = ElementTree.fromstring(svg(mechanism, at))
    circles = {
        tuple(round(float(c.get(k, "nan")), 1) for k in ("cx", "cy"))
        for c in root.iter("{http://www.w3.org/2000/svg}circle")
    }
    a1, a2, a3, _ = FIVE_BAR.sigma(mechanism.independent_part(at.q_tree))
    left = FIVE_BAR.l[0] * np.array([np.cos(a1), np.sin(a1)])
    right = FIVE_BAR.l[2] * np.array([np.cos(a3), np.sin(a3)]) + [FIVE_BAR.base, 0.0]
    tip = left + FIVE_BAR.l[1] * np.array([np.cos(a1 + a2), np.sin(a1 + a2)])
    expected = np.array([[0.0, 0.0], [FIVE_BAR.base, 0.0], left, right, tip])
    ours, theirs = (
        np.sort(np.linalg.norm(x[:, None] - x[None], axis=2).ravel()) for x in (np.array(sorted(circles)), expected)
    )
    assert len(circles) == 5
    assert_close(ours / ours[-1], theirs / theirs[-1], 1e-3)


def test_svg_escapes_names_and_refuses_spatial_mechanisms() -> None:
    mechanism = load("five_bar")
    mechanism.name = '</title><script>alert("x")</script>\x07'
    text = svg(mechanism, mechanism.assembled)
    assert "<script" not in text
    ElementTree.fromstring(text)
    with pytest.raises(InputError, match="svg: delta is spatial"):
        svg(load("delta"), load("delta").assembled)
