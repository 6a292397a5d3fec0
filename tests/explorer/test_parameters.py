"""Parameters of the explorer: sliders, and rebuilt mechanisms against `load` and the paper's five-bar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, MechanismError
from ckc_pin.explorer.parameters import list_parameters, rebuild
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.parameters import values_of, with_components
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

LENGTH = "joint.theta_2.xyz.x"  # l_1 of the five-bar


@pytest.mark.parametrize("length", [0.2, 0.25, 0.31])
def test_length_gives_the_mechanism_of_check_with_the_same_value(length: float) -> None:
    mechanism = ckc_pin.load("five_bar")
    rebuilt, at = rebuild(mechanism, {LENGTH: length}, mechanism.assembled)
    theirs = ckc_pin.check("five_bar", {LENGTH: length})
    assert_close(rebuilt.tree.to_coordinates(rebuilt.q_tree), theirs.q_tree, 1e-12)
    assert_close(at.q_tree, rebuilt.q_tree, 0.0)
    assert rebuilt.independent == mechanism.independent
    assert rebuilt.tolerance == ckc_pin.load("five_bar", {LENGTH: length}).tolerance


@pytest.mark.parametrize("branch", [1, -1])
def test_rebuilt_five_bar_keeps_q_and_branch_at_random_lengths(branch: int) -> None:
    mechanism = ckc_pin.load("five_bar")
    names = {"joint.theta_2.xyz.x": 0, "joint.tip_left_fixed.xyz.x": 1, "joint.theta_4.xyz.x": 2}
    random = np.random.default_rng(3)
    at = mechanism.kinematics(FIVE_BAR.sigma(np.array([1.7, 1.4]), branch))
    values = {}
    for _ in range(12):
        lengths = list(FIVE_BAR.l)
        for name, k in names.items():
            lengths[k] = values[name] = FIVE_BAR.l[k] * random.uniform(0.85, 1.15)
        previous = at.q_tree
        _, at = rebuild(mechanism, values, at)
        theirs = replace(FIVE_BAR, l=tuple(lengths)).sigma(previous[[0, 2]], branch)
        assert_close(at.q_tree[[0, 2]], previous[[0, 2]], 0.0)
        assert_close(np.angle(np.exp(1j * (at.q_tree - theirs))), 0.0, 1e-10)
        assert np.abs(at.phi).max() <= 1e-12
    _, back = rebuild(mechanism, {}, at)
    assert_close(np.angle(np.exp(1j * (back.q_tree - FIVE_BAR.sigma(back.q_tree[[0, 2]], branch)))), 0.0, 1e-10)


def test_mechanism_that_cannot_be_assembled_is_refused_with_the_reason() -> None:
    mechanism = ckc_pin.load("five_bar")
    with pytest.raises(MechanismError, match=r"not closed: nearest miss .* m at loop elbow"):
        rebuild(mechanism, {"joint.theta_3.xyz.x": 3.0}, mechanism.assembled)
    with pytest.raises(MechanismError, match="negative mass"):
        rebuild(mechanism, {"link.link_1.mass": -1.0}, mechanism.assembled)
    with pytest.raises(InputError, match=r"no 'link\.link_9\.mass'"):
        rebuild(mechanism, {"link.link_9.mass": 1.0}, mechanism.assembled)


def test_q_moves_if_the_loops_cannot_be_closed_with_it() -> None:
    mechanism = ckc_pin.load("five_bar")
    at = sigma(mechanism, np.array([2.6, 0.55])).at  # the distal links are nearly in line
    rebuilt, moved = rebuild(mechanism, {"joint.tip_left_fixed.xyz.x": 0.22, "joint.tip_right_fixed.xyz.x": 0.22}, at)
    assert np.abs(moved.phi).max() <= 1e-10
    assert np.abs(rebuilt.assembled.phi).max() <= 1e-10
    assert np.abs(moved.q_tree[[0, 2]] - at.q_tree[[0, 2]]).max() > 1e-3


def test_values_of_the_file_remain_and_vectors_mix_with_components() -> None:
    mechanism = ckc_pin.load("five_bar", {"gravity": (0.0, -1.6, 0.0), "link.link_1.mass": 0.5})
    rebuilt, _ = rebuild(mechanism, {"gravity.y": -3.7}, mechanism.assembled)
    values = {info.name: info for info in list_parameters(rebuilt, mechanism)}
    assert (values["gravity.y"].value, values["gravity.y"].default) == (-3.7, -1.6)
    assert values["link.link_1.mass"].value == values["link.link_1.mass"].default == 0.5


@pytest.mark.parametrize("name", ["five_bar", "delta", "flyball", "talos", "andrews"])
def test_sliders_contain_their_values_and_match_the_parameters(name: str) -> None:
    mechanism = ckc_pin.load(name)
    sliders = list_parameters(mechanism)
    parameters = with_components(values_of(mechanism.spec, mechanism.urdf))
    assert {slider.name for slider in sliders} == {key for key, x in parameters.items() if not isinstance(x, tuple)}
    for slider in sliders:
        assert slider.lower < slider.upper
        assert slider.lower <= slider.value <= slider.upper
        assert slider.value == slider.default == parameters[slider.name]
        assert not (slider.name.endswith(".mass") and slider.lower < 0)


def test_every_slider_of_five_bar_can_go_to_its_ends_or_is_refused_with_a_reason() -> None:
    mechanism = ckc_pin.load("five_bar")
    reasons = []
    for slider in list_parameters(mechanism):
        for end in (slider.lower, slider.upper):
            try:
                rebuilt, at = rebuild(mechanism, {slider.name: end}, mechanism.assembled)
            except MechanismError as error:
                reasons.append(str(error).removeprefix(f"{mechanism.sources.name}: "))
            else:
                assert np.abs(at.phi).max() <= 1e-10
                assert list_parameters(rebuilt, mechanism)
    starts = ("not closed: nearest miss", "the loops close on another assembly branch", "loop 'elbow'", "independent: ")
    assert 0 < len(reasons) < 60
    assert [reason for reason in reasons if not reason.startswith(starts)] == []
