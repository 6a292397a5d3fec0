"""The explorer as a person uses it: random drags of real mechanisms in Chromium, runs, two pages, random input."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin.explorer.paths import EXPLORED
from ckc_pin.explorer.session import Session
from ckc_pin.view.bodies import body_path
from tests.browser.pages import Visit, browser, look_at, tabs

__all__ = ["browser", "look_at", "tabs"]

READY = "document.getElementById('closure').textContent && !viewer.needs_render"
MECHANISMS = ("five_bar", "delta", "stewart", "bricard", "two_ur5", "machine.xml")
IMPORTED = Path(__file__).parents[1] / "contract" / "test_import_data"
PATH_POINTS = 6
MAX_CLOSURE = 1e-10

# Where the bodies that can be dragged are in the window: the middle of each one's first visible mesh.
BODY_POSITIONS = """(paths) => {
  const {Box3, Vector3} = MeshCat.THREE, box = viewer.renderer.domElement.getBoundingClientRect();
  viewer.scene.updateMatrixWorld(true);
  return paths.map(path => {
    const object = viewer.scene_tree.find(path.split("/").filter(Boolean)).object;
    const at = new Box3().setFromObject(object).getCenter(new Vector3()).project(viewer.camera);
    return [box.left + (at.x + 1) * box.width / 2, box.top + (1 - at.y) * box.height / 2];
  }).filter(([x, y]) => Number.isFinite(x) && Number.isFinite(y));
}"""


class RecordedExplorer:
    """An explorer whose frames are recorded."""

    def __init__(self, explorer: ckc_pin.Explorer, frames: list[tuple[float, float, float]]) -> None:
        self.explorer, self.frames = explorer, frames
        self.session: Session = explorer._session

    @property
    def paths(self) -> list[str]:
        """Paths of the bodies in the scene."""
        mechanism = self.session.mechanism
        return [body_path(mechanism, EXPLORED, joint) for joint in range(1, mechanism.tree.model.njoints)]

    @property
    def values(self) -> dict[str, float]:
        mechanism = self.session.mechanism
        return mechanism.tree.named(mechanism.tree.to_coordinates(self.session.at.q_tree))


@pytest.fixture
def explore(monkeypatch) -> Iterator[Callable[..., RecordedExplorer]]:
    """Start explorers that record time, closure and branch of each frame, and stop them at the end."""
    started: list[ckc_pin.Explorer] = []
    frames: list[tuple[float, float, float]] = []
    send_frame = Session.send_frame

    def record(self: Session) -> None:
        phi_z = self.at.phi_z
        sign = np.linalg.slogdet(phi_z)[0] if phi_z.shape[0] == phi_z.shape[1] else 1.0
        frames.append((time.perf_counter(), float(np.abs(self.at.phi).max(initial=0.0)), float(sign)))
        send_frame(self)

    monkeypatch.setattr(Session, "send_frame", record)

    def start(what: Any, **options: Any) -> RecordedExplorer:
        explorer = ckc_pin.explore(what, **options)
        started.append(explorer)
        return RecordedExplorer(explorer, frames)

    yield start
    for explorer in started:
        explorer.stop()


def drag_along(visit: Visit, start: tuple[float, float], path: np.ndarray) -> None:
    mouse = visit.page.mouse
    mouse.move(*start)
    mouse.down()
    for x, y in path:
        mouse.move(x, y)
        time.sleep(0.03)
    mouse.up()


@pytest.mark.parametrize("name", MECHANISMS)
def test_random_drags_stay_closed_on_their_branch(name, explore, look_at):
    """Closure is checked in each frame, and frames keep coming while the mouse moves."""
    if name.endswith(".xml"):
        with pytest.warns(ckc_pin.errors.ImportNote):
            recorded = explore(IMPORTED / name)
    else:
        recorded = explore(name)
    visit = look_at(recorded.explorer.url, READY)
    start = recorded.values
    random = np.random.default_rng(7)
    places = visit.page.evaluate(BODY_POSITIONS, recorded.paths)
    assert places
    for _ in range(3):
        x, y = places[int(random.integers(len(places)))]
        steps = random.uniform(-40, 40, (PATH_POINTS, 2))
        drag_along(visit, (x, y), np.array([x, y]) + np.cumsum(steps, axis=0))
    visit.until("!document.getElementById('undo').disabled")
    assert recorded.values != start
    frames = np.array(recorded.frames)
    assert frames[:, 1].max() <= MAX_CLOSURE
    assert len(set(frames[:, 2])) == 1
    assert len(frames) > PATH_POINTS


def test_slider_at_its_end_says_why(explore, look_at):
    recorded = explore("five_bar")
    visit = look_at(recorded.explorer.url, READY)
    number = visit.page.locator("#coordinates input.number").first
    number.fill("3")
    number.press("Enter")
    visit.until("document.body.innerText.includes('phi_z is singular there')")
    assert recorded.session.at.margin() < 1e-3


def test_run_of_the_page_equals_the_command_to_the_bit(explore, look_at, tmp_path):
    recorded = explore("five_bar/swing", out=tmp_path)
    visit = look_at(recorded.explorer.url, READY)
    visit.page.locator("#run-section summary").click()
    visit.page.locator("#start").click()
    visit.until("parseFloat(document.getElementById('time-slider').max) > 0.3")
    visit.page.locator("#stop").click()
    visit.page.locator("#keep-section summary").click()
    visit.page.locator("#save-run").click()
    visit.until("document.getElementById('notice-text').textContent.includes('run.npz')")
    saved = ckc_pin.Run.load(tmp_path / "explored")
    again = ckc_pin.simulate(tmp_path / "explored" / "explored.scene.toml")
    assert np.array_equal(saved.q_tree, again.q_tree)
    assert saved.t[-1] > 0.3


def test_two_pages_show_one_pose(explore, look_at):
    recorded = explore("five_bar")
    first, second = (look_at(recorded.explorer.url, READY) for _ in range(2))
    number = first.page.locator("#coordinates input.number").first
    number.fill("-1.2")
    number.press("Enter")
    for visit in (first, second):
        visit.until("document.querySelector('#coordinates input.number').value === '-1.2'")


def test_explorer_that_is_started_again_is_found_by_its_page(explore, look_at):
    recorded = explore("five_bar", token="0123456789abcdef")
    port = int(recorded.explorer.url.split(":")[2].split("/")[0])
    visit = look_at(recorded.explorer.url, READY)
    recorded.explorer.stop()
    visit.until("document.getElementById('status').textContent")
    again = explore("delta", port=port, token="0123456789abcdef")
    visit.until("document.getElementById('title').textContent === 'delta'")
    assert again.explorer.url == recorded.explorer.url
    visit.complaints[:] = [line for line in visit.complaints if "WebSocket" not in line]  # refused while it was away


def test_random_input_leaves_no_error_and_no_growth(explore, look_at):
    """The memory of the page after many gestures is that after few, up to 30 MB."""
    recorded = explore("five_bar")
    visit = look_at(recorded.explorer.url, READY)
    random = np.random.default_rng(3)
    session = visit.page.context.new_cdp_session(visit.page)
    visit.page.evaluate("document.querySelectorAll('details').forEach(section => { section.open = true; })")
    memory = []
    for k in range(40):
        kind = int(random.integers(5))
        places = visit.page.evaluate(BODY_POSITIONS, recorded.paths)
        x, y = places[int(random.integers(len(places)))]
        match kind:
            case 0 | 1:
                drag_along(visit, (x, y), np.array([x, y]) + np.cumsum(random.uniform(-60, 60, (4, 2)), axis=0))
            case 2:
                visit.page.keyboard.press(str(random.choice(["h", "b", "1", "3", "4", "5", "6", "Control+z"])))
            case 3:
                number = visit.page.locator("#coordinates input.number").first
                number.fill(str(round(float(random.uniform(-4, 4)), 3)))
                number.press("Enter")
            case _:
                visit.page.mouse.wheel(0, float(random.uniform(-100, 100)))
        if k in (16, 39):
            session.send("HeapProfiler.collectGarbage")
            memory.append(session.send("Runtime.getHeapUsage")["usedSize"])
    assert memory[1] - memory[0] < 30e6
    assert np.array(recorded.frames)[:, 1].max() <= MAX_CLOSURE
