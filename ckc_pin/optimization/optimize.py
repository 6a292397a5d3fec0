"""Plan a motion: the entry points of `optimize`, from a file or from Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.validation import describe_value, require_callable, require_table
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import as_mechanism, load_beside
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.end_states import (
    refuse_unsupported,
    refuse_with_crossings,
)
from ckc_pin.optimization.limits import MotionLimits, make_limits
from ckc_pin.optimization.places import resolve_places
from ckc_pin.optimization.plan import Plan
from ckc_pin.optimization.plan_along import plan_along
from ckc_pin.optimization.point_to_point import plan_between
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.route import Route
from ckc_pin.optimization.spec import (
    OptimizeSpec,
    make_spec,
    read_optimize,
)
from ckc_pin.scene.arguments import embed_file

__all__ = ["optimize", "optimize_file", "read_arguments"]


def optimize(
    mechanism: Mechanism | str | Path,
    *,
    start: Mapping[str, Any] | None = None,
    to: Mapping[str, Any] | None = None,
    via: Sequence[Mapping[str, Any]] | None = None,
    periodic: Mapping[str, Any] | None = None,
    path: Mapping[str, Any] | None = None,
    minimize: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    cross_singularities: bool = False,
    desired: Mapping[str, Any] | None = None,
    intervals: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Plan:
    """Plan a motion of a mechanism, from one configuration to another or along a path, within limits.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
    start, to : mapping, optional
        The keys of ``[from]`` and ``[to]``: ``{"q": {"theta_1": -1.2, "theta_3": -1.9}}``,
        ``{"point": {"tip": [0.1, -0.4, 0.0]}}`` or ``{"at": "equilibrium"}``. The start is as assembled by default.
    via : sequence of mappings, optional
        The keys of each ``[[via]]``, places that the motion passes: ``[{"q": {"theta_1": -1.2}, "dwell": 0.1}]``.
    periodic : mapping, optional
        The keys of ``[periodic]``, of a motion that repeats: ``{"turns": {"crank": 1}}``. Then there is no `to`, and
        coordinates and rates that `start` does not name are free.
    path : mapping, optional
        The keys of ``[path]``, of the fastest motion along one:
        ``{"q": {"theta_1": [-1.2, -1.0], "theta_3": [-1.9, -1.7]}}``, or
        ``{"point": {"tip": [[0.1, -0.4, 0.0], [0.2, -0.4, 0.0]]}}``. With ``{"shape": "free"}``, a path from `start` to
        `to` is searched that keeps the limits and does not reach a singular configuration.
    minimize, limits : mapping, optional
        The keys of ``[minimize]`` and ``[limits]``: ``{"time": 1.0}``, ``{"torque": 3.0, "rate": 5.0}``.
    cross_singularities : bool
        Singular configurations may be crossed, as the key of the file.
    desired : mapping, optional
        The motion that ``minimize["tracking"]`` refers to: ``{"file": {"t": t, "theta_1": x, "theta_3": y}}``, or the
        other keys of a tracking controller's ``desired``.
    intervals : int, optional
        Intervals of the grid.
    progress : callable, optional
        Called as progress(fraction).

    Raises
    ------
    InputError, MechanismError
        Unknown names, or a path out of reach.
    NumericalError
        No motion fulfils the limits.
    """
    mechanism = as_mechanism(mechanism, "optimize")
    require_callable(progress, "optimize: progress", "a function of the fraction", 1)
    tables = {"from": start, "to": to, "periodic": periodic, "path": path, "minimize": minimize, "limits": limits,
              "desired": desired}  # fmt: skip
    spec, sources = read_arguments(
        mechanism, tables, intervals, "optimize", via, cross_singularities=cross_singularities
    )
    return _optimize(mechanism, spec, sources, progress or (lambda fraction: None))


def read_arguments(
    mechanism: Mechanism,
    tables: Mapping[str, Any],
    intervals: int | None,
    where: str,
    via: Any = None,
    **keys: Any,
) -> tuple[OptimizeSpec, Sources]:
    """Return the task that the tables and other keys of a file, from Python, describe; tables of None are absent.

    Raises
    ------
    InputError
        Unknown keys or wrong values.
    """
    data: dict[str, Any] = {"mechanism": mechanism.name, **keys}
    for name, table in tables.items():
        if table is not None:
            require_table(table, f"{where}: {name}", f"a table with the keys of [{name}]")
            data[name] = _to_data(table)
    if via is not None:
        if isinstance(via, str) or not isinstance(via, Sequence):
            raise InputError(f"{where}: via: expected a list of tables, got {describe_value(via)}")
        for k, table in enumerate(via):
            require_table(table, f"{where}: via[{k}]", "a table with the keys of [[via]]")
        data["via"] = _to_data(via)
    if intervals is not None:
        data["intervals"] = intervals
    texts: dict[str, str] = {}
    embed_file(data.get("desired"), "desired.csv", texts, f"{where}: desired.file", reads_paths=True)
    return make_spec(data, where), Sources(where, None, texts)


def optimize_file(
    path: str | Path, overrides: Mapping[str, Any] | None = None, progress: Callable[[float], None] | None = None
) -> Plan:
    """Plan the motion that a file describes, with values replaced by dotted key; errors as of `optimize`."""
    spec, sources = read_optimize(path, overrides)
    mechanism = load_beside(spec.mechanism, Path(path).parent, spec.parameters)
    return _optimize(mechanism, spec, sources, progress or (lambda fraction: None))


def _to_data(value: Any) -> Any:
    """Return tables and arrays as dictionaries and lists."""
    if isinstance(value, Mapping):
        return {key: _to_data(x) for key, x in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_to_data(x) for x in value] if isinstance(value, list | tuple) else value


def _optimize(mechanism: Mechanism, spec: OptimizeSpec, sources: Sources, progress: Callable[[float], None]) -> Plan:
    mechanism.refuse_prescribed_joints("optimize")
    if not mechanism.d:
        raise InputError(f"optimize: {mechanism.name} has no freedoms, so that nothing moves")
    is_free = spec.path is not None and spec.path.shape == "free"
    if spec.periodic is not None and (spec.to is not None or spec.path is not None):
        other = "to" if spec.to is not None else "path"
        raise InputError(f"optimize: {other}: a periodic motion ends where it begins; remove {other} or periodic")
    if spec.periodic is None and (spec.path is None or is_free) == (spec.to is None):
        got = "neither" if spec.to is None else "both"
        raise InputError(f'optimize: expected either `to` or `path`, got {got}; path.shape = "free" needs both')
    if spec.via and spec.path is not None:
        raise InputError("optimize: via: a motion along a path passes the places of the path; remove via or path")
    limits = make_limits(spec.limits, mechanism)
    with one_blas_thread():
        if spec.path is None:
            return _between_places(mechanism, spec, limits, sources, progress)
        return plan_along(mechanism, spec, spec.path, limits)


def _between_places(
    mechanism: Mechanism, spec: OptimizeSpec, limits: MotionLimits, sources: Sources,
    progress: Callable[[float], None],
) -> Plan:  # fmt: skip
    """Plan a motion from one configuration to another, or a periodic one."""
    period = None if spec.periodic is None else spec.periodic.time
    if period is not None:
        if period > limits.time:
            raise InputError(f"optimize: periodic.time: {period:g} s is above limits.time = {limits.time:g} s")
        limits = msgspec.structs.replace(limits, time=period)
        if spec.minimize.time:
            raise InputError("optimize: periodic.time: the period is given, which minimize.time does not change; give "
                             "another weight, as effort = 1.0")  # fmt: skip
    refuse_unsupported(mechanism, spec.minimize, limits, spec.desired)
    if spec.cross_singularities:
        refuse_with_crossings(spec)
    dynamics = ReducedDynamics(mechanism)
    resolved = resolve_places(dynamics, spec, limits.time)
    route = Route.of(resolved.members, limits, resolved.places, resolved.stays, [x.at.q_tree for x in resolved.states])
    plan = plan_between(dynamics, spec, limits, sources, resolved.names, resolved.states, route, progress)
    return replace(plan, via_t=(0.0, *plan.via_t)) if resolved.names[0] == "via[0]" else plan
