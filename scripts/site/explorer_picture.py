"""Pictures of the explorer: python -m scripts.site.explorer_picture writes them into docs/images.

A Chromium without a window shows the page while the mouse of Playwright drags the five-bar, switches its branch, lets
it go and pushes it.
"""

from __future__ import annotations

import io
import math
import shutil
from pathlib import Path

from PIL import Image, ImageDraw
from playwright.sync_api import Page, Playwright, sync_playwright

import ckc_pin
from scripts.experiments.chart import shrink

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
SIZE = (920, 540)  # of the window, pixels
SCREENS = {"wide": (1100, 640), "narrow": (400, 700)}
SCALE = 0.75  # of the picture
FRAME_MS = 80
COLOURS = 80
STARTING_MS = 3000
TIP = ["theta_2", [0.2794, 0.0, 0.0]]  # body and place of the dragged point
ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]  # WebGL without a GPU

# Where a named point is in the window.
POINT = """(name) => {
  const {Vector3} = MeshCat.THREE, box = viewer.renderer.domElement.getBoundingClientRect();
  const path = `/world/explored/joint:${name[0]}`.split("/").filter(Boolean);
  viewer.scene.updateMatrixWorld(true);
  const at = viewer.scene_tree.find(path).object.localToWorld(new Vector3(...name[1])).project(viewer.camera);
  return [box.left + (at.x + 1) * box.width / 2, box.top + (1 - at.y) * box.height / 2];
}"""


class Film:
    """Screenshots of a page with the mouse drawn into them."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.frames: list[Image.Image] = []
        self.mouse = (0.0, 0.0)
        self.is_down = False

    def move(self, x: float, y: float) -> None:
        """Move the mouse."""
        self.mouse = (x, y)
        self.page.mouse.move(x, y)

    def shoot(self, count: int = 1) -> None:
        """Take frames, each when the page has settled."""
        for _ in range(count):
            self.page.wait_for_timeout(FRAME_MS)
            image = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
            x, y = self.mouse
            radius = 7 if self.is_down else 9
            outline = (20, 20, 20)
            ImageDraw.Draw(image).ellipse(
                (x - radius, y - radius, x + radius, y + radius),
                fill=outline if self.is_down else None,
                outline=outline,
                width=2,
            )
            self.frames.append(
                image.resize((round(SCALE * image.width), round(SCALE * image.height)), Image.Resampling.LANCZOS)
            )

    def drag(self, path: list[tuple[float, float]], hold: int = 0) -> None:
        """Drag along a path."""
        self.move(*path[0])
        self.shoot(2)
        self.is_down = True
        self.page.mouse.down()
        for x, y in path[1:]:
            self.move(x, y)
            self.shoot()
        self.shoot(hold)
        self.page.mouse.up()
        self.is_down = False

    def click(self, selector: str, count: int = 4) -> None:
        """Move the mouse to an element and click it."""
        box = self.page.locator(selector).bounding_box()
        assert box is not None
        self.move(box["x"] + min(40.0, box["width"] / 2), box["y"] + box["height"] / 2)
        self.shoot(2)
        self.page.mouse.click(*self.mouse)
        self.shoot(count)

    def save(self, path: Path) -> None:
        """Write the frames as a GIF with one palette, in which the colours of all links are kept."""
        shown = self.frames[:: max(1, len(self.frames) // 6)]
        montage = Image.new("RGB", (shown[0].width, len(shown) * shown[0].height))
        for k, frame in enumerate(shown):
            montage.paste(frame, (0, k * frame.height))
        palette = montage.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in self.frames]
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True)


def wave(x: float, y: float, width: float, height: float, count: int) -> list[tuple[float, float]]:
    """Return a path of the mouse: to one side, to the other, and back, up at both sides."""
    angles = [2 * math.pi * k / count for k in range(count + 1)]
    return [(x + width * math.sin(s), y - height * (1 - math.cos(2 * s))) for s in angles]


def film_five_bar(page: Page) -> Film:
    """Drag the tip with traces, switch the branch, let go, and push while it swings."""
    film = Film(page)
    x, y = page.evaluate(POINT, TIP)
    film.drag(wave(x, y, 110, 45, 36))
    for section in ("#move-section", "#show-section"):
        page.locator(f"{section} > summary").click()
    film.click("#branches-section > summary", 1)
    film.click("#branches-button", 6)
    film.click("#branches button >> nth=1", 6)
    film.click("#undo", 3)
    page.locator("#branches-section > summary").click()
    film.click("#run-section > summary", 1)
    film.click("#start", 6)
    x, y = page.evaluate(POINT, TIP)
    film.drag([(x + 3 * k, y - 2 * k) for k in range(20)], 6)
    film.shoot(10)
    return film


def open_page(playwright: Playwright, url: str, size: tuple[int, int]) -> Page:
    """Open the explorer's page in a window of a size."""
    browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto(url)
    page.wait_for_timeout(STARTING_MS)
    return page


def photograph_delta(playwright: Playwright, url: str) -> None:
    """Write a picture of the delta with some quantities in a wide window, and one of a narrow window."""
    for name, size in SCREENS.items():
        page = open_page(playwright, url, size)
        for quantity in ("forces", "ellipsoids", "traces"):
            page.locator(f"#quantities [data-name={quantity}] input").check()
        x, y = page.evaluate(POINT, ["plate_place", [0.0, 0.0, 0.0]])
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(1, 13):
            page.mouse.move(x + 4 * step, y - 2 * step)
            page.wait_for_timeout(FRAME_MS)
        page.mouse.up()
        page.wait_for_timeout(STARTING_MS)
        page.screenshot(path=IMAGES / "guide" / f"explore_{name}.png")
        shrink(IMAGES / "guide" / f"explore_{name}.png")
        for quantity in ("forces", "ellipsoids", "traces"):
            page.locator(f"#quantities [data-name={quantity}] input").uncheck()
        page.keyboard.press("h")


def main() -> None:
    """Write the pictures."""
    with ckc_pin.explore("five_bar") as explorer, sync_playwright() as playwright:
        page = open_page(playwright, explorer.url, SIZE)
        page.evaluate("viewer.hide_background()")  # Its gradient would take most colours of the palette.
        film_five_bar(page).save(IMAGES / "explore.gif")
    with ckc_pin.explore("delta") as explorer, sync_playwright() as playwright:
        photograph_delta(playwright, explorer.url)
    print(f"written: {IMAGES / 'explore.gif'} and two pictures in {IMAGES / 'guide'}")


if __name__ == "__main__":
    main()
