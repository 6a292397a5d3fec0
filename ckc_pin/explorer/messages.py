"""Messages between the explorer's page and the program, over one WebSocket.

The page sends JSON objects whose key `type` names the message. The program sends drawing commands of meshcat's viewer
(MessagePack), and the reports below as commands of the same form. docs/reference/explorer_protocol.md describes both.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

__all__ = [
    "BranchList",
    "CoordinateInfo",
    "CopyText",
    "Drag",
    "FrameShown",
    "GoTo",
    "ListBranches",
    "MapImage",
    "MotorInfo",
    "Move",
    "Notice",
    "ParameterInfo",
    "Pause",
    "PoseReport",
    "QuantityInfo",
    "Redo",
    "Release",
    "Report",
    "Request",
    "ResetParameters",
    "Rewind",
    "RunReport",
    "Save",
    "SelectBranch",
    "SetMotor",
    "SetParameter",
    "Setup",
    "Show",
    "ShowMap",
    "StartRun",
    "StopRun",
    "TextReport",
    "Undo",
    "read_request",
]

Finite = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Vector = Annotated[list[Finite], msgspec.Meta(min_length=3, max_length=3)]
Name = Annotated[str, msgspec.Meta(max_length=500)]


# --- from the page -------------------------------------------------------------------------------


def _tag(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() and k else c.lower() for k, c in enumerate(name))


class _FromPage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=_tag):
    """Base of the page's messages; the tag is the class name in small letters with underscores."""


class FrameShown(_FromPage, frozen=True):
    """The page has shown the last frame and can take another."""


class Move(_FromPage, frozen=True):
    """Move one coordinate to a value; the others follow on the constraint manifold.

    Attributes
    ----------
    coordinate
        A coordinate of the tree.
    value
        rad or m.
    """

    coordinate: Name
    value: Finite


class Drag(_FromPage, frozen=True):
    """Pull a point of a body towards a target: moves the mechanism, or pushes it with a spring while it runs.

    Attributes
    ----------
    body
        Name of the joint that moves the body.
    point
        Its position in the body's axes, m.
    target
        Where the mouse is, in the world, m.
    normal
        Normal of the plane in which the mouse moves, in the world. The distance along it is not reduced. Absent: all
        three directions count.
    """

    body: Name
    point: Vector
    target: Vector
    normal: Vector | None = None


class Release(_FromPage, frozen=True):
    """End of a gesture: a slider or the mouse has been released. The pose becomes one step of undo."""


class Undo(_FromPage, frozen=True):
    """Return to the pose before the last gesture."""


class Redo(_FromPage, frozen=True):
    """Take back the last undo."""


class Home(_FromPage, frozen=True):
    """Return to the assembled configuration."""


class GoTo(_FromPage, frozen=True):
    """Move independent coordinates to values, on the present branch, as a click in the map does.

    Attributes
    ----------
    values
        rad or m, by coordinate.
    """

    values: dict[Name, Finite]


class ListBranches(_FromPage, frozen=True):
    """Search the assembly branches at the present q and draw them as ghosts; with `on` false, remove them."""

    on: bool = True


class SelectBranch(_FromPage, frozen=True):
    """Continue on a branch of the list.

    Attributes
    ----------
    index
        Place in the last `branches` report.
    """

    index: Annotated[int, msgspec.Meta(ge=0, le=10_000)]


class ShowMap(_FromPage, frozen=True):
    """Compute the singularity map; with `on` false, hide it."""

    on: bool = True


class Show(_FromPage, frozen=True):
    """Show or hide a quantity of `setup.quantities`. A hidden quantity is not computed."""

    quantity: Name
    on: bool


class SetParameter(_FromPage, frozen=True):
    """Rebuild the mechanism with a named parameter and assemble it near the present pose."""

    name: Name
    value: Finite


class ResetParameters(_FromPage, frozen=True):
    """Return all parameters to their values in the files."""


class StartRun(_FromPage, frozen=True):
    """Start or continue a run at the present pose.

    Attributes
    ----------
    mode
        "free": motors exert the torques of their sliders. "scene": under the scene's controller. "hold": motors hold
        their targets (eq. 16).
    speed
        Simulated seconds per second.
    rtol
        Relative tolerance.
    formulation
        Default: the scene's.
    """

    mode: Literal["free", "scene", "hold"] = "free"
    speed: Annotated[float, msgspec.Meta(gt=0, le=100)] = 1.0
    rtol: Annotated[float, msgspec.Meta(ge=1e-12, le=1e-2)] = 1e-6
    formulation: Literal["reduced", "spf", "dae"] | None = None


class Pause(_FromPage, frozen=True):
    """Pause or continue a run."""

    on: bool = True


class Rewind(_FromPage, frozen=True):
    """Show an earlier time of a run, which continues from there after `pause` with `on` false."""

    t: Annotated[float, msgspec.Meta(ge=0, le=1e9)]


class StopRun(_FromPage, frozen=True):
    """End the run. The pose stays where it is."""


class SetMotor(_FromPage, frozen=True):
    """Set a motor's torque (mode "free") or the target of an independent coordinate (mode "hold").

    Attributes
    ----------
    name
        A motor, or a coordinate.
    value
        N m or N of the motor; rad or m of the coordinate.
    """

    name: Name
    value: Finite


class Save(_FromPage, frozen=True):
    """Write files into the folder of the explorer's `out`: a scene at this pose, the parameters, or the run.

    Attributes
    ----------
    what
    name
        Of the file, without its ending.
    """

    what: Literal["scene", "parameters", "run"]
    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]{0,63}$")] = "explored"


class CopyText(_FromPage, frozen=True):
    """Ask for text to copy: the pose as [q_guess], Python lines that reproduce the state, or an SVG picture."""

    what: Literal["q_guess", "python", "svg"]


Request = (
    FrameShown
    | Move
    | Drag
    | Release
    | Undo
    | Redo
    | Home
    | GoTo
    | ListBranches
    | SelectBranch
    | ShowMap
    | Show
    | SetParameter
    | ResetParameters
    | StartRun
    | Pause
    | Rewind
    | StopRun
    | SetMotor
    | Save
    | CopyText
)

_decoder = msgspec.json.Decoder(Request)


def read_request(message: str | bytes) -> Request:
    """Return a message of the page (msgspec.ValidationError or DecodeError if it is none)."""
    return _decoder.decode(message)


# --- to the page ---------------------------------------------------------------------------------


def _convert_scalar(value: Any) -> float | int:
    """Convert a scalar of NumPy, which msgspec does not know."""
    return value.item()


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """Base of the program's reports, which the page gets as a command {"type": "report", "path": ..., ...}.

    The newest report of each kind is kept for pages that connect later.
    """

    def to_command(self) -> dict[str, Any]:
        """Return the report as a command of the viewer; its path is the kind of the report, as "pose"."""
        kind = _tag(type(self).__name__.removesuffix("Report"))
        return {"type": "report", "path": kind, "content": msgspec.to_builtins(self, enc_hook=_convert_scalar)}


class CoordinateInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A slider. `lower` and `upper` are the ends of its scale; `has_stops`: they are its limits."""

    name: str
    unit: Literal["rad", "m"]
    lower: float
    upper: float
    has_stops: bool
    is_independent: bool
    motors: list[str] = []


class MotorInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A motor: its unit (N m or N), the end of its torque slider, and the coordinates that it drives."""

    name: str
    unit: str
    limit: float
    coordinates: list[str] = []


class ParameterInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter's slider: its name as in a scene's [parameters], value, the value of the files, unit and scale."""

    name: str
    group: str
    unit: str
    value: float
    default: float
    lower: float
    upper: float


class QuantityInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A quantity that can be shown. `unavailable` tells why it cannot be shown for this mechanism, if it cannot."""

    name: str
    label: str
    on: bool
    unavailable: str = ""


class Setup(Report, frozen=True, kw_only=True):
    """Everything that a page needs once, and again when the mechanism has been rebuilt.

    Attributes
    ----------
    title, summary
        Name of the mechanism, and one line about it: coordinates, freedoms.
    coordinates, motors, parameters, quantities
    bodies
        Path in the scene of each body that can be dragged, by the name of its joint.
    points
        Named points: [name of the joint, x, y, z] in its axes.
    normal
        Normal of a planar mechanism's plane in the world.
    modes
        Modes of `start_run` that this mechanism has.
    can_map
        Whether there is a singularity map.
    warnings
        Of the mechanism, and why it is not closed.
    can_save
        Whether the program has a folder to save into.
    """

    title: str
    summary: str
    coordinates: list[CoordinateInfo]
    motors: list[MotorInfo]
    parameters: list[ParameterInfo]
    quantities: list[QuantityInfo]
    bodies: dict[str, str]
    points: dict[str, list[Any]]
    normal: list[float] | None
    modes: list[str]
    formulation: str
    can_map: bool
    can_branch: bool
    warnings: list[str]
    can_save: bool


class PoseReport(Report, frozen=True, kw_only=True):
    """The present pose; part of every frame.

    Attributes
    ----------
    values
        Coordinates, rad or m.
    closure
        Largest |phi|, m or rad.
    end
        Why the last movement ended before its target: "theta_1 is at its upper limit", or "".
    ended
        The coordinate at whose slider `end` belongs, or "" for a drag.
    margins
        By name of a bar: [value, reference]. `sigma_min(phi_z)` and `sigma_min(J)`, dimensionless, with the value at
        home.
    quantities
        Lines of text of each quantity that is shown: [label, value].
    can_undo, can_redo
    """

    values: dict[str, float]
    closure: float
    end: str = ""
    ended: str = ""
    margins: dict[str, list[float]] = {}
    quantities: dict[str, list[list[str]]] = {}
    can_undo: bool = False
    can_redo: bool = False


class BranchList(Report, frozen=True, kw_only=True):
    """Assembly branches at the present q: a line of text each; `current` is the present one. Empty: none are shown."""

    branches: list[str]
    current: int
    note: str = ""


class MapImage(Report, frozen=True, kw_only=True):
    """The singularity map of one or two independent coordinates.

    Attributes
    ----------
    x, y
        Coordinates of the axes; y is "" for a mechanism of one freedom.
    x_range, y_range
        rad or m.
    x_turns, y_turns
        Whether the axis is a full turn, so that the place of a point is found modulo 2 pi.
    image
        PNG as base64, its rows from the upper end of y downwards.
    note
        What the colours mean, or why there is no map.
    """

    x: str = ""
    y: str = ""
    x_range: list[float] = []
    y_range: list[float] = []
    x_turns: bool = False
    y_turns: bool = False
    image: str = ""
    note: str = ""


class RunReport(Report, frozen=True, kw_only=True):
    """State of the run.

    Attributes
    ----------
    state
        "none", "running", "paused" or "stopped".
    t, t_last
        Time that is shown, and the last one that was computed, s.
    message
        Why it stopped, or a remark.
    real_time
        Simulated seconds per second that were reached; it is less than the speed if the computation is too slow.
    mode
        Mode of the last `start_run`; "" before the first.
    motors
        What `set_motor` sets, by name: torques in mode "free", targets in mode "hold". Other modes: empty.
    """

    state: Literal["none", "running", "paused", "stopped"] = "none"
    t: float = 0.0
    t_last: float = 0.0
    message: str = ""
    real_time: float = 0.0
    mode: str = ""
    motors: dict[str, float] = {}


class TextReport(Report, frozen=True, kw_only=True):
    """Text to copy or a picture to save. `serial` increases, so that a page recognises a new one."""

    title: str
    text: str
    file_name: str = ""
    serial: int = 0


class Notice(Report, frozen=True, kw_only=True):
    """A message to read: what was refused or done."""

    text: str
    is_error: bool = False
    serial: int = 0
