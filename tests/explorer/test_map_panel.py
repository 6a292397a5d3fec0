"""The map of the explorer against the closed form of the five-bar; its threads."""

from __future__ import annotations

import time
from base64 import b64decode
from io import BytesIO

import numpy as np
import pytest
from matplotlib.image import imread

import ckc_pin
from ckc_pin.explorer.branches import find_branches
from ckc_pin.explorer.map_panel import MapPanel, explain_no_map, select_aspect
from ckc_pin.explorer.messages import MapImage
from tests.analytic.five_bar import FIVE_BAR, Array

FINAL = 120.0  # s, until the last image of a map


class Listener:
    """Collects the images of a panel."""

    def __init__(self) -> None:
        self.images: list[MapImage] = []
        self.panel = MapPanel(self.images.append)

    def wait_for(self, condition) -> None:
        deadline = time.monotonic() + FINAL
        while not any(condition(image) for image in self.images):
            assert time.monotonic() < deadline
            time.sleep(0.02)


def is_final(image: MapImage) -> bool:
    return "finer" not in image.note


def pixels(image: MapImage) -> Array:
    return imread(BytesIO(b64decode(image.image)))[..., :3]


@pytest.fixture(scope="module")
def five_bar_map():
    listener, mechanism = Listener(), ckc_pin.load("five_bar")
    listener.panel.request(mechanism, mechanism.assembled)
    listener.wait_for(is_final)
    yield listener, mechanism
    listener.panel.close()


def test_map_of_five_bar_is_coloured_where_its_elbows_are_in_reach(five_bar_map) -> None:
    """Reached cells have a hue, and the others are grey; far from the border of the closed form."""
    listener, _ = five_bar_map
    coarse, final = listener.images[:2]
    assert [is_final(coarse), is_final(final)] == [False, True]
    for image, margin in ((coarse, 0.05), (final, 0.015)):
        assert (image.x, image.y, image.x_turns, image.y_turns) == ("theta_1", "theta_3", True, True)
        assert image.x_range == image.y_range == [-np.pi, np.pi]
        picture = pixels(image)
        height, width, _ = picture.shape
        checked = {True: 0, False: 0}
        for theta_1, theta_3 in np.random.default_rng(0).uniform(-np.pi, np.pi, (4000, 2)):
            elbows = (FIVE_BAR.l[0] * np.exp(1j * theta_1), FIVE_BAR.base + FIVE_BAR.l[2] * np.exp(1j * theta_3))
            gap = abs(elbows[1] - elbows[0])
            longest = FIVE_BAR.l[1] + FIVE_BAR.l[3]
            if abs(gap - longest) < margin or gap < 0.1:
                continue
            column = int((theta_1 + np.pi) / (2 * np.pi) * width)
            row = int((np.pi - theta_3) / (2 * np.pi) * height)
            colour = picture[row, column]
            has_hue = np.ptp(colour) > 0.02
            if image is final and has_hue and colour[1] > colour[0]:
                continue  # the green line of a serial singularity
            checked[bool(gap < longest)] += 1
            assert has_hue == (gap < longest)
        assert min(checked.values()) > 300


def test_brightness_alone_tells_singular_from_regular(five_bar_map) -> None:
    listener, _ = five_bar_map
    picture = pixels(listener.images[0]).mean(axis=2)
    height, width = picture.shape
    samples = []
    for theta_1, theta_3 in np.random.default_rng(1).uniform(-np.pi, np.pi, (3000, 2)):
        try:
            s = abs(FIVE_BAR.s(FIVE_BAR.sigma(np.array([theta_1, theta_3]))))
        except ValueError:
            continue
        at = int((np.pi - theta_3) / (2 * np.pi) * height), int((theta_1 + np.pi) / (2 * np.pi) * width)
        samples.append((s, picture[at]))
    sine, brightness = np.array(samples).T
    assert brightness[sine < 0.2].mean() > brightness[sine > 0.9].mean() + 0.2


def test_panel_shows_the_branch_of_the_pose(five_bar_map) -> None:
    listener, mechanism = five_bar_map
    count = len(listener.images)
    here, other = find_branches(mechanism, mechanism.assembled)
    listener.panel.follow(here)
    assert len(listener.images) == count
    listener.panel.follow(other)
    listener.panel.follow(other)
    assert len(listener.images) == count + 1
    assert listener.images[-1].image != listener.images[1].image
    listener.panel.follow(here)
    assert listener.images[-1].image == listener.images[1].image


def test_aspect_of_random_poses_is_that_of_their_branch(five_bar_map) -> None:
    listener, mechanism = five_bar_map
    result, random = listener.panel._map, np.random.default_rng(4)
    home = int(np.sign(FIVE_BAR.s(mechanism.q_tree)))
    for _ in range(20):
        q, branch = random.uniform([1.2, 0.9], [1.9, 1.6]), int(random.choice([-1, 1]))
        turned = FIVE_BAR.sigma(q, branch) + 2 * np.pi * random.integers(-2, 3, 4)
        assert select_aspect(result, mechanism.kinematics(turned)) == (0 if branch == home else 1)


def test_newer_request_replaces_a_map_that_is_under_way() -> None:
    listener = Listener()
    first, second = ckc_pin.load("five_bar"), ckc_pin.load("slider_crank")
    listener.panel.request(first, first.assembled)
    time.sleep(0.2)
    listener.panel.request(second, second.assembled)
    listener.wait_for(lambda image: image.x == "crank" and is_final(image))
    assert [image.x for image in listener.images] == ["crank", "crank"]
    strip = pixels(listener.images[-1])
    assert strip.shape[0] < strip.shape[1]
    assert (listener.images[-1].y, listener.images[-1].y_range) == ("", [])
    assert "serial" in listener.images[-1].note
    listener.panel.close()


@pytest.mark.parametrize(
    ("name", "reason"),
    [("three_rrr", "one or two freedoms, and the mechanism has 3"), ("flyball", ""), ("talos", "has 26")],
)
def test_mechanism_without_map_says_why(name: str, reason: str) -> None:
    listener, mechanism = Listener(), ckc_pin.load(name)
    assert reason in explain_no_map(mechanism)
    if reason:
        listener.panel.request(mechanism, mechanism.assembled)
        assert listener.images == [MapImage(note=explain_no_map(mechanism))]


def test_map_without_loci_has_the_same_cells() -> None:
    with_loci, without = (ckc_pin.singularity_map("slider_crank", cells=32, loci=loci) for loci in (True, False))
    assert with_loci.loci
    assert without.loci == ()
    assert np.array_equal(with_loci.aspects[0].det_phi_z, without.aspects[0].det_phi_z)
