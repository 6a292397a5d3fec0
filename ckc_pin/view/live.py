"""Live view: a simulation is shown in the browser while it is computed.

The integration only appends its output times to a queue. A separate thread draws the newest one up to
`MAX_FRAMES_PER_SECOND` times a second, and only for viewers that have shown the previous frame. Other output times are
skipped.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from time import perf_counter
from time import sleep as pause

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import Scene
from ckc_pin.view import bodies, commands
from ckc_pin.view.commands import Command
from ckc_pin.view.drawing import WORLD, draw_runs_3d, estimate_reach, set_camera
from ckc_pin.view.geometry import compute_placements
from ckc_pin.view.player import open_in_browser, start_server

__all__ = ["LiveView", "live_view"]

MAX_FRAMES_PER_SECOND = 30
ROOT = f"{WORLD}/live"


@contextmanager
def live_view(
    scene: Scene, speed: float | None, port: int = 0, open_browser: bool = False
) -> Iterator[LiveView | None]:
    """Show a scene's simulation in the browser for the duration of a ``with`` statement.

    If the view cannot be started (port in use, meshcat not installed, invalid visual), the reason is printed and the
    context's value is None. A missing view never prevents a simulation.
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
    """A page in the browser that follows a running simulation. Its `on_output` is passed to `simulate`.

    Parameters
    ----------
    scene : Scene
    speed : float or None
        Simulated seconds per second, at most as fast as they are computed; None: always the newest output time.
    port : int

    Raises
    ------
    InputError
        A port in use, meshcat not installed, or an invalid visual in a URDF.
    """

    def __init__(self, scene: Scene, speed: float | None, port: int = 0) -> None:
        # The view needs its own mechanism, because a mechanism must not be used by two threads.
        self.mechanism = load_scene_mechanism(scene)
        self.t_end, self.speed = scene.spec.t_end, speed
        drawing = _draw_mechanism(self.mechanism)
        self.server = start_server(scene.name, [], port)
        for command in drawing:
            self.server.send(command)
        self._frames: deque[tuple[float, Array]] = deque(maxlen=1 if speed is None else None)
        self._pending: tuple[float, Array] | None = None
        self._start_time: float | None = None
        self._stopped = Event()
        self._thread = Thread(target=self._run_thread, name="ckc_pin live view", daemon=True)
        self._thread.start()

    def on_output(self, t: float, q_tree: Array) -> None:
        """Queue an output time. This output callback of `simulate` takes microseconds, whatever the viewers do."""
        self._start_time = self._start_time or perf_counter()
        self._frames.append((t, q_tree))

    def finish(self, run: Run, *, stay: bool) -> None:
        """Wait until a view at a set speed has shown the end; with `stay`, play the run back until Ctrl-C."""
        if self.speed is not None and self._start_time is not None:
            pause(max(0.0, self._start_time + float(run.t[-1]) / self.speed - perf_counter()))
        self.stop()
        if stay:
            self.play_back(run)
            print(f"played back at {self.server.url}  (Ctrl-C ends)", file=sys.stderr, flush=True)
            Event().wait()

    def play_back(self, run: Run) -> None:
        """Replace the last frame by the playback of a run."""
        self.server.send(commands.delete(WORLD))
        self.server.send(commands.set_status(""))
        for command in draw_runs_3d([run], speed=self.speed or 1.0):
            self.server.send(command)

    def stop(self) -> None:
        """Draw the last output time and end the thread."""
        self._stopped.set()
        self._thread.join()

    # --- in the view's thread --------------------------------------------------------------------

    def _run_thread(self) -> None:
        while not self._stopped.wait(1.0 / MAX_FRAMES_PER_SECOND):
            self._draw_newest()
        self._draw_newest()

    def _draw_newest(self) -> None:
        due = self._take_due_frame()
        self._pending = due or self._pending
        if self._pending is not None and self.server.viewers:  # Without viewers no frame is computed.
            self.server.send(self._create_frame(*self._pending))
            self._pending = None

    def _take_due_frame(self) -> tuple[float, Array] | None:
        """Return the newest output time that is due; earlier ones are dropped."""
        until = float("inf")
        if self.speed is not None and self._start_time is not None:
            until = self.speed * (perf_counter() - self._start_time)
        frame = None
        while self._frames and self._frames[0][0] <= until:
            frame = self._frames.popleft()
        return frame

    def _create_frame(self, t: float, q_tree: Array) -> Command:
        tree = self.mechanism.tree
        pose = compute_placements(self.mechanism, tree.from_coordinates(q_tree)[None])
        transforms = bodies.place_bodies(self.mechanism, ROOT, pose)
        return commands.group_commands([*transforms, commands.set_status(f"t = {t:.2f} of {self.t_end:g} s")])


def _draw_mechanism(mechanism: Mechanism) -> list[Command]:
    pose = compute_placements(mechanism, mechanism.q_tree[None])
    return [
        *set_camera(mechanism, estimate_reach(mechanism, pose)),
        *bodies.draw_bodies(mechanism, ROOT, pose, bodies.SOLID),
        *bodies.draw_loop_frames(mechanism, ROOT, bodies.SOLID),
    ]
