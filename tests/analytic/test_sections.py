"""Sections of the delta's workspace against the closed form: each arm's circle meets a sphere around the plate."""

from __future__ import annotations

import numpy as np
import pytest

import ckc_pin
from ckc_pin.analysis.map import workspace_sections
from ckc_pin.analysis.map.sections import SectionStack
from ckc_pin.view.map_figures import draw_sections

BASE, PLATE, ARM, ROD = 0.25, 0.04, 0.18, 0.45  # m, of the delta


def distance_to_singular(place: np.ndarray) -> np.ndarray:
    """Return the smallest distance of a place (..., 3) of the plate from where an arm is in line with its rods.

    With X outwards from the motor, |(X - a cos), Y, z + a sin| = rod has a solution for the angle if
    |X² + Y² + z² + a² - rod²| < 2 a sqrt(X² + z²).
    """
    margins = []
    for turn in 2 * np.pi / 3 * np.arange(3):
        x = place[..., 0] * np.cos(turn) + place[..., 1] * np.sin(turn) + PLATE - BASE
        y = place[..., 1] * np.cos(turn) - place[..., 0] * np.sin(turn)
        z = place[..., 2]
        margins.append(2 * ARM * np.hypot(x, z) - np.abs(x**2 + y**2 + z**2 + ARM**2 - ROD**2))
    return np.min(margins, axis=0)


BOXES = []  # stacks with their boxes, whose search takes longer than the sections


@pytest.fixture(scope="module")
def stack():
    done, find_box = [], SectionStack.find_box
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SectionStack, "find_box", lambda self: BOXES.append((self, find_box(self))) or BOXES[-1][1])
        sections = workspace_sections("delta", count=2, cells=16, progress=done.append)
    assert (done[0], done[-1]) == (0.0, 1.0)
    assert done == sorted(done)
    return sections


def test_sections_match_the_closed_form_workspace(stack, monkeypatch):
    """Including three corners at the top that are connected only below."""
    (sections_of_delta, box), *_ = BOXES
    monkeypatch.setattr(SectionStack, "find_box", lambda _: box)
    sections = sections_of_delta.fill_sections(4, 16)
    for grid in sections:
        x, y = np.meshgrid(*(axis.values for axis in grid.domain.axes), indexing="ij")
        (height,) = np.unique(grid.values[grid.reached, 2].round(12))
        place = np.stack([x, y, np.full(x.shape, height)], axis=-1).reshape(-1, 3)
        room, reached = distance_to_singular(place), grid.reached
        np.testing.assert_array_equal(reached, room > 0)
        np.testing.assert_allclose(grid.values[reached], place[reached], atol=1e-9)
        frame = np.abs(place[:, :2]).max(axis=1) > 0.97 * np.abs(place[:, :2]).max()
        assert room[frame].max() < 0  # the workspace ends inside the window
    assert sections[-1].values[sections[-1].reached, 2].max() > -0.18


def test_serial_curves_have_an_arm_in_line_with_its_rods(stack):
    for one in stack:
        assert {locus.kind for locus in one.loci} == {"serial"}
        for locus in one.loci:
            assert locus.residual < 1e-8
            shown = locus.point[np.any(locus.on, axis=0)]
            np.testing.assert_allclose(shown[:, 2], one.fixed["z"], atol=1e-9)
            np.testing.assert_allclose(distance_to_singular(shown), 0.0, atol=1e-8)


def test_figure_has_a_panel_for_each_section(stack):
    figure = draw_sections(stack)
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.get_title(loc="left")]
    assert [title.split(":")[0] for title in titles] == [f"$z$ = {one.fixed['z']:.3f} m" for one in stack]


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("five_bar", {}, "sections need three freedoms"),
        ("three_rrr", {}, "sections need three freedoms"),
        ("delta", {"count": 1}, "sections = 1: expected 2 to 24"),
        ("delta", {"cells": 2000}, "cells = 2000: expected 16 to 400"),
        ("delta", {"over": ("x", "x")}, "two of x, y, z"),
        ("delta", {"over": ("x", "w")}, "two of x, y, z"),
        ("delta", {"point": "tip"}, "no point 'tip' in delta; there are plate"),
    ],
)
def test_invalid_sections_are_refused(name, options, says):
    with pytest.raises(ckc_pin.InputError, match=says):
        workspace_sections(name, **options)


def test_map_and_point_are_public():
    result = ckc_pin.singularity_map("four_bar", cells=16)
    assert result.mechanism == "four_bar"
    assert ckc_pin.Point(ckc_pin.load("five_bar"), "tip").name == "tip"
