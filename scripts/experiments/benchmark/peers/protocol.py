"""Run works in a program of its own: it reads a problem as JSON on standard input and prints a motion as JSON lines."""

from __future__ import annotations

import hashlib
import json
import shlex
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.analysis.precision.motion import Motion, motion_without_data
from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.frames import Frame
from scripts.experiments.benchmark.peers import Peer, peers
from scripts.experiments.benchmark.peers.stepping import CONTROLLED, start_of
from scripts.experiments.benchmark.work import WORKS, Work

__all__ = ["PROTOCOL", "ProgramPeer", "add_programs", "make_problem"]

PROTOCOL = 1
TOLERANCES = tuple(10.0**-k for k in range(2, 14))
QUICK_TOLERANCES = TOLERANCES[1::2]
START_S, BUDGETS = 20.0, 5.0  # a program is ended after this time and so many budgets
# Points of a loop's frames that coincide, by the loop's type: the origin, and these axes' end points.
POINTS = {"point": "", "point_2d": "", "hinge": "a", "weld": "xy"}
LINES = ("name", "unsupported", "acceleration", "t", "wall_s")  # keys, of which each line has one


class ProgramPeer:
    """A program that follows the protocol of docs/report/peers.md.

    Parameters
    ----------
    command : str
        Command line. Files that it names are part of the key under which its runs are stored.
    expected : str, optional
        Name of a program of this project. Its text is part of every key, so its version has no digest. Its errors fall
        slowly with the tolerance, so every second one is enough.

    Raises
    ------
    InputError
        The program does not start, or does not introduce itself by name and version.
    """

    def __init__(self, command: str, expected: str = "") -> None:
        self._command, self._expected = _split(command), expected
        introduction = self._ask(make_problem(WORKS[0], 1e-3, 1.0, instants=False), START_S)
        if not isinstance(introduction.get("name"), str) or not isinstance(introduction.get("version"), str):
            raise InputError(f'{command}: its first line is not {{"name": "...", "version": "..."}}')
        self.name: str = expected or introduction["name"]
        self.packaged = bool(introduction.get("packaged", False))
        self._settings = [str(setting) for setting in introduction.get("settings", [""])]
        self._version: str = introduction["version"]
        self._starts: dict[str, dict[str, Any]] = {}

    def missing(self, work: Work) -> str | None:
        if work.controlled:
            return CONTROLLED
        if work.mechanism.spec.coupling:
            return "the protocol has no couplings"
        return self._start(work).get("unsupported")

    def version(self) -> str:
        return self._version if self._expected or not self._digest else f"{self._version} ({self._digest})"

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        tolerances = TOLERANCES[::2] if self._expected else TOLERANCES
        for setting in self._settings:
            for rtol in QUICK_TOLERANCES if quick else tolerances:
                yield f"{setting}, rtol {rtol:.0e}".removeprefix(", ")

    def check(self, work: Work) -> str:
        """Compare the constrained acceleration at the start, if the program prints it."""
        theirs = self._start(work).get("acceleration")
        if theirs is None:
            return "it does not print its acceleration at the start"
        mechanism, (q_tree, v_tree) = work.mechanism, start_of(work)
        terms = Terms(mechanism, mechanism.kinematics(q_tree), v_tree)
        ours = dae_acceleration(terms, np.zeros(mechanism.tree.n))
        if np.shape(theirs) != ours.shape:
            return f"its acceleration at the start has the shape {np.shape(theirs)}, not {ours.shape}"
        difference = np.abs(np.array(theirs) - ours).max() / max(float(np.abs(ours).max()), 1.0)
        return f"the constrained acceleration differs by {difference:.0e}"

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        named, _, rtol = setting.rpartition("rtol ")
        problem = make_problem(work, float(rtol), budget, named.removesuffix(", "))
        try:
            answer = self._ask(problem, START_S + BUDGETS * budget)
            return _make_motion(work, answer, budget)
        except InputError as error:
            return motion_without_data("failed", str(error))

    def _start(self, work: Work) -> dict[str, Any]:
        """Return what the program says of a work without computing its motion."""
        if work.key not in self._starts:
            problem = make_problem(work, 1e-3, 1.0, instants=False)
            try:
                self._starts[work.key] = self._ask(problem, START_S)
            except InputError as error:
                self._starts[work.key] = {"unsupported": str(error)}
        return self._starts[work.key]

    @cached_property
    def _digest(self) -> str:
        files = [path for path in map(Path, self._command) if path.is_file()]
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:8] if files else ""

    def _ask(self, problem: Mapping[str, Any], patience: float) -> dict[str, Any]:
        """Return the merged lines of the program's answer, its states as a list under "states".

        Raises
        ------
        InputError
            It does not start, takes too long, ends with an error, or prints something else.
        """
        command, start = self._command[0], perf_counter()
        try:
            done = subprocess.run(
                self._command, input=json.dumps(problem), capture_output=True, text=True, errors="replace",
                timeout=patience, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise InputError(f"{command}: it was stopped after {patience:.0f} s") from None
        except OSError as error:
            raise InputError(f"{command}: it does not start: {error.strerror}") from None
        process_s = perf_counter() - start
        if done.returncode:
            lines = done.stderr.strip().splitlines()
            raise InputError(f"{command}: exit code {done.returncode}: {lines[-1] if lines else 'no message'}")
        answer: dict[str, Any] = {"states": [], "process_s": process_s}
        for number, line in enumerate(done.stdout.splitlines(), 1):
            try:
                values = json.loads(line)
            except ValueError:
                values = None
            if not isinstance(values, dict) or not values.keys() & set(LINES):
                expected = f"expected a JSON object with one of the keys {', '.join(LINES)}"
                raise InputError(f"{command}: line {number} is {line[:60]!r}; {expected}")
            if "t" in values:
                answer["states"].append(values)
            else:
                answer |= values
        return answer


def add_programs(commands: Sequence[str]) -> list[Peer]:
    """Return the programs of command lines.

    Raises
    ------
    InputError
        One does not introduce itself, or has the name of another program.
    """
    added: list[Peer] = [ProgramPeer(command) for command in commands]
    names = [peer.name for peer in (*peers(), *added)] if added else []
    for peer in added:
        if names.count(peer.name) > 1:
            raise InputError(f"--peer: two programs have the name {peer.name!r}; choose another name")
    return added


def _split(command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"--peer: {command!r}: {error}") from None
    if not words:
        raise InputError('--peer: the command is empty; an example is --peer "python my_peer.py"')
    return words


def _make_motion(work: Work, answer: Mapping[str, Any], budget: float) -> Motion:
    """Return the motion of an answer.

    Raises
    ------
    InputError
        States are missing or have a wrong length, or the stated time is impossible.
    """
    if "unsupported" in answer:
        return motion_without_data("refused", str(answer["unsupported"]))
    tree, states = work.mechanism.tree, answer["states"]
    wall_s = answer.get("wall_s")
    if not isinstance(wall_s, int | float) or not 0 < wall_s <= answer["process_s"]:
        raise InputError(
            f"wall_s is {wall_s!r}; expected seconds, at most those of the process, {answer['process_s']:.3g}"
        )
    if wall_s > budget:
        return motion_without_data("refused", f"takes {wall_s:.2g} s, the budget is {budget:.2g} s")
    times = [state["t"] for state in states]
    if len(times) != len(work.instants) or np.abs(np.array(times) - work.instants).max() > 1e-9 * work.t_end:
        raise InputError(f"it printed states at t = {times}; expected {work.instants.tolist()}")
    lengths = {"q": tree.model.nq, "v": tree.n}
    for key, length in lengths.items():
        for state in states:
            if np.shape(state.get(key)) != (length,):
                raise InputError(f"{key} at t = {state['t']:g} is {state.get(key)!r}; expected {length} numbers")
    q, v = (np.array([state[key] for state in states], dtype=float) for key in lengths)
    q_tree = np.array([tree.to_coordinates(row) for row in q])
    rhs, steps = (int(answer[key]) if key in answer else None for key in ("rhs", "steps"))
    return Motion("done", "", q_tree, v, float(wall_s), rhs=rhs, steps=steps)


def make_problem(work: Work, rtol: float, budget: float, setting: str = "", *, instants: bool = True) -> dict[str, Any]:
    """Return a work as the JSON that programs read; without instants they only introduce themselves."""
    mechanism, (q, v) = work.mechanism, start_of(work)
    tree, model, springs = mechanism.tree, mechanism.tree.model, mechanism.springs
    bodies = []
    for k in range(1, model.njoints):
        axis, turns = ((0.0, 0.0, 0.0), False) if model.joints[k].nv == 6 else tree.axis(k)
        inertia, placement = model.inertias[k], model.jointPlacements[k]
        bodies.append({
            "name": model.names[k], "parent": int(model.parents[k]),
            "joint": "free" if model.joints[k].nv == 6 else "revolute" if turns else "prismatic",
            "axis": _list(axis), **_placed(placement.rotation, placement.translation), "mass": inertia.mass,
            "center": _list(inertia.lever), "inertia": _list(inertia.inertia),
        })  # fmt: skip
    joints = {
        "armature": model.armature, "stiffness": springs.joint_stiffness, "rest": springs.joint_rest,
        "damping": springs.joint_damping, "force": springs.constant,
    }  # fmt: skip
    frames = [
        tuple(mechanism.frames.find(end, f"loop {loop.name!r}") for end in (loop.frame_a, loop.frame_b))
        for loop in mechanism.spec.loop
    ]
    loops = [
        {"name": loop.name, "type": loop.type, "axis_a": _list(loop.axis_a), "axis_b": _list(loop.axis_b),
         "length": loop.length, "a": _frame(a), "b": _frame(b)}
        for loop, (a, b) in zip(mechanism.spec.loop, frames, strict=True)
    ]  # fmt: skip
    return {
        "protocol": PROTOCOL, "work": work.key, "gravity": _list(model.gravity.linear), "bodies": bodies,
        "joints": {key: _list(values) for key, values in joints.items()}, "springs": list(_springs(work)),
        "loops": loops, "pairs": _pairs(work, frames), "size": mechanism.size, "q": _list(q), "v": _list(v),
        "t_end": work.t_end, "instants": _list(work.instants) if instants else [], "rtol": rtol, "setting": setting,
        "budget_s": budget,
    }  # fmt: skip


def _pairs(work: Work, frames: Sequence[Sequence[Frame]]) -> list[dict[str, Any]] | None:
    """Return pairs of points that coincide where the loops are closed, None if points cannot express a loop."""
    pairs = []
    for loop, ends in zip(work.mechanism.spec.loop, frames, strict=True):
        if loop.type not in POINTS:
            return None
        axes = {"x": ([1, 0, 0],) * 2, "y": ([0, 1, 0],) * 2, "a": (loop.axis_a, loop.axis_b)}
        for directions in (([0, 0, 0],) * 2, *(axes[name] for name in POINTS[loop.type])):
            pair = {}
            for end, frame, direction in zip("ab", ends, directions, strict=True):
                along = np.array(direction, dtype=float) / max(float(np.linalg.norm(direction)), 1e-300)
                point = frame.translation + frame.rotation @ along * work.mechanism.size
                pair[end] = {"body": frame.joint, "point": _list(point)}
            pairs.append(pair)
    return pairs


def _springs(work: Work) -> Iterator[dict[str, Any]]:
    springs = work.mechanism.springs
    count = len(springs.stiffness)
    for k in range(count):
        ends = {
            name: {"body": int(springs.anchors.point_joint[end]), "point": _list(springs.anchors.point_local[end])}
            for name, end in (("a", k), ("b", count + k))
        }
        numbers = {
            "stiffness": springs.stiffness[k],
            "rest_length": springs.rest_length[k],
            "damping": springs.damping[k],
        }
        yield {**ends, **{key: float(value) for key, value in numbers.items()}}


def _frame(frame: Frame) -> dict[str, Any]:
    return {"body": frame.joint, **_placed(frame.rotation, frame.translation)}


def _placed(rotation: Array, translation: Array) -> dict[str, Any]:
    return {"rotation": _list(rotation), "translation": _list(translation)}


def _list(values: Any) -> list[Any]:
    numbers: list[Any] = np.array(values, dtype=float).tolist()
    return numbers
