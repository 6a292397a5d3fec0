"""Decode the messages that a viewer receives."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import msgspec
import numpy as np
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from ckc_pin.view.server import ViewServer

Server = Callable[..., ViewServer]


def messages_to(server: ViewServer, count: int, **headers: str) -> list[dict]:
    """What a viewer that connects now is told in its first messages."""

    async def listen() -> list[bytes]:
        url = server.url.replace("http", "ws")
        connection = await websocket_connect(HTTPRequest(url, headers=headers), max_message_size=2**26)
        messages = [await asyncio.wait_for(connection.read_message(), 20) for _ in range(count)]
        await leave(connection)
        return messages

    return [msgspec.msgpack.decode(message) for message in asyncio.run(listen())]


async def leave(connection: WebSocketClientConnection) -> None:
    connection.close()
    while await connection.read_message() is not None:
        pass


def floats(value: msgspec.msgpack.Ext, columns: int) -> np.ndarray:
    """A Float32Array of the viewer as rows."""
    assert value.code == 0x17
    return np.frombuffer(value.data, dtype="<f4").reshape(-1, columns).astype(float)


def objects(drawing: list[dict]) -> dict[str, dict]:
    return {c["path"]: c["object"] for c in drawing if c["type"] == "set_object"}


def tracks(drawing: list[dict]) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Times, positions and quaternions by path."""
    (animation,) = [c for c in drawing if c["type"] == "set_animation"]
    result = {}
    for one in animation["animations"]:
        position, quaternion = (one["clip"]["tracks"] * 2)[:2]
        if (position["name"], quaternion["name"]) != (".position", ".quaternion"):
            continue
        assert one["clip"]["fps"] == 1  # times are seconds
        times = floats(position["times"], 1)[:, 0]
        result[one["path"]] = times, floats(position["values"], 3), floats(quaternion["values"], 4)
    return result


def matrix(columns: list[float]) -> np.ndarray:
    return np.array(columns).reshape(4, 4).T


def rotated(quaternions: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point turned by quaternions x, y, z, w."""
    vector, w = quaternions[:, :3], quaternions[:, 3:]
    return point + 2 * np.cross(vector, np.cross(vector, point) + w * point)


def placed(drawing: list[dict], path: str = "/world") -> np.ndarray:
    (command,) = [c for c in drawing if c["type"] == "set_transform" and c["path"] == path]
    return matrix(command["matrix"])
