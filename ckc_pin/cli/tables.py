"""Tables of terms, inverse dynamics and profiles for a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.units import motor_units

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from ckc_pin.run.motion_forces import MotionForces
    from ckc_pin.run.run import Run

__all__ = ["inverse_table", "profile_table", "terms_table"]

SPATIAL = (slice(0, 3), slice(3, 6))  # force and moment of a wrench
NO_MOMENT = 1e-9  # of the force on the arm of the mechanism's size


def terms_table(found: Terms) -> Group:
    """Return all terms at a state for people."""
    from rich.console import Group
    from rich.text import Text

    mechanism = found.mechanism
    state = _plain_table("coordinate", "q_tree", "v_tree", "h_tree")
    numbers = mechanism.tree.to_coordinates(found.q_tree)
    for k, name in enumerate(mechanism.coordinates):
        state.add_row(name, *(f"{x:.8g}" for x in (numbers[k], found.v_tree[k], found.h_tree[k])))
    parts: list[Any] = [state, Text(f"energy {found.energy:.8g} J")]
    for name in ("phi", "h"):
        parts.append(Text(f"{name}  {_row(np.asarray(getattr(found, name)))}"))
    for name in ("D_tree", "C_tree", "rho", "rho_dot", "D", "C"):
        parts += [Text(name), *(Text("  " + _row(row)) for row in getattr(found, name))]
    parts += [Text("phi_q | phi_z"), *(Text(f"  {_row(a)} | {_row(b)}") for a, b in _rows_of_jacobian(found))]
    return Group(*parts)


def inverse_table(found: MotionForces) -> Group:
    """Return what a motion needs for people: the largest of each, and when."""
    from rich.console import Group
    from rich.text import Text

    table = _plain_table("of the motion")
    for title in ("largest", "at t (s)"):
        table.add_column(title, justify="right")
    beyond = {entry["motor"]: entry for entry in found.exceeded}
    table.add_column("limit")
    for k, (motor, unit) in enumerate(zip(found.actuated, motor_units(found.mechanism), strict=True)):
        limit = found.limit[k]
        says = f"{limit:.4g} {unit}" if np.isfinite(limit) else ""
        if motor in beyond:
            says += f", exceeded from t = {beyond[motor]['t']:.4g} s on"
        table.add_row(f"motor {motor}", *_largest(found.t, np.abs(found.tau[:, k]), unit), says)
    for loop, multipliers in found.loop_forces.items():
        if loop not in found.loop_wrenches:
            table.add_row(f"coupling {loop}", *_largest(found.t, np.abs(multipliers[:, 0]), ""))
            continue
        force, moment = (np.linalg.norm(found.loop_wrenches[loop][:, part], axis=1) for part in SPATIAL)
        if force.any() or not moment.any():
            table.add_row(f"loop {loop}", *_largest(found.t, force, "N"))
        if moment.max() > NO_MOMENT * found.mechanism.size * force.max():
            table.add_row(f"loop {loop}, moment", *_largest(found.t, moment, "N m"))
    return Group(table, Text(found.message))


def _largest(t: Array, sizes: Array, unit: str) -> tuple[str, str]:
    at = int(np.argmax(sizes))
    return f"{sizes[at]:.4g} {unit}", f"{t[at]:.4g}"


def profile_table(run: Run) -> Table:
    """Return which terms were evaluated, how often, and what that cost."""
    table = _plain_table("term")
    for title in ("evaluated", "ms"):
        table.add_column(title, justify="right")
    for name, cost in run.profile.items():
        table.add_row(name, str(cost["calls"]), f"{1e3 * cost['seconds']:.2f}")
    return table


def _rows_of_jacobian(found: Terms) -> zip[tuple[Array, Array]]:
    return zip(found.at.phi_q, found.at.phi_z, strict=True)


def _row(values: Array) -> str:
    return " ".join(f"{x + 0.0:>14.8g}" for x in values)


def _plain_table(*titles: str) -> Table:
    from rich.table import Table

    table = Table(*titles, box=None, show_header=any(titles), pad_edge=False)
    return table
