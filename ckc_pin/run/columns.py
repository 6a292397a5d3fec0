"""Named columns of a run (data frame, CSV, xarray), and units of its quantities, of parameters and of scene keys."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import is_parameter
from ckc_pin.mechanism.units import STIFF, VISCOUS, effort, joined, motor_units, parameter_unit, row_units

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = [
    "derivative_unit",
    "integral_unit",
    "key_unit",
    "list_columns",
    "quantity_units",
    "to_csv_text",
    "to_data_frame",
    "to_dataset",
]

SCALARS = ("energy", "lyapunov", "dissipated")  # quantities of a run with one value per instant, J
AXES = ["x", "y", "z"]
KEYS_IN_SECONDS = ("t_end", "epsilon", "max_step", "min_step", "max_wall_s", "output_dt", "sample_time", "delay",
                   "filter")  # fmt: skip


# --- columns ---------------------------------------------------------------------------------------


def list_columns(run: Run) -> dict[str, Array]:
    """Return the columns of a run's table except t, by name: coordinates, ``v.``, ``u.``, ``tau.``, ``phi.``, ``w.``.

    Energies and the world coordinates of points follow.

    Raises
    ------
    InputError
        Two columns would have the same name.
    """
    rows = _row_names(run)
    columns: list[tuple[str, Array]] = [
        *_name_columns("", run.coordinates, run.q_tree),
        *_name_columns("v.", run.coordinates, run.v_tree),
        *_name_columns("u.", run.independent, run.u),
        *_name_columns("tau.", run.actuated, run.tau),
        *_name_columns("phi.", rows, run.phi),
        *_name_columns("w.", rows, run.w),
        *((name, getattr(run, name)) for name in SCALARS if getattr(run, name) is not None),
    ]
    for point, path in run.points.items():
        columns += _name_columns(f"{point}.", AXES, path)
    by_name = dict(columns)
    if len(by_name) < len(columns) or "t" in by_name:
        names = [name for name, _ in columns]
        duplicate = next((name for name in names if names.count(name) > 1), "t")
        raise InputError(f"{run.scene_name}: two columns would be called {duplicate!r}; rename that joint")
    return by_name


def to_csv_text(run: Run) -> str:
    """Return a run as CSV with the columns t and those of `list_columns`. All digits of each number are written."""
    import csv

    columns = list_columns(run)
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["t", *columns])
    writer.writerows(np.column_stack([run.t, *columns.values()]).tolist())
    return text.getvalue()


def to_data_frame(run: Run) -> Any:
    """Return a run as a pandas DataFrame with the index t.

    Raises
    ------
    InputError
        pandas is not installed.
    """
    try:
        import pandas
    except ModuleNotFoundError:
        raise InputError("to_pandas needs pandas: pip install 'ckc_pin[data]'") from None
    return pandas.DataFrame(list_columns(run), index=pandas.Index(run.t, name="t"))


def to_dataset(run: Run) -> Any:
    """Return a run as an xarray Dataset with named dimensions and units.

    Raises
    ------
    InputError
        xarray is not installed.
    """
    try:
        import xarray
    except ModuleNotFoundError:
        raise InputError("to_xarray needs xarray: pip install 'ckc_pin[data]'") from None
    units = quantity_units(run.mechanism)
    vectors = {
        "q_tree": ("coordinate", run.q_tree),
        "v_tree": ("coordinate", run.v_tree),
        "u": ("independent", run.u),
        "tau": ("motor", run.tau),
        "phi": ("row", run.phi),
        "w": ("row", run.w),
    }
    data: dict[str, Any] = {
        name: (("t", dimension), values, {"units": joined(units[name])})
        for name, (dimension, values) in vectors.items()
    }
    data |= {name: ("t", getattr(run, name), {"units": "J"}) for name in SCALARS if getattr(run, name) is not None}
    coordinates: dict[str, Any] = {
        "t": ("t", run.t, {"units": "s"}),
        "coordinate": list(run.coordinates),
        "independent": list(run.independent),
        "motor": list(run.actuated),
        "row": _row_names(run),
        "unit": ("coordinate", units["q_tree"]),
        "independent_unit": ("independent", units["error"]),
        "motor_unit": ("motor", units["tau"]),
        "row_unit": ("row", units["phi"]),
    }
    if run.points:
        data["points"] = (("point", "t", "axis"), np.array(list(run.points.values())), {"units": "m"})
        coordinates |= {"point": list(run.points), "axis": AXES}
    attributes = {"scene": run.scene_name, "formulation": run.scene["formulation"], "status": run.status}
    return xarray.Dataset(data, coordinates, {**attributes, "message": run.message})


def _row_names(run: Run) -> list[str]:
    return [".".join(name) for name in run.mechanism.closure.names]


def _name_columns(prefix: str, names: Sequence[str], values: Array) -> list[tuple[str, Array]]:
    return [(f"{prefix}{name}", values[:, k]) for k, name in enumerate(names)]


# --- units -----------------------------------------------------------------------------------------


def quantity_units(mechanism: Mechanism) -> dict[str, list[str]]:
    """Return the unit of each component of a run's quantities, by the quantity's name."""
    tree, q, rows = mechanism.tree, mechanism.partition.q, row_units(mechanism)
    independent = [tree.units()[k] for k in q]
    return {
        "q_tree": tree.units(), "v_tree": tree.units("/s"), "error": independent,
        "u": [effort(unit) for unit in independent], "tau": motor_units(mechanism), "phi": rows, "w": rows,
        "t": ["s"], "energy": ["J"], "dissipated": ["J"], "lyapunov": ["J"],
    }  # fmt: skip


def integral_unit(unit: str) -> str:
    """Return the unit of a quantity's integral over time."""
    return unit.removesuffix("/s") if unit.endswith("/s") else "s²" if unit == "s" else f"{unit} s"


def derivative_unit(unit: str, other: str) -> str:
    """Return the unit of the derivative of a quantity with respect to another one."""
    return f"{unit}/({other})" if "/" in other or " " in other else f"{unit}/{other}" if other else unit


def key_unit(mechanism: Mechanism, name: str) -> str:
    """Return the unit of a mechanism parameter or of a scene's key; "" if it has none."""
    if is_parameter(name):
        return parameter_unit(mechanism, name)
    root, _, rest = name.partition(".")
    key, _, component = rest.partition(".")
    if name.rpartition(".")[2] in KEYS_IN_SECONDS:
        return "s"
    if name == "friction_smoothing":
        return joined(mechanism.tree.units("/s"))
    if root == "initial":
        return _component_unit(mechanism.coordinates, mechanism.tree.units("/s" if key == "q_dot" else ""), component)
    if root == "controller":
        return _controller_unit(mechanism, key, component)
    return ""


def _controller_unit(mechanism: Mechanism, key: str, component: str) -> str:
    units = quantity_units(mechanism)
    q, tau = units["error"], units["tau"]
    if key in ("sensor", "drive", "allocation"):
        key, _, component = component.partition(".")
    if key == "desired":
        component, _, key = component.rpartition(".")
        if not component:  # the path of a point
            return {"max_rate": "m/s", "max_acceleration": "m/s²"}.get(key, "")
    viscous, rates = [VISCOUS[unit] for unit in q], [f"{unit}/s" for unit in q]
    by_coordinate = {
        "K_P": [STIFF[unit] for unit in q], "K_V": viscous, "K_D": viscous, "Lambda": ["1/s"] * len(q), "q_d": q,
        "offset": q, "rate": rates, "max_rate": rates, "max_acceleration": [f"{unit}/s²" for unit in q],
        "resolution": q, "q_noise": q, "q_dot_noise": rates,
    }  # fmt: skip
    by_motor = {"torque_limit": tau, "preload": tau, "torque_resolution": tau,
                "torque_rate": [f"{unit}/s" for unit in tau]}  # fmt: skip
    if key in by_coordinate:
        return _component_unit(mechanism.independent, by_coordinate[key], component)
    return _component_unit(mechanism.actuated, by_motor[key], component) if key in by_motor else ""


def _component_unit(names: tuple[str, ...], units: list[str], name: str) -> str:
    """Return the unit of the component called `name`, or the units of all components if there is none."""
    return dict(zip(names, units, strict=True)).get(name) or joined(units)
