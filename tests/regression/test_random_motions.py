"""Conservative motions that once ended with a wrong result or an exception, each with its cause."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin import simulate
from tests.property.test_runs import kinetic

FIVE_BAR = "theta_1", "theta_3"


def start(q: tuple[float, ...], q_dot: tuple[float, ...], names: tuple[str, ...] = FIVE_BAR) -> dict[str, Any]:
    return {"initial": {"q": dict(zip(names, q, strict=True)), "q_dot": dict(zip(names, q_dot, strict=True))}}


# scene, formulation, rtol, overrides; largest energy error, in rtol times the largest kinetic energy
CASES = {
    # The last stage was on another branch and had a number that was not finite.
    "a chart that ends": (
        "five_bar/swing", "reduced", 1e-2,
        {**start((1.0974350852385353, 2.770016072687662), (-0.3543304420202529, -0.21339817076162462)), "t_end": 2.0},
    ),
    "thirty-five radians a second": (
        "five_bar/swing", "reduced", 1e-4,
        start((-0.18277858053988316, 1.2174227104611797), (-34.58822934308963, -30.0966282772864)),
    ),
    "an event beside a change of chart": (
        "five_bar/swing", "spf", 1e-3,
        {
            **start((0.12786945328782462, 2.7274534722446475), (11.206239326351458, -0.025765964985891142)),
            "event": [{"of": "q_dot", "coordinate": "theta_1", "value": 1.0}],
        },
    ),
    # Error control used q and q_dot only. The rates of z were wrong, and the change of chart preserved the error.
    "sixty radians a second of z at a chart's end": (
        "five_bar/swing", "reduced", 1e-4,
        start((-1.049311270049265, -2.5978491246810176), (15.458185805003557, 5.071114398814352)),
    ),
    "the same at 1e-6": (
        "five_bar/swing", "reduced", 1e-6,
        start((-1.049311270049265, -2.5978491246810176), (15.458185805003557, 5.071114398814352)),
    ),
    # Newton's method converged to another branch, which was not detected.
    "another branch of the slider-crank": (
        "slider_crank/default", "reduced", 1e-3,
        {"initial": {"at": "assembled", "q_dot": {"crank": -10.155557178717102}}},
    ),
    "another branch of the five-bar": (
        "five_bar/swing", "reduced", 1e-5,
        start((1.9164960458714306, 1.3675577643661274), (0.46863452933324745, 0.2551845563469394)),
    ),
    "another branch, by Radau": (
        "five_bar_as_printed/swing", "reduced", 4.9755119632780304e-06,
        {
            **start((0.7417670453165257, 0.7634330248463774), (-8.314367116170565, -8.530800754234198)),
            "t_end": 0.53, "solver.method": "Radau",
        },
    ),
    # One step went to another branch, from where all steps were rejected.
    "a step that began on another branch": (
        "five_bar/swing", "reduced", 2.609209975332588e-07,
        {**start((0.47501492728687644, -4.415820786937327), (0.0, 0.0)), "t_end": 0.7},
    ),
    # z was closed to a fraction of rtol and its rates amplified the residual, so every other step was rejected.
    "steps that shrink to nothing": (
        "five_bar/swing", "reduced", 2.2e-3,
        start((1.4899101633707061, -3.037115581529414), (0.15038675698040077, -0.034662251343755134)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_energy_is_conserved_without_control(case: str) -> None:
    scene, formulation, rtol, overrides = CASES[case]
    overrides = {"t_end": 4.0, "solver.output_dt": 0.02, **overrides, "formulation": formulation, "solver.rtol": rtol}
    run = simulate(scene, overrides)
    assert run.status == "done", run.message
    off = np.abs(run.energy - run.energy[0]).max()
    assert off <= 100 * rtol * max(1.0, kinetic(run).max())


def test_three_formulations_conserve_energy_equally_well() -> None:
    """Medians of the energy errors over rtol in random motions of the five-bar agree within a factor of 30."""
    random = np.random.default_rng(18)
    off: dict[str, list[float]] = {"reduced": [], "spf": [], "dae": []}
    for _ in range(12):
        q = tuple(random.uniform(-3, 3) * 0.3 + at for at in (-1.434, -1.7))
        q_dot = tuple(random.uniform(-15, 15, 2))
        rtol = 10 ** random.uniform(-9, -3)
        for formulation in off:
            overrides = {**start(q, q_dot), "formulation": formulation, "solver.rtol": rtol, "t_end": 1.0}
            run = simulate("five_bar/swing", overrides)
            assert run.status == "done", run.message
            off[formulation].append(np.abs(run.energy - run.energy[0]).max() / (rtol * max(1.0, kinetic(run).max())))
    medians = [float(np.median(values)) for values in off.values()]
    assert max(medians) <= 30 * min(medians)
    assert max(map(max, off.values())) <= 100


def test_reduced_run_stops_where_z_is_less_accurate_than_rtol() -> None:
    """Near the flat configuration phi_z amplifies rounding. A run used to need 400,000 right-hand sides.

    Rounding also decides which runs come that near, and which stop because a step contains the flat configuration.
    """
    rtol, imprecise = 3.3e-10, 0
    for theta in np.linspace(0.0564, 0.0566, 20):
        overrides = {
            "formulation": "reduced", "t_end": 0.13, "solver.rtol": rtol,
            "initial": {"q": {"theta_0": theta}, "q_dot": {"theta_0": 0.0}},
        }  # fmt: skip
        run = simulate("n_four_bar", overrides)
        assert run.status == "stopped"
        assert run.stats["rhs"] < 20_000
        assert np.abs(run.energy - run.energy[0]).max() < 100 * rtol
        imprecise += "phi_z" in run.message and run.t[-1] > 0.0995
    assert imprecise > 0


def test_diverging_motion_is_not_reported_as_singular() -> None:
    """Sampled velocity feedback with a too large gain. The message used to blame phi_z with a singular value of nan."""
    overrides = {
        "formulation": "dae", "t_end": 1.4, "solver.rtol": 2e-5,
        "initial": {"q": {"crank": 4.0}, "q_dot": {"crank": 0.0}},
        "controller": {
            "type": "set_point", "K_P": 26.380734454728017, "K_V": 12.878174764941416,
            "q_d": {"crank": 3.9961850746563043}, "sample_time": 0.004195423552193236,
        },
    }  # fmt: skip
    run = simulate("slider_crank", overrides)
    assert run.status == "stopped"
    assert "runs away" in run.message
    assert "nan" not in run.message
    assert run.stats["rhs"] < 10_000_000  # the rest of the run would take more than 1e9
