"""Each member does what a single run of the same overrides does, whoever else is there and however it is run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin.codegen.library import compile_terms
from ckc_pin.ensembles.members import DONE, FAILED, STOPPED, Members
from ckc_pin.ensembles.outputs import SHORT
from ckc_pin.ensembles.spec import OutputSpec
from ckc_pin.errors import CkcError, InputError
from scripts.experiments.generated_sizes import ring
from tests.contract.test_parameters import folder

CLOSE = 1e-7  # rtol is 1e-9; a start that is closed to rounding in another way moves the steps
OUTPUTS = {"end": "q_tree", "rate": "v_tree", "drift": "energy_drift"}
HANGING = {"initial.q.theta_1": -1.434, "initial.q.theta_3": -1.707}
SWING = {"t_end": 0.5, "solver.rtol": 1e-9, "solver.terms": "pinocchio"}

# scene, overrides, variables with their ranges, whether they are put into a loop that is there
CASES: dict[str, tuple[str, dict[str, Any], dict[str, tuple[float, float]], bool]] = {
    "starts": ("five_bar/swing", {}, {"initial.q.theta_1": (-1.9, -0.9), "initial.q_dot.theta_3": (-1, 1)}, True),
    "masses": ("five_bar/swing", {}, {"link.link_2.mass": (0.1, 0.5), "link.link_3.com.y": (-0.05, 0.05)}, True),
    "lengths": ("five_bar/swing", {"formulation": "reduced"},
                {"joint.theta_2.xyz.x": (0.24, 0.28), "loop.elbow.frame_b.xyz.y": (-0.01, 0.01),
                 "gravity.y": (-10, -5)}, True),
    "inertia": ("five_bar/swing", {"formulation": "spf"},
                {"link.link_1.inertia.izz": (0.002, 0.02), "joint.theta_1.damping": (0, 0.1)}, True),
    "generated": ("five_bar/swing", {"solver.terms": "generated"},
                  {"link.link_2.mass": (0.1, 0.5), "link.link_2.com.y": (-0.05, 0.05),
                   "joint.theta_4.xyz.x": (0.24, 0.28)}, True),
    "another model": ("five_bar/tracking", {"controller.model": "mechanism.toml", "initial.at": None, **HANGING},
                      {"joint.theta_2.xyz.x": (0.24, 0.26)}, True),
    "set point": ("five_bar/set_point", {"initial.at": None, **HANGING}, {"initial.q.theta_1": (-1.5, -1.3)}, True),
    "compensated": ("five_bar/set_point", {}, {"link.link_2.mass": (0.1, 0.5)}, False),
    "gains": ("five_bar/tracking", {}, {"controller.K_D": (5, 20)}, False),
    "rotations": ("five_bar/swing", {}, {"joint.theta_2.rpy.z": (-0.1, 0.1)}, False),
}  # fmt: skip


def prepared(case: str, threads: int = 2, **outputs: Any) -> tuple[Members, np.ndarray[Any, Any]]:
    scene, overrides, ranges, _ = CASES[case]
    members = Members(scene, {**SWING, **overrides}, tuple(ranges), {**OUTPUTS, **outputs}, 6, threads)
    low, high = np.array(list(ranges.values())).T
    return members, np.random.default_rng(5).uniform(low, high, (6, len(ranges)))


@pytest.mark.parametrize("case", CASES)
def test_member_equals_a_run_with_its_overrides(case: str) -> None:
    members, values = prepared(case)
    assert members.batched == CASES[case][3]
    found = members.run(0, values)
    assert found.status.tolist() == [DONE] * 6, found.message
    assert np.ptp(found.outputs["end"], axis=0).max() > 1e-4  # the variables matter
    for k, value in enumerate(values):
        run = ckc_pin.simulate(members.scene_name, members.overrides_of(value))
        assert np.abs(found.outputs["end"][k] - run.q_tree[-1]).max() < CLOSE
        assert np.abs(found.outputs["rate"][k] - run.v_tree[-1]).max() < 10 * CLOSE


@pytest.mark.parametrize("case", ["starts", "lengths", "inertia", "generated", "set point", "gains"])
def test_numbers_are_the_same_to_the_bit_in_any_order_chunk_and_thread(case: str) -> None:
    members, values = prepared(case, threads=1)
    alone, _ = prepared(case, threads=3)
    whole = members.run(0, values)
    order = np.array([4, 1, 5, 0, 3, 2])
    mixed = alone.run(0, values[order])
    for name, x in whole.outputs.items():
        assert np.array_equal(x[order], mixed.outputs[name]), name
        assert np.array_equal(x[2:3], members.run(2, values[2:3]).outputs[name]), name


def test_springs_forces_and_lengths_are_varied_too(tmp_path: Path) -> None:
    at = folder(tmp_path / "sprung")
    ranges = {"spring.0.stiffness": (30, 60), "spring.0.frame_a.xyz.x": (0, 0.1), "spring.1.rest": (0, 0.4),
              "spring.1.damping": (0.05, 0.2), "force.0.value": (-0.3, 0.3), "loop.knee.length": (0.48, 0.52),
              "loop.knee.frame_a.xyz.y": (-0.02, 0.02), "joint.elbow.xyz.x": (0.38, 0.42), "link.arm.mass": (1, 2),
              "link.rod.com.y": (-0.02, 0.02), "spring.0.rest_length": (0, 0.2)}  # fmt: skip
    overrides = {"t_end": 0.5, "solver.rtol": 1e-9, "initial.at": None, "initial.q.elbow": 0.35}
    members = Members(at, overrides, tuple(ranges), {"end": "q_tree"}, 6, 2)
    low, high = np.array(list(ranges.values())).T
    values = np.random.default_rng(5).uniform(low, high, (6, len(ranges)))
    assert members.batched
    found = members.run(0, values)
    for k, value in enumerate(values):
        run = ckc_pin.simulate(at, members.overrides_of(value))
        assert np.abs(found.outputs["end"][k] - run.q_tree[-1]).max() < CLOSE


def test_a_table_among_the_overrides_replaces_the_scenes_table() -> None:
    """As in a single run: nothing stays of the table that was there, which says another start."""
    scene = "five_bar/tracking"
    overrides = {"t_end": 0.1, "initial": {"q": {"theta_1": -1.0, "theta_3": -2.0}}}
    assert ckc_pin.load_scene(scene).spec.initial.at == "equilibrium"
    found = ckc_pin.ensemble(
        scene, {"link.link_2.mass": [0.2, 0.3]}, {"end": "q_tree"}, overrides=overrides, progress=False
    )
    for k, mass in enumerate((0.2, 0.3)):
        run = ckc_pin.simulate(scene, {**overrides, "link.link_2.mass": mass})
        assert np.abs(found["end"][k] - run.q_tree[-1]).max() < CLOSE


@pytest.mark.parametrize("name", ["gravity.x", "link.link_2.mass", "initial.q.theta_1"])
def test_a_distribution_that_is_none_names_those_there_are(name: str) -> None:
    with pytest.raises(ckc_pin.InputError, match=rf"{name}: unknown key 'gauss'; valid: uniform, loguniform, normal"):
        ckc_pin.ensemble("five_bar/swing", {name: {"gauss": [0, 1]}}, {"end": "q_tree"}, members=2)


def test_reductions_are_those_of_the_run() -> None:
    kept: dict[str, Any] = {
        name: {"of": of, "reduce": how}
        for name, of, how in [("low", "theta_2", "min"), ("mean", "v_tree", "mean"), ("area", "error", "integral"),
                              ("rms", "error", "rms"), ("path", "u", "trajectory"), ("late", "error", "end")]
    }  # fmt: skip
    specs = {name: OutputSpec(**spec) for name, spec in kept.items()}
    scene = "five_bar/tracking"
    members = Members(scene, {"t_end": 0.3, "solver.output_dt": 0.01}, ("initial.q_dot.theta_1",),
                      {**specs, **{name: name for name in SHORT}, "settled": "settled", "drift": "energy_drift"},
                      1, 1)  # fmt: skip
    found = members.run(0, np.array([[0.2]])).outputs
    run = ckc_pin.simulate(scene, {"t_end": 0.3, "solver.output_dt": 0.01, "initial.q_dot.theta_1": 0.2})
    error = run.q_tree[:, members.mechanism.partition.q] - np.array([desired(run, t) for t in run.t])
    assert np.allclose(found["low"], run.q_tree[:, run.column("theta_2")].min(), atol=1e-9)
    assert np.allclose(found["mean"], np.trapezoid(run.v_tree, run.t, axis=0) / 0.3, atol=1e-7)
    assert np.allclose(found["area"], np.trapezoid(error, run.t, axis=0), atol=1e-9)
    assert np.allclose(found["rms"] ** 2, np.trapezoid(error**2, run.t, axis=0) / 0.3, atol=1e-9)
    assert np.allclose(found["path"][0], run.u.T, atol=1e-5)
    assert np.allclose(found["late"], error[-1], atol=1e-9)
    assert np.allclose(found["max_abs_u"], np.abs(run.u).max(), atol=1e-5)
    assert np.allclose(found["drift"], np.abs(run.energy - run.energy[0]).max(), atol=1e-6)
    assert found["settled"].tolist() == [0.0]


@pytest.mark.parametrize(
    ("scene", "overrides", "name", "values"),
    [
        ("five_bar/set_point", {"t_end": 0.3}, "controller.q_d.theta_1", [0.6, 0.7]),
        ("five_bar/tracking", {"t_end": 0.3}, "controller.desired.theta_3.offset", [0.7, 0.9]),
        ("five_bar/set_point", {"solver.output_dt": None}, "t_end", [0.1, 0.3]),
        ("five_bar/set_point", {"t_end": 0.3, "solver.output_dt": 0.02}, "solver.output_dt", [0.01, 0.05]),
    ],
)
def test_reductions_are_over_the_members_own_instants_and_from_its_own_desired_motion(
    scene: str, overrides: dict[str, Any], name: str, values: list[float]
) -> None:
    kept: dict[str, Any] = {
        how: OutputSpec(of="error", reduce=how) for how in ("integral", "max_abs", "mean", "rms", "end")
    }
    overrides = {"solver.terms": "pinocchio", **overrides}
    members = Members(scene, overrides, (name,), kept, 1, 1)
    found = members.run(0, np.array(values)[:, None]).outputs
    for k, value in enumerate(values):
        run = ckc_pin.simulate(scene, {**overrides, name: value})
        q_d = run.scene["controller"].get("q_d") or {}
        wanted = [[q_d[x] for x in run.independent] if q_d else desired(run, t) for t in run.t]
        error = run.q_tree[:, members.mechanism.partition.q] - np.array(wanted)
        area = np.trapezoid(error, run.t, axis=0)
        assert np.allclose(found["integral"][k], area, atol=1e-9)
        assert np.allclose(found["mean"][k], area / run.t[-1], atol=1e-9)
        assert np.allclose(found["rms"][k] ** 2, np.trapezoid(error**2, run.t, axis=0) / run.t[-1], atol=1e-9)
        assert np.allclose(found["max_abs"][k], np.abs(error).max(axis=0), atol=1e-9)
        assert np.allclose(found["end"][k], error[-1], atol=1e-9)


def test_settled_is_at_the_members_own_target() -> None:
    name, gains = "controller.q_d.theta_1", {"controller.K_V": 4.0, "t_end": 20.0, "solver.output_dt": 1.0}
    members = Members("five_bar/set_point", gains, (name,), {"settled": OutputSpec(of="settled")}, 1, 1)
    run = ckc_pin.simulate("five_bar/set_point", {**gains, name: 0.7})
    assert abs(run.q_tree[-1, run.column("theta_1")] - 0.7) < 1e-4
    assert members.run(0, np.array([[0.7]])).outputs["settled"].tolist() == [1.0]


@pytest.mark.parametrize("name", ["t_end", "solver.output_dt"])
def test_a_trajectory_needs_the_same_instants_of_all_members(name: str) -> None:
    path = {"path": OutputSpec(of="theta_1", reduce="trajectory")}
    with pytest.raises(InputError, match=f"path: a trajectory is kept at the same instants .* {name} makes others"):
        Members("five_bar/swing", SWING, (name,), path, 1, 1)


def desired(run: ckc_pin.Run, t: float) -> list[float]:
    return [
        of.get("offset", 0.0) + sum(a * np.sin(w * t + p) for a, w, p in of["harmonics"])
        for of in (run.scene["controller"]["desired"][name] for name in run.independent)
    ]


def test_members_that_stop_or_cannot_begin_stay_with_their_reason() -> None:
    names = ("link.link_2.mass", "joint.theta_2.xyz.x", "solver.max_rhs")
    values = np.array([[0.3, 0.26, 9999], [-1.0, 0.26, 9999], [0.3, 9.0, 9999], [0.3, 0.26, 20], [np.nan, 0.26, 9999]])
    members = Members("five_bar/swing", SWING, names, OUTPUTS, 5, 2)
    found = members.run(0, values)
    assert found.status.tolist() == [DONE, FAILED, FAILED, STOPPED, FAILED]
    for k, says in ((1, "negative mass -1 kg"), (2, "not closed"), (3, "max_rhs = 20"), (4, "nan")):
        assert says in found.message[k]
    assert np.isfinite(found.outputs["end"]).all(axis=1).tolist() == [True, False, False, True, False]


def test_a_member_that_stops_at_its_start_has_no_mean() -> None:
    """NaN has a sign, which a chunk that is left out, as it is all NaN, does not keep: the same bits in any chunk."""
    kept = {how: OutputSpec(of="theta_1", reduce=how) for how in ("mean", "rms")}
    found = Members("five_bar/swing", SWING, ("solver.max_rhs",), kept, 1, 1).run(0, np.array([[1.0]]))
    assert found.status.tolist() == [STOPPED]
    for name in kept:
        assert found.outputs[name].tobytes() == np.array([np.nan]).tobytes()


def test_an_unphysical_member_of_a_batch_is_failed_and_the_others_are_not() -> None:
    members = Members("five_bar/swing", SWING, ("link.link_2.mass", "joint.theta_2.xyz.x"), OUTPUTS, 3, 2)
    assert members.batched
    values = np.array([[0.3, 0.26], [-1.0, 0.26], [0.3, 9.0], [0.0, 0.26], [np.inf, 0.26]])
    found = members.run(0, values)  # a warning of NumPy's would be an error here
    assert found.status.tolist() == [DONE, FAILED, FAILED, found.status[3], FAILED]
    assert "negative mass" in found.message[1]
    massless = ckc_pin.simulate("five_bar/swing", members.overrides_of(values[3]))
    assert np.array_equal(found.outputs["end"][3], massless.q_tree[-1])


def test_events_end_members_and_give_their_times() -> None:
    overrides = {**SWING, "event": [{"coordinate": "theta_1", "value": -1.2, "stop": True}]}
    members = Members("five_bar/swing", overrides, ("initial.q.theta_3",), {"when": "event.0", "t": "t"}, 2, 1)
    values = np.array([[-1.2], [-1.1]])
    found = members.run(0, values)
    for k, value in enumerate(values):
        run = ckc_pin.simulate("five_bar/swing", members.overrides_of(value))
        assert found.outputs["when"][k] == pytest.approx(run.events[0]["t"], abs=1e-8)
        assert found.outputs["t"][k] == found.outputs["when"][k]
        assert found.message[k].startswith("stopped by the event at t = ")


@pytest.mark.parametrize(
    ("names", "outputs", "says"),
    [
        (("link.link_9.mass",), OUTPUTS, "there are link.link_1, link.link_2"),
        (("initial.q.theta_9",), OUTPUTS, "no such coordinate; there are theta_1"),
        (("controller.K_P",), OUTPUTS, "is no number of the scene"),
        (("solver.rtoll",), OUTPUTS, "unknown key"),
        (("link.link_2.com",), OUTPUTS, "vary link.link_2.com.x, .y or .z"),
        (("epsilon",), {"x": "theta_9"}, "no 'theta_9'; there are q_tree"),
        (("epsilon",), {"x": "event.0"}, "the scene has no event '0'"),
        (("epsilon",), {"x": "error"}, "has no q_d"),
        (("epsilon",), {"x": lambda run: 1 / 0}, "x raised ZeroDivisionError for the scene itself"),
    ],
)
def test_what_is_not_there_is_refused(names: tuple[str, ...], outputs: dict[str, Any], says: str) -> None:
    with pytest.raises(CkcError) as error:
        Members("five_bar/swing", SWING, names, outputs, 1, 1)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("at", ["equilibrium", "assembled"])
@pytest.mark.parametrize("name", ["initial.q.theta_1", "initial.q.theta_2"])
def test_a_start_that_a_run_refuses_is_refused_of_an_ensemble(name: str, at: str) -> None:
    overrides = {**SWING, "initial": {"at": at}}
    with pytest.raises(ckc_pin.InputError) as of_run:
        ckc_pin.simulate("five_bar/swing", {**overrides, name: -1.2})
    with pytest.raises(ckc_pin.InputError) as of_ensemble:
        ckc_pin.ensemble("five_bar/swing", {name: [-1.2]}, {"end": "q_tree"}, overrides=overrides, progress=False)
    assert str(of_ensemble.value) == str(of_run.value)
    assert str(of_run.value) == f'five_bar/swing: initial: give either at = "{at}" or q, not both'


def test_whole_numbers_beyond_64_bits_are_taken_as_in_a_run() -> None:
    members = Members("five_bar/swing", SWING, ("initial.q_dot.theta_1", "solver.max_rhs"), OUTPUTS, 1, 1)
    assert members.overrides_of(np.array([1e20, 200.0]))["initial.q_dot.theta_1"] == 1e20
    ckc_pin.load_scene("five_bar/swing", members.overrides_of(np.array([1e20, 200.0])))


def test_an_output_that_raises_fails_its_member_only() -> None:
    def late(run: ckc_pin.Run) -> float:
        if run.q_tree[0, 0] < -1.2:
            raise RuntimeError("too far")
        return float(run.t[-1])

    members = Members("five_bar/swing", SWING, ("initial.q.theta_1",), {"late": late, **OUTPUTS}, 2, 2)
    found = members.run(0, np.array([[-1.3], [-1.0]]))
    assert found.status.tolist() == [FAILED, DONE]
    assert found.message[0] == "output 'late' raised RuntimeError: too far"
    assert np.isfinite(found.outputs["end"]).all()


def test_terms_of_a_tree_that_is_too_large_are_compiled_nowhere(tmp_path: Path) -> None:
    scene, names = ring(41, tmp_path), ("link.link_0.mass",)
    with pytest.raises(InputError, match="41 coordinates, which move 861 joints"):
        Members(scene, {"t_end": 1e-4, "solver.terms": "generated"}, names, {"end": "q_tree"}, 3, 1)
    members = Members(scene, {"t_end": 1e-4}, names, {"end": "q_tree"}, 10**9, 1)  # as many as would repay it
    assert members.terms == "pinocchio"
    assert members.run(0, np.array([[0.9], [1.1]])).status.tolist() == [DONE] * 2


def test_a_number_that_is_zero_varies_though_terms_without_it_are_in_the_cache() -> None:
    """What a plain run compiled leaves out what is zero in the file: a member by it would be the scene itself."""
    compile_terms(ckc_pin.load("five_bar"))
    names = ("gravity.x", "link.link_2.com.y", "joint.theta_2.xyz.y")
    values = np.array([[2.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]])
    members = Members("five_bar/swing", {**SWING, "solver.terms": "auto"}, names, dict(OUTPUTS), 3, 1)
    assert members.batched
    found = members.run(0, values)
    for k, value in enumerate(values):
        overrides = SWING | dict(zip(names, value.tolist(), strict=True))
        np.testing.assert_allclose(
            found.outputs["end"][k], ckc_pin.simulate("five_bar/swing", overrides).q_tree[-1], atol=CLOSE
        )
