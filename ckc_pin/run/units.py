"""Units of what a run holds, and of the numbers of a scene, by name."""

from __future__ import annotations

from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import is_parameter
from ckc_pin.mechanism.units import STIFF, VISCOUS, effort, joined, motor_units, parameter_unit, row_units

__all__ = ["by_time", "key_unit", "per", "quantity_units"]

SECONDS = ("t_end", "epsilon", "max_step", "min_step", "max_wall_s", "output_dt", "sample_time", "delay", "filter")


def quantity_units(mechanism: Mechanism) -> dict[str, list[str]]:
    """Return the unit of each component of what a run holds, by the quantity's name."""
    tree, q, rows = mechanism.tree, mechanism.partition.q, row_units(mechanism)
    independent = [tree.units()[k] for k in q]
    return {
        "q_tree": tree.units(), "v_tree": tree.units("/s"), "error": independent,
        "u": [effort(unit) for unit in independent], "tau": motor_units(mechanism), "phi": rows, "w": rows,
        "t": ["s"], "energy": ["J"], "dissipated": ["J"], "lyapunov": ["J"],
    }  # fmt: skip


def by_time(unit: str) -> str:
    """Return the unit of a quantity's integral over time."""
    return unit.removesuffix("/s") if unit.endswith("/s") else "s²" if unit == "s" else f"{unit} s"


def per(unit: str, other: str) -> str:
    """Return the unit of a derivative."""
    return f"{unit}/({other})" if "/" in other or " " in other else f"{unit}/{other}" if other else unit


def key_unit(mechanism: Mechanism, name: str) -> str:
    """Return the unit of a number by its name: the mechanism's, or a scene's key; "" where it has none."""
    if is_parameter(name):
        return parameter_unit(mechanism, name)
    root, _, rest = name.partition(".")
    key, _, of = rest.partition(".")
    if name.rpartition(".")[2] in SECONDS:
        return "s"
    if name == "friction_smoothing":
        return joined(mechanism.tree.units("/s"))
    if root == "initial":
        return _along(mechanism.coordinates, mechanism.tree.units("/s" if key == "q_dot" else ""), of)
    if root == "controller":
        return _of_controller(mechanism, key, of)
    return ""


def _of_controller(mechanism: Mechanism, key: str, of: str) -> str:
    units = quantity_units(mechanism)
    q, tau = units["error"], units["tau"]
    if key in ("sensor", "drive", "allocation"):
        key, _, of = of.partition(".")
    if key == "desired":
        of, _, key = of.rpartition(".")
    viscous = [VISCOUS[unit] for unit in q]
    join_dotted_keys = {
        "K_P": [STIFF[unit] for unit in q], "K_V": viscous, "K_D": viscous, "Lambda": ["1/s"] * len(q), "q_d": q,
        "offset": q, "resolution": q, "q_noise": q, "q_dot_noise": [f"{unit}/s" for unit in q],
    }  # fmt: skip
    by_motor = {"torque_limit": tau, "preload": tau, "torque_resolution": tau,
                "torque_rate": [f"{unit}/s" for unit in tau]}  # fmt: skip
    if key in join_dotted_keys:
        return _along(mechanism.independent, join_dotted_keys[key], of)
    return _along(mechanism.actuated, by_motor[key], of) if key in by_motor else ""


def _along(names: tuple[str, ...], units: list[str], name: str) -> str:
    """Return one's unit, or where none of them is named that of all."""
    return dict(zip(names, units, strict=True)).get(name) or joined(units)
