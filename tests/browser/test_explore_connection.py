"""Connection of the explorer's page: frames, several pages, a program that is gone, and notebooks."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import numpy as np

from ckc_pin.explorer import messages
from tests.browser.explorer import ROOT, five_bar, open_explorer, program
from tests.browser.pages import browser, look_at, tabs

__all__ = ["browser", "five_bar", "look_at", "program", "tabs"]


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *args: object) -> None:
        """Print nothing."""


def test_frames_are_answered_and_the_newest_one_is_shown(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    placement = five_bar.placements["theta_2"]
    for k in range(1, 101):
        placement[:3, 3] = [0.01 * k, 0, 0]
        five_bar.move(end=f"frame {k}")
    visit.until("document.getElementById('end').textContent === 'frame 100'")
    matrix = np.reshape(visit.tree()["/world/explored/joint:theta_2"]["matrix"], (4, 4)).T
    np.testing.assert_allclose(matrix, placement, atol=1e-6)
    five_bar.take(0)  # answers to frames are not requests


def test_two_pages_get_the_same_reports(look_at, five_bar):
    first, second = open_explorer(look_at, five_bar), open_explorer(look_at, five_bar)
    five_bar.values["theta_1"] = 0.75
    five_bar.move(can_undo=True)
    for visit in (first, second):
        visit.until("document.querySelector('#coordinates [data-name=theta_1] .number').value === '0.75'")
    second.page.click("#undo")
    assert five_bar.take(1) == [messages.Undo()]


def test_page_waits_for_a_program_that_is_gone(look_at, program):
    gone = program("five_bar")
    visit = open_explorer(look_at, gone)
    gone.server.stop()
    visit.until("document.getElementById('status').textContent")
    assert visit.page.inner_text("#status").startswith("The program has ended")
    assert visit.page.evaluate("() => document.getElementById('panel').inert")
    visit.page.wait_for_timeout(1500)
    back = program("delta", port=gone.server.port, token=gone.server.token)
    visit.until("!document.getElementById('status').textContent")
    visit.until("document.getElementById('title').textContent === 'delta'")
    visit.until("document.querySelector('#coordinates [data-name=arm_1]')")
    names = {path.split("/")[3] for path in visit.tree() if path.startswith(f"{ROOT}/joint:")}
    assert names == {path.split("/")[3] for path in back.setup.bodies.values()}
    visit.page.click("#home")
    assert back.take(1) == [messages.Home()]
    refused = [text for text in visit.complaints if "ERR_CONNECTION_REFUSED" in text]  # what Chromium itself logs
    assert len(refused) >= 1
    assert visit.complaints == refused
    visit.complaints.clear()


def test_page_works_in_a_frame_of_a_notebook(look_at, five_bar, tmp_path):
    """A notebook is a page of another port of this machine."""
    cell = (
        f"<!DOCTYPE html><script>viewer = 'none here'</script><iframe src={five_bar.server.url} width=900 height=500>"
    )
    (tmp_path / "favicon.ico").touch()
    (tmp_path / "cell.html").write_text(cell)
    notebook = ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=tmp_path))
    Thread(target=notebook.serve_forever, daemon=True).start()
    try:
        visit = look_at(f"http://localhost:{notebook.server_port}/cell.html", "document.querySelector('iframe')")
        frame = visit.page.frame_locator("iframe")
        frame.locator("#coordinates .row").first.wait_for()
        five_bar.requests.clear()
        frame.locator("#home").click()
        assert five_bar.take(1) == [messages.Home()]
        assert visit.page.evaluate("() => viewer") == "none here"
    finally:
        notebook.shutdown()
        notebook.server_close()


def test_page_requests_only_its_server(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    address = five_bar.server.url.removeprefix("http")
    assert set(visit.requests) == {
        f"http{address}",
        f"http{address}main.min.js",
        f"http{address}start.js",
        f"ws{address}",
    }
