"""Branches of the explorer against the closed form of the five-bar, `check --branches`, and closure."""

from __future__ import annotations

import numpy as np
import pytest

import ckc_pin
from ckc_pin.explorer.branches import MAX_LISTED, draw_branches, find_branches, list_branches
from ckc_pin.explorer.paths import BRANCHES
from ckc_pin.kinematics.sigma import sigma
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close


def wrapped(angles):
    return np.angle(np.exp(1j * np.asarray(angles)))


def test_branches_of_five_bar_equal_its_closed_form_at_any_pose() -> None:
    mechanism = ckc_pin.load("five_bar")
    random = np.random.default_rng(1)
    for _ in range(5):
        q = mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.2, 0.2, 2)
        at = sigma(mechanism, q).at
        ours = [branch.q_tree for branch in find_branches(mechanism, at)]
        assert_close(ours[0], at.q_tree, 0.0)
        theirs = [FIVE_BAR.sigma(q, branch) for branch in (1, -1)]
        order = np.argsort([np.abs(wrapped(x - ours[0])).max() for x in theirs])
        assert len(ours) == 2
        for mine, k in zip(ours, order, strict=True):
            assert_close(wrapped(mine - theirs[k]), 0.0, 1e-10)


@pytest.mark.parametrize("name", ["five_bar", "four_bar", "slider_crank", "three_rrr"])
def test_branches_at_home_equal_those_of_check_and_are_closed(name: str) -> None:
    mechanism = ckc_pin.load(name)
    branches, report = list_branches(mechanism, mechanism.assembled)
    theirs = ckc_pin.check(name, branches=True).branches
    assert theirs is not None
    assert len(branches) == len(theirs) == len(report.branches) > 1
    is_angle = ~mechanism.tree.in_metres
    for branch, other in zip(branches, theirs, strict=True):
        gap = mechanism.tree.to_coordinates(branch.q_tree) - other
        gap[is_angle] = wrapped(gap[is_angle])
        assert_close(gap, 0.0, 1e-9)
        assert np.abs(branch.phi).max() <= 1e-10
        assert np.array_equal(mechanism.independent_part(branch.q_tree), mechanism.independent_part(mechanism.q_tree))


def test_angles_of_branches_are_within_half_a_turn_of_the_present_ones() -> None:
    mechanism = ckc_pin.load("five_bar")
    for branch in find_branches(mechanism, mechanism.assembled):
        assert np.abs(branch.q_tree - mechanism.q_tree).max() <= np.pi


def test_large_mechanism_gives_a_note_and_no_branches() -> None:
    mechanism = ckc_pin.load("delta")
    branches, report = list_branches(mechanism, mechanism.assembled)
    assert branches == report.branches == []
    assert "at most 12 dependent joints and without a free root; this one has 18" in report.note


def test_continuum_of_configurations_is_cut_off_with_a_note() -> None:
    branches, report = list_branches(*(lambda m: (m, m.assembled))(ckc_pin.load("bricard")))
    assert len(branches) == len(report.branches) == MAX_LISTED
    assert "the mechanism can move although q stands still" in report.note


def test_ghosts_have_the_bodies_of_all_branches_but_the_current_one() -> None:
    mechanism = ckc_pin.load("five_bar")
    branches = find_branches(mechanism, mechanism.assembled)
    drawing = draw_branches(mechanism, branches, 0)
    assert drawing[0] == {"type": "delete", "path": BRANCHES}
    assert {command["path"].split("/")[3] for command in drawing[1:]} == {"2"}
    materials = [c["object"]["materials"][0] for c in drawing if c["type"] == "set_object"]
    assert materials
    assert all(material["opacity"] < 0.4 for material in materials)
    places = {c["path"]: np.reshape(c["matrix"], (4, 4)).T for c in drawing if c["type"] == "set_transform"}
    pose = branches[1].pose
    for joint in range(1, mechanism.tree.model.njoints):
        place = places[f"{BRANCHES}/2/joint:{mechanism.tree.model.names[joint]}"]
        assert_close(place[:3, :3], pose.rotation[joint], 1e-15)
        assert_close(place[:3, 3], pose.translation[joint], 1e-15)
    assert draw_branches(mechanism, [], 0) == drawing[:1]
