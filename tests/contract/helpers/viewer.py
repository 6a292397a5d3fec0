"""A minimal viewer, answers of a server, and the addresses that a process listens on."""

from __future__ import annotations

import os
import socket
import struct
from http.client import HTTPConnection
from pathlib import Path

from ckc_pin.view.server import ViewServer

__all__ = ["listening", "raw_viewer", "status", "vanish"]


def raw_viewer(server: ViewServer) -> socket.socket:
    """A WebSocket opened by hand, which never answers anything."""
    viewer = socket.create_connection(("127.0.0.1", server.port), timeout=20)
    viewer.sendall(
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    assert viewer.recv(12) == b"HTTP/1.1 101"
    return viewer


def status(server: ViewServer, path: str, **headers: str) -> int:
    """Return the status of the answer to a GET request with some headers."""
    connection = HTTPConnection("127.0.0.1", server.port, timeout=20)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status


def vanish(viewer: socket.socket) -> None:
    """Reset the connection, as when a machine goes down."""
    viewer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    viewer.close()


def listening(pid: int | str = "self") -> set[str]:
    """Addresses that a process listens on, "IP:PORT" in hexadecimals as in the kernel's tables."""
    folder = Path(f"/proc/{pid}")
    sockets = set()
    for name in os.listdir(folder / "fd"):
        try:
            sockets.add(os.readlink(folder / "fd" / name))
        except FileNotFoundError:  # closed meanwhile
            continue
    addresses = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in (folder / "net" / table).read_text().splitlines()[1:]:
            fields = line.split()
            if f"socket:[{fields[9]}]" in sockets and (table.startswith("udp") or fields[3] == "0A"):
                addresses.add(fields[1])
    return addresses
