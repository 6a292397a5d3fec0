"""A simulation in the browser while it computes.

The integration hands over its output instants and goes on at once. A thread of its own draws the newest one a few times
a second, and only for viewers that have shown the last one: what comes in between is dropped.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from time import perf_counter
from time import sleep as pause
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.scene.parts import scene_mechanism
from ckc_pin.scene.scene import Scene
from ckc_pin.view import bodies, commands
from ckc_pin.view.browser import open_in_browser
from ckc_pin.view.camera import WORLD, extent_of_reach, surroundings
from ckc_pin.view.commands import Command
from ckc_pin.view.drawing import scene as drawing_of
from ckc_pin.view.page import page
from ckc_pin.view.skeleton import placements

if TYPE_CHECKING:
    from ckc_pin.view.server import ViewServer

__all__ = ["LiveView", "live_view"]

FRAMES = 30  # a second, at most
ROOT = f"{WORLD}/live"


@contextmanager
def live_view(
    scene: Scene, speed: float | None, port: int = 0, open_browser: bool = False
) -> Iterator[LiveView | None]:
    """Show a scene's simulation for as long as the context lasts.

    Where that cannot be (a port in use, meshcat missing, shapes that cannot be drawn) it says so and gives None: a view
    never keeps a run from being computed.
    """
    try:
        view = LiveView(scene, speed, port)
    except InputError as error:
        print(f"no live view: {error}; the run goes on without", file=sys.stderr)
        yield None
        return
    with view.server:
        print(f"watch it at {view.server.url}", file=sys.stderr, flush=True)
        if open_browser:
            open_in_browser(view.server.url)
        try:
            yield view
        finally:
            view.stop()


class LiveView:
    """Draws output instants as they come.

    Parameters
    ----------
    scene : Scene
    speed : float or None
        Show so many seconds of the simulation in a second, as far as they are computed; None: the newest.
    port : int

    Raises
    ------
    InputError
        A port in use, meshcat missing, a drawing that cannot be.
    """

    def __init__(self, scene: Scene, speed: float | None, port: int = 0) -> None:
        self.mechanism = scene_mechanism(scene)  # its own: the integration's must not be used by another thread
        self.t_end, self.speed = scene.spec.t_end, speed
        drawing = _drawing(self.mechanism)
        self.server = _serve(scene.name, port)
        for command in drawing:
            self.server.send(command)
        self._frames: deque[tuple[float, Array]] = deque(maxlen=1 if speed is None else None)
        self._last: tuple[float, Array] | None = None
        self._began: float | None = None
        self._ended = Event()
        self._thread = Thread(target=self._draw, name="ckc_pin live view", daemon=True)
        self._thread.start()

    def on_output(self, t: float, q_tree: Array) -> None:
        """Take an output instant: `simulate`'s output callback. Costs next to nothing, whatever the viewers do."""
        self._began = self._began or perf_counter()
        self._frames.append((t, q_tree))

    def finish(self, run: Run, *, stay: bool) -> None:
        """Wait until a slower view has come to the end; to stay is to go on with playback until Ctrl-C."""
        if self.speed is not None and self._began is not None:
            pause(max(0.0, self._began + float(run.t[-1]) / self.speed - perf_counter()))
        self.stop()
        if stay:
            self.play_back(run)
            print(f"played back at {self.server.url}  (Ctrl-C ends)", file=sys.stderr, flush=True)
            Event().wait()

    def play_back(self, run: Run) -> None:
        """Put the playback of the run in the place of its last instant."""
        self.server.send(commands.delete(WORLD))
        self.server.send(commands.say(""))
        for command in drawing_of([run], speed=self.speed or 1.0):
            self.server.send(command)

    def stop(self) -> None:
        """Draw the last instant; nothing is drawn any more when this returns."""
        self._ended.set()
        self._thread.join()

    # --- in the view's thread --------------------------------------------------------------------

    def _draw(self) -> None:
        while not self._ended.wait(1.0 / FRAMES):
            self._draw_newest()
        self._draw_newest()

    def _draw_newest(self) -> None:
        due = self._due()
        self._last = due or self._last
        if self._last is not None and self.server.viewers:  # nobody there: nothing to compute
            self.server.send(self._frame(*self._last))
            self._last = None

    def _due(self) -> tuple[float, Array] | None:
        """Return the newest instant whose time has come; those before it are dropped."""
        until = float("inf")
        if self.speed is not None and self._began is not None:
            until = self.speed * (perf_counter() - self._began)
        found = None
        while self._frames and self._frames[0][0] <= until:
            found = self._frames.popleft()
        return found

    def _frame(self, t: float, q_tree: Array) -> Command:
        tree = self.mechanism.tree
        moved = placements(self.mechanism, tree.from_coordinates(q_tree)[None])
        placed = [
            commands.set_transform(
                bodies.body_path(self.mechanism, ROOT, joint),
                _matrix(moved.rotation[0, joint], moved.translation[0, joint]),
            )
            for joint in range(1, tree.model.njoints)
        ]
        return commands.several([*placed, commands.say(f"t = {t:.2f} of {self.t_end:g} s")])


def _drawing(mechanism: Mechanism) -> list[Command]:
    moved = placements(mechanism, mechanism.q_tree[None])
    return [
        *surroundings(mechanism, extent_of_reach(mechanism, moved)),
        *bodies.draw_bodies(mechanism, ROOT, moved, bodies.SOLID),
        *bodies.draw_loop_frames(mechanism, ROOT, bodies.SOLID),
    ]


def _serve(title: str, port: int) -> ViewServer:
    try:
        from ckc_pin.view.server import ViewServer
    except ModuleNotFoundError:
        raise InputError("playback needs meshcat and its tornado: pip install 'ckc_pin[view]'") from None
    return ViewServer(page(title, []), port)


def _matrix(rotation: Array, translation: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix
