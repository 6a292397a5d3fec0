"""Playback in a browser: from the server, live and from a file."""

from __future__ import annotations

import io

import matplotlib.image
import numpy as np
import pytest

import ckc_pin
from ckc_pin.view.live import live_view
from ckc_pin.view.player import play_runs, save_html
from tests.browser.pages import browser, look_at, tabs
from tests.contract.sketches import FOUR_BAR, FOUR_BAR_LOOP, START_OF_FOUR_BAR, tetrahedron, write_scene

__all__ = ["browser", "look_at", "tabs"]

L_PROXIMAL, BASE = 0.2794, 0.3048  # of five_bar
ELBOWS = {"theta_1": ("theta_2", 0.0), "theta_3": ("theta_4", BASE)}  # proximal joint: elbow, foot
HOSTILE = """&quot;&gt;&lt;img src=x onerror=window.pwned=1&gt;"""
PWNED = '"><img src=x onerror=window.pwned=1>'


@pytest.fixture(scope="module")
def tracking(run) -> ckc_pin.Run:
    return run("five_bar/tracking", formulation="reduced")


def elbow(run: ckc_pin.Run, joint: str) -> np.ndarray:
    """Where an elbow is along a run, (m, 3)."""
    angle = run.q_tree[:, run.column(joint)]
    return np.column_stack([ELBOWS[joint][1] + L_PROXIMAL * np.cos(angle), L_PROXIMAL * np.sin(angle), 0 * angle])


def assert_elbows(visit, run: ckc_pin.Run, root: str) -> None:
    paths = [f"/world/{root}/joint:{distal}" for distal, _ in ELBOWS.values()]
    placed = visit.placements(run.t, paths)
    for k, joint in enumerate(ELBOWS):
        np.testing.assert_allclose(placed[:, k, :3, 3], elbow(run, joint), atol=1e-6)


def test_server_page_plays_the_run(look_at, tracking):
    with play_runs(tracking, block=False) as server:
        visit = look_at(server.url)
        tree = visit.tree()
        root = "/world/1: reduced"
        for joint in tracking.coordinates:
            assert tree[f"{root}/joint:{joint}"]["type"] == "Group"
            assert [p for p in tree if p.startswith(f"{root}/joint:{joint}/link:") and tree[p]["type"] == "Mesh"]
            assert [p for p in tree if p.startswith(f"{root}/desired/joint:{joint}/link:")]
        assert {tree[f"{root}/joint:{joint}/loop:elbow:{side}/<object>"]["type"]
                for side, joint in (("A", "theta_2"), ("B", "theta_4"))} == {"Mesh"}  # fmt: skip
        assert tree[f"{root}/trace:tip/<object>"]["type"] == "Line"
        assert tree[f"{root}/trace:tip/<object>"]["corners"] == len(tracking.t)
        assert visit.caption() == ["five_bar/tracking", "reduced", "gray: desired"]
        assert_elbows(visit, tracking, "1: reduced")
        address = server.url.removeprefix("http")
        assert set(visit.requests) == {
            f"http{address}",
            f"http{address}main.min.js",
            f"http{address}start.js",
            f"ws{address}",
        }


def test_playback_starts_at_the_given_speed_with_a_time_slider(look_at, tracking):
    with play_runs(tracking, speed=0.5, block=False) as server:
        visit = look_at(server.url)
        assert visit.page.evaluate("viewer.animator.mixer.timeScale") == 0.5
        visit.until("viewer.animator.time > 0.1")
        played, elements = visit.page.evaluate(
            """() => {
              viewer.animator.pause();
              const elbow = viewer.scene_tree.find(["world", "1: reduced", "joint:theta_2"]).object;
              return [viewer.animator.actions[0].time, elbow.position.toArray()];
            }"""
        )
        expected = [np.interp(played, tracking.t, column) for column in elbow(tracking, "theta_1").T]
        np.testing.assert_allclose(elements, expected, atol=1e-6)  # between keyframes the browser interpolates
        labels = visit.page.locator(".dg .property-name").all_text_contents()
        assert {"play", "pause", "reset", "time (s)", "speed"} <= set(labels)
        assert visit.page.input_value("#speed") == "0.5"
        assert visit.page.evaluate("viewer.animator.duration") == pytest.approx(9.5)


def test_screenshot_shows_the_links(look_at, tracking):
    with play_runs(tracking, block=False) as server:
        visit = look_at(server.url)
        visit.placements(np.array([1.5]), ["/world"])
        visit.page.evaluate("viewer.render()")
        image = matplotlib.image.imread(io.BytesIO(visit.page.screenshot()))[:, :, :3]
    red, green, blue = np.moveaxis(image[:, :700], 2, 0)  # beside the controls
    for link in ((blue > 0.5) & (red < 0.3), (red > 0.5) & (blue < 0.3) & (green < 0.3), (red > 0.8) & (blue < 0.4)):
        assert link.sum() > 200  # blue, red and orange links
    assert np.median(image) > 0.85  # on a bright ground


def test_saved_page_plays_from_disk_without_network(look_at, tracking, tmp_path):
    path = save_html(tracking, tmp_path / "tracking.html")
    visit = look_at(path.as_uri(), offline=True)
    assert visit.requests == [path.as_uri()]
    assert visit.caption() == ["five_bar/tracking", "reduced", "gray: desired"]
    assert_elbows(visit, tracking, "1: reduced")


def test_notebook_frame_is_isolated_from_its_page(look_at, tracking, tmp_path):
    """The cell's markup in a test page: the frame plays, and its scripts cannot access that page."""
    page = tmp_path / "cell.html"
    displayed = tracking.play(inline=True)._repr_html_()
    cell = f"<!DOCTYPE html><title>cell</title><script>viewer = 'none here'</script><body>{displayed}</body>"
    page.write_text(cell, encoding="utf-8")
    visit = look_at(page.as_uri(), "document.querySelector('iframe')", offline=True)
    (frame,) = visit.page.main_frame.child_frames
    frame.wait_for_load_state()
    assert frame.evaluate("() => viewer.animator.duration") == pytest.approx(tracking.t[-1], abs=1e-6)
    assert frame.evaluate("() => document.querySelector('canvas').width") > 100
    seen = "() => { try { return parent.viewer } catch (error) { return error.name } }"
    assert frame.evaluate(seen) == "SecurityError"
    assert visit.page.evaluate("() => viewer") == "none here"
    assert not [url for url in visit.requests if url.startswith(("http", "ws"))]


def test_saved_page_draws_two_runs_with_meshes_and_gaps(look_at, run, tmp_path):
    mesh = '<visual><geometry><mesh filename="crank.stl"/></geometry></visual>'
    urdf = FOUR_BAR.replace('<link name="crank">', f'<link name="crank">{mesh}')
    scene = write_scene(tmp_path / "m", urdf, FOUR_BAR_LOOP, START_OF_FOUR_BAR, 0.1)
    tetrahedron(tmp_path / "m" / "crank.stl")
    runs = [ckc_pin.simulate(scene, {"formulation": name}) for name in ("spf", "reduced")]
    path = save_html(runs, tmp_path / "two.html", gap=1000.0)
    tree = look_at(path.as_uri(), offline=True).tree()
    first, second = sorted({p.split("/")[2] for p in tree if p.startswith("/world/")})
    assert first == "1: reduced"
    assert second.startswith("2: SPF")
    for root, opacity in ((first, 1.0), (second, 0.4)):
        drawn = {p: one for p, one in tree.items() if p.startswith(f"/world/{root}/") and one["type"] == "Mesh"}
        assert {one["opacity"] for one in drawn.values()} == {opacity}
        assert tree[f"/world/{root}/joint:alpha/link:crank/0/<object>"]["corners"] == 4
        assert [p for p in drawn if p.startswith(f"/world/{root}/joint:gamma/rod:")]
        assert f"/world/{root}/gap:joint/way/rod/<object>" in drawn
        colours = {tree[p]["color"] for p in drawn if "/joint:" in p and "/loop:" not in p}
        assert len(colours) == 3  # one a link


def test_names_from_files_are_not_parsed_as_html(look_at, tmp_path):
    urdf = FOUR_BAR.replace('"alpha"', f'"{HOSTILE}"').replace('"crank"', f'"{HOSTILE}"')
    loop = FOUR_BAR_LOOP.replace('"alpha"', f"'{PWNED}'").replace("alpha =", f"'{PWNED}' =")
    loop = loop.replace('name = "joint"', f"name = '{PWNED}'")
    path = write_scene(tmp_path / "m", urdf, loop, f"[initial.q]\n'{PWNED}' = -0.5\n", 0.02)
    run = ckc_pin.simulate(path.rename(path.with_name(f"{PWNED}.scene.toml")))
    with play_runs(run, block=False) as server:
        pages = [server.url, save_html(run, tmp_path / "x.html").as_uri()]
        for visit in map(look_at, pages):
            assert [p for p in visit.tree() if p.endswith(f"/joint:{PWNED}")]
            assert PWNED in visit.caption()[0]
            visit.page.evaluate("viewer.gui.__folders.Scene.open()")
            assert visit.page.evaluate("window.pwned") is None
            assert visit.page.locator("img").count() == 0
            assert not [url for url in visit.requests if url.endswith("/x")]


def test_live_view_shows_the_simulation_then_its_playback(look_at):
    scene = ckc_pin.load_scene("five_bar/swing")
    with live_view(scene, None) as view:
        visit = look_at(view.server.url, until="viewer.scene_tree.children.world?.children.live")
        displayed = []

        def on_output(t: float, q_tree: np.ndarray) -> None:
            view.on_output(t, q_tree)
            if t in (0.4, 1.2):
                visit.until(f"document.getElementById('status').textContent === 't = {t:.2f} of 2 s'")
                displayed.append(np.array(visit.tree()["/world/live/joint:theta_2"]["matrix"][12:15]))

        run = ckc_pin.simulate(scene, {}, on_output=on_output)
        for t, where in zip((0.4, 1.2), displayed, strict=True):
            np.testing.assert_allclose(where, elbow(run, "theta_1")[run.at(t)], atol=1e-6)
        view.stop()
        view.play_back(run)
        visit.until("viewer.animator.actions.length")
        assert not [p for p in visit.tree() if p.startswith("/world/live")]
        assert_elbows(visit, run, "1: DAE")
    visit.until("document.getElementById('status').textContent")
    assert visit.caption()[-1] == "the program that sent this has ended"
