"""Web server for meshcat's viewer: runs in a thread of this process and listens on 127.0.0.1 only.

The Host and Origin headers of every request must name this server. Otherwise another web page could talk to it through
the user's browser (DNS rebinding, cross-site WebSockets).
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Mapping
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any

import msgspec
from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ckc_pin.errors import InputError
from ckc_pin.view.commands import SEVERAL, Command, SceneState
from ckc_pin.view.page import read_live_script, read_viewer_script

__all__ = ["ViewServer"]

LOOPBACK = "127.0.0.1"
MAX_MESSAGE_BYTES = 2**16  # from a viewer; they are a few hundred bytes long
CLOSING_TIMEOUT_S = 0.5  # for a viewer to answer the closing handshake

# The page loads from, and sends to, this server only. Inline styles are allowed because dat.gui creates a style sheet.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self' ws://{host}; frame-ancestors {ancestors}; base-uri 'none'; form-action 'none'"
)


class ViewServer:
    """A server that shows a scene in any number of browsers. A browser that connects later sees the current scene.

    Parameters
    ----------
    page : str
        The HTML at ``folder``.
    port : int
        0: any free port.
    script : str, optional
        The script of the page, ``start.js``; the default is that of playback.
    folder : str
        Path below which everything is served. Nothing exists outside of it.
    ancestors : str
        Pages that may show this one in a frame, as in the header Content-Security-Policy.

    Raises
    ------
    InputError
        The port is invalid or in use; meshcat is not installed.

    Attributes
    ----------
    url : str
    port : int

    Examples
    --------
    >>> with ViewServer(render_server_page("empty", [])) as server:  # doctest: +SKIP
    ...     server.send(set_property("/Axes", "visible", False))
    """

    def __init__(
        self, page: str, port: int = 0, *, script: str | None = None, folder: str = "/", ancestors: str = "'none'"
    ) -> None:
        if not 0 <= port <= 65535:
            raise InputError(f"port {port}: choose one from 1 to 65535, or 0 for any free one")
        start = read_live_script() if script is None else script
        scripts: Mapping[str, bytes | str] = {"main.min.js": read_viewer_script(), "start.js": start}
        self._socket = _listen(port)
        self.port = int(self._socket.getsockname()[1])
        self.url = f"http://{LOOPBACK}:{self.port}{folder}"
        self.hosts = {f"{name}:{self.port}" for name in (LOOPBACK, "localhost")}
        self.scene_state = SceneState()
        self.viewers: set[_Viewer] = set()
        routes: list[Any] = [(folder, _Viewer, {"server": self, "page": page, "ancestors": ancestors})]
        routes += [
            (f"{folder}{name}", _Script, {"server": self, "content": content}) for name, content in scripts.items()
        ]
        self._application = Application(
            routes,
            default_handler_class=_NotFound,
            default_handler_args={"server": self},
            websocket_max_message_size=MAX_MESSAGE_BYTES,
            log_function=lambda handler: None,
        )
        self._scene_lock = Lock()
        self._ready = Event()
        self._thread = Thread(target=lambda: asyncio.run(self._serve()), name="ckc_pin view", daemon=True)
        self._thread.start()
        self._ready.wait()

    def send(self, command: Command) -> None:
        """Send a drawing command to all connected viewers and keep it for later ones. Any thread may call this.

        The call does not wait for viewers. A group of commands is a live frame: a viewer that has not yet shown the
        previous frame skips all but the newest one.
        """
        with self._scene_lock:
            message = self.scene_state.apply(command)
        self._loop.call_soon_threadsafe(self._show, message, command["type"])

    def stop(self) -> None:
        """Close all connections and the port, and wait for the thread to end."""
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
        viewers = list(self.viewers)
        for viewer in viewers:
            if viewer.next_frame is not None:
                viewer.send(viewer.next_frame)
            viewer.close(1001, "stopped")
        if viewers:
            closing = [asyncio.ensure_future(viewer.closed.wait()) for viewer in viewers]
            await asyncio.wait(closing, timeout=CLOSING_TIMEOUT_S)
        for viewer in list(self.viewers):
            viewer.abort()

    def _show(self, message: bytes, kind: str) -> None:
        for viewer in list(self.viewers):
            if kind == SEVERAL:
                viewer.send_frame(message)
                continue
            if kind == "delete":  # A waiting frame would draw the deleted objects again.
                viewer.next_frame = None
            viewer.send(message)

    def receive(self, message: str | bytes, reply: Callable[[Command], None]) -> bool:
        """Handle a viewer's message; return whether the viewer has shown the last frame.

        Every message of a playback page says that. `reply` sends a command to this viewer alone.
        """
        return True

    def add_viewer(self, viewer: _Viewer) -> None:
        """Send the current scene to a new viewer, and all later commands too."""
        with self._scene_lock:
            messages = self.scene_state.messages()
        for message in messages:
            viewer.send(message)
        self.viewers.add(viewer)


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # for ports that were closed just now
        listener.bind((LOOPBACK, port))
        listener.listen(16)
    except OSError as error:
        listener.close()
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"port {port} on {LOOPBACK}: {reason}; choose another, or 0 for any free one") from None
    listener.setblocking(False)
    return listener


def _ignore_closed(sending: asyncio.Future[None]) -> None:
    """Ignore that a viewer disconnected while a message was sent; `on_close` follows. Raise any other error."""
    if not sending.cancelled() and not isinstance(sending.exception(), WebSocketClosedError | None):
        sending.result()


class _SameOriginHandler(RequestHandler):
    """Base of all handlers: rejects requests whose Host or Origin is not this server."""

    def initialize(self, server: ViewServer, **rest: Any) -> None:
        self.server = server

    def prepare(self) -> None:
        origin = self.request.headers.get("Origin")
        if self.request.headers.get("Host", "") not in self.server.hosts:
            raise HTTPError(403)
        if origin is not None and not self.is_same_origin(origin):
            raise HTTPError(403)

    def is_same_origin(self, origin: str) -> bool:
        """Return whether pages of an origin may use this server."""
        return origin.removeprefix("http://") in self.server.hosts and origin.startswith("http://")

    def set_default_headers(self) -> None:
        self.set_header("Server", "ckc_pin")
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")

    def log_exception(self, *error: Any) -> None:
        if error[0] is None or not issubclass(error[0], HTTPError):  # rejected requests are not logged
            super().log_exception(*error)


class _NotFound(_SameOriginHandler):
    def get(self) -> None:
        raise HTTPError(404)


class _Script(_SameOriginHandler):
    def initialize(self, server: ViewServer, content: bytes | str = "", **rest: Any) -> None:
        super().initialize(server)
        self.content = content

    def get(self) -> None:
        self.set_header("Content-Type", "text/javascript; charset=utf-8")
        self.write(self.content)


class _Viewer(_SameOriginHandler, WebSocketHandler):
    """The page, and the WebSocket that the page opens at the same address."""

    def initialize(self, server: ViewServer, page: str = "", ancestors: str = "", **rest: Any) -> None:
        super().initialize(server)
        self.page = page
        self.ancestors = ancestors
        self.closed = asyncio.Event()
        self.is_busy = False  # has not yet answered that it has shown the last frame
        self.next_frame: bytes | None = None  # sent after that answer

    async def get(self, *args: Any, **kwargs: Any) -> None:
        if self.request.headers.get("Upgrade", "").lower() == "websocket":
            await super().get(*args, **kwargs)
            return
        self.set_header("Content-Type", "text/html; charset=utf-8")
        policy = POLICY.format(host=self.request.headers["Host"], ancestors=self.ancestors)
        self.set_header("Content-Security-Policy", policy)
        self.finish(self.page)

    def check_origin(self, origin: str) -> bool:
        return self.is_same_origin(origin)

    def open(self, *args: str, **kwargs: str) -> None:
        self.server.add_viewer(self)

    def send(self, message: bytes) -> None:
        try:
            sending = asyncio.ensure_future(self.write_message(message, binary=True))
        except WebSocketClosedError:
            return
        sending.add_done_callback(_ignore_closed)

    def send_frame(self, message: bytes) -> None:
        """Send a live frame now, or after the previous one has been shown unless a newer one replaces it."""
        if self.is_busy:
            self.next_frame = message
            return
        self.is_busy = True
        self.send(message)

    def on_message(self, message: str | bytes) -> None:
        """Handle a message. If the last frame has been shown, send the waiting one."""
        if not self.server.receive(message, self.reply):
            return
        self.is_busy, next_frame, self.next_frame = False, self.next_frame, None
        if next_frame is not None:
            self.send_frame(next_frame)

    def reply(self, command: Command) -> None:
        self.send(msgspec.msgpack.encode(command))

    def on_close(self) -> None:
        self.server.viewers.discard(self)
        self.closed.set()

    def abort(self) -> None:
        """Close the connection without waiting for the viewer's answer."""
        if self.ws_connection is not None and self.ws_connection.stream is not None:
            self.ws_connection.stream.close()
