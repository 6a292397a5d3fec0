"""Make the pictures of docs/images."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import Page, ViewportSize, sync_playwright

import ckc_pin
from ckc_pin.analysis.map import singularity_map, workspace_sections
from ckc_pin.view.identification_figures import draw_identification
from ckc_pin.view.map_figures import draw_map, draw_sections
from ckc_pin.view.player import play_runs
from ckc_pin.view.report_page import render_report
from ckc_pin.view.result_figures import draw_plan
from ckc_pin.view.style import figure_style
from scripts.experiments import identification_trials as trials
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


def reports() -> Iterator[tuple[str, ckc_pin.Identification]]:
    """Yield names and results of identifications from simulated records, with one that is not fitted."""
    names = trials.CASES["five_bar"].parameters
    start = ckc_pin.load("five_bar")
    torques = [trials.measure_torques("five_bar", seed) for seed in (0, 1)]
    yield "five_bar", ckc_pin.identify(start, torques[0], names, validation=torques[1])
    runs = [trials.measure_motion("delta", seed) for seed in (0, 1)]
    of_motion = trials.CASES["delta"].of_motion
    yield "delta", ckc_pin.identify("delta", runs[0], of_motion, method="motion", validation=runs[1])
    plate = {"link.plate.mass": 0.8 * ckc_pin.load("stewart").tree.model.inertias[-1].mass}
    platform = [trials.measure_torques("stewart", seed) for seed in (0, 1)]
    names = ("link.plate.inertial", "joint.leg_*.damping")
    yield "stewart", ckc_pin.identify(ckc_pin.load("stewart", plate), platform[0], names, validation=platform[1])


def picture_reports(page: Page) -> None:
    """Save pictures of whole reports of identifications."""
    with tempfile.TemporaryDirectory() as folder:
        for name, result in reports():
            with figure_style():
                text = render_report(result, draw_identification(result))
            (Path(folder) / "report.html").write_text(text, encoding="utf-8")
            page.goto((Path(folder) / "report.html").as_uri())
            page.screenshot(path=IMAGES / "guide" / f"report_{name}.png", full_page=True)


def draw_crossing(path: Path, dpi: int) -> None:
    """Draw the fastest motion of the five-bar to a place beyond a singular configuration."""
    target = {"theta_1": 1.443, "theta_2": -2.038, "theta_3": 3.352, "theta_4": -2.781}
    plan = ckc_pin.optimize("five_bar", to={"q": target}, limits={"torque": 3.0}, cross_singularities=True)
    draw_plan(plan).savefig(path, dpi=dpi)


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
        picture_reports(page)
        browser.close()
    with figure_style():
        for name in ("five_bar", "five_bar_as_printed"):
            draw_map(singularity_map(name, scene="tracking")).savefig(IMAGES / f"map_{name}.png", dpi=DPI)
        draw_sections(workspace_sections("delta")).savefig(IMAGES / "delta_workspace.png", dpi=DPI)
        draw_friction(IMAGES / "five_bar_friction.png", DPI)
        draw_preload(IMAGES / "two_ur5_preload.png", DPI)
        draw_crossing(IMAGES / "guide" / "crossing.png", DPI // 2)
    for picture in [*IMAGES.glob("*.png"), *IMAGES.glob("guide/report_*.png"), IMAGES / "guide" / "crossing.png"]:
        shrink(picture)
