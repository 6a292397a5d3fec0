"""Outputs of ensembles by the names of quantities, against the runs of the members."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, Run, simulate
from ckc_pin.ensembles.members import Members
from ckc_pin.ensembles.spec import OutputSpec
from tests.conftest import assert_close

SCENE = "five_bar/tracking"
MASSES = [0.2, 0.3]
OVERRIDES: dict[str, Any] = {"t_end": 0.2, "solver.output_dt": 0.02, "solver.rtol": 1e-9}
REDUCTIONS = {
    "end": lambda x: x[-1],
    "max_abs": lambda x: np.abs(x).max(),
    "rms": lambda x: np.sqrt(np.trapezoid(x**2, dx=0.02) / 0.2),
    "at": lambda x: x[5],
}
RECORDED = ("theta_2", "v.theta_2", "u.theta_3", "tau.theta_1", "error.theta_3", "energy.total", "phi.max")
DERIVED = ("desired.v.theta_1", "energy.kinetic", "tip.x", "tip.v.y", "a.theta_2", "loop.elbow.x", "joint.theta_2.fy",
           "sigma_min")  # fmt: skip


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    return [simulate(SCENE, OVERRIDES | {"parameters": {"link.link_2.mass": mass}}) for mass in MASSES]


def _specs(outputs: dict[str, dict[str, Any]]) -> dict[str, OutputSpec]:
    return {name: OutputSpec(**output) for name, output in outputs.items()}


def _output(name: str, reduction: str) -> dict[str, Any]:
    return {"of": name, "at": 0.1} if reduction == "at" else {"of": name, "reduce": reduction}


@pytest.mark.parametrize("names", [RECORDED, DERIVED], ids=["recorded", "derived"])
def test_outputs_by_name_are_those_of_the_members_runs(names: tuple[str, ...], runs: list[Run]) -> None:
    outputs = {f"{reduction} of {name}": _output(name, reduction) for name in names for reduction in REDUCTIONS}
    results = ckc_pin.ensemble(SCENE, {"link.link_2.mass": MASSES}, outputs, overrides=OVERRIDES, progress=False)
    for name in names:
        for reduction, function in REDUCTIONS.items():
            expected = np.array([function(run[name]) for run in runs])
            size = np.abs(np.array([run[name] for run in runs])).max()
            assert_close(results[f"{reduction} of {name}"].to_numpy(), expected, 1e-8 * max(1.0, size))
    assert results["status"].to_numpy().tolist() == [1, 1]


def test_points_and_energies_follow_from_rows_if_only_the_start_varies() -> None:
    names = ("tip.x", "tip.v.y", "energy.kinetic", "energy.potential", "sigma_min")
    outputs = {f"{reduction} of {name}": _output(name, reduction) for name in names for reduction in REDUCTIONS}
    outputs["way"] = {"of": "tip.x", "reduce": "trajectory"}
    rates = [0.5, 1.0]
    members = Members("five_bar/swing", OVERRIDES, ("initial.q_dot.theta_1",), _specs(outputs), 2, 1)
    assert members.is_batched
    chunk = members.run(0, np.array(rates)[:, None])
    runs = [simulate("five_bar/swing", OVERRIDES | {"initial.q_dot.theta_1": rate}) for rate in rates]
    for name in names:
        for reduction, function in REDUCTIONS.items():
            assert_close(chunk.outputs[f"{reduction} of {name}"], [function(run[name]) for run in runs], 1e-7)
    assert_close(chunk.outputs["way"], [run["tip.x"] for run in runs], 1e-7)
    assert members.units["max_abs of tip.v.y"] == ("m/s",)


def test_trajectories_and_units_by_name(runs: list[Run]) -> None:
    outputs = {name: {"of": name, "reduce": "trajectory"} for name in ("tip.y", "tau.theta_3")}
    outputs["way"] = {"of": "tip.v.x", "reduce": "integral"}
    results = ckc_pin.ensemble(SCENE, {"link.link_2.mass": MASSES}, outputs, overrides=OVERRIDES, progress=False)
    assert results["tip.y"].dims == results["tau.theta_3"].dims == ("member", "time")
    assert_close(results["tip.y"].to_numpy()[1], runs[1]["tip.y"], 1e-9)
    assert_close(results["tau.theta_3"].to_numpy()[0], runs[0]["tau.theta_3"], 1e-7)
    assert [results[name].attrs["units"] for name in outputs] == ["m", "N m", "m"]
    assert float(results["way"][0]) == pytest.approx(np.trapezoid(runs[0]["tip.v.x"], runs[0].t), abs=1e-9)


def test_a_member_that_ends_early_has_no_value_at_a_later_time() -> None:
    event = {"coordinate": "theta_1", "value": -1.1, "stop": True}
    overrides = {"t_end": 0.5, "solver.output_dt": 0.05, "event": [event]}
    outputs = {name: {"of": name, "at": 0.4} for name in ("tip.x", "theta_1")}
    outputs["last"] = {"of": "tip.x"}
    results = ckc_pin.ensemble(SCENE, {"link.link_2.mass": MASSES}, outputs, overrides=overrides, progress=False)
    run = simulate(SCENE, overrides | {"parameters": {"link.link_2.mass": MASSES[0]}})
    assert run.t[-1] < 0.4
    assert np.isnan(results["tip.x"]).all()
    assert np.isnan(results["theta_1"]).all()
    assert float(results["last"][0]) == pytest.approx(run["tip.x"][-1], abs=1e-6)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("tau.theta_2", r"outputs: x: 'tau\.theta_2': no such quantity; the nearest names are 'tau\.theta_1'"),
        ("desired.theta_1", r"outputs: x: run\['desired\.theta_1'\]: the run has no desired motion"),
        ("error.theta_1", r"outputs: x: error is q - q_d, but the scene's controller has no q_d"),
        ({"of": "theta_1", "at": 0.1, "reduce": "max"}, "outputs: x: give reduce or at, not both"),
        ({"of": "theta_1", "at": 9.0}, r"outputs: x: at = 9 s is after t_end = 0\.2 s"),
    ],
)
def test_unusable_outputs_are_refused(output: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        ckc_pin.ensemble(
            "five_bar/swing", {"link.link_2.mass": MASSES}, {"x": output}, overrides={"t_end": 0.2}, progress=False
        )
