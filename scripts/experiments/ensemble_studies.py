"""Two studies by ensembles: tracking with inaccurate link lengths, and the basin of attraction of a set point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.sources import Sources
from ckc_pin.ensembles.members import SweepTask
from ckc_pin.ensembles.sobol_indices import compute_sobol_indices
from ckc_pin.ensembles.spec import parse_sweep
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.view.ensemble_figures import draw_basins, draw_quantiles, draw_sobol_indices
from ckc_pin.view.layout import write_figure
from scripts.experiments.certificate.certificate import DIVISIONS, certify, rest_height, sublevel_set
from scripts.experiments.chart import shrink
from scripts.experiments.paper.set_point_experiments import load_case

LENGTHS = {
    "l1, left proximal": "joint.theta_2.xyz.x",
    "l2, left distal": "loop.elbow.frame_a.xyz.x",
    "l3, right proximal": "joint.theta_4.xyz.x",
    "l4, right distal": "loop.elbow.frame_b.xyz.x",
}
DEVIATION = 1e-4  # m: standard deviation of a length's error
HANGING = {"theta_1": -1.434308508, "theta_3": -1.707332169}  # near where tracking starts as shipped
TRACKING: dict[str, Any] = {
    "formulation": "reduced", "solver.rtol": 1e-7, "controller.model": "mechanism.toml", "initial.at": None,
    **{f"initial.q.{name}": x for name, x in HANGING.items()},
}  # fmt: skip
LATTICE = (-1.9, 1.9)  # rad: range of both starting angles


def tolerances(out: Path, members: int, weighed_by: int) -> str:
    """Draw the plant's lengths at random, with an exact controller model; return tables of the change of q - q_d."""
    nominal = {name: _nominal(key) for name, key in LENGTHS.items()}
    variables = {LENGTHS[name]: {"normal": [x, DEVIATION]} for name, x in nominal.items()}
    outputs: dict[str, Any] = {
        "worst": {"of": "error", "reduce": "max_abs"}, "rms": {"of": "error", "reduce": "rms"},
        "late": {"of": "theta_1", "reduce": "end"}, "error": {"of": "error", "reduce": "trajectory"},
    }  # fmt: skip
    perturbed = ckc_pin.ensemble("five_bar/tracking", variables, outputs, members=members, seed=1, overrides=TRACKING)
    exact = ckc_pin.ensemble("five_bar/tracking", {"epsilon": [1e-3]}, outputs, overrides=TRACKING)
    change = perturbed["error"] - exact["error"][0]
    fan = draw_quantiles(change.rename("change of the error").assign_attrs(units="rad"))
    write_figure(fan, out, "tolerances_fan", ("png",))
    lines = ["| joint | rms error, exact lengths (rad) | change by wrong lengths: 95 % stay below, the most (rad) |",
             "|---|---|---|"]  # fmt: skip
    for name in perturbed["independent"].to_numpy():
        peak = abs(change.sel(independent=name)).max("time")
        nominal_rms = float(exact["rms"].sel(independent=name)[0])
        lines.append(f"| {name} | {nominal_rms:.2e} | {float(peak.quantile(0.95)):.2e}, {float(peak.max()):.2e} |")
    data = {"scene": "five_bar/tracking", "variables": variables, "outputs": {"late": "theta_1"}, "seed": 1,
            "members": members, "overrides": dict(TRACKING)}  # fmt: skip
    weighed = compute_sobol_indices(
        SweepTask(parse_sweep(data, Sources("study", Path())), "study", "five_bar/tracking", None), weighed_by
    )
    draw_sobol_indices(weighed.sel(output="late"), out / "tolerances_importance.png")
    lines += ["", "| length | first order | total |", "|---|---|---|"]
    for name, key in LENGTHS.items():
        one = weighed.sel(output="late", variable=key)
        lines.append(f"| {name} | {float(one['first_order']):.2f} | {float(one['total_order']):.2f} |")
    return "\n".join(lines)


def basin(out: Path, count: int, divisions: int) -> str:
    """Start at rest from a lattice of angles and compare the basin of attraction with the certified set."""
    case = load_case({"formulation": "reduced"})
    proved = certify(case.mechanism, case.controller, case.start, divisions)
    grid = {"grid": {"start": LATTICE[0], "stop": LATTICE[1], "count": count}}
    names = ("initial.q.theta_1", "initial.q.theta_3")
    data_set = ckc_pin.ensemble(
        "five_bar/set_point", dict.fromkeys(names, grid), {"end": "q_tree", "settled": "settled", "u": "max_abs_u"},
        overrides={"formulation": "reduced", "initial": {"q": HANGING}, "solver.rtol": 1e-6, "t_end": 10.0},
    )  # fmt: skip
    for name in names:
        data_set[name].attrs["units"] = "rad"
    starts = np.column_stack([data_set[name].to_numpy() for name in names])
    home = (data_set["settled"].to_numpy() == 1.0) & (data_set["status"].to_numpy() == 1)
    inside = _proved(case, proved.safe_level, divisions, starts)
    map_ = ckc_pin.singularity_map("five_bar", cells=64)  # curves are as accurate as with more cells
    q = case.mechanism.partition.q
    curves = [_wrap_angles(locus.q_tree[:, q]) for locus in map_.loci if locus.kind != "serial"]
    target = case.controller.q_d
    draw_basins(data_set, names, "end", out / "basin.png", settled="settled", curves=curves,
                marks=[("$q_d$", float(target[0]), float(target[1]))])  # fmt: skip
    can = data_set["status"].to_numpy() != 3
    return "\n".join(
        [
            f"{len(starts)} starts, {can.sum()} can be assembled, {home.sum()} settle at q_d, "
            f"{np.count_nonzero(data_set['status'].to_numpy() == 2)} runs stop before the end",
            f"the scene's start: {proved.status} ({proved.reason}); proved up to V_L = {proved.safe_level:.3g} J of "
            f"{proved.level:.3g} J",
            f"{inside.sum()} starts in the proved set, {np.count_nonzero(inside & home)} of them settle at q_d",
        ]
    )


def _proved(case: Any, level: float, divisions: int, starts: Array) -> BoolArray:
    """Return which starts are in the part of {U <= level} around q_d, by the certificate's lattice."""
    region = sublevel_set(case.mechanism, case.controller, level, divisions)
    nodes = np.array([case.mechanism.independent_part(at.q_tree) for at in region.explored.nodes])
    inside = np.zeros(len(starts), bool)
    for k, q in enumerate(starts):
        has_neighbour = np.all(np.abs(nodes - q) <= region.step, axis=1).any()
        if has_neighbour:
            at = sigma(case.mechanism, q, case.controller.target.at)
            inside[k] = at.verdict == "converged" and rest_height(case.mechanism, case.controller, at.at) <= level
    return inside


def _wrap_angles(curve: Array) -> Array:
    """Wrap a curve of angles to [-pi, pi), with a row of NaN at each jump."""
    turned = (curve + np.pi) % (2 * np.pi) - np.pi
    jumps = np.flatnonzero(np.abs(np.diff(turned, axis=0)).max(axis=1) > np.pi) + 1
    return np.insert(turned, jumps, np.nan, axis=0)


def _nominal(name: str) -> float:
    from ckc_pin.mechanism.parameters import values_of

    mechanism = ckc_pin.load("five_bar")
    of, _, axis = name.rpartition(".")
    vector = values_of(mechanism.spec, mechanism.urdf)[of]
    assert isinstance(vector, tuple)
    return vector["xyz".index(axis)]


def main(out: Path, quick: bool = False) -> None:
    """Draw the figures and print both studies."""
    out.mkdir(parents=True, exist_ok=True)
    lengths = tolerances(out, *((8, 2) if quick else (512, 64)))
    print(f"Lengths wrong by {DEVIATION * 1e3:g} mm (standard deviation)\n\n{lengths}\n")
    print(f"Set-point control from everywhere\n\n{basin(out, *((5, 9) if quick else (41, DIVISIONS)))}")
    for figure in out.glob("*.png"):
        shrink(figure)
