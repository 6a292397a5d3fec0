"""The explorer's state: the pose and its history, parameters, what is shown, and the run. One thread owns it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from threading import Thread

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import CkcError, InputError
from ckc_pin.explorer import saving
from ckc_pin.explorer.branches import draw_branches, list_branches
from ckc_pin.explorer.describe import describe_setup
from ckc_pin.explorer.history import PoseHistory, Snapshot
from ckc_pin.explorer.live_run import LiveRun, list_modes
from ckc_pin.explorer.map_panel import MapPanel
from ckc_pin.explorer.messages import (
    BranchList,
    CopyText,
    Drag,
    GoTo,
    Home,
    ListBranches,
    MapImage,
    Move,
    Notice,
    Pause,
    PoseReport,
    Redo,
    Release,
    Report,
    Request,
    ResetParameters,
    Rewind,
    RunReport,
    Save,
    SelectBranch,
    SetMotor,
    SetParameter,
    Show,
    ShowMap,
    StartRun,
    StopRun,
    TextReport,
    Undo,
)
from ckc_pin.explorer.opening import Opened, close_again
from ckc_pin.explorer.parameters import list_parameters, rebuild
from ckc_pin.explorer.paths import BRANCHES, EXPLORED, SHOWN
from ckc_pin.explorer.quantities import Quantities
from ckc_pin.kinematics.moving import Movement, drag_point, move_coordinate, move_independent
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view import bodies, commands
from ckc_pin.view.commands import Command
from ckc_pin.view.drawing import estimate_reach, motion_extent, set_camera
from ckc_pin.view.geometry import compute_placements

__all__ = ["Session"]

LOOP_FRAMES = "loop_frames"
SHOWN_AT_FIRST = ("conditioning", LOOP_FRAMES)  # quantities
MAX_FRAMES_OF_MOVEMENT = 100  # that are computed at once if another request waits
STEPS_PER_FRAME = 3  # tangent steps of a drag or a slider between two frames


class Session:
    """A mechanism in the hands of the explorer's users. All pages see the same one.

    Parameters
    ----------
    opened : Opened
    send : callable
        Sends a drawing command to all pages.
    post : callable
        Calls a function later in the thread that owns the session. Any thread may call it.
    folder : Path or None
        Where `Save` writes; None if it cannot.
    """

    def __init__(
        self,
        opened: Opened,
        send: Callable[[Command], None],
        post: Callable[[Callable[[], None]], None],
        folder: Path | None = None,
    ) -> None:
        self._send, self._post, self._folder = send, post, folder
        self._serial = count(1)
        self._run: LiveRun | None = None
        self._last_run: LiveRun | None = None
        self._open(opened)

    def _open(self, opened: Opened) -> None:
        """Begin with a mechanism at its start."""
        self.opened = opened
        self.original = self.mechanism = opened.mechanism
        self.at = opened.start
        self.parameters: dict[str, float] = {}
        self.history = PoseHistory(Snapshot(self.at.q_tree, {}))
        self.map_panel, self._has_map = MapPanel(lambda image: self._post(lambda: self._report(image))), False
        self._branches: list[Kinematics] = []
        self._goal: Move | Drag | GoTo | None = None
        self._is_released = False
        self._last_slider = ""
        self._end, self._ended = "", ""
        self._pushed: int | None = None  # joint that moves the body which is pushed
        self._branch_report = BranchList(branches=[], current=0)
        self.draw()

    # --- drawing ---------------------------------------------------------------------------------

    def draw(self) -> None:
        """Draw the mechanism from nothing and report everything about it."""
        pose = compute_placements(self.mechanism, self.at.q_tree[None])
        # Half of the room that a motion might need: pages can zoom out, and bodies should be large enough to grab.
        bounds = zip(motion_extent(self.mechanism, [pose]), estimate_reach(self.mechanism, pose), strict=True)
        low, high = (0.5 * (present + reach) for present, reach in bounds)
        for command in set_camera(self.mechanism, (low, high)):
            self._send(command)
        self._draw_bodies()
        self.quantities = self._make_quantities(SHOWN_AT_FIRST)
        self._describe()
        for report in (RunReport(), BranchList(branches=[], current=0), MapImage()):
            self._report(report)
        self.send_frame()

    def _draw_bodies(self) -> None:
        pose = compute_placements(self.mechanism, self.at.q_tree[None])
        self._send(commands.delete(EXPLORED))
        for command in bodies.draw_bodies(self.mechanism, EXPLORED, pose, bodies.SOLID):
            self._send(command)

    def _describe(self) -> None:
        parameters = [] if self.opened.problem else list_parameters(self.mechanism, self.original)
        modes = list_modes(self.mechanism, self.opened.scene) if not self.opened.problem else []
        quantities = self.quantities.infos()
        if self.opened.problem:
            quantities = [info for info in quantities if info.name == LOOP_FRAMES]
        self._report(
            describe_setup(
                self.opened, self.mechanism, parameters, quantities, modes,
                can_save=self._folder is not None,
            )
        )  # fmt: skip

    def send_frame(self) -> None:
        """Send the present pose, what is shown of it, and the state of the run."""
        pose = compute_placements(self.mechanism, self.at.q_tree[None])
        frame = bodies.place_bodies(self.mechanism, EXPLORED, pose)
        opened = self.opened.with_open_loops
        at = self.at if opened is None else opened.kinematics(self.at.q_tree)
        shown = self.quantities.evaluate(at, *self._motion())
        tree = self.mechanism.tree
        report = PoseReport(
            values=tree.named(tree.to_coordinates(self.at.q_tree)),
            closure=float(np.abs(at.phi).max(initial=0.0)),
            end=self._end,
            ended=self._ended,
            margins=shown.margins,
            quantities=shown.lines,
            can_undo=self.history.can_undo and self._run is None,
            can_redo=self.history.can_redo and self._run is None,
        )
        for command in shown.commands:
            # Frames may be skipped, and only the last one is kept for pages that connect later.
            if command["type"] == "set_transform":
                frame.append(command)
            else:
                self._send(command)
        frame.append(report.to_command())
        if self._run is not None:
            frame.append(self._run.report().to_command())
        self._send(commands.group_commands(frame))
        if self._has_map:
            self.map_panel.follow(self.at)

    def _motion(self) -> tuple[Array | None, Array | None, Array | None]:
        """Return rates and motor torques of the run, and the wrenches of pushes on the bodies; None at rest."""
        if self._run is None:
            return None, None, None
        frame = self._run.frame()
        wrenches = None
        if frame.push is not None and self._pushed is not None:
            wrenches = np.zeros((self.mechanism.tree.model.njoints, 6))
            point, force = frame.push
            wrenches[self._pushed] = np.concatenate([force, np.cross(point, force)])
        return frame.v_tree, frame.tau, wrenches

    def _make_quantities(self, shown: Sequence[str]) -> Quantities:
        """Return the quantities of the present mechanism, with some of them shown."""
        mechanism = self.opened.with_open_loops or self.mechanism
        quantities = Quantities(mechanism, self.opened.scene, lambda: self._post(lambda: None))
        for name in shown if not self.opened.problem else (LOOP_FRAMES,):
            with suppress(InputError):  # it is not available for other parameter values
                for command in quantities.show(name, True):
                    self._send(command)
        return quantities

    def _report(self, report: Report) -> None:
        self._send(report.to_command())

    def notify(self, text: str, *, is_error: bool = False) -> None:
        """Show a message on all pages."""
        self._report(Notice(text=text, is_error=is_error, serial=next(self._serial)))

    # --- requests --------------------------------------------------------------------------------

    def handle(self, request: Request) -> None:
        """Do what a page asks for. What cannot be done is answered with a notice."""
        try:
            self._handle(request)
        except CkcError as error:
            self.notify(str(error), is_error=True)

    def _handle(self, request: Request) -> None:
        if not isinstance(request, Move | GoTo | Drag | Release):
            self._complete_movement()
        match request:
            case Drag() if self._run is not None:
                self._pushed, point, target = self._grabbed(request)
                self._run.push(request.body, point, target, request.normal)
            case Release() if self._run is not None:
                self._run.release()
            case Move() | Drag() | GoTo() if self._run is None:
                self._check_goal(request)
                self._goal, self._is_released, self._last_slider = request, False, ""
                self._hide_branches()
            case Release():
                if isinstance(self._goal, Drag):  # the mouse may have been released within one frame
                    self._move(self._goal)
                self._is_released = True
            case StartRun():
                self._start_run(request)
            case Pause(on=on):
                self._require_run().pause(on)
            case Rewind(t=t):
                self._require_run().rewind(t)
            case SetMotor(name=name, value=value):
                self._require_run().set_motor(name, value)
            case StopRun():
                self._stop_run()
            case Undo() | Redo() | Home() | ListBranches() | SelectBranch() | SetParameter() | ResetParameters():
                if self._run is not None:
                    raise InputError("stop the run first")
                self._change(request)
            case ShowMap(on=on):
                self._show_map(on)
            case Show(quantity=name, on=on):
                for command in self.quantities.show(name, on):
                    self._send(command)
                self._describe()
            case Save():
                self._save(request)
            case CopyText(what=what):
                self._copy(what)
            case _:
                raise InputError("stop the run first; while it runs, dragging pushes the mechanism")

    def _change(self, request: Request) -> None:
        """Change pose or parameters at once."""
        if not isinstance(request, SetParameter):
            self._last_slider = ""
        match request:
            case Undo():
                self._restore(self.history.undo())
            case Redo():
                self._restore(self.history.redo())
            case Home():
                self._go_to(self.mechanism.assembled)
            case SelectBranch(index=index):
                if index >= len(self._branches):
                    raise InputError("the list of branches is out of date; list them again")
                self._go_to(self._branches[index])
                self._show_branches(index)
            case ListBranches(on=True):
                self._list_branches()
            case ListBranches():
                self._hide_branches()
            case SetParameter(name=name, value=value):
                self._set_parameters({**self.parameters, name: value}, name)
            case ResetParameters():
                self._set_parameters({}, "")

    # --- movements -------------------------------------------------------------------------------

    @property
    def is_active(self) -> bool:
        """Whether the movement to the present target goes on without a further request."""
        return self._goal is not None

    def advance(self) -> None:
        """Take the next frame: of the run, or of the movement to the present target."""
        if self._run is not None:
            self.at = self.mechanism.kinematics(self._run.frame().q_tree)
        elif self._goal is not None:
            self._move(self._goal)
        self._end_gesture()

    def _complete_movement(self) -> None:
        """Bring a slider's movement to its end, so that the next request finds its result. A drag ends where it is."""
        for _ in range(MAX_FRAMES_OF_MOVEMENT):
            if self._goal is None or isinstance(self._goal, Drag):
                break
            self._move(self._goal)
        self._goal = None
        self._end_gesture()

    def _end_gesture(self) -> None:
        """Add a pose to the history when its gesture has ended."""
        if self._run is None and self._is_released and (self._goal is None or isinstance(self._goal, Drag)):
            self._goal, self._is_released = None, False
            self.history.add(Snapshot(self.at.q_tree, dict(self.parameters)))
            if self.opened.with_open_loops is not None:
                self._close_loops()

    def _move(self, goal: Move | Drag | GoTo) -> None:
        movement = self._follow(goal)
        self.at = movement.at
        self._end, self._ended = movement.end, goal.coordinate if isinstance(goal, Move) and movement.end else ""
        if movement.reached or movement.end:
            self._goal = None

    def _follow(self, goal: Move | Drag | GoTo) -> Movement:
        match goal:
            case Move(coordinate=name, value=value):
                return move_coordinate(self.mechanism, self.at, name, value, STEPS_PER_FRAME)
            case GoTo(values=values):
                return move_independent(self.mechanism, self.at, values, STEPS_PER_FRAME)
            case Drag():
                joint, point, target = self._grabbed(goal)
                normal = None if goal.normal is None else np.array(goal.normal)
                return drag_point(self.mechanism, self.at, joint, point, target, normal, STEPS_PER_FRAME)

    def _grabbed(self, drag: Drag) -> tuple[int, np.ndarray, np.ndarray]:
        names = list(self.mechanism.tree.model.names)
        if drag.body not in names[1:]:
            raise InputError(f"drag: {drag.body!r} moves no body")
        return names.index(drag.body), np.array(drag.point), np.array(drag.target)

    def _check_goal(self, goal: Move | Drag | GoTo) -> None:
        """Refuse names that do not exist, before the movement begins."""
        match goal:
            case Move(coordinate=name):
                self.mechanism.tree.indices((name,), "move")
            case GoTo(values=values):
                self.mechanism.vector(values, self.mechanism.independent, "go_to", fill=0.0)
            case Drag():
                self._grabbed(goal)

    def _go_to(self, at: Kinematics) -> None:
        self.at, self._end, self._ended = self.mechanism.kinematics(at.q_tree), "", ""
        self.history.add(Snapshot(self.at.q_tree, dict(self.parameters)))

    def _restore(self, snapshot: Snapshot) -> None:
        self._hide_branches()
        if dict(snapshot.parameters) != self.parameters:
            mechanism, at = rebuild(self.original, snapshot.parameters, self.mechanism.kinematics(snapshot.q_tree))
            self._replace_mechanism(mechanism, at, dict(snapshot.parameters))
        self.at, self._end, self._ended = self.mechanism.kinematics(snapshot.q_tree), "", ""

    def _close_loops(self) -> None:
        """Close open loops if they can be closed near the pose to which the user has moved the mechanism."""
        closed = close_again(self.opened, self.at)
        if closed is not None:
            self._open(closed)
            self.notify("the loops are closed now; copy the pose as q_guess to keep it")

    # --- parameters ------------------------------------------------------------------------------

    def _set_parameters(self, values: dict[str, float], slider: str) -> None:
        """Rebuild the mechanism; if it cannot be assembled, the last one stays and the error says why."""
        if self.opened.problem:
            raise InputError("parameters can be changed when the loops are closed")
        self._hide_branches()
        mechanism, at = rebuild(self.original, values, self.at)
        self._replace_mechanism(mechanism, at, values)
        snapshot = Snapshot(at.q_tree, dict(values))
        if slider and slider == self._last_slider:
            self.history.replace_parameters(snapshot)
        else:
            self.history.add(snapshot)
        self._last_slider = slider

    def _replace_mechanism(self, mechanism: Mechanism, at: Kinematics, parameters: dict[str, float]) -> None:
        """Continue with the mechanism of other parameter values at a pose; draw and describe it."""
        self.mechanism, self.at, self.parameters = mechanism, at, parameters
        shown = self.quantities.visible_names
        self.quantities.close()
        self._send(commands.delete(SHOWN))
        self._draw_bodies()  # before the quantities, some of which draw on the bodies
        self.quantities = self._make_quantities(shown)
        self._describe()
        if self._has_map:
            self.map_panel.request(mechanism, self.at)

    # --- branches --------------------------------------------------------------------------------

    def _list_branches(self) -> None:
        """Search the branches in a thread of their own, since that may take seconds."""
        mechanism, at = self.mechanism, self.at
        searched = mechanism.copy(mechanism.sources)
        self._report(BranchList(branches=[], current=0, note="searching"))

        def search() -> None:
            branches, report = list_branches(searched, searched.kinematics(at.q_tree))
            self._post(lambda: show(branches, report))

        def show(branches: list[Kinematics], report: BranchList) -> None:
            if self.mechanism is mechanism and self.at is at:  # otherwise they belong to another q
                self._branches, self._branch_report = branches, report
                self._show_branches(report.current)
            else:
                self._report(BranchList(branches=[], current=0))

        Thread(target=search, name="ckc_pin branches", daemon=True).start()

    def _show_branches(self, current: int) -> None:
        for command in draw_branches(self.mechanism, self._branches, current):
            self._send(command)
        self._branch_report = msgspec.structs.replace(self._branch_report, current=current)
        self._report(self._branch_report)

    def _hide_branches(self) -> None:
        if self._branches:
            self._branches = []
            self._send(commands.delete(BRANCHES))
            self._report(BranchList(branches=[], current=0))

    def _show_map(self, on: bool) -> None:
        self._has_map = on
        if on:
            self._report(MapImage(note="computing"))
            self.map_panel.request(self.mechanism, self.at)
        else:
            self.map_panel.close()
            self._report(MapImage())

    # --- run -------------------------------------------------------------------------------------

    def _start_run(self, request: StartRun) -> None:
        if self.opened.problem:
            raise InputError("a run needs closed loops")
        self._stop_run()
        self._hide_branches()
        self._goal, self._end, self._ended = None, "", ""
        scene, at = self.opened.scene, self.at
        is_start = scene is not None and not self.parameters and np.array_equal(at.q_tree, self.opened.start.q_tree)
        self._run = LiveRun(
            self.mechanism,
            at,
            scene,
            request.mode,
            speed=request.speed,
            rtol=request.rtol,
            formulation=request.formulation,
            q_dot=self.opened.q_dot if is_start else None,
            on_frame=lambda: self._post(lambda: None),
        )
        self._run.start()

    def _stop_run(self) -> None:
        if self._run is not None:
            self._end_run()
            self._go_to(self.at)

    def _end_run(self) -> None:
        if self._run is not None:
            self._run.stop()
            self.at = self.mechanism.kinematics(self._run.frame().q_tree)
            self._report(self._run.report())
            self._last_run, self._run = self._run, None

    def _require_run(self) -> LiveRun:
        if self._run is None:
            raise InputError("there is no run; start one first")
        return self._run

    # --- saving ----------------------------------------------------------------------------------

    def _save(self, request: Save) -> None:
        if self._folder is None:
            raise InputError("there is no folder to save into")
        match request.what:
            case "scene":
                path = saving.save_scene(self._folder, request.name, self.mechanism, self.opened.scene, self.at)
                self.notify(f"written: {path}")
            case "parameters":
                self.notify(f"written: {saving.save_parameters(self._folder, request.name, self.mechanism)}")
            case "run":
                self._export(self._folder, request.name)

    def _export(self, folder: Path, name: str) -> None:
        """Write the run in a thread of its own, since it is simulated again."""
        run = self._run or self._last_run
        if run is None:
            raise InputError("there is no run to save; start one first")

        def export() -> None:
            try:
                _, message = run.export(folder, name)
            except CkcError as error:
                message, is_error = str(error), True
            else:
                is_error = False
            self._post(lambda: self.notify(message, is_error=is_error))

        Thread(target=export, name="ckc_pin export", daemon=True).start()

    def _copy(self, what: str) -> None:
        mechanism, name = self.mechanism, self.opened.name
        match what:
            case "q_guess":
                title, text, file = "the pose as [q_guess]", saving.q_guess_text(mechanism, self.at), ""
            case "python":
                title, file = "Python lines that reproduce the state", ""
                text = saving.python_lines(name, mechanism, self.at, self.opened.scene)
            case _:
                title, text, file = "picture", saving.svg(mechanism, self.at), f"{mechanism.name}.svg"
        self._report(TextReport(title=title, text=text, file_name=file, serial=next(self._serial)))

    def close(self) -> None:
        """End the run and all threads."""
        self._end_run()
        self.quantities.close()
        self.map_panel.close()
