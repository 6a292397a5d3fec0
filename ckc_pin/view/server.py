"""A web server for meshcat's viewer, inside this process, on 127.0.0.1 only.

Host and Origin of every request must be this very server's, or another web page could talk to it through the
reader's browser (DNS rebinding, cross-site WebSockets).
"""

from __future__ import annotations

import asyncio
import socket
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ckc_pin.errors import InputError
from ckc_pin.view.commands import SEVERAL, Command, Stage
from ckc_pin.view.page import START_SCRIPT, viewer_script

__all__ = ["ViewServer"]

LOOPBACK = "127.0.0.1"
MAX_INCOMING = 2**16  # bytes; viewers have little to say
GOODBYE = 0.5  # s that a viewer has to answer a closing handshake

# Nothing is loaded from, or sent to, anywhere else. dat.gui writes its own style sheet.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self' ws://{host}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


class ViewServer:
    """Shows a scene to any number of browsers; one that comes later or reloads sees it as it is by then.

    Parameters
    ----------
    page : str
        The HTML at ``/``.
    port : int
        0: any free one.

    Raises
    ------
    InputError
        No such port, or one in use; meshcat is not installed.

    Attributes
    ----------
    url : str
    port : int

    Examples
    --------
    >>> with ViewServer(page("empty", [])) as server:  # doctest: +SKIP
    ...     server.send(set_property("/Axes", "visible", False))
    """

    def __init__(self, page: str, port: int = 0) -> None:
        if not 0 <= port <= 65535:
            raise InputError(f"port {port}: choose one from 1 to 65535, or 0 for any free one")
        files = {"main.min.js": ("text/javascript", viewer_script()), "start.js": ("text/javascript", START_SCRIPT)}
        self._socket = _listen(port)
        self.port = int(self._socket.getsockname()[1])
        self.url = f"http://{LOOPBACK}:{self.port}/"
        self.hosts = {f"{name}:{self.port}" for name in (LOOPBACK, "localhost")}
        self.stage = Stage()
        self.viewers: set[_Viewer] = set()
        routes: list[Any] = [("/", _Viewer, {"server": self, "page": page})]
        routes += [(f"/{name}", _File, {"server": self, "kind": kind, "content": content})
                   for name, (kind, content) in files.items()]  # fmt: skip
        self._application = Application(
            routes,
            default_handler_class=_Nothing,
            default_handler_args={"server": self},
            websocket_max_message_size=MAX_INCOMING,
            log_function=lambda handler: None,
        )
        self._drawing = Lock()
        self._ready = Event()
        self._thread = Thread(target=lambda: asyncio.run(self._serve()), name="ckc_pin view", daemon=True)
        self._thread.start()
        self._ready.wait()

    def send(self, command: Command) -> None:
        """Draw: for the viewers that are there, and for those to come. From any thread, which never waits.

        `several` things make a frame: a viewer that has not shown the last one yet misses all but the newest.
        """
        with self._drawing:
            message = self.stage.apply(command)
        self._loop.call_soon_threadsafe(self._show, message, command["type"])

    def stop(self) -> None:
        """Close every connection and the port; when this returns the thread is gone."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()

    def __enter__(self) -> ViewServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    # --- in the server's thread ------------------------------------------------------------------

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        server = HTTPServer(self._application)
        server.add_socket(self._socket)
        self._ready.set()
        await self._stop.wait()
        server.stop()
        await server.close_all_connections()
        leaving = list(self.viewers)
        for viewer in leaving:
            if viewer.newest is not None:
                viewer.show(viewer.newest)
            viewer.close(1001, "stopped")
        if leaving:
            await asyncio.wait([asyncio.ensure_future(viewer.gone.wait()) for viewer in leaving], timeout=GOODBYE)
        for viewer in list(self.viewers):
            viewer.hang_up()

    def _show(self, message: bytes, kind: str) -> None:
        for viewer in list(self.viewers):
            if kind == SEVERAL:
                viewer.show_frame(message)
                continue
            if kind == "delete":  # nor is a frame to come that would draw it again
                viewer.newest = None
            viewer.show(message)

    def welcome(self, viewer: _Viewer) -> None:
        """Draw the scene as it is for a viewer that has just come, and keep it informed."""
        with self._drawing:
            messages = self.stage.messages()
        for message in messages:
            viewer.show(message)
        self.viewers.add(viewer)


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port just left is free
        listener.bind((LOOPBACK, port))
        listener.listen(16)
    except OSError as error:
        listener.close()
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"port {port} on {LOOPBACK}: {reason}; choose another, or 0 for any free one") from None
    listener.setblocking(False)
    return listener


def _forget(sent: asyncio.Future[None]) -> None:
    """A viewer that went away while it was told something is no error; `on_close` follows."""
    if not sent.cancelled() and not isinstance(sent.exception(), WebSocketClosedError | None):
        sent.result()


class _OwnOnly(RequestHandler):
    """Answers only requests that were meant for this server."""

    def initialize(self, server: ViewServer, **rest: Any) -> None:
        self.server = server

    def prepare(self) -> None:
        origin = self.request.headers.get("Origin")
        if self.request.headers.get("Host", "") not in self.server.hosts:
            raise HTTPError(403)
        if origin is not None and not self.own(origin):
            raise HTTPError(403)

    def own(self, origin: str) -> bool:
        """Whether a page of this origin may talk to us."""
        return origin.removeprefix("http://") in self.server.hosts and origin.startswith("http://")

    def set_default_headers(self) -> None:
        self.set_header("Server", "ckc_pin")
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")

    def log_exception(self, *error: Any) -> None:
        if error[0] is None or not issubclass(error[0], HTTPError):  # a refusal is no news
            super().log_exception(*error)


class _Nothing(_OwnOnly):
    def get(self) -> None:
        raise HTTPError(404)


class _File(_OwnOnly):
    def initialize(self, server: ViewServer, kind: str = "", content: bytes | str = "", **rest: Any) -> None:
        super().initialize(server)
        self.kind, self.content = kind, content

    def get(self) -> None:
        self.set_header("Content-Type", f"{self.kind}; charset=utf-8")
        self.write(self.content)


class _Viewer(_OwnOnly, WebSocketHandler):
    """The page at ``/``, and the WebSocket that the page opens at the same place."""

    def initialize(self, server: ViewServer, page: str = "", **rest: Any) -> None:
        super().initialize(server)
        self.page = page
        self.gone = asyncio.Event()
        self.busy = False  # with a frame
        self.newest: bytes | None = None  # frame that came meanwhile

    async def get(self, *args: Any, **kwargs: Any) -> None:
        if self.request.headers.get("Upgrade", "").lower() == "websocket":
            await super().get(*args, **kwargs)
            return
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.set_header("Content-Security-Policy", POLICY.format(host=self.request.headers["Host"]))
        self.finish(self.page)

    def check_origin(self, origin: str) -> bool:
        return self.own(origin)

    def open(self, *args: str, **kwargs: str) -> None:
        self.server.welcome(self)

    def show(self, message: bytes) -> None:
        try:
            sent = asyncio.ensure_future(self.write_message(message, binary=True))
        except WebSocketClosedError:
            return
        sent.add_done_callback(_forget)

    def show_frame(self, message: bytes) -> None:
        """Show a frame now, or when the one before has been shown and no newer one has come."""
        if self.busy:
            self.newest = message
            return
        self.busy = True
        self.show(message)

    def on_message(self, message: str | bytes) -> None:
        """Take any message for what our page says, that it has shown a frame."""
        self.busy, newest, self.newest = False, self.newest, None
        if newest is not None:
            self.show_frame(newest)

    def on_close(self) -> None:
        self.server.viewers.discard(self)
        self.gone.set()

    def hang_up(self) -> None:
        """Close without waiting for an answer."""
        if self.ws_connection is not None and self.ws_connection.stream is not None:
            self.ws_connection.stream.close()
