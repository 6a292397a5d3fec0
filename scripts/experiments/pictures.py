"""Make the pictures of docs/images."""

from __future__ import annotations

import os
import time
from pathlib import Path

from playwright.sync_api import Page, ViewportSize, sync_playwright

import ckc_pin
from ckc_pin.analysis.map import singularity_map, workspace_sections
from ckc_pin.view.map_figures import draw_map, draw_sections
from ckc_pin.view.player import play_runs
from ckc_pin.view.style import figure_style
from scripts.experiments.chart import shrink
from scripts.experiments.joint_pictures import draw_friction, draw_preload

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
SIZE: ViewportSize = {"width": 720, "height": 540}
DPI = 170
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", *([] if os.getuid() else ["--no-sandbox"])]


def screenshot(page: Page, runs: list[ckc_pin.Run], t: float, path: Path) -> None:
    """Save a picture of the playback at time t, without the controls."""
    server = play_runs(runs, block=False)
    assert server is not None  # it does not wait
    with server:
        page.goto(server.url)
        while not page.evaluate("Boolean(window.viewer && viewer.animator.actions.length)"):
            time.sleep(0.1)
        page.evaluate("player.pause(); viewer.gui.domElement.style.display = 'none'")
        page.evaluate(f"player.seek({t}); document.getElementById('bar').style.display = 'none'; viewer.render()")
        time.sleep(0.5)
        page.screenshot(path=path)


def main(chromium: Path) -> None:
    """Make the pictures of playback, then the figures."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    tracking = ckc_pin.simulate("five_bar/tracking")
    lift = ckc_pin.simulate("two_ur5/lift")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport=SIZE)
        screenshot(page, [tracking], 1.45, IMAGES / "five_bar_tracking.png")
        screenshot(page, [lift], 1.0, IMAGES / "two_ur5_lift.png")
        browser.close()
    with figure_style():
        for name in ("five_bar", "five_bar_as_printed"):
            draw_map(singularity_map(name, scene="tracking")).savefig(IMAGES / f"map_{name}.png", dpi=DPI)
        draw_sections(workspace_sections("delta")).savefig(IMAGES / "delta_workspace.png", dpi=DPI)
        draw_friction(IMAGES / "five_bar_friction.png", DPI)
        draw_preload(IMAGES / "two_ur5_preload.png", DPI)
    for picture in IMAGES.glob("*.png"):
        shrink(picture)
