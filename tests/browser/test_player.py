"""Buttons and keys of the playback page."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

import ckc_pin
from ckc_pin.view.page import STATIC
from ckc_pin.view.player import save_html
from tests.browser.pages import browser, look_at, tabs

__all__ = ["browser", "look_at", "tabs"]

END = 9.5  # s, of five_bar/tracking
FIRST, SECOND = "/world/1: reduced", "/world/2: SPF, ε = 10⁻⁴"


@pytest.fixture(scope="module")
def runs(run) -> list[ckc_pin.Run]:
    return [run("five_bar/tracking", formulation=name) for name in ("reduced", "spf")]


@pytest.fixture(scope="module")
def saved(runs, tmp_path_factory):
    """A file of two runs, the second one stopped early, with forces."""
    rows = slice(0, int(np.searchsorted(runs[1].t, 4.0)) + 1)
    names = ("t", "q_tree", "v_tree", "u", "tau", "phi", "w", "energy", "lyapunov")
    short = replace(
        runs[1], status="stopped", message="phi_z is <singular>", **{n: getattr(runs[1], n)[rows] for n in names}
    )
    return save_html([runs[0], short], tmp_path_factory.mktemp("saved") / "two.html", forces=True)


@pytest.fixture
def visit(look_at, saved):
    """The page of two runs, which stands at its start."""
    opened = look_at(saved.as_uri(), offline=True)
    opened.page.evaluate("player.pause(); player.seek(0)")
    return opened


def time(visit) -> float:
    return float(visit.page.evaluate("viewer.animator.time"))


def playing(visit) -> bool:
    return bool(visit.page.evaluate("viewer.animator.playing"))


def test_space_key_plays_and_pauses(visit):
    visit.page.keyboard.press("Space")
    visit.until("viewer.animator.time > 0.05")
    assert playing(visit)
    visit.page.keyboard.press("Space")
    assert not playing(visit)
    where = time(visit)
    visit.page.click("#play")
    visit.until(f"viewer.animator.time > {where}")
    visit.page.keyboard.press(" ")  # the button that was clicked does not take it
    assert not playing(visit)


def test_arrow_keys_step_and_change_the_speed(visit, runs):
    camera = visit.page.evaluate("viewer.camera.position.toArray()")
    visit.page.keyboard.press("ArrowRight")
    assert time(visit) == pytest.approx(END / 100)
    visit.page.keyboard.press("ArrowLeft")
    visit.page.keyboard.press("ArrowLeft")
    assert time(visit) == 0
    visit.page.keyboard.press("Shift+ArrowRight")
    visit.page.keyboard.press("Shift+ArrowRight")
    assert time(visit) == pytest.approx(runs[0].t[2], abs=1e-6)
    visit.page.keyboard.press("Shift+ArrowLeft")
    assert time(visit) == pytest.approx(runs[0].t[1], abs=1e-6)
    visit.page.keyboard.press("End")
    assert time(visit) == pytest.approx(END)
    visit.page.keyboard.press("Home")
    assert time(visit) == 0
    visit.page.keyboard.press("ArrowUp")
    assert visit.page.evaluate("viewer.animator.mixer.timeScale") == 2
    assert visit.page.input_value("#speed") == "2"
    visit.page.keyboard.press("ArrowDown")
    visit.page.keyboard.press("ArrowDown")
    assert visit.page.evaluate("viewer.animator.mixer.timeScale") == 0.5
    assert visit.page.evaluate("viewer.camera.position.toArray()") == camera  # the viewer would pan by arrows


def test_playback_ends_or_repeats(visit):
    visit.page.evaluate(f"player.seek({END} - 0.1); player.play()")
    visit.until("!viewer.animator.playing")
    assert time(visit) == pytest.approx(END)
    visit.page.keyboard.press("Space")  # from the start
    visit.until("viewer.animator.time > 0 && viewer.animator.time < 5")
    visit.page.keyboard.press("l")
    assert visit.page.get_attribute("#loop", "aria-pressed") == "true"
    visit.page.evaluate(f"player.seek({END} - 0.1)")
    visit.until("viewer.animator.playing && viewer.animator.time > 0.05 && viewer.animator.time < 5")


def test_checkboxes_and_number_keys_show_and_hide_runs(visit):
    assert visit.tree()[SECOND]["visible"]
    visit.page.get_by_label("translucent: SPF").uncheck()
    assert [visit.tree()[path]["visible"] for path in (FIRST, SECOND)] == [True, False]
    visit.page.keyboard.press("1")
    visit.page.keyboard.press("2")
    assert [visit.tree()[path]["visible"] for path in (FIRST, SECOND)] == [False, True]
    assert visit.page.get_by_label("translucent: SPF").is_checked()


def test_caption_shows_the_outcome_after_a_run_has_stopped(visit):
    line = "translucent: SPF, ε = 10⁻⁴"
    assert line in visit.caption()
    visit.page.evaluate("player.seek(3.9)")
    assert line in visit.caption()
    visit.page.evaluate("player.seek(4.1)")
    assert f"{line} – stopped at 4 s: phi_z is <singular>" in visit.caption()
    assert "reduced" in visit.caption()


def test_arrows_have_position_direction_and_ratio_of_forces(visit, runs):
    names = [path for path in visit.tree() if path.startswith(f"{FIRST}/forces/") and path.count("/") == 4]
    assert sorted(path.split("/")[-1] for path in names) == ["loop:elbow", "motor:theta_1", "motor:theta_3"]
    times = np.array([1.0, 2.0, 5.0])
    placed = visit.placements(times, [f"{FIRST}/forces/loop:elbow", f"{FIRST}/forces/motor:theta_1"])
    rows = [runs[0].at(t) for t in times]
    forces = runs[0].loop_forces()["elbow"][rows]
    np.testing.assert_allclose(placed[:, 0, :3, 3], runs[0].points["tip"][rows], atol=1e-5)
    along = placed[:, 0, :3, 2]
    sizes = np.linalg.norm(along, axis=1)
    np.testing.assert_allclose(
        along[:, :2] / sizes[:, None], forces / np.linalg.norm(forces, axis=1)[:, None], atol=1e-5
    )
    np.testing.assert_allclose(sizes / sizes[0], np.linalg.norm(forces, axis=1) / np.linalg.norm(forces[0]), rtol=1e-4)
    torques = runs[0].tau[rows, 0]
    np.testing.assert_allclose(np.sign(placed[:, 1, 2, 2]), np.sign(torques))
    lengths = np.linalg.norm(placed[:, 1, :3, 2], axis=1)
    np.testing.assert_allclose(lengths / lengths[0], np.abs(torques / torques[0]), rtol=1e-4)
    visit.page.keyboard.press("f")
    assert not visit.tree()[f"{FIRST}/forces"]["visible"]
    visit.page.click("#forces")
    assert visit.tree()[f"{FIRST}/forces"]["visible"]


def test_all_controls_fit_a_small_screen(visit):
    visit.page.set_viewport_size({"width": 360, "height": 640})
    for name in ("play", "time-slider", "time", "speed", "loop", "forces", "controls", "record"):
        box = visit.page.locator(f"#{name}").bounding_box()
        assert 0 <= box["x"] < box["x"] + box["width"] <= 360
        assert box["y"] + box["height"] <= 640
    assert not visit.page.locator(".dg.main").is_visible()
    height = visit.page.locator("#meshcat-pane").bounding_box()["height"]
    visit.until(f"Math.abs(viewer.camera.zoom - 360 / {height}) < 1e-9")
    assert visit.page.evaluate("document.documentElement.scrollWidth") == 360


def test_play_button_shows_a_triangle_and_a_pause_sign(visit):
    """Drawn pixels, whatever fonts the system has: the pause sign is two bars, the triangle one area."""

    def count_areas() -> int:
        image = matplotlib.image.imread(io.BytesIO(visit.page.locator("#play svg").screenshot()))
        is_dark = image[image.shape[0] // 2, :, :3].mean(axis=1) < 0.5
        return int(np.sum(np.diff(is_dark.astype(int)) == 1) + is_dark[0])

    assert visit.page.inner_text("#play") == ""
    assert (count_areas(), visit.page.get_attribute("#play", "aria-label")) == (1, "play")
    visit.page.keyboard.press("Space")
    assert (count_areas(), visit.page.get_attribute("#play", "aria-label")) == (2, "pause")


def test_controls_of_the_viewer_are_shown_on_request(visit):
    assert not visit.page.get_by_text("Open Controls").is_visible()
    assert not visit.page.locator(".dg.main").is_visible()
    visit.page.click("#controls")
    assert visit.page.get_by_text("Scene", exact=True).is_visible()
    assert not visit.page.get_by_text("Close Controls").is_visible()
    visit.page.keyboard.press("h")
    assert not visit.page.locator(".dg.main").is_visible()


def test_bar_does_not_cover_the_mechanism(visit):
    pane, bar = (visit.page.locator(name).bounding_box() for name in ("#meshcat-pane canvas", "#bar"))
    assert pane["y"] + pane["height"] <= bar["y"]
    assert bar["y"] + bar["height"] == 540
    assert visit.page.evaluate("viewer.camera.aspect") == pytest.approx(pane["width"] / pane["height"])


def test_video_is_recorded_as_webm(visit, tmp_path):
    visit.page.evaluate("viewer.animator.mixer.timeScale = 16")
    with visit.page.expect_download(timeout=60_000) as waiting:
        visit.page.keyboard.press("r")
    assert waiting.value.suggested_filename == "five_bar_tracking.webm"
    waiting.value.save_as(tmp_path / "video.webm")
    assert (tmp_path / "video.webm").read_bytes().startswith(bytes.fromhex("1a45dfa3"))  # WebM
    assert (tmp_path / "video.webm").stat().st_size > 10_000


def test_loop_frames_have_distinct_render_orders(visit):
    orders = visit.page.evaluate(
        """() => ["joint:theta_2/loop:elbow:A", "joint:theta_4/loop:elbow:B"].map(path =>
             viewer.scene_tree.find(["world", "1: reduced", ...path.split("/"), "<object>"]).object.renderOrder)"""
    )
    assert orders[0] > orders[1]


def test_the_browser_accepts_every_style_rule(visit):
    """Rules and declarations that a browser does not understand are dropped silently."""
    css = re.sub(r"/\*.*?\*/", "", (STATIC / "player.css").read_text(encoding="utf-8"), flags=re.DOTALL)
    kept = visit.page.evaluate(
        """css => {
             const sheet = new CSSStyleSheet();
             sheet.replaceSync(css);
             const flat = rule => rule.cssRules && rule.cssRules.length ? Array.from(rule.cssRules).flatMap(flat)
               : [rule.selectorText];
             return Array.from(sheet.cssRules).flatMap(flat);
           }""",
        css,
    )
    blocks = re.findall(r"[^{};]+\{[^{}]*\}", css)
    assert len(kept) == len(blocks)
    declarations = re.findall(r"([a-z-]+): ([^;{}]+);", css)
    supported = visit.page.evaluate(
        """pairs => pairs.map(([name, value]) => CSS.supports(name, value.replace(" !important", "")))""", declarations
    )
    assert [pair for pair, ok in zip(declarations, supported, strict=True) if not ok] == []
