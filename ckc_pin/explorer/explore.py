"""Explore a mechanism in the browser: `explore`, and the `Explorer` that it returns."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from html import escape
from os.path import isdir
from pathlib import Path
from threading import Event, Thread
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.validation import require_flag, require_path, require_table, require_type
from ckc_pin.errors import InputError
from ckc_pin.explorer.opening import open_explored
from ckc_pin.explorer.request_queue import RequestQueue
from ckc_pin.explorer.session import Session
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import Scene
from ckc_pin.view.player import open_in_browser

if TYPE_CHECKING:
    from ckc_pin.explorer.server import ExploreServer

__all__ = ["Explorer", "explore"]

FRAME_S = 1.0 / 60.0  # shortest time between two frames
PAGE_HEIGHT_PX = 640  # in a notebook


def explore(
    what: Mechanism | Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    out: str | Path | None = None,
    port: int = 0,
    token: str = "",
    open_browser: bool = False,
) -> Explorer:
    """Take hold of a mechanism in the browser: drag it with its loops closed, change it, and run it.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
        A mechanism or a scene: itself, its shipped name or its path. With a scene, a run is under its controller.
    overrides : mapping, optional
        Values by dotted key, as for `load` and `load_scene`.
    out : str or Path, optional
        An existing folder that "save" writes into; default: the working directory.
    port : int
        On 127.0.0.1; 0: any free port.
    token : str
        Path of the page, at least 16 letters, digits, hyphens and underscores; default: a random one. A page that was
        open finds an explorer that is started again with the same port and token.
    open_browser : bool
        Also open the address in the default browser.

    Returns
    -------
    Explorer
        It runs in threads of its own until its `stop`. A notebook shows it below the cell.

    Raises
    ------
    InputError, MechanismError
        The mechanism or scene cannot be loaded; a port in use; meshcat is not installed. A mechanism whose loops cannot
        be closed is shown with its open loops.

    Examples
    --------
    >>> explore("five_bar").wait()  # doctest: +SKIP
    """
    if overrides is not None:
        require_table(overrides, "explore: overrides", 'values by dotted key, as {"link.link_2.mass": 0.3}')
    require_type(port, int, "explore: port", "a port from 1 to 65535, or 0 for any free one")
    require_type(token, str, "explore: token", "a string")
    require_flag(open_browser, "explore: open_browser")
    if out is not None:
        require_path(out, "explore: out", "a folder")
    folder = Path(out or "")
    if not isdir(folder):
        raise InputError(f"explore: out = {folder}: no such folder; make it first")
    explorer = Explorer(what, dict(overrides) if overrides else None, folder, port, token)
    if open_browser:
        open_in_browser(explorer.url)
    return explorer


class Explorer:
    """A mechanism that any number of pages in the browser show and move together.

    Attributes
    ----------
    url : str
        Address of the page, on this machine only.
    """

    def __init__(self, what: Any, overrides: dict[str, Any] | None, folder: Path, port: int, token: str) -> None:
        opened = open_explored(what, overrides)
        self._queue: RequestQueue = RequestQueue()
        self._stopped = Event()
        self._error: BaseException | None = None
        self._server = _start_server(opened.name, self._queue.put, port, token)
        self.url = self._server.url
        self._name = opened.name
        self._session = Session(opened, self._server.send, self._queue.put, folder)
        self._thread = Thread(target=self._run_thread, name="ckc_pin explorer", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until `stop` is called from another thread, or until Ctrl-C."""
        self._stopped.wait()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End the server; pages that are open say so."""
        self._stopped.set()
        self._queue.put(lambda: None)  # The thread may be about to wait for a request.
        self._thread.join()
        self._server.stop()

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        return f"Explorer of {self._name} at {self.url}"

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{escape(self.url, quote=True)}" width="100%" height="{PAGE_HEIGHT_PX}" '
            'style="border: 1px solid #ddd"></iframe>'
        )

    # --- in the explorer's thread ----------------------------------------------------------------

    def _run_thread(self) -> None:
        try:
            with one_blas_thread():
                self._work()
        except Exception as error:  # A defect: the pages show it, and `wait` raises it.
            traceback.print_exc()
            self._session.notify(f"the explorer has ended: {error!r}; start it again", is_error=True)
            self._error = error
            self._stopped.set()
        finally:
            self._session.close()

    def _work(self) -> None:
        session, next_frame, has_changed = self._session, 0.0, False
        while not self._stopped.is_set():
            remaining = max(0.0, next_frame - perf_counter()) if session.is_active or has_changed else None
            request = self._queue.take(remaining)
            while request is not None:
                _execute(session, request)
                has_changed = True
                # Requests may come faster than they are handled; frames are sent all the same.
                request = self._queue.take(0.0) if perf_counter() < next_frame else None
            if (session.is_active or has_changed) and perf_counter() >= next_frame:
                next_frame, has_changed = perf_counter() + FRAME_S, False
                session.advance()
                session.send_frame()


def _execute(session: Session, request: Any) -> None:
    """Handle a request of a page, or call a function that another thread has posted."""
    if callable(request):
        request()
    else:
        session.handle(request)


def _start_server(name: str, on_request: Callable[[Any], None], port: int, token: str) -> ExploreServer:
    try:
        from ckc_pin.explorer.server import ExploreServer
    except ModuleNotFoundError:
        raise InputError("the explorer needs meshcat and tornado: pip install 'ckc_pin[view]'") from None
    return ExploreServer(name, on_request, port, token)
