"""Names of the quantities of results, columns of tables, xarray datasets, and units of quantities and keys."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.tables import require_distinct, require_names
from ckc_pin.base.validation import find_near_names
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import is_parameter
from ckc_pin.mechanism.units import STIFF, VISCOUS, effort, joined, motor_units, parameter_unit, row_units
from ckc_pin.run.run_file import ARRAYS, OPTIONAL, WORKS

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = [
    "Quantity",
    "derivative_unit",
    "evaluate_quantity",
    "integral_unit",
    "key_unit",
    "list_columns",
    "list_quantities",
    "quantity_units",
    "to_dataset",
    "unknown_quantity",
]

AXES = ("x", "y", "z")
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
WRENCH_UNITS = ("N", "N", "N", "N m", "N m", "N m")
SCALARS = ("energy", "lyapunov", "dissipated")  # recorded quantities of a run with one value per instant, J
DESIRED = ("desired", "desired_dot", "error")  # arrays that only runs with a desired motion have
TABLE_ARRAYS = (
    "q_tree",
    "v_tree",
    "u",
    "tau",
    *DESIRED,
    "point_positions",
    "point_velocities",
    "phi",
    "w",
    "energy",
    "works",
)
NEAR_NAMES = 4  # that a message about an unknown name lists
KEYS_IN_SECONDS = ("t_end", "epsilon", "max_step", "min_step", "max_wall_s", "output_dt", "sample_time", "delay",
                   "filter")  # fmt: skip


# --- names -----------------------------------------------------------------------------------------


class Quantity(NamedTuple):
    """A named scalar quantity of a result: a column of one of its arrays.

    Attributes
    ----------
    array : str
        Name of the array with a row for each instant: an attribute of `Run`, or of `ckc_pin.run.derived.RunQuantities`.
    column : int or None
        None if the array has one value for each instant.
    unit : str
    """

    array: str
    column: int | None
    unit: str

    def select(self, values: Array) -> Array:
        """Return the quantity from its array."""
        return values if self.column is None else values[:, self.column]


def iterate_quantities(mechanism: Mechanism) -> Iterator[tuple[str, Quantity]]:
    """Yield the names of all quantities of a mechanism's results (docs/reference/names.md), with their meaning."""
    tree, motors = mechanism.tree, mechanism.motors.names
    by_quantity = quantity_units(mechanism)
    q_units, row_names = by_quantity["error"], [".".join(name) for name in mechanism.closure.names]
    rates = [f"{unit}/s" for unit in q_units]
    yield from _name_columns("", mechanism.coordinates, "q_tree", by_quantity["q_tree"])
    yield from _name_columns("v.", mechanism.coordinates, "v_tree", by_quantity["v_tree"])
    yield from _name_columns("a.", mechanism.coordinates, "a_tree", tree.units("/s²"))
    yield from _name_columns("u.", mechanism.independent, "u", by_quantity["u"])
    yield from _name_columns("tau.", motors, "tau", by_quantity["tau"])
    yield from _name_columns("desired.", mechanism.independent, "desired", q_units)
    yield from _name_columns("desired.v.", mechanism.independent, "desired_dot", rates)
    yield from _name_columns("error.", mechanism.independent, "error", q_units)
    for infix, array, unit in (("", "point_positions", "m"), ("v.", "point_velocities", "m/s")):
        names = [f"{point}.{infix}{axis}" for point in mechanism.points for axis in AXES]
        yield from _name_columns("", names, array, [unit] * len(names))
    yield from _name_columns("loop.", row_names, "multipliers", [effort(unit) for unit in by_quantity["phi"]])
    joints = [name for name, joint in list(zip(tree.model.names, tree.model.joints, strict=True))[1:] if joint.nv == 1]
    wrenches = [f"{joint}.{component}" for joint in joints for component in WRENCH]
    yield from _name_columns("joint.", wrenches, "joint_wrenches", WRENCH_UNITS * len(joints))
    yield "energy.kinetic", Quantity("kinetic_energy", None, "J")
    yield "energy.potential", Quantity("potential_energy", None, "J")
    yield "energy.total", Quantity("energy", None, "J")
    yield from _name_columns("work.", WORKS, "works", ["J"] * len(WORKS))
    yield from _name_columns("phi.", row_names, "phi", by_quantity["phi"])
    yield from _name_columns("w.", row_names, "w", by_quantity["w"])
    yield "phi.max", Quantity("phi_max", None, joined(by_quantity["phi"]))
    yield "sigma_min", Quantity("sigma_min", None, "")


def list_quantities(mechanism: Mechanism) -> dict[str, Quantity]:
    """Return the quantities of a mechanism's results by name. If two have the same name, the first one keeps it."""
    quantities: dict[str, Quantity] = {}
    for name, quantity in iterate_quantities(mechanism):
        quantities.setdefault(name, quantity)
    return quantities


def unknown_quantity(where: str, name: Any, mechanism: Mechanism, arrays: Sequence[str] = ()) -> InputError:
    """Return the error for a name that no quantity has. It lists the nearest names, coordinates and arrays."""
    nearest = find_near_names(name, [*list_quantities(mechanism), *arrays], NEAR_NAMES)
    listed = ", ".join(mechanism.coordinates) + (f", and the arrays {', '.join(arrays)}" if arrays else "")
    return InputError(
        f"{where}: no such quantity; the nearest names are {', '.join(map(repr, nearest))}; "
        f"there are the coordinates {listed}; docs/reference/names.md has all names"
    )


def _name_columns(
    prefix: str, names: Sequence[str], array: str, units: Sequence[str]
) -> Iterator[tuple[str, Quantity]]:
    for column, (name, unit) in enumerate(zip(names, units, strict=True)):
        yield prefix + name, Quantity(array, column, unit)


def evaluate_quantity(run: Run, name: str, quantity: Quantity) -> Array:
    """Return a quantity along a run, shape (m,). Only its array is computed.

    Raises
    ------
    InputError
        The run does not determine it.
    """
    recorded = quantity.array in (*ARRAYS, *OPTIONAL, "desired", "error")
    values = getattr(run if recorded else run.derived, quantity.array)
    if values is None:
        reason = "has no works; set work = true" if quantity.array == "works" else "has no desired motion"
        raise InputError(f"run[{name!r}]: the run {reason}")
    return quantity.select(values)


# --- tables ----------------------------------------------------------------------------------------


def list_columns(run: Run, names: Sequence[str] | None = None, where: str = "Run.to_csv") -> dict[str, Array]:
    """Return the columns of a run's table except t, by name.

    Parameters
    ----------
    run : Run
    names : sequence of str, optional
        Any names that ``run[name]`` takes. Default: what is recorded, the desired motion with its errors, and points.
    where : str
        Named in errors.

    Raises
    ------
    InputError
        Unknown name, or two columns would have the same name.
    """
    if names is not None:
        return {name: _select_named(run, name, f"{where}: columns") for name in require_names(names, where)}
    absent = {*(() if run.desired is not None else DESIRED), *(() if run.works is not None else ("works",))}
    arrays = [name for name in TABLE_ARRAYS if name not in absent]
    columns = [
        (name, evaluate_quantity(run, name, quantity))
        for array in arrays
        for name, quantity in iterate_quantities(run.mechanism)
        if quantity.array == array
    ]
    columns += [(name, getattr(run, name)) for name in SCALARS if getattr(run, name) is not None]
    return require_distinct(columns, "t", run.scene_name)


def _select_named(run: Run, name: str, where: str) -> Array:
    values = run[name]
    if values.ndim != 1:
        raise InputError(f"{where}: {name!r} is an array of several columns; name each of them")
    return values


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
    if run.works is not None:
        data |= {f"work.{name}": ("t", run.works[:, k], {"units": "J"}) for k, name in enumerate(WORKS)}
    if run.desired_path is not None:
        q_unit, rate_unit = joined(units["error"]), joined(f"{unit}/s" for unit in units["error"])
        data["desired"] = (("t", "independent"), run.desired, {"units": q_unit})
        data["desired.v"] = (("t", "independent"), run.desired_path.q_dot, {"units": rate_unit})
        data["error"] = (("t", "independent"), run.error, {"units": q_unit})
    coordinates: dict[str, Any] = {
        "t": ("t", run.t, {"units": "s"}),
        "coordinate": list(run.coordinates),
        "independent": list(run.independent),
        "motor": list(run.actuated),
        "row": [".".join(name) for name in run.mechanism.closure.names],
        "unit": ("coordinate", units["q_tree"]),
        "independent_unit": ("independent", units["error"]),
        "motor_unit": ("motor", units["tau"]),
        "row_unit": ("row", units["phi"]),
    }
    if run.points:
        data["points"] = (("point", "t", "axis"), np.array(list(run.points.values())), {"units": "m"})
        velocities = run.derived.point_velocities.reshape(len(run.t), -1, 3)
        data["points.v"] = (("point", "t", "axis"), velocities.transpose(1, 0, 2), {"units": "m/s"})
        coordinates |= {"point": list(run.points), "axis": list(AXES)}
    attributes = {"scene": run.scene_name, "formulation": run.scene["formulation"], "status": run.status}
    return xarray.Dataset(data, coordinates, {**attributes, "message": run.message})


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
