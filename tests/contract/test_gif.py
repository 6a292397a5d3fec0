"""Playback as a GIF: timing and positions, without a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import ckc_pin
from ckc_pin import InputError, Run, load, simulate
from ckc_pin.view.geometry import compute_placements, pinocchio_configurations, projection_planes
from ckc_pin.view.gif import save_gif
from ckc_pin.view.links import find_link_shapes
from ckc_pin.view.outlines import project_base, project_outline
from tests.contract.helpers.command import ckc

L1, L2, BASE = 0.2794, 0.3048, 0.3048  # m, of five_bar
BLUE = (0, 0x72, 0xB2)


@pytest.fixture(scope="module")
def swing() -> Run:
    return simulate("five_bar/swing", {"t_end": 0.5})


def frames(path: Path) -> list[Image.Image]:
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.info["loop"] == 0
        return [frame.copy() for frame in ImageSequence.Iterator(image)]


def test_gif_takes_as_long_as_the_run(swing: Run, tmp_path: Path) -> None:
    whole = frames(save_gif(swing, tmp_path / "a.gif"))
    slow = frames(save_gif(swing, tmp_path / "b.gif", speed=0.25))
    assert [len(whole), len(slow)] == [11, 41]
    assert {frame.info["duration"] for frame in whole[:-1]} == {50}
    assert whole[-1].info["duration"] == 1000
    assert len({frame.convert("RGB").tobytes() for frame in slow}) == 41
    assert {frame.convert("RGB").getpixel((2, frame.height - 2)) for frame in whole} == {(255, 255, 255)}


def test_bars_agree_with_closed_form_positions(swing: Run) -> None:
    """Ends of links by the angles alone; the base joins its two pins."""
    plane = projection_planes(swing.mechanism)[0]
    rows = np.array([0, 20, 50])
    moved = compute_placements(swing.mechanism, pinocchio_configurations(swing, rows))
    shapes = find_link_shapes(swing.mechanism, moved)
    for k, row in enumerate(rows):
        one, two, three, four = swing.q_tree[row]
        elbows = [L1 * np.array([np.cos(a), np.sin(a)]) + [x, 0] for a, x in ((one, 0.0), (three, BASE))]
        tips = [
            e + L2 * np.array([np.cos(a), np.sin(a)]) for e, a in zip(elbows, (one + two, three + four), strict=True)
        ]
        drawn = project_outline(swing.mechanism, shapes, moved.select_row(k), plane)
        expected = [[[0, 0], elbows[0]], [elbows[0], tips[0]], [[BASE, 0], elbows[1]], [elbows[1], tips[1]]]
        for bar in expected:
            assert min(np.abs(drawn_bar - np.array(bar)).max() for drawn_bar in drawn.bars) < 1e-9
        for ring in (*elbows, *tips, [0, 0], [BASE, 0]):
            assert np.abs(drawn.rings - ring).max(axis=1).min() < 1e-9
        assert drawn.blocks == []
    assert project_base(shapes, plane).ground.tolist() == [[0, 0], [BASE, 0]]


def test_slider_moves_along_its_rail() -> None:
    mechanism = load("slider_crank")
    run = simulate("slider_crank", {"t_end": 0.3})
    moved = compute_placements(mechanism, pinocchio_configurations(run))
    (plane,) = projection_planes(mechanism)
    shapes = find_link_shapes(mechanism, moved)
    middles = np.array(
        [
            project_outline(mechanism, shapes, moved.select_row(k), plane).blocks[0].mean(axis=0)
            for k in range(len(run.t))
        ]
    )
    np.testing.assert_allclose(middles, np.column_stack([run["slider"], np.zeros(len(run.t))]), atol=1e-12)
    (rail,) = project_base(shapes, plane).rails
    assert rail[:, 0].min() < middles[:, 0].min() < middles[:, 0].max() < rail[:, 0].max()


def test_frames_show_the_pose_at_their_time(swing: Run, tmp_path: Path) -> None:
    """What is blue lies around the middle of the links, in one scale, upwards where y grows."""
    pictures = [np.asarray(frame.convert("RGB")).astype(int) for frame in frames(save_gif(swing, tmp_path / "a.gif"))]
    blue = [np.abs(picture - BLUE).max(axis=2) < 60 for picture in pictures]
    middles = np.array([[x.mean() for x in np.nonzero(where)[::-1]] for where in blue])
    rows = [swing.at(k / 20) for k in range(11)]
    plane = projection_planes(swing.mechanism)[0]
    moved = compute_placements(swing.mechanism, pinocchio_configurations(swing, np.array(rows)))
    shapes = find_link_shapes(swing.mechanism, moved)
    bars = [project_outline(swing.mechanism, shapes, moved.select_row(k), plane).bars for k in range(11)]
    lengths = [np.linalg.norm(bar[1] - bar[0]) for bar in bars[0]]
    x, y = np.array([np.average([bar.mean(axis=0) for bar in each], axis=0, weights=lengths) for each in bars]).T
    one, none = np.ones(11), np.zeros(11)
    equations = np.vstack([np.column_stack([x, one, none]), np.column_stack([-y, none, one])])
    answer, *_ = np.linalg.lstsq(equations, middles.T.ravel())
    off = np.abs(equations @ answer - middles.T.ravel()).max()
    assert off < 0.05 * np.ptp(middles[:, 0])
    assert answer[0] > 500, "pixels a metre"


def test_gif_shows_several_runs_desired_poses_and_spatial_robots(tmp_path: Path) -> None:
    runs = [simulate("five_bar/tracking", {"t_end": 0.3, "formulation": name}) for name in ("reduced", "spf")]
    one, both = (save_gif(which, tmp_path / f"{len(which)}.gif") for which in (runs[:1], runs))
    assert frames(one)[0].size[1] != frames(both)[0].size[1] or one.read_bytes() != both.read_bytes()
    lift = simulate("delta", {"t_end": 0.2})
    assert len(frames(save_gif(lift, tmp_path / "delta.gif"))) == 5


def test_command_and_notebook_write_gifs(swing: Run, tmp_path: Path) -> None:
    swing.save(tmp_path / "run.npz")
    answer = ckc("play", str(tmp_path / "run.npz"), "--gif", str(tmp_path / "own.gif"))
    assert answer.code == 0, answer.err
    assert answer.out == f"written: {tmp_path / 'own.gif'}\n"
    playback = ckc_pin.play(swing, inline=True)
    assert playback.save(tmp_path / "again.gif").read_bytes() == (tmp_path / "own.gif").read_bytes()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--html", "x.html"], "--video goes with --size, --fps and --speed only"),
        (["--forces"], "--video goes with --size, --fps and --speed only"),
        (["--speed", "0.001"], "10001 frames, but a GIF may have 1200; choose speed 0.0084 or more"),
        (["--size", "wide"], "--size wide: expected width and height in pixels, such as 960x540"),
        (["--size", "960"], "--size 960: expected width and height in pixels, such as 960x540"),
        (["--size", "0x540"], "size = 0 x 540; expected width and height in pixels, two integers from 120 to 3840"),
        (["--size", "960x9999"], "expected width and height in pixels, two integers from 120 to 3840"),
        (["--size", "3840x3840", "--fps", "50"], "26 frames of 3840 x 3840 pixels are 1.1 times as much as a GIF may"),
        (["--fps", "60"], "fps = 60.0; a GIF shows 1 to 50 frames per second"),
        (["--fps", "0"], "fps = 0.0; a GIF shows 1 to 50 frames per second"),
        (["--fps", "nan"], "fps = nan; a GIF shows 1 to 50 frames per second"),
        (["--gif", "nowhere/x.gif"], "nowhere/x.gif: cannot be written"),
    ],
)
def test_invalid_gif_options_are_rejected(options: list[str], says: str, swing: Run, tmp_path: Path) -> None:
    swing.save(tmp_path / "run.npz")
    answer = ckc("play", str(tmp_path / "run.npz"), "--gif", str(tmp_path / "own.gif"), *options)
    assert answer.code == 2
    assert says in answer.err
    assert not (tmp_path / "own.gif").exists()


@pytest.mark.parametrize("option", [["--size", "640x480"], ["--fps", "10"]])
def test_options_of_a_video_need_a_video(option: list[str], swing: Run, tmp_path: Path) -> None:
    swing.save(tmp_path / "run.npz")
    answer = ckc("play", str(tmp_path / "run.npz"), *option, "--html", str(tmp_path / "x.html"))
    assert answer.code == 2
    assert answer.err == f"error: {option[0]} goes with --video FILE; give both\n"
    with pytest.raises(InputError, match=r"size and fps are those of a GIF; give a path that ends in \.gif"):
        ckc_pin.play(swing, inline=True).save(tmp_path / "x.html", fps=10)


@pytest.mark.parametrize("size", [(640, 480), (333, 777), (1001, 200), (120, 120)])
def test_gif_has_the_given_size(size: tuple[int, int], tmp_path: Path) -> None:
    """In every frame, the blue links have the same ratio of width to height whatever the size: nothing is distorted."""
    swing = simulate("five_bar/swing", {"t_end": 0.05})
    ratios = []
    for one in (None, size):
        (first, *_) = pictures = frames(save_gif(swing, tmp_path / "a.gif", size=one))
        assert one is None or {picture.size for picture in pictures} == {one}
        rows, columns = np.nonzero(np.abs(np.asarray(first.convert("RGB")).astype(int) - BLUE).max(axis=2) < 60)
        ratios.append(np.ptp(columns) / np.ptp(rows))
    assert ratios[1] == pytest.approx(ratios[0], rel=0.1)


@pytest.mark.parametrize("fps", [1, 7.5, 30, 50])
def test_gif_has_the_given_frames_per_second(fps: float, swing: Run, tmp_path: Path) -> None:
    """Frame k is due at k / fps, within half of GIF's hundredth of a second."""
    durations = [frame.info["duration"] for frame in frames(save_gif(swing, tmp_path / "a.gif", fps=fps))]
    assert len(durations) == int(np.ceil(0.5 * fps)) + 1
    due = np.concatenate([[0], np.cumsum(durations[:-1])])
    np.testing.assert_allclose(due, 1000 * np.arange(len(durations)) / fps, atol=5.0)


def test_runs_of_two_mechanisms_are_rejected(swing: Run, tmp_path: Path) -> None:
    other = simulate("slider_crank", {"t_end": 0.1})
    with pytest.raises(InputError, match="play runs of different mechanisms one by one"):
        save_gif([swing, other], tmp_path / "x.gif")
