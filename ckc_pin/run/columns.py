"""A run as other programs hold data: labelled arrays, a data frame, a CSV file; all of one table of columns."""

from __future__ import annotations

from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined
from ckc_pin.run.units import quantity_units

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["as_csv", "as_data_frame", "as_dataset", "columns"]

BY_TIME = ("energy", "lyapunov", "dissipated")
AXES = ["x", "y", "z"]


def columns(run: Run) -> dict[str, Array]:
    """Return a column for each number of an instant but t: coordinates by name, the rest with a prefix.

    Raises
    ------
    InputError
        A joint is called as another column is.
    """
    every: list[tuple[str, Array]] = [
        *_by_name("", run.coordinates, run.q_tree),
        *_by_name("v.", run.coordinates, run.v_tree),
        *_by_name("u.", run.independent, run.u),
        *_by_name("tau.", run.actuated, run.tau),
        *_by_name("phi.", _rows(run), run.phi),
        *_by_name("w.", _rows(run), run.w),
        *((name, getattr(run, name)) for name in BY_TIME if getattr(run, name) is not None),
    ]
    for point, path in run.points.items():
        every += _by_name(f"{point}.", AXES, path)
    found = dict(every)
    if len(found) < len(every) or "t" in found:
        names = [name for name, _ in every]
        twice = next((name for name in names if names.count(name) > 1), "t")
        raise InputError(f"{run.scene_name}: two columns would be called {twice!r}; give that joint another name")
    return found


def as_csv(run: Run) -> str:
    """Return a run as CSV, the columns t and those of `columns`; every number as it is, to its last digit."""
    import csv

    table = columns(run)
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["t", *table])
    writer.writerows(np.column_stack([run.t, *table.values()]).tolist())
    return text.getvalue()


def as_data_frame(run: Run) -> Any:
    """Return a run as pandas' DataFrame, its index t.

    Raises
    ------
    InputError
        pandas is not installed.
    """
    try:
        import pandas
    except ModuleNotFoundError:
        raise InputError("to_pandas needs pandas: pip install 'ckc_pin[data]'") from None
    return pandas.DataFrame(columns(run), index=pandas.Index(run.t, name="t"))


def as_dataset(run: Run) -> Any:
    """Return a run as xarray's Dataset, its dimensions named.

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
    along = {
        "q_tree": ("coordinate", run.q_tree),
        "v_tree": ("coordinate", run.v_tree),
        "u": ("independent", run.u),
        "tau": ("motor", run.tau),
        "phi": ("row", run.phi),
        "w": ("row", run.w),
    }
    data: dict[str, Any] = {
        name: (("t", by), values, {"units": joined(units[name])}) for name, (by, values) in along.items()
    }
    data |= {name: ("t", getattr(run, name), {"units": "J"}) for name in BY_TIME if getattr(run, name) is not None}
    places: dict[str, Any] = {
        "t": ("t", run.t, {"units": "s"}),
        "coordinate": list(run.coordinates),
        "independent": list(run.independent),
        "motor": list(run.actuated),
        "row": _rows(run),
        "unit": ("coordinate", units["q_tree"]),
        "independent_unit": ("independent", units["error"]),
        "motor_unit": ("motor", units["tau"]),
        "row_unit": ("row", units["phi"]),
    }
    if run.points:
        data["points"] = (("point", "t", "axis"), np.array(list(run.points.values())), {"units": "m"})
        places |= {"point": list(run.points), "axis": AXES}
    about = {"scene": run.scene_name, "formulation": run.scene["formulation"], "status": run.status}
    return xarray.Dataset(data, places, {**about, "message": run.message})


def _rows(run: Run) -> list[str]:
    return [".".join(name) for name in run.mechanism.closure.names]


def _by_name(prefix: str, names: Any, values: Array) -> list[tuple[str, Array]]:
    return [(f"{prefix}{name}", values[:, k]) for k, name in enumerate(names)]
