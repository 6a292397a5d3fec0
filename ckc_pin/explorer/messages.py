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
    value : rad, m
        The value to move to.
    """

    coordinate: Name
    value: Finite


class Drag(_FromPage, frozen=True):
    """Pull a point of a body towards a target: moves the mechanism, or pushes it with a spring while it runs.

    Attributes
    ----------
    body
        Name of the joint that moves the body.
    point : m
        Its position in the body's axes.
    target : m
        Where the mouse is, in the world.
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
    values : rad, m
        Values by coordinate.
    """

    values: dict[Name, Finite]


class ListBranches(_FromPage, frozen=True):
    """Search the assembly branches at the present q and draw them as ghosts.

    Attributes
    ----------
    on
        False: remove the ghosts and the list.
    """

    on: bool = True


class SelectBranch(_FromPage, frozen=True):
    """Continue on a branch of the list.

    Attributes
    ----------
    index
        Place in the last report `branch_list`, from 0.
    """

    index: Annotated[int, msgspec.Meta(ge=0, le=10_000)]


class ShowMap(_FromPage, frozen=True):
    """Compute the singularity map.

    Attributes
    ----------
    on
        False: hide it.
    """

    on: bool = True


class Show(_FromPage, frozen=True):
    """Show or hide a quantity. A hidden quantity is not computed.

    Attributes
    ----------
    quantity
        Name of a quantity of `setup`.
    on
        Whether to show it.
    """

    quantity: Name
    on: bool


class SetParameter(_FromPage, frozen=True):
    """Rebuild the mechanism with a named parameter and assemble it near the present pose.

    Attributes
    ----------
    name
        Name of a parameter of `setup`.
    value
        Its new value, in the parameter's unit.
    """

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
        Absent: the scene's.
    """

    mode: Literal["free", "scene", "hold"] = "free"
    speed: Annotated[float, msgspec.Meta(gt=0, le=100)] = 1.0
    rtol: Annotated[float, msgspec.Meta(ge=1e-12, le=1e-2)] = 1e-6
    formulation: Literal["reduced", "spf", "dae"] | None = None


class Pause(_FromPage, frozen=True):
    """Pause or continue a run.

    Attributes
    ----------
    on
        False: continue from the time that is shown.
    """

    on: bool = True


class Rewind(_FromPage, frozen=True):
    """Show an earlier time of a run, which continues from there after `pause` with `on` false.

    Attributes
    ----------
    t : s
        The time to show.
    """

    t: Annotated[float, msgspec.Meta(ge=0, le=1e9)]


class StopRun(_FromPage, frozen=True):
    """End the run. The pose stays where it is."""


class SetMotor(_FromPage, frozen=True):
    """Set a motor's torque (mode "free") or the target of an independent coordinate (mode "hold").

    Attributes
    ----------
    name
        A motor, or a coordinate.
    value : N m, N, rad, m
        Torque or force of the motor, or target of the coordinate.
    """

    name: Name
    value: Finite


class Save(_FromPage, frozen=True):
    """Write files into the folder of the explorer's `out`: a scene at this pose, the parameters, or the run.

    Attributes
    ----------
    what
        What to save.
    name
        Name of the file, without its ending.
    """

    what: Literal["scene", "parameters", "run"]
    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]{0,63}$")] = "explored"


class CopyText(_FromPage, frozen=True):
    """Ask for text to copy; the report `text` answers.

    Attributes
    ----------
    what
        The pose as [q_guess], Python lines that reproduce the state, or an SVG picture.
    """

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

    @classmethod
    def kind(cls) -> str:
        """Return the kind of the report as "pose" for `PoseReport`."""
        return _tag(cls.__name__.removesuffix("Report"))

    def to_command(self) -> dict[str, Any]:
        """Return the report as a command of the viewer; its path is the kind of the report."""
        return {"type": "report", "path": self.kind(), "content": msgspec.to_builtins(self, enc_hook=_convert_scalar)}


class CoordinateInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A coordinate's slider.

    Attributes
    ----------
    name
        The coordinate.
    unit
        Unit of its values.
    lower : rad, m
        Lower end of the slider.
    upper : rad, m
        Upper end of the slider.
    has_stops
        Whether the ends are the coordinate's limits.
    is_independent
        Whether it belongs to q. The others are dependent, z.
    motors
        Names of the motors that drive it.
    """

    name: str
    unit: Literal["rad", "m"]
    lower: float
    upper: float
    has_stops: bool
    is_independent: bool
    motors: list[str] = []


class MotorInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A motor's slider, which is shown during a run in mode "free".

    Attributes
    ----------
    name
        The motor.
    unit
        Unit of its torque, N m, or of its force, N.
    limit : N m, N
        Upper end of the slider. The lower end is its negative.
    coordinates
        Names of the coordinates that it drives.
    """

    name: str
    unit: str
    limit: float
    coordinates: list[str] = []


class ParameterInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter's slider.

    Attributes
    ----------
    name
        Its name, as in a scene's [parameters].
    group
        Heading under which the page lists it.
    unit
        Unit of its values.
    value
        Its present value.
    default
        Its value in the files.
    lower
        Lower end of the slider.
    upper
        Upper end of the slider.
    """

    name: str
    group: str
    unit: str
    value: float
    default: float
    lower: float
    upper: float


class QuantityInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A quantity that can be shown.

    Attributes
    ----------
    name
        Its name in `show` and in `pose.quantities`.
    label
        Text of its checkbox.
    on
        Whether it is shown.
    unavailable
        Why it cannot be shown for this mechanism; "" if it can.
    """

    name: str
    label: str
    on: bool
    unavailable: str = ""


class Setup(Report, frozen=True, kw_only=True):
    """Everything that a page needs once, and again when the mechanism has been rebuilt.

    Attributes
    ----------
    title
        Name of the mechanism or scene.
    summary
        One line about it: coordinates, freedoms.
    coordinates
        Sliders of the coordinates.
    motors
        Sliders of the motors.
    parameters
        Sliders of the parameters.
    quantities
        What can be shown.
    bodies
        Path in the scene of each body that can be dragged, by the name of its joint.
    points
        Named points: [name of the joint, x, y, z] in its axes.
    normal
        Normal of a planar mechanism's plane in the world; absent for other mechanisms.
    modes
        Modes of `start_run` that this mechanism has.
    formulation
        Formulation that a run uses by default.
    can_map
        Whether there is a singularity map.
    can_branch
        Whether branches can be listed.
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
    values : rad, m
        Values of all coordinates by name.
    closure : m, rad
        Largest |phi|.
    end
        Why the last movement ended before its target: "theta_1 is at its upper limit", or "".
    ended
        The coordinate at whose slider `end` belongs, or "" for a drag.
    margins
        By name of a bar: [value, reference]. `sigma_min(phi_z)` and `sigma_min(J)`, dimensionless, with the value at
        home.
    quantities
        Lines of text of each quantity that is shown: [label, value].
    can_undo
        Whether there is a pose to undo to.
    can_redo
        Whether there is a pose to redo.
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
    """Assembly branches at the present q.

    Attributes
    ----------
    branches
        A line of text for each. Empty: none are shown.
    current
        Place of the present branch in the list, from 0.
    note
        A remark below the list's button.
    """

    branches: list[str]
    current: int
    note: str = ""


class MapImage(Report, frozen=True, kw_only=True):
    """The singularity map of one or two independent coordinates.

    Attributes
    ----------
    x
        Coordinate of the horizontal axis.
    y
        Coordinate of the vertical axis; "" for a mechanism of one freedom.
    x_range : rad, m
        Values of x at the left and right edges.
    y_range : rad, m
        Values of y at the lower and upper edges.
    x_turns
        Whether the horizontal axis is a full turn, so that the place of a point is found modulo 2 pi.
    y_turns
        The same of the vertical axis.
    image
        PNG as base64, its rows from the upper end of y downwards. "": no map is shown.
    note
        What the colours mean, or why there is no map.
    """

    x: str = ""
    y: str = ""
    x_range: list[float] = []
    y_range: list[float] = []
    image: str = ""
    x_turns: bool = False
    y_turns: bool = False
    note: str = ""


class RunReport(Report, frozen=True, kw_only=True):
    """State of the run.

    Attributes
    ----------
    state
        Whether a run exists and proceeds.
    t : s
        Time that is shown.
    t_last : s
        Last time that was computed.
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
    """Text to copy or a picture to save. Only the page that asked for it uses it.

    Attributes
    ----------
    title
        What it is.
    text
        The text, or the picture as SVG.
    file_name
        Name of the file to save it as. "": the text is copied.
    serial
        Increases with each text.
    """

    title: str
    text: str
    file_name: str = ""
    serial: int = 0


class Notice(Report, frozen=True, kw_only=True):
    """A message to read: what was refused or done.

    Attributes
    ----------
    text
        The message.
    is_error
        Whether something was refused. The page shows such a message until it is closed.
    serial
        Increases with each message.
    """

    text: str
    is_error: bool = False
    serial: int = 0
