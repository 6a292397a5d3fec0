"""Drawing commands of meshcat's viewer as MessagePack (its protocol is described in meshcat's viewer/Readme.md).

This module writes the commands itself instead of using meshcat's Python package. Importing that package starts a ZeroMQ
context, IPython and a server that listens on all interfaces, whereas the commands are a few dictionaries in the format
of three.js.
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
    "SceneState",
    "Track",
    "create_material",
    "delete",
    "draw_polyline",
    "draw_primitive",
    "draw_surface",
    "group_commands",
    "set_animation",
    "set_property",
    "set_runs",
    "set_status",
    "set_transform",
]

Command = dict[str, Any]

SEVERAL = "several"  # the type of a group of commands

_UINT32, _FLOAT32 = 0x16, 0x17  # extension types of Uint32Array and Float32Array in msgpack-lite
# Cylinders have their axis along y in three.js, and along z in a URDF.
_CYLINDER_ROTATION = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_TRACK_TYPES = {"position": "vector3", "quaternion": "quaternion", "scale": "vector3", "visible": "bool"}


@dataclass(frozen=True)
class Track:
    """Keyframes of one object.

    Attributes
    ----------
    path : str
    times : (m,) array
        s.
    values : mapping
        By property: "position" and "scale" (m, 3), "quaternion" (m, 4) as x, y, z, w, "visible" (m,) of bool.
    """

    path: str
    times: Array
    values: Mapping[str, Array | BoolArray]


class SceneState:
    """The current scene as the messages that draw it from nothing, for viewers that connect later."""

    def __init__(self) -> None:
        self._messages: dict[tuple[str, str], bytes] = {}
        self._animation: bytes | None = None

    def apply(self, command: Command) -> bytes:
        """Update the scene by a command and return the command's message."""
        message = msgspec.msgpack.encode(command)
        kind, path = command["type"], command["path"]
        if kind == "set_animation":
            self._animation = message
        elif kind == "delete":
            self._remove(path)
        else:
            self._messages[f"{kind} {command.get('property', '')}", path] = message
        return message

    def _remove(self, path: str) -> None:
        """Remove the objects at a path and below it, the last live frame, and the animation."""
        self._messages = {
            key: message
            for key, message in self._messages.items()
            if not f"{key[1]}/".startswith(f"{path}/") and not key[0].startswith(SEVERAL)
        }
        self._animation = None

    def messages(self) -> list[bytes]:
        """Return the messages that draw the scene; the animation comes last because it refers to the objects."""
        return [*self._messages.values(), *([] if self._animation is None else [self._animation])]


# --- objects -------------------------------------------------------------------------------------


def create_material(colour: Colour, opacity: float = 1.0, on_top: bool = False) -> dict[str, Any]:
    """Return a material of three.js; with `on_top` its object is drawn in front of everything else."""
    red, green, blue = (round(255 * x) for x in colour)
    material = {"type": "MeshPhongMaterial", "color": red << 16 | green << 8 | blue, "shininess": 20, "side": 0}
    if opacity < 1:  # The offset draws a translucent surface in front of an opaque one at the same place.
        material |= {"transparent": True, "opacity": opacity, "depthWrite": False}
        material |= {"polygonOffset": True, "polygonOffsetFactor": -1, "polygonOffsetUnits": -1}
    return material | ({"transparent": True, "depthTest": False} if on_top else {})


def draw_primitive(
    path: str, shape: str, size: Iterable[float], placement: Array, material: dict[str, Any], render_order: int = 0
) -> Command:
    """Draw a box (x, y, z), a cylinder or a cone along z (radius, length), or a sphere (radius).

    Among objects with an `on_top` material, the one with the higher `render_order` covers the other from every side.
    """
    size = [float(x) for x in size]
    if shape == "box":
        geometry = dict(zip(("type", "width", "height", "depth"), ("BoxGeometry", *size), strict=True))
    elif shape in ("cylinder", "cone"):
        top = size[0] if shape == "cylinder" else 0.0
        geometry = {"type": "CylinderGeometry", "radiusTop": top, "radiusBottom": size[0], "height": size[1],
                    "radialSegments": 40}  # fmt: skip
        placement = placement @ _CYLINDER_ROTATION
    else:
        geometry = {"type": "SphereGeometry", "radius": size[0], "widthSegments": 24, "heightSegments": 16}
    command = _set_object(path, "Mesh", geometry, material, placement)
    if render_order:
        command["object"]["object"]["renderOrder"] = render_order
    return command


def draw_polyline(path: str, points: Array, colour: Colour, opacity: float = 1.0) -> Command:
    """Draw a line through points (m, 3)."""
    position = {"itemSize": 3, "type": "Float32Array", "array": _pack_floats(points), "normalized": False}
    # Without normals the viewer would compute them.
    normal = position | {"array": _pack_floats(np.tile([0.0, 0.0, 1.0], (len(points), 1)))}
    geometry = {"type": "BufferGeometry", "data": {"attributes": {"position": position, "normal": normal}}}
    keys = ("color", "transparent", "opacity")
    properties = {key: x for key, x in create_material(colour, opacity).items() if key in keys}
    return _set_object(path, "Line", geometry, {"type": "LineBasicMaterial", **properties}, np.eye(4))


def draw_surface(path: str, corners: Array, faces: IntArray, placement: Array, material: dict[str, Any]) -> Command:
    """Draw a triangulated surface with flat shading: corners (m, 3), and faces (k, 3) as indices of corners."""
    position = {"itemSize": 3, "type": "Float32Array", "array": _pack_floats(corners), "normalized": False}
    indices = msgspec.msgpack.Ext(_UINT32, np.ascontiguousarray(faces, dtype="<u4").tobytes())
    data = {"attributes": {"position": position}, "index": {"type": "Uint32Array", "array": indices}}
    geometry = {"type": "BufferGeometry", "data": data}
    return _set_object(path, "Mesh", geometry, material | {"flatShading": True, "side": 2}, placement)


def _set_object(path: str, kind: str, geometry: dict[str, Any], material: dict[str, Any], placement: Array) -> Command:
    uuids = {part: f"{part} of {path}" for part in ("object", "geometry", "material")}  # Any unique strings will do.
    description = {
        "metadata": {"version": 4.5, "type": "Object"},
        "geometries": [{"uuid": uuids["geometry"], **geometry}],
        "materials": [{"uuid": uuids["material"], **material}],
        "object": {"uuid": uuids["object"], "type": kind, "geometry": uuids["geometry"],
                   "material": uuids["material"], "matrix": _list_columns(placement)},
    }  # fmt: skip
    return {"type": "set_object", "path": path, "object": description}


# --- changes of the scene ------------------------------------------------------------------------


def set_transform(path: str, matrix: Array) -> Command:
    """Place the object at a path, and everything below it, relative to its parent; matrix (4, 4)."""
    return {"type": "set_transform", "path": path, "matrix": _list_columns(matrix)}


def set_property(path: str, name: str, value: Any) -> Command:
    """Set a property of a three.js object."""
    return {"type": "set_property", "path": path, "property": name, "value": value}


def delete(path: str) -> Command:
    """Delete the object at a path and everything below it."""
    return {"type": "delete", "path": path}


def group_commands(commands: Sequence[Command]) -> Command:
    """Group commands into one message, a live frame. The page answers when it has shown the frame."""
    return {"type": SEVERAL, "path": "", "commands": list(commands)}


def set_status(text: str) -> Command:
    """Set the plain text of the status line below the caption. The page handles it, not the viewer."""
    return {"type": "say", "path": "", "text": text}


def set_runs(runs: Sequence[Mapping[str, Any]], forces: Sequence[str]) -> Command:
    """Tell the page which objects can be shown and hidden.

    Parameters
    ----------
    runs : sequence of mappings
        Each with `path`, `label`, `t_end`, and `outcome`, the text that is shown from `t_end` on.
    forces : sequence of str
        Paths of the force arrows.
    """
    return {"type": "runs", "path": "", "runs": [dict(run) for run in runs], "forces": list(forces)}


def set_animation(tracks: Iterable[Track], speed: float = 1.0) -> Command:
    """Animate objects in the viewer, once, with a time slider.

    Parameters
    ----------
    tracks : iterable of Track
        In simulated time, which the slider shows.
    speed : float
        Simulated seconds per second of playback.
    """
    animations = []
    for track in tracks:
        clip_tracks = [
            {"name": f".{name}", "type": _TRACK_TYPES[name], "times": _pack_floats(track.times),
             "values": _pack_values(values)}
            for name, values in track.values.items()
        ]  # fmt: skip
        animations.append({"path": track.path, "clip": {"fps": 1, "name": "run", "tracks": clip_tracks}})
    options = {"play": True, "repetitions": 1, "clampWhenFinished": True, "timeScale": speed}
    return {"type": "set_animation", "path": "", "animations": animations, "options": options}


# --- encoding ------------------------------------------------------------------------------------


def _list_columns(matrix: Array) -> list[float]:
    columns: list[float] = matrix.T.ravel().tolist()
    return columns


def _pack_values(values: Array | BoolArray) -> Any:
    return values.tolist() if values.dtype == bool else _pack_floats(values.astype(float))


def _pack_floats(values: Array) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(_FLOAT32, np.ascontiguousarray(values, dtype="<f4").tobytes())
