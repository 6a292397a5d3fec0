"""Web server of the explorer: a `ViewServer` that also receives requests of its pages.

A random token in the address keeps out other programs and users of this machine, who could otherwise guess the port.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable
from itertools import count

import msgspec

from ckc_pin.errors import InputError
from ckc_pin.explorer.messages import FrameShown, Notice, Request, read_request
from ckc_pin.explorer.page import read_explore_script, render_explore_page
from ckc_pin.view.commands import Command
from ckc_pin.view.server import ViewServer

__all__ = ["ExploreServer"]

TOKEN_BYTES = 24
TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")
MAX_NOTICE_LENGTH = 300  # characters of a message that quotes an invalid request
NOTEBOOKS = "http://localhost:* http://127.0.0.1:*"  # pages that may show the explorer in a frame


class ExploreServer(ViewServer):
    """A server for the explorer's page, in any number of browsers. All of them see the same scene and reports.

    Send drawing commands by `send`, and reports by ``send(report.to_command())``. The newest report of each kind is
    kept for pages that connect later. Valid requests are passed to `on_request`. Invalid ones are answered with a
    notice.

    Parameters
    ----------
    title : str
        Of the page until the first `Setup` arrives, as plain text.
    on_request : callable
        Called with each `Request` in the server's thread, so it must return at once. It never gets `FrameShown`.
    port : int
        0: any free port.
    token : str, optional
        Path of the page, at least 16 letters, digits, hyphens and underscores; default: a random one. A server that is
        started again with the port and token of an earlier one is found by the pages of the earlier one.

    Raises
    ------
    InputError
        The token or the port is invalid, or the port is in use; meshcat is not installed.

    Attributes
    ----------
    url : str
    port : int
    token : str

    Examples
    --------
    >>> with ExploreServer("five_bar", requests.put) as server:  # doctest: +SKIP
    ...     print(server.url)
    """

    def __init__(self, title: str, on_request: Callable[[Request], None], port: int = 0, token: str = "") -> None:
        self.token = token or secrets.token_urlsafe(TOKEN_BYTES)
        if not TOKEN.fullmatch(self.token):
            raise InputError("token: use 16 to 128 letters, digits, hyphens and underscores")
        self.on_request = on_request
        self._notices = count(1)
        page, script = render_explore_page(title), read_explore_script()
        super().__init__(page, port, script=script, folder=f"/{self.token}/", ancestors=NOTEBOOKS)

    def receive(self, message: str | bytes, reply: Callable[[Command], None]) -> bool:
        """Pass a request on; answer an invalid one with a notice to its page alone."""
        try:
            request = read_request(message)
        except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
            text = f"request refused: {error}"[:MAX_NOTICE_LENGTH]
            reply(Notice(text=text, is_error=True, serial=next(self._notices)).to_command())
            return False
        if isinstance(request, FrameShown):
            return True
        self.on_request(request)
        return False
