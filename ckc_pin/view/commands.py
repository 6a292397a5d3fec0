"""The language that meshcat's viewer speaks: drawing commands as MessagePack (meshcat's viewer/Readme.md).

They are written here, not by meshcat's Python package: its import brings a ZeroMQ context, IPython and a server that
listens on every interface, and its commands are a few dictionaries of three.js's own format.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.view.visuals import Colour

__all__ = [
    "SEVERAL",
    "Command",
    "Stage",
    "Track",
    "body",
    "delete",
    "material",
    "name_runs",
    "polyline",
    "say",
    "set_animation",
    "set_property",
    "set_transform",
    "several",
    "surface",
]

Command = dict[str, Any]

SEVERAL = "several"

_UINT32, _FLOAT32 = 0x16, 0x17  # msgpack-lite's extension types of a Uint32Array and a Float32Array
_TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # three.js's cylinders lie along y

# What three.js animates, by property.
_KINDS = {"position": "vector3", "quaternion": "quaternion", "scale": "vector3", "visible": "bool"}


@dataclass(frozen=True)
class Track:
    """How an object moves: at times (m,), s, the values of some of its properties.

    These are "position" and "scale" (m, 3), "quaternion" (m, 4) as x, y, z, w, and "visible" (m,) of bool.
    """

    path: str
    times: Array
    values: Mapping[str, Array | BoolArray]


class Stage:
    """The scene as drawn so far, in the messages that draw it again for a viewer that comes later."""

    def __init__(self) -> None:
        self._messages: dict[tuple[str, str], bytes] = {}
        self._animation: bytes | None = None

    def apply(self, command: Command) -> bytes:
        """Take a command into account; return its message."""
        message = msgspec.msgpack.encode(command)
        kind, path = command["type"], command["path"]
        if kind == "set_animation":
            self._animation = message
        elif kind == "delete":
            self._forget(path)
        else:
            self._messages[f"{kind} {command.get('property', '')}", path] = message
        return message

    def _forget(self, path: str) -> None:
        """Forget what is at a path and below, the last frame, and the animation."""
        self._messages = {
            key: message
            for key, message in self._messages.items()
            if not f"{key[1]}/".startswith(f"{path}/") and not key[0].startswith(SEVERAL)
        }
        self._animation = None

    def messages(self) -> list[bytes]:
        """Return the messages that draw the scene from nothing; the animation needs its objects and comes last."""
        return [*self._messages.values(), *([] if self._animation is None else [self._animation])]


def material(colour: Colour, opacity: float = 1.0, on_top: bool = False) -> dict[str, Any]:
    """Return a material; a translucent one lies on opaque ones at the same place, `on_top` on everything."""
    red, green, blue = (round(255 * x) for x in colour)
    plain = {"type": "MeshPhongMaterial", "color": red << 16 | green << 8 | blue, "shininess": 20, "side": 0}
    if opacity < 1:
        plain |= {"transparent": True, "opacity": opacity, "depthWrite": False}
        plain |= {"polygonOffset": True, "polygonOffsetFactor": -1, "polygonOffsetUnits": -1}
    return plain | ({"transparent": True, "depthTest": False} if on_top else {})


def body(
    path: str, shape: str, size: Iterable[float], placement: Array, look: dict[str, Any], order: int = 0
) -> Command:
    """Draw a box (x, y, z), a cylinder or a cone along z (radius, length) or a sphere (radius).

    Of what is drawn on top of everything, the higher in `order` lies on the lower, whatever the side it is seen from.
    """
    size = [float(x) for x in size]
    if shape == "box":
        geometry = dict(zip(("type", "width", "height", "depth"), ("BoxGeometry", *size), strict=True))
    elif shape in ("cylinder", "cone"):
        top = size[0] if shape == "cylinder" else 0.0
        geometry = {"type": "CylinderGeometry", "radiusTop": top, "radiusBottom": size[0], "height": size[1],
                    "radialSegments": 40}  # fmt: skip
        placement = placement @ _TURN
    else:
        geometry = {"type": "SphereGeometry", "radius": size[0], "widthSegments": 24, "heightSegments": 16}
    command = _object(path, "Mesh", geometry, look, placement)
    if order:
        command["object"]["object"]["renderOrder"] = order
    return command


def polyline(path: str, points: Array, colour: Colour, opacity: float = 1.0) -> Command:
    """Draw a line through points (m, 3)."""
    position = {"itemSize": 3, "type": "Float32Array", "array": _floats(points), "normalized": False}
    normal = position | {"array": _floats(np.tile([0.0, 0.0, 1.0], (len(points), 1)))}  # else the viewer makes them up
    geometry = {"type": "BufferGeometry", "data": {"attributes": {"position": position, "normal": normal}}}
    look = {key: x for key, x in material(colour, opacity).items() if key in ("color", "transparent", "opacity")}
    return _object(path, "Line", geometry, {"type": "LineBasicMaterial", **look}, np.eye(4))


def surface(path: str, corners: Array, faces: IntArray, placement: Array, look: dict[str, Any]) -> Command:
    """Draw a triangulated surface: corners (m, 3), faces (k, 3) of their numbers; each triangle is seen as flat."""
    position = {"itemSize": 3, "type": "Float32Array", "array": _floats(corners), "normalized": False}
    numbers = msgspec.msgpack.Ext(_UINT32, np.ascontiguousarray(faces, dtype="<u4").tobytes())
    data = {"attributes": {"position": position}, "index": {"type": "Uint32Array", "array": numbers}}
    return _object(
        path, "Mesh", {"type": "BufferGeometry", "data": data}, look | {"flatShading": True, "side": 2}, placement
    )


def set_transform(path: str, matrix: Array) -> Command:
    """Place what is at a path, and everything below it, in its parent."""
    return {"type": "set_transform", "path": path, "matrix": _columns(matrix)}


def set_property(path: str, name: str, value: Any) -> Command:
    """Set a property of a three.js object."""
    return {"type": "set_property", "path": path, "property": name, "value": value}


def delete(path: str) -> Command:
    """Take away what is at a path, and everything below it."""
    return {"type": "delete", "path": path}


def several(these: Sequence[Command]) -> Command:
    """Draw several things in one message, a frame that the next one replaces; our page answers when it is shown."""
    return {"type": SEVERAL, "path": "", "commands": list(these)}


def say(text: str) -> Command:
    """Write a line of plain text below the caption; understood by our page, not by the viewer."""
    return {"type": "say", "path": "", "text": text}


def name_runs(runs: Sequence[Mapping[str, Any]], forces: Sequence[str]) -> Command:
    """Tell our page what there is to show and to hide.

    Parameters
    ----------
    runs : sequence of mappings
        Each with its path, label, last instant `t_end`, and what is `said` from then on.
    forces : sequence of str
        Paths of the arrows.
    """
    return {"type": "runs", "path": "", "runs": [dict(run) for run in runs], "forces": list(forces)}


def set_animation(tracks: Iterable[Track], speed: float = 1.0) -> Command:
    """Make the viewer move things by itself, once, with a time slider.

    Parameters
    ----------
    tracks : iterable of Track
        In the run's own time, which the slider shows.
    speed : float
        How much of it goes by in a second: the viewer's timeScale, which our page sets.
    """
    animations = []
    for track in tracks:
        clip_tracks = [
            {"name": f".{name}", "type": _KINDS[name], "times": _floats(track.times), "values": _values(values)}
            for name, values in track.values.items()
        ]
        animations.append({"path": track.path, "clip": {"fps": 1, "name": "run", "tracks": clip_tracks}})
    options = {"play": True, "repetitions": 1, "clampWhenFinished": True, "timeScale": speed}
    return {"type": "set_animation", "path": "", "animations": animations, "options": options}


def _object(path: str, kind: str, geometry: dict[str, Any], look: dict[str, Any], placement: Array) -> Command:
    names = {part: f"{part} of {path}" for part in ("object", "geometry", "material")}  # any unique strings will do
    whole = {
        "metadata": {"version": 4.5, "type": "Object"},
        "geometries": [{"uuid": names["geometry"], **geometry}],
        "materials": [{"uuid": names["material"], **look}],
        "object": {"uuid": names["object"], "type": kind, "geometry": names["geometry"],
                   "material": names["material"], "matrix": _columns(placement)},
    }  # fmt: skip
    return {"type": "set_object", "path": path, "object": whole}


def _columns(matrix: Array) -> list[float]:
    columns: list[float] = matrix.T.ravel().tolist()
    return columns


def _values(values: Array | BoolArray) -> Any:
    return values.tolist() if values.dtype == bool else _floats(values.astype(float))


def _floats(values: Array) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(_FLOAT32, np.ascontiguousarray(values, dtype="<f4").tobytes())
