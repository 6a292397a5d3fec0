"""Panels over time. Each takes a `Slot` and a `Group`, draws an axes for each unit, and labels them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.units import motor_units
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.canvas import Slot, fit_legend, limit, line, note_on, say
from ckc_pin.view.desired import DesiredPath
from ckc_pin.view.group import Group, columns
from ckc_pin.view.labels import plain, rate_symbol, symbol, with_unit

__all__ = ["coordinates", "effort_symbol", "efforts", "errors", "loop_forces", "rates", "scalar", "unit_of"]

DOTS = 25  # of a desired curve
SPIN = 2 * np.pi  # of a hinge's way: what turns further is wrapped
TURNS = 20  # more would be stripes: these are counted
NAMED = 3  # in a note


# --- what moves ----------------------------------------------------------------------------------


def coordinates(slot: Slot, group: Group, names: Sequence[str]) -> None:
    """Draw coordinates over time, what was wanted as dots; hinges that spin are wrapped, or counted in turns."""
    ways = {name: max(float(np.ptp(run.q_tree[:, run.column(name)])) for run in group.runs) for name in names}
    kinds: dict[str, list[str]] = {}
    for name in names:
        free = name in group.mechanism.tree.free_coordinates
        unit = unit_of(group, name)
        counted = unit == "rad" and not free and ways[name] > TURNS * 2 * np.pi
        kinds.setdefault("turns" if counted else unit, []).append(name)
    wrapped = [name for name in kinds.get("rad", []) if ways[name] > SPIN
               and name not in group.mechanism.tree.free_coordinates]  # fmt: skip
    for (unit, own), ax in zip(kinds.items(), slot.axes(len(kinds)), strict=True):

        def shown(q: Array, name: str, unit: str = unit) -> Array:
            return q / (2 * np.pi) if unit == "turns" else _wrapped(q) if name in wrapped else q

        _curves(ax, group, own, lambda run, name: shown(run.q_tree[:, run.column(name)], name))
        _dots(ax, group, own, lambda wanted, k, name: shown(wanted.q[:, k], name))
        ax.set_ylabel(with_unit(symbol(own[0]) if len(own) == 1 else "$q$", unit))
        if wrapped and unit == "rad":
            ax.set_yticks([-np.pi, 0, np.pi], ["$-π$", "0", "$π$"])
            every = len(wrapped) == len(own)
            spin = ", ".join(map(symbol, wrapped)) if len(wrapped) <= NAMED else f"{len(wrapped)} that spin"
            note_on(ax, f"{'' if every else f'{spin}: '}wrapped to $±π$")
    _time(slot, group, list(kinds))


def rates(slot: Slot, group: Group, names: Sequence[str]) -> None:
    """Draw rates over time, what was wanted as dots where it moves."""
    kinds = _by_unit(names, lambda name: f"{unit_of(group, name)}/s")
    for (unit, own), ax in zip(kinds.items(), slot.axes(len(kinds)), strict=True):
        _curves(ax, group, own, lambda run, name: run.v_tree[:, run.column(name)])
        if group.kind == "tracking":
            _dots(ax, group, own, lambda wanted, k, _: wanted.q_dot[:, k])
        note = limit(ax, [(run.t, run.v_tree[:, columns(run, own)]) for run in group.runs], group.shown, group.small)
        note_on(ax, note)
        ax.set_ylabel(with_unit(rate_symbol(own[0]) if len(own) == 1 else r"$\dot q$", unit))
    _time(slot, group, list(kinds))


def errors(slot: Slot, group: Group, names: Sequence[str]) -> None:
    """Draw q - q_d over time."""
    kinds = _by_unit(names, lambda name: unit_of(group, name))
    for (unit, own), ax in zip(kinds.items(), slot.axes(len(kinds)), strict=True):
        for name in _behind_first(group, own):
            for run, wanted, shape in zip(group.runs, group.wanted, group.lines, strict=True):
                if wanted is not None:
                    error = run.q_tree[:, run.column(name)] - wanted.q[:, run.independent.index(name)]
                    ax.plot(run.t, error, **_look(group, name, shape))
        ax.set_ylabel(with_unit("$q - q_d$", unit))
    _time(slot, group, list(kinds))


# --- what pushes ---------------------------------------------------------------------------------


def efforts(slot: Slot, group: Group, names: Sequence[str], note: str = "") -> None:
    """Draw the motors' efforts over time; a short peak at either end is marked instead of flattening the rest."""
    run = group.runs[0]
    units = motor_units(group.mechanism)
    kinds = _by_unit(names, lambda name: units[run.actuated.index(name)])
    for (unit, own), ax in zip(kinds.items(), slot.axes(len(kinds)), strict=True):
        _curves(ax, group, own, lambda run, name: run.tau[:, run.actuated.index(name)])
        rows = [run.actuated.index(name) for name in own]
        cut = limit(ax, [(run.t, run.tau[:, rows]) for run in group.runs], group.shown, group.small)
        note_on(ax, "\n".join(filter(None, [note, cut])))
        note = ""
        ax.set_ylabel(with_unit(f"${effort_symbol(group)}$", unit))
    _time(slot, group, list(kinds))


def effort_symbol(group: Group) -> str:
    """Return u where the motors turn the independent joints themselves, as in the paper, else tau."""
    return "u" if group.mechanism.has_direct_drives else r"\tau"


def loop_forces(slot: Slot, group: Group) -> None:
    """Draw the size of each loop's force over time, N: of its multipliers those of rows that are lengths."""
    mechanism = group.mechanism
    (ax,) = slot.axes()
    metres = mechanism.closure.in_metres(mechanism.tree)
    loops = [loop for loop, _ in mechanism.closure.names]
    curves = [{loop: np.linalg.norm(forces[:, own], axis=1) for loop, forces in run.loop_forces().items()
               if any(own := metres[[name == loop for name in loops]])} for run in group.runs]  # fmt: skip
    holding = list(curves[0])
    largest = {loop: max(float(np.nanmax(sizes[loop], initial=0.0)) for sizes in curves) for loop in holding}
    named = style.foremost(largest)
    colours = style.colours(named)
    for loop in [*(loop for loop in holding if loop not in named), *named]:
        for run, shape, sizes in zip(group.runs, group.lines, curves, strict=True):
            look = shape if loop in colours else shape | {"linewidth": 0.7}
            ax.plot(run.t, sizes[loop], color=colours.get(loop, style.REST), **look)
    every = [(run.t, np.column_stack(list(sizes.values()))) for run, sizes in zip(group.runs, curves, strict=True)
             if sizes]  # fmt: skip
    say(ax, slot.title, limit(ax, every, group.end))
    _axis(ax, group.end)
    ax.set_ylabel(with_unit(r"$|\lambda|$", "N"))
    if not holding:
        ax.text(0.5, 0.5, "no loop holds points together", ha="center", va="center", transform=ax.transAxes)
    if len(holding) == 1:
        say(ax, slot.title.replace("loop forces", f"force in loop {plain(holding[0])}"), limit(ax, every, group.end))
        return
    handles = [line(colours[loop], plain(loop)) for loop in named]
    if len(named) < len(holding):
        handles.append(line(style.REST, f"{len(holding) - len(named)} more"))
    fit_legend(ax, handles)


# --- one number ----------------------------------------------------------------------------------


def scalar(
    slot: Slot, group: Group, values: Callable[[Run], Array], name: str, dots: bool = False, cut: bool = True
) -> Any:
    """Draw one number over all of the time, a colour for each run; as dots where it is mostly rounding."""
    (ax,) = slot.axes()
    for k, (run, shape) in enumerate(zip(group.runs, group.lines, strict=True)):
        look = {"linestyle": "none", "marker": ".", "markersize": 2.0 * shape["linewidth"]} if dots else shape
        ax.plot(run.t, values(run), color=style.COLOURS[k % len(style.COLOURS)], **look)
    if cut:
        say(ax, slot.title, limit(ax, [(run.t, values(run)[:, None]) for run in group.runs], group.end))
    ax.set_ylabel(name)
    _axis(ax, group.end)
    return ax


def unit_of(group: Group, name: str) -> str:
    """Return the unit of a coordinate."""
    return group.mechanism.tree.units()[group.mechanism.tree.index[name]]


# --- parts ---------------------------------------------------------------------------------------


def _by_unit(names: Sequence[str], unit: Callable[[str], str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(unit(name), []).append(name)
    return found


def _behind_first(group: Group, names: Sequence[str]) -> list[str]:
    """Names in the order that puts those without a colour of their own behind the others."""
    return sorted(names, key=lambda name: group.colours[name] != style.REST)


def _look(group: Group, name: str, shape: dict[str, Any]) -> dict[str, Any]:
    colour = group.colours[name]
    return shape | {"color": colour} | ({"linewidth": 0.7} if colour == style.REST else {})


def _curves(ax: Any, group: Group, names: Sequence[str], values: Callable[[Run, str], Array]) -> None:
    ordered = _behind_first(group, names)
    for run, shape in zip(group.runs, group.lines, strict=True):
        for name in ordered:
            ax.plot(run.t, values(run, name), **_look(group, name, shape))


def _dots(ax: Any, group: Group, names: Sequence[str], values: Callable[[DesiredPath, int, str], Array]) -> None:
    for run, wanted in group.desired:
        rows = np.unique(np.linspace(0, len(run.t) - 1, 10 if group.small else DOTS).astype(int))
        for k, name in enumerate(run.independent):
            if name in names and group.colours[name] != style.REST:
                column = values(wanted, k, name)
                ax.plot(run.t[rows], column[rows], linestyle="none", marker=".", markersize=3, color="black")


def _wrapped(q: Array) -> Array:
    """Angles within ±pi, without the lines that their jumps would draw."""
    around = np.remainder(q + np.pi, 2 * np.pi) - np.pi
    jumps = np.flatnonzero(np.abs(np.diff(around)) > np.pi)
    around[jumps] = np.nan
    return around


def _time(slot: Slot, group: Group, units: Sequence[str]) -> None:
    """Label the lowest of a panel's axes."""
    for ax in slot.figure.axes[-len(units) :]:
        _axis(ax, group.shown)
        ax.set_xlabel("")
    slot.figure.axes[-1].set_xlabel(with_unit("$t$", "s"))


def _axis(ax: Any, end: float) -> None:
    ax.set_xlabel(with_unit("$t$", "s"))
    if end > 0:
        ax.set_xlim(-0.02 * end, 1.02 * end)
