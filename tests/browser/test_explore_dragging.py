"""Dragging of bodies in the explorer's page, compared with projections that NumPy computes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin.explorer import messages
from ckc_pin.view import commands
from tests.browser.explorer import ROOT, StandIn, five_bar, open_explorer, program
from tests.browser.pages import Visit, browser, look_at, tabs

__all__ = ["browser", "five_bar", "look_at", "program", "tabs"]

VIEW = """() => {
  viewer.scene.updateMatrixWorld(true);
  const box = viewer.renderer.domElement.getBoundingClientRect();
  const columns = [viewer.camera.projectionMatrix, viewer.camera.matrixWorldInverse,
                   viewer.scene_tree.find(["world"]).object.matrixWorld].map(one => one.elements);
  return [columns, [box.left, box.top, box.width, box.height]];
}"""

# Whether the line from the grabbed point to the target is visible, and its ends.
LINE = """() => {
  const line = viewer.scene.children.find(one => one.type === "Line"), position = line.geometry.attributes.position;
  const ends = [0, 1].map(k => new MeshCat.THREE.Vector3().fromBufferAttribute(position, k));
  return [line.visible, ...ends.map(end => line.localToWorld(end).toArray())];
}"""


class View:
    """Projection of points of the mechanism's world into the window, and back to rays, in NumPy."""

    def __init__(self, visit: Visit) -> None:
        columns, self.box = visit.page.evaluate(VIEW)
        self.projection, self.camera, self.world = (np.array(one).reshape(4, 4).T for one in columns)
        self.to_clip = self.projection @ self.camera @ self.world
        self.eye = np.linalg.solve(self.camera @ self.world, [0.0, 0.0, 0.0, 1.0])[:3]
        self.direction = -np.linalg.inv(self.camera @ self.world)[:3, 2]

    def project(self, point: np.ndarray) -> tuple[float, float]:
        clip = self.to_clip @ [*point, 1.0]
        x, y = clip[:2] / clip[3]
        x_0, y_0, width, height = self.box
        return x_0 + (x + 1) / 2 * width, y_0 + (1 - y) / 2 * height

    def ray(self, x: float, y: float) -> np.ndarray:
        """Return the direction of the ray from the eye through a place of the window."""
        x_0, y_0, width, height = self.box
        far = np.linalg.solve(self.to_clip, [2 * (x - x_0) / width - 1, 1 - 2 * (y - y_0) / height, 1.0, 1.0])
        direction = far[:3] / far[3] - self.eye
        return direction / np.linalg.norm(direction)

    def meet_plane(self, x: float, y: float, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        ray = self.ray(x, y)
        return self.eye + ray * ((point - self.eye) @ normal) / (ray @ normal)


def meet_box(eye: np.ndarray, ray: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return where a ray enters a box about the origin (slab method)."""
    ends = np.sort([(-size / 2 - eye) / ray, (size / 2 - eye) / ray], axis=0)
    assert ends[0].max() < ends[1].min()
    return eye + ray * ends[0].max()


SIZE = np.array([0.1, 0.06, 0.04])
PLACEMENT = np.eye(4)
PLACEMENT[:3, :3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]


def add_box(program: StandIn, position: np.ndarray, **overrides: Any) -> np.ndarray:
    """Add a body that is a box in front of the mechanism, and return its placement."""
    placement = PLACEMENT.copy()
    placement[:3, 3] = position
    path = f"{ROOT}/joint:box"
    program.server.send(
        commands.draw_primitive(f"{path}/link", "box", SIZE, np.eye(4), commands.create_material((1, 0, 0)))
    )
    program.server.send(commands.set_transform(path, placement))
    program.report(program.describe(bodies={**program.setup.bodies, "box": path}, **overrides))
    return placement


@pytest.mark.parametrize("name", ["five_bar", "delta"])
def test_dragged_body_sends_point_and_target_in_the_plane_of_the_screen(look_at, program, name):
    stand_in = program(name)
    visit = open_explorer(look_at, stand_in)
    view = View(visit)
    centre = view.eye + 0.5 * view.direction * (view.projection[1, 1] > 0)
    placement = add_box(stand_in, centre)
    visit.until("viewer.scene_tree.find(['world', 'explored']).children['joint:box']")
    visit.page.wait_for_timeout(200)
    x, y = np.round(view.project(centre)) + np.array([7, 4])
    camera = visit.page.evaluate("() => viewer.camera.position.toArray()")
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    visit.page.mouse.move(x + 40, y - 25)
    (drag,) = stand_in.take(1)
    back = np.linalg.inv(placement)
    eye, ray = (back @ [*view.eye, 1.0])[:3], back[:3, :3] @ view.ray(x, y)
    point = meet_box(eye, ray, SIZE)
    assert drag.body == "box"
    np.testing.assert_allclose(drag.point, point, atol=1e-6)
    grabbed = (placement @ [*point, 1.0])[:3]
    np.testing.assert_allclose(drag.normal, view.direction, atol=1e-6)
    np.testing.assert_allclose(drag.target, view.meet_plane(x + 40, y - 25, grabbed, view.direction), atol=1e-6)
    is_visible, *ends = visit.page.evaluate(LINE)
    assert is_visible
    world = view.world @ np.transpose([[*grabbed, 1.0], [*drag.target, 1.0]])
    np.testing.assert_allclose(np.transpose(ends), world[:3], atol=1e-6)
    visit.page.mouse.up()
    assert stand_in.take(1) == [messages.Release()]
    assert not visit.page.evaluate(LINE)[0]
    assert visit.page.evaluate("() => viewer.camera.position.toArray()") == camera


def test_planar_mechanism_is_dragged_in_its_plane_unless_seen_edge_on(look_at, program):
    planar = program("five_bar", normal=[0.0, 0.0, 1.0])
    visit = open_explorer(look_at, planar)
    # Turn the view, so that the plane of the screen is another one.
    visit.page.mouse.move(60, 480)
    visit.page.mouse.down()
    visit.page.mouse.move(140, 430, steps=4)
    visit.page.mouse.up()
    planar.take(0)
    visit.page.wait_for_timeout(200)
    view = View(visit)
    assert abs(view.direction[2]) < 0.95
    placement = planar.placements["theta_2"]
    length = 0.1
    x, y = view.project((placement @ [length, 0, 0, 1])[:3])
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    visit.page.mouse.move(x + 30, y + 20)
    (drag,) = planar.take(1)
    visit.page.mouse.up()
    planar.take(1)
    assert drag.body == "theta_2"
    assert drag.point[0] == pytest.approx(length, abs=0.03)
    grabbed = (placement @ [*drag.point, 1.0])[:3]
    np.testing.assert_allclose(np.cross(grabbed - view.eye, view.ray(x, y)), 0, atol=1e-6)  # on the ray
    np.testing.assert_allclose(drag.normal, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(drag.target, view.meet_plane(x + 30, y + 20, grabbed, np.array([0, 0, 1])), atol=1e-6)
    across = np.cross(view.direction, [0.0, 0.0, 1.0])
    planar.report(planar.describe(normal=list(across / np.linalg.norm(across))))
    visit.page.wait_for_timeout(200)
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    visit.page.mouse.move(x + 30, y + 20)
    (drag,) = planar.take(1)
    visit.page.mouse.up()
    planar.take(1)
    np.testing.assert_allclose(drag.normal, view.direction, atol=1e-6)


def test_named_point_near_the_pointer_is_preferred(look_at, program):
    stand_in = program("five_bar", points={"tip": ["theta_2", 0.2, 0.01, 0.0]})
    visit = open_explorer(look_at, stand_in)
    view = View(visit)
    tip = (stand_in.placements["theta_2"] @ [0.2, 0.01, 0.0, 1.0])[:3]
    x, y = view.project(tip)
    visit.page.mouse.move(x + 9, y - 6)  # the pointer keeps its distance from the point
    visit.page.mouse.down()
    visit.page.mouse.move(x + 29, y + 4)
    (drag,) = stand_in.take(1)
    visit.page.mouse.up()
    stand_in.take(1)
    assert (drag.body, drag.point) == ("theta_2", [0.2, 0.01, 0.0])
    np.testing.assert_allclose(drag.target, view.meet_plane(x + 20, y + 10, tip, view.direction), atol=1e-5)


def test_background_turns_the_view_and_a_click_does_not_drag(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    view = View(visit)
    x, y = view.project(five_bar.placements["theta_2"][:3, 3])
    visit.page.mouse.click(x, y)
    before = visit.page.evaluate("() => viewer.camera.position.toArray()")
    visit.page.mouse.move(40, 500)
    visit.page.mouse.down()
    visit.page.mouse.move(120, 480, steps=3)
    visit.page.mouse.up()
    after = visit.page.evaluate("() => viewer.camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 0.01
    five_bar.take(0)


def test_escape_ends_the_drag(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    x, y = View(visit).project(five_bar.placements["theta_2"][:3, 3])
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    visit.page.mouse.move(x + 10, y)
    five_bar.take(1)
    visit.page.keyboard.press("Escape")
    assert five_bar.take(1) == [messages.Release()]
    visit.page.mouse.move(x + 30, y)
    visit.page.mouse.up()
    five_bar.take(0)


def test_drag_sends_one_message_per_animation_frame(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    x, y = View(visit).project(five_bar.placements["theta_2"][:3, 3])
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    counted = visit.page.evaluate(
        """([x, y]) => new Promise(resolve => {
          const pane = document.getElementById("meshcat-pane"), send = WebSocket.prototype.send;
          let sent = 0;
          WebSocket.prototype.send = function (text) { sent += 1; send.call(this, text); };
          requestAnimationFrame(() => {
            for (let k = 1; k <= 50; k += 1) {
              pane.dispatchEvent(new PointerEvent("pointermove", {pointerId: 1, clientX: x + k, clientY: y}));
            }
            requestAnimationFrame(() => requestAnimationFrame(() => {
              WebSocket.prototype.send = send;
              resolve(sent);
            }));
          });
        })""",
        [x, y],
    )
    assert counted == 1
    visit.page.mouse.up()
    assert [type(one) for one in five_bar.take(2)] == [messages.Drag, messages.Release]


class Fingers:
    """Touches of a page."""

    def __init__(self, visit: Visit) -> None:
        self.session = visit.page.context.new_cdp_session(visit.page)

    def put(self, kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_finger_drags_a_body(look_at, five_bar):
    visit = open_explorer(look_at, five_bar, has_touch=True)
    view = View(visit)
    joint = five_bar.placements["theta_2"]
    x, y = view.project((joint @ [0.1, 0, 0, 1])[:3])
    across = np.array(view.project((joint @ [0.1, 0.1, 0, 1])[:3])) - [x, y]
    x, y = np.array([x, y]) + 14 * across / np.linalg.norm(across)  # a finger may miss a thin link
    fingers = Fingers(visit)
    fingers.put("touchStart", (x, y))
    fingers.put("touchMove", (x + 20, y + 5))
    (drag,) = five_bar.take(1)
    assert drag.body == "theta_2"
    grabbed = (joint @ [*drag.point, 1.0])[:3]
    moved = np.subtract(view.project(np.array(drag.target)), view.project(grabbed))
    np.testing.assert_allclose(moved, [20, 5], atol=1.0)
    fingers.put("touchEnd")
    assert five_bar.take(1) == [messages.Release()]


def test_second_finger_ends_the_drag_and_zooms(look_at, five_bar):
    visit = open_explorer(look_at, five_bar, has_touch=True)
    view = View(visit)
    x, y = view.project(five_bar.placements["theta_2"][:3, 3])
    fingers = Fingers(visit)
    fingers.put("touchStart", (x, y))
    fingers.put("touchMove", (x + 5, y))
    five_bar.take(1)
    fingers.put("touchStart", (x + 5, y), (x + 60, y))
    assert five_bar.take(1) == [messages.Release()]
    for k in range(1, 6):
        fingers.put("touchMove", (x + 5 - 8 * k, y), (x + 60 + 8 * k, y))
    fingers.put("touchEnd")
    five_bar.take(0)
    visit.page.wait_for_timeout(100)
    after = View(visit)
    np.testing.assert_allclose(after.direction, view.direction, atol=1e-9)  # it does not turn
    assert (after.eye - view.eye) @ view.direction > 0.1 * np.linalg.norm(view.eye)
    fingers.put("touchStart", (x, y))  # and afterwards a finger drags again
    fingers.put("touchEnd")
