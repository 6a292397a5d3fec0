"""Random sensitivities through impacts, stops and friction, judged by one-sided differences from both sides.

A derivative exists where the difference quotients of runs with a larger and with a smaller parameter have one limit.
Each side is computed with two steps; where these disagree, as they do beside an event, an output instant says nothing.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Terms
from ckc_pin.errors import CkcError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import values_of, with_components
from scripts.experiments.fuzz.contact.stops import with_limits
from scripts.experiments.fuzz.mechanisms import random_mechanism
from scripts.experiments.fuzz.spatial import Array

__all__ = ["Draw", "JudgedColumn", "columns_of", "columns_table", "draw", "is_wrong", "judge_columns"]

RTOL, RTOL_RUNS = 1e-10, 1e-12  # of the sensitivities, and of the runs that differences are taken of
INSTANTS = 40
STEP_FACTOR = 4.0  # between the two steps of a side
LARGEST_STEP, SMALLEST_STEP = 1e-2, 1e-6  # of the parameter's own scale
WANTED_CHANGE = 1e-5  # of the motion, relative: what a step should bring about
NOISE = 3e-11  # relative, of a run's states
AGREEMENT = 1e-3  # of the largest entry: derivatives that differ by less are equal
CONVERGED = 3e-2  # of the largest entry: how far the two steps of a side may differ
PARAMETERS = 4  # for each mechanism
ENDS = {"friction": (0.0,), "damping": (0.0,), "restitution": (0.0, 1.0), "armature": (0.0,)}  # one side is refused
WRONG = ("false none", "missed", "wrong value")
RAW = "raised"
LIMIT = {"solver.max_rhs": 200_000, "solver.max_wall_s": 10.0}


@dataclass(frozen=True)
class Draw:
    """A scene with friction and stops, and the parameters that its sensitivities are asked for."""

    seed: int
    kind: str
    scene: Path
    overrides: dict[str, Any]
    parameters: dict[str, float]  # name, and the value that it has


@dataclass(frozen=True)
class JudgedColumn:
    """One parameter of one scene.

    Attributes
    ----------
    verdict : str
        Of the sensitivities: "derivative", "none", or why there is neither.
    judged : str
        By differences: "derivative", "none" or "undecided".
    error : float
        Largest difference from the differences, of the largest entry; NaN where it is not known.
    note : str
    """

    seed: int
    kind: str
    formulation: str
    parameter: str
    verdict: str
    judged: str
    error: float = np.nan
    note: str = ""

    @property
    def result(self) -> str:
        """What the comparison says: "right", "false none", "missed", "wrong value" or "undecided"."""
        if self.verdict not in ("derivative", "none") or self.judged == "undecided":
            return "undecided"
        if self.verdict == "none":
            return "right" if self.judged == "none" else "false none"
        if self.judged == "none":
            return "missed"
        return "wrong value" if self.error > 1.0 else "right"


# --- drawing -----------------------------------------------------------------------------------------


def draw(seed: int, folder: Path) -> Draw:
    """Write a random mechanism with friction and stops to a folder, and draw its start and parameters."""
    random = np.random.default_rng([seed, 41])
    made = random_mechanism(seed)
    made.write(folder)
    plain = ckc_pin.load(folder)
    tree, reach = plain.tree, plain.tree.step_scale
    numbers = tree.to_coordinates(plain.q_tree)
    force = np.abs(Terms(plain, plain.assembled, np.zeros(plain.n)).h_tree)
    force = np.where(force > 1e-9 * force.max(), force, force.max()) if force.any() else np.ones(plain.n)
    text, urdf = (folder / "mechanism.toml").read_text(), (folder / "tree.urdf").read_text()
    for name, k in tree.index.items():
        if name in tree.free_coordinates:
            continue
        rubs, stops = random.random() < 0.5, random.random() < 0.4
        if not (rubs or stops):
            continue
        text += f'\n[[joint]]\nname = "{name}"\n'
        if rubs:
            text += f"friction = {float(force[k] * 10 ** random.uniform(-2, 0.3))!r}\n"
        if stops:
            room = random.uniform(0.02, 0.4, 2) * reach[k]
            if random.random() < 0.25:  # at its stop from the start
                room[int(random.integers(2))] = 0.0
            urdf = with_limits(urdf, name, float(numbers[k] - room[0]), float(numbers[k] + room[1]))
            text += f"stops = true\nrestitution = {float(random.choice([0.0, 0.0, 0.3, 0.5, 0.9, 1.0]))!r}\n"
    (folder / "mechanism.toml").write_text(text)
    (folder / "tree.urdf").write_text(urdf)
    mechanism = ckc_pin.load(folder)
    pace = float(np.sqrt(mechanism.size))
    moves = (random.random(mechanism.d) < 0.7) * (random.random() < 0.8)
    unit = reach[mechanism.partition.q]
    rates = (random.normal(size=mechanism.d) * moves * unit / pace).tolist()
    overrides: dict[str, Any] = {
        "initial": {"q_dot": dict(zip(mechanism.independent, rates, strict=True))},
        "t_end": float(0.6 * pace * 10 ** random.uniform(-1, 0)),
        "formulation": "dae" if mechanism.splits_root else str(random.choice(["dae", "reduced"])),
        **LIMIT,
    }
    overrides["solver.output_dt"] = overrides["t_end"] / INSTANTS
    if mechanism.splits_root or random.random() < 0.4:
        overrides["initial"]["at"] = "assembled"
    else:
        start = mechanism.independent_part(mechanism.q_tree).tolist()
        overrides["initial"]["q"] = dict(zip(mechanism.independent, start, strict=True))
    parameters = _parameters(random, mechanism, overrides["initial"]) if _scale(mechanism)[1] else {}
    return Draw(seed, made.kind, folder, overrides, parameters)


def _parameters(random: np.random.Generator, mechanism: Mechanism, initial: Mapping[str, Any]) -> dict[str, float]:
    """Draw a key first, so that the few stops and frictions are not lost among inertias."""
    values = with_components(values_of(mechanism.spec, mechanism.urdf))
    known = {name: float(x) for name, x in values.items() if not isinstance(x, tuple)}
    known = {name: x for name, x in known.items() if x not in ENDS.get(name.rpartition(".")[2], ())}
    for key in ("q", "q_dot"):
        known |= {f"initial.{key}.{name}": x for name, x in initial.get(key, {}).items()}
    if "at" in initial:  # what moves an assembled start is refused
        placing = re.compile(r"joint\..*\.(xyz|rpy)\..|loop\..*|coupling\..*")
        known = {name: x for name, x in known.items() if not placing.fullmatch(name)}
    groups: dict[str, list[str]] = {}
    for name in known:
        root, second, *_ = parts = name.split(".")
        key = {"initial": second, "gravity": ""}.get(root, parts[-1] if len(parts[-1]) > 1 else parts[-2])
        groups.setdefault(f"{root}.{key}", []).append(name)
    drawn: dict[str, float] = {}
    while len(drawn) < min(PARAMETERS, len(known)):
        of_key = groups[str(random.choice(list(groups)))]
        name = of_key[int(random.integers(len(of_key)))]
        drawn[name] = known[name]
    return drawn


# --- the suite ---------------------------------------------------------------------------------------


def columns_of(seed: int) -> list[JudgedColumn]:
    """Draw a seed's scene and judge its columns; an exception that is none of the package's is a wrong column too."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return judge_columns(draw(seed, Path(folder) / "mechanism"))
        except CkcError as error:
            return [JudgedColumn(seed, "", "", "", f"refused: {error}", "undecided")]
        except Exception as error:
            return [JudgedColumn(seed, "", "", "", RAW, "undecided", note=f"{type(error).__name__}: {error}")]


def is_wrong(column: JudgedColumn) -> bool:
    """Whether sensitivities and differences contradict each other."""
    return column.verdict == RAW or column.result in WRONG


def columns_table(columns: Sequence[JudgedColumn]) -> str:
    """Counts by kind of mechanism, the reasons of what is undecided, and every wrong column."""
    head = ("right", *WRONG, "undecided")
    lines = [f"{'mechanism':18s} {'columns':>8s}" + "".join(f" {name:>12s}" for name in head) + f" {'none':>6s}"]
    kinds = sorted({column.kind for column in columns})
    for kind in (*kinds, "all"):
        of_kind = [column for column in columns if kind in (column.kind, "all")]
        count = Counter(column.result for column in of_kind)
        none = sum(column.judged == "none" for column in of_kind)
        numbers = "".join(f" {count[name]:12d}" for name in head)
        lines.append(f"{kind:18s} {len(of_kind):8d}{numbers} {none:6d}")
    why = Counter(
        "differences do not converge, or on one side alone" if x.verdict in ("derivative", "none") else x.verdict[:40]
        for x in columns if x.result == "undecided"
    )  # fmt: skip
    lines += ["", "undecided:", *(f"  {count:5d}  {reason}" for reason, count in why.most_common())]
    wrong = [x for x in columns if is_wrong(x)]
    lines += ["", f"wrong: {len(wrong)}"]
    lines += [f"  seed {x.seed}: {x.formulation} {x.parameter}: {x.result} {x.error:.2g} {x.note}" for x in wrong]
    return "\n".join(lines)


# --- judging -----------------------------------------------------------------------------------------


def judge_columns(drawn: Draw) -> list[JudgedColumn]:
    """Ask for each parameter by itself and for all together, and compare with differences."""
    if not drawn.parameters:
        return []
    overrides = {**drawn.overrides, "solver.rtol": RTOL_RUNS}
    try:
        run = ckc_pin.simulate(drawn.scene, overrides)
    except CkcError as error:
        return [_column(drawn, name, f"no run: {error}") for name in drawn.parameters]
    if run.status != "done":
        return [_column(drawn, name, f"no run: {run.message}") for name in drawn.parameters]
    columns = [_judge(drawn, name, run) for name in drawn.parameters]
    return [*columns, *_together(drawn, columns)]


def _column(drawn: Draw, name: str, verdict: str, judged: str = "undecided", **more: Any) -> JudgedColumn:
    return JudgedColumn(drawn.seed, drawn.kind, drawn.overrides["formulation"], name, verdict, judged, **more)


def _together(drawn: Draw, columns: Sequence[JudgedColumn]) -> list[JudgedColumn]:
    """Whether the verdict about all parameters is that about the first of them that has none."""
    alone = [column.verdict for column in columns]
    if any(verdict not in ("derivative", "none") for verdict in alone):
        return []
    try:
        found = ckc_pin.sensitivities(drawn.scene, list(drawn.parameters), {**drawn.overrides, "solver.rtol": RTOL})
    except CkcError as error:
        return [_column(drawn, "all", f"refused: {error}")]
    verdict, expected = _verdict(found), "none" if "none" in alone else "derivative"
    return [_column(drawn, "all", verdict, expected, error=0.0, note=found.run.message)]


def _verdict(found: ckc_pin.Sensitivities) -> str:
    if found.run.status == "done":
        return "derivative"
    return "none" if "no derivative" in found.run.message else f"stopped: {found.run.message}"


def _states(run: ckc_pin.Run, mechanism: Mechanism) -> Array:
    """Joints' coordinates and rates by instant, (m, 2 n), in units of a mechanism that stays the same."""
    scale, joints = _scale(mechanism)
    return np.hstack([run.q_tree[:, joints], run.v_tree[:, joints]]) / scale


def _scale(mechanism: Mechanism) -> tuple[Array, Sequence[int]]:
    tree = mechanism.tree
    joints = [k for name, k in tree.index.items() if name not in tree.free_coordinates]
    reach = tree.step_scale[joints]
    return np.concatenate([reach, reach / np.sqrt(mechanism.size)]), joints


def _judge(drawn: Draw, name: str, run: ckc_pin.Run) -> JudgedColumn:
    try:
        found = ckc_pin.sensitivities(drawn.scene, [name], {**drawn.overrides, "solver.rtol": RTOL})
    except CkcError as error:
        return _column(drawn, name, f"refused: {error}")
    verdict, note = _verdict(found), found.run.message
    if verdict not in ("derivative", "none"):
        return _column(drawn, name, verdict, note=note)
    at, here = drawn.parameters[name], run
    try:
        sides = _sides(drawn, name, at, here)
        if verdict == "none" and _differ(*sides) is False:  # what differs may fade before the next instant
            t = float(found.run.t[-1])
            t_end = t + 1e-3 * (run.t[-1] - t)
            drawn = Draw(
                drawn.seed, drawn.kind, drawn.scene, {**drawn.overrides, "t_end": t_end, "solver.output_dt": t_end}, {}
            )
            here = ckc_pin.simulate(drawn.scene, {**drawn.overrides, "solver.rtol": RTOL_RUNS})
            sides = _sides(drawn, name, at, here)
    except _OneSideOnly as error:
        return _column(drawn, name, verdict, note=f"{note}; {error}")
    differ = _differ(*sides)
    judged = "undecided" if differ is None else "none" if differ else "derivative"
    largest = np.nan
    if verdict == judged == "derivative":
        scale, joints = _scale(run.mechanism)
        S = np.hstack([found.q_tree[:, joints, 0], found.v_tree[:, joints, 0]]) / scale
        largest = max(side.error(S) for side in sides)
    return _column(drawn, name, verdict, judged, error=largest, note=note)


class _OneSideOnly(Exception):
    """With a larger or with a smaller parameter there is no run."""


@dataclass(frozen=True)
class _Side:
    """Derivatives by differences on one side: by instant, with how far they may be off; NaN where that is not known."""

    value: Array
    uncertainty: Array

    def error(self, S: Array) -> float:
        """The largest difference from what is known, of what is allowed."""
        size = max(np.nanmax(np.abs(self.value), initial=0.0), np.abs(S).max())
        allowed = 3 * self.uncertainty + AGREEMENT * size
        return float(np.nanmax(np.abs(S - self.value) / allowed[:, None], initial=0.0))


def _sides(drawn: Draw, name: str, at: float, run: ckc_pin.Run) -> tuple[_Side, _Side]:
    here = _states(run, run.mechanism)
    unit = abs(at) if name.startswith("link.") and at else max(abs(at), 0.1)
    moved = _difference(drawn, name, at, 1e-4 * unit, run) * 1e-4 * unit
    change = float(np.quantile(np.abs(moved).max(axis=1), 0.95))  # some instants are beside an event
    size = max(1.0, np.abs(here).max())
    h = 1e-4 * unit * np.clip(WANTED_CHANGE * size / max(change, 1e-300), SMALLEST_STEP / 1e-4, LARGEST_STEP / 1e-4)
    return _side(drawn, name, at, h, run), _side(drawn, name, at, -h, run)


def _side(drawn: Draw, name: str, at: float, h: float, base: ckc_pin.Run) -> _Side:
    far, near = (_difference(drawn, name, at, step, base) for step in (h, h / STEP_FACTOR))
    value = near + (near - far) / (STEP_FACTOR - 1)
    uncertainty = np.abs(near - far).max(axis=1)
    noise = NOISE * max(1.0, np.abs(_states(base, base.mechanism)).max()) * STEP_FACTOR / abs(h)
    size = np.median(np.abs(near).max(axis=1))
    lost = uncertainty > CONVERGED * np.maximum(np.abs(near).max(axis=1), size) + 10 * noise
    value[lost], uncertainty[lost] = np.nan, np.nan
    return _Side(value, uncertainty + noise)


def _difference(drawn: Draw, name: str, at: float, h: float, base: ckc_pin.Run) -> Array:
    try:
        run = ckc_pin.simulate(drawn.scene, {**drawn.overrides, "solver.rtol": RTOL_RUNS, name: at + h})
    except CkcError as error:
        raise _OneSideOnly(f"{name} {h:+.2g}: {error}") from error
    if run.status != "done":
        raise _OneSideOnly(f"{name} {h:+.2g}: {run.message}")
    return (_states(run, base.mechanism) - _states(base, base.mechanism)) / h


def _differ(one: _Side, other: _Side) -> bool | None:
    """Whether the two sides have derivatives of their own; None where that cannot be told."""
    size = max(np.nanmax(np.abs(one.value), initial=0.0), np.nanmax(np.abs(other.value), initial=0.0))
    apart = np.abs(one.value - other.value).max(axis=1)
    known = np.isfinite(apart)
    if known.sum() < max(1, len(known) // 4):
        return None
    allowed = 3 * (one.uncertainty + other.uncertainty)[known] + AGREEMENT * size
    ratio = float((apart[known] / allowed).max())
    return None if 1.0 < ratio < 3.0 else ratio >= 3.0
