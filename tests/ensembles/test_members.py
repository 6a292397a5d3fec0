"""Each member agrees with a single run with the same overrides, for any order, chunk and thread."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin.codegen.library import compile_terms
from ckc_pin.ensembles.members import DONE, FAILED, STOPPED, Members
from ckc_pin.ensembles.outputs import NAMED_REDUCTIONS
from ckc_pin.ensembles.spec import OutputSpec
from ckc_pin.errors import CkcError, InputError
from scripts.experiments.generated_sizes import ring
from tests.contract.test_parameters import folder

TOLERANCE = 1e-7  # rtol is 1e-9, and the two starts are closed differently up to rounding
OUTPUTS = {"end": "q_tree", "rate": "v_tree", "drift": "energy_drift"}
HANGING = {"initial.q.theta_1": -1.434, "initial.q.theta_3": -1.707}
SWING = {"t_end": 0.5, "solver.rtol": 1e-9, "solver.terms": "pinocchio"}

# scene, overrides, variables with their ranges, whether the members are batched
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


def prepare(case: str, threads: int = 2, **outputs: Any) -> tuple[Members, np.ndarray[Any, Any]]:
    scene, overrides, ranges, _ = CASES[case]
    members = Members(scene, {**SWING, **overrides}, tuple(ranges), {**OUTPUTS, **outputs}, 6, threads)
    low, high = np.array(list(ranges.values())).T
    return members, np.random.default_rng(5).uniform(low, high, (6, len(ranges)))


@pytest.mark.parametrize("case", CASES)
def test_member_equals_a_run_with_its_overrides(case: str) -> None:
    members, values = prepare(case)
    assert members.is_batched == CASES[case][3]
    result = members.run(0, values)
    assert result.status.tolist() == [DONE] * 6, result.message
    assert np.ptp(result.outputs["end"], axis=0).max() > 1e-4  # the variables have an effect
    for k, value in enumerate(values):
        run = ckc_pin.simulate(members.scene_of(value))
        assert np.abs(result.outputs["end"][k] - run.q_tree[-1]).max() < TOLERANCE
        assert np.abs(result.outputs["rate"][k] - run.v_tree[-1]).max() < 10 * TOLERANCE


@pytest.mark.parametrize("case", ["starts", "lengths", "inertia", "generated", "set point", "gains"])
def test_results_are_bitwise_equal_for_any_order_chunk_and_thread(case: str) -> None:
    members, values = prepare(case, threads=1)
    other, _ = prepare(case, threads=3)
    chunk = members.run(0, values)
    order = np.array([4, 1, 5, 0, 3, 2])
    mixed = other.run(0, values[order])
    for name, x in chunk.outputs.items():
        assert np.array_equal(x[order], mixed.outputs[name]), name
        assert np.array_equal(x[2:3], members.run(2, values[2:3]).outputs[name]), name


def test_springs_forces_and_lengths_can_vary(tmp_path: Path) -> None:
    at = folder(tmp_path / "sprung")
    ranges = {"spring.0.stiffness": (30, 60), "spring.0.frame_a.xyz.x": (0, 0.1), "spring.1.rest": (0, 0.4),
              "spring.1.damping": (0.05, 0.2), "force.0.value": (-0.3, 0.3), "loop.knee.length": (0.48, 0.52),
              "loop.knee.frame_a.xyz.y": (-0.02, 0.02), "joint.elbow.xyz.x": (0.38, 0.42), "link.arm.mass": (1, 2),
              "link.rod.com.y": (-0.02, 0.02), "spring.0.rest_length": (0, 0.2)}  # fmt: skip
    overrides = {"t_end": 0.5, "solver.rtol": 1e-9, "initial.at": None, "initial.q.elbow": 0.35}
    members = Members(at, overrides, tuple(ranges), {"end": "q_tree"}, 6, 2)
    low, high = np.array(list(ranges.values())).T
    values = np.random.default_rng(5).uniform(low, high, (6, len(ranges)))
    assert members.is_batched
    result = members.run(0, values)
    for k, value in enumerate(values):
        run = ckc_pin.simulate(at, members.overrides_of(value))
        assert np.abs(result.outputs["end"][k] - run.q_tree[-1]).max() < TOLERANCE


def test_a_table_among_the_overrides_replaces_the_scenes_table() -> None:
    """As in a single run, no key of the scene's table remains."""
    scene = "five_bar/tracking"
    overrides = {"t_end": 0.1, "initial": {"q": {"theta_1": -1.0, "theta_3": -2.0}}}
    assert ckc_pin.load_scene(scene).spec.initial.at == "equilibrium"
    result = ckc_pin.ensemble(
        scene, {"link.link_2.mass": [0.2, 0.3]}, {"end": "q_tree"}, overrides=overrides, progress=False
    )
    for k, mass in enumerate((0.2, 0.3)):
        run = ckc_pin.simulate(scene, {**overrides, "link.link_2.mass": mass})
        assert np.abs(result["end"][k] - run.q_tree[-1]).max() < TOLERANCE


@pytest.mark.parametrize("name", ["gravity.x", "link.link_2.mass", "initial.q.theta_1"])
def test_the_error_of_an_unknown_distribution_lists_the_valid_ones(name: str) -> None:
    with pytest.raises(ckc_pin.InputError, match=rf"{name}: unknown key 'gauss'; valid: uniform, loguniform, normal"):
        ckc_pin.ensemble("five_bar/swing", {name: {"gauss": [0, 1]}}, {"end": "q_tree"}, members=2)


def test_reductions_match_those_of_a_run() -> None:
    outputs: dict[str, Any] = {
        name: {"of": of, "reduce": how}
        for name, of, how in [("low", "theta_2", "min"), ("mean", "v_tree", "mean"), ("area", "error", "integral"),
                              ("rms", "error", "rms"), ("path", "u", "trajectory"), ("late", "error", "end")]
    }  # fmt: skip
    specs = {name: OutputSpec(**spec) for name, spec in outputs.items()}
    scene = "five_bar/tracking"
    members = Members(scene, {"t_end": 0.3, "solver.output_dt": 0.01}, ("initial.q_dot.theta_1",),
                      {**specs, **{name: name for name in NAMED_REDUCTIONS}, "settled": "settled",
                       "drift": "energy_drift"}, 1, 1)  # fmt: skip
    result = members.run(0, np.array([[0.2]])).outputs
    run = ckc_pin.simulate(scene, {"t_end": 0.3, "solver.output_dt": 0.01, "initial.q_dot.theta_1": 0.2})
    error = run.q_tree[:, members.mechanism.partition.q] - np.array([desired(run, t) for t in run.t])
    assert np.allclose(result["low"], run.q_tree[:, run.column("theta_2")].min(), atol=1e-9)
    assert np.allclose(result["mean"], np.trapezoid(run.v_tree, run.t, axis=0) / 0.3, atol=1e-7)
    assert np.allclose(result["area"], np.trapezoid(error, run.t, axis=0), atol=1e-9)
    assert np.allclose(result["rms"] ** 2, np.trapezoid(error**2, run.t, axis=0) / 0.3, atol=1e-9)
    assert np.allclose(result["path"][0], run.u.T, atol=1e-5)
    assert np.allclose(result["late"], error[-1], atol=1e-9)
    assert np.allclose(result["max_abs_u"], np.abs(run.u).max(), atol=1e-5)
    assert np.allclose(result["drift"], np.abs(run.energy - run.energy[0]).max(), atol=1e-6)
    assert result["settled"].tolist() == [0.0]


@pytest.mark.parametrize(
    ("scene", "overrides", "name", "values"),
    [
        ("five_bar/set_point", {"t_end": 0.3}, "controller.q_d.theta_1", [0.6, 0.7]),
        ("five_bar/tracking", {"t_end": 0.3}, "controller.desired.theta_3.offset", [0.7, 0.9]),
        ("five_bar/set_point", {"solver.output_dt": None}, "t_end", [0.1, 0.3]),
        ("five_bar/set_point", {"t_end": 0.3, "solver.output_dt": 0.02}, "solver.output_dt", [0.01, 0.05]),
    ],
)
def test_reductions_use_the_instants_and_the_desired_motion_of_the_member(
    scene: str, overrides: dict[str, Any], name: str, values: list[float]
) -> None:
    outputs: dict[str, Any] = {
        how: OutputSpec(of="error", reduce=how) for how in ("integral", "max_abs", "mean", "rms", "end")
    }
    overrides = {"solver.terms": "pinocchio", **overrides}
    members = Members(scene, overrides, (name,), outputs, 1, 1)
    result = members.run(0, np.array(values)[:, None]).outputs
    for k, value in enumerate(values):
        run = ckc_pin.simulate(scene, {**overrides, name: value})
        q_d = run.scene["controller"].get("q_d") or {}
        q_d_by_time = [[q_d[x] for x in run.independent] if q_d else desired(run, t) for t in run.t]
        error = run.q_tree[:, members.mechanism.partition.q] - np.array(q_d_by_time)
        area = np.trapezoid(error, run.t, axis=0)
        assert np.allclose(result["integral"][k], area, atol=1e-9)
        assert np.allclose(result["mean"][k], area / run.t[-1], atol=1e-9)
        assert np.allclose(result["rms"][k] ** 2, np.trapezoid(error**2, run.t, axis=0) / run.t[-1], atol=1e-9)
        assert np.allclose(result["max_abs"][k], np.abs(error).max(axis=0), atol=1e-9)
        assert np.allclose(result["end"][k], error[-1], atol=1e-9)


def test_settled_uses_the_target_of_the_member() -> None:
    name, gains = "controller.q_d.theta_1", {"controller.K_V": 4.0, "t_end": 20.0, "solver.output_dt": 1.0}
    members = Members("five_bar/set_point", gains, (name,), {"settled": OutputSpec(of="settled")}, 1, 1)
    run = ckc_pin.simulate("five_bar/set_point", {**gains, name: 0.7})
    assert abs(run.q_tree[-1, run.column("theta_1")] - 0.7) < 1e-4
    assert members.run(0, np.array([[0.7]])).outputs["settled"].tolist() == [1.0]


@pytest.mark.parametrize("name", ["t_end", "solver.output_dt"])
def test_a_trajectory_needs_the_same_instants_of_all_members(name: str) -> None:
    path = {"path": OutputSpec(of="theta_1", reduce="trajectory")}
    with pytest.raises(InputError, match=f"path: a trajectory needs the same output instants .* but {name} varies"):
        Members("five_bar/swing", SWING, (name,), path, 1, 1)


def desired(run: ckc_pin.Run, t: float) -> list[float]:
    return [
        motion.get("offset", 0.0) + sum(a * np.sin(w * t + p) for a, w, p in motion["harmonics"])
        for motion in (run.scene["controller"]["desired"][name] for name in run.independent)
    ]


def test_members_that_stop_or_fail_have_a_message() -> None:
    names = ("link.link_2.mass", "joint.theta_2.xyz.x", "solver.max_rhs")
    values = np.array([[0.3, 0.26, 9999], [-1.0, 0.26, 9999], [0.3, 9.0, 9999], [0.3, 0.26, 20], [np.nan, 0.26, 9999]])
    members = Members("five_bar/swing", SWING, names, OUTPUTS, 5, 2)
    result = members.run(0, values)
    assert result.status.tolist() == [DONE, FAILED, FAILED, STOPPED, FAILED]
    for k, message in ((1, "negative mass -1 kg"), (2, "not closed"), (3, "max_rhs = 20"), (4, "nan")):
        assert message in result.message[k]
    assert np.isfinite(result.outputs["end"]).all(axis=1).tolist() == [True, False, False, True, False]


def test_a_member_that_stops_at_its_start_has_no_mean() -> None:
    """Its NaN must have the same sign as that of a chunk which Zarr omits because it has fill values only."""
    outputs = {how: OutputSpec(of="theta_1", reduce=how) for how in ("mean", "rms")}
    result = Members("five_bar/swing", SWING, ("solver.max_rhs",), outputs, 1, 1).run(0, np.array([[1.0]]))
    assert result.status.tolist() == [STOPPED]
    for name in outputs:
        assert result.outputs[name].tobytes() == np.array([np.nan]).tobytes()


def test_an_unphysical_member_of_a_batch_fails_alone() -> None:
    members = Members("five_bar/swing", SWING, ("link.link_2.mass", "joint.theta_2.xyz.x"), OUTPUTS, 3, 2)
    assert members.is_batched
    values = np.array([[0.3, 0.26], [-1.0, 0.26], [0.3, 9.0], [0.0, 0.26], [np.inf, 0.26]])
    result = members.run(0, values)  # pytest turns a warning of NumPy into an error
    assert result.status.tolist() == [DONE, FAILED, FAILED, result.status[3], FAILED]
    assert "negative mass" in result.message[1]
    massless = ckc_pin.simulate("five_bar/swing", members.overrides_of(values[3]))
    assert np.array_equal(result.outputs["end"][3], massless.q_tree[-1])


def test_events_end_members_and_their_times_are_outputs() -> None:
    overrides = {**SWING, "event": [{"coordinate": "theta_1", "value": -1.2, "stop": True}]}
    members = Members("five_bar/swing", overrides, ("initial.q.theta_3",), {"when": "event.0", "t": "t"}, 2, 1)
    values = np.array([[-1.2], [-1.1]])
    result = members.run(0, values)
    for k, value in enumerate(values):
        run = ckc_pin.simulate("five_bar/swing", members.overrides_of(value))
        assert result.outputs["when"][k] == pytest.approx(run.events[0]["t"], abs=1e-8)
        assert result.outputs["t"][k] == result.outputs["when"][k]
        assert result.message[k].startswith("stopped by the event at t = ")


@pytest.mark.parametrize(
    ("names", "outputs", "message"),
    [
        (("link.link_9.mass",), OUTPUTS, "there are link.link_1, link.link_2"),
        (("initial.q.theta_9",), OUTPUTS, "no such coordinate; there are theta_1"),
        (("controller.K_P",), OUTPUTS, "is not a number of the scene"),
        (("solver.rtoll",), OUTPUTS, "unknown key"),
        (("link.link_2.com",), OUTPUTS, "vary link.link_2.com.x, .y or .z"),
        (("epsilon",), {"x": "theta_9"}, "'theta_9': no such quantity; the nearest names are 'theta_1'"),
        (("epsilon",), {"x": "event.0"}, "the scene has no event '0'"),
        (("epsilon",), {"x": "error"}, "has no q_d"),
        (("epsilon",), {"x": lambda run: 1 / 0}, "x raised ZeroDivisionError for the scene itself"),
    ],
)
def test_unknown_variables_and_outputs_are_rejected(
    names: tuple[str, ...], outputs: dict[str, Any], message: str
) -> None:
    with pytest.raises(CkcError) as error:
        Members("five_bar/swing", SWING, names, outputs, 1, 1)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("at", ["equilibrium", "assembled"])
@pytest.mark.parametrize("name", ["initial.q.theta_1", "initial.q.theta_2"])
def test_an_ensemble_rejects_the_same_starts_as_a_run(name: str, at: str) -> None:
    overrides = {**SWING, "initial": {"at": at}}
    with pytest.raises(ckc_pin.InputError) as run_error:
        ckc_pin.simulate("five_bar/swing", {**overrides, name: -1.2})
    with pytest.raises(ckc_pin.InputError) as ensemble_error:
        ckc_pin.ensemble("five_bar/swing", {name: [-1.2]}, {"end": "q_tree"}, overrides=overrides, progress=False)
    assert str(ensemble_error.value) == str(run_error.value)
    assert str(run_error.value) == f'five_bar/swing: initial: give either at = "{at}" or q, not both'


def test_whole_numbers_beyond_64_bits_are_accepted() -> None:
    members = Members("five_bar/swing", SWING, ("initial.q_dot.theta_1", "solver.max_rhs"), OUTPUTS, 1, 1)
    assert members.overrides_of(np.array([1e20, 200.0]))["initial.q_dot.theta_1"] == 1e20
    ckc_pin.load_scene("five_bar/swing", members.overrides_of(np.array([1e20, 200.0])))


def test_an_output_that_raises_fails_its_member_only() -> None:
    def late(run: ckc_pin.Run) -> float:
        if run.q_tree[0, 0] < -1.2:
            raise RuntimeError("too far")
        return float(run.t[-1])

    members = Members("five_bar/swing", SWING, ("initial.q.theta_1",), {"late": late, **OUTPUTS}, 2, 2)
    result = members.run(0, np.array([[-1.3], [-1.0]]))
    assert result.status.tolist() == [FAILED, DONE]
    assert result.message[0] == "output 'late' raised RuntimeError: too far"
    assert np.isfinite(result.outputs["end"]).all()


def test_terms_of_a_large_tree_are_not_compiled(tmp_path: Path) -> None:
    scene, names = ring(41, tmp_path), ("link.link_0.mass",)
    with pytest.raises(InputError, match="41 coordinates, which move 861 joints"):
        Members(scene, {"t_end": 1e-4, "solver.terms": "generated"}, names, {"end": "q_tree"}, 3, 1)
    members = Members(scene, {"t_end": 1e-4}, names, {"end": "q_tree"}, 10**9, 1)  # compiling would save time
    assert members.terms == "pinocchio"
    assert members.run(0, np.array([[0.9], [1.1]])).status.tolist() == [DONE] * 2


def test_a_parameter_that_is_zero_varies_if_cached_terms_lack_it() -> None:
    """Terms compiled for a run lack numbers that are zero in the file, and would ignore the parameter."""
    compile_terms(ckc_pin.load("five_bar"))
    names = ("gravity.x", "link.link_2.com.y", "joint.theta_2.xyz.y")
    values = np.array([[2.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]])
    members = Members("five_bar/swing", {**SWING, "solver.terms": "auto"}, names, dict(OUTPUTS), 3, 1)
    assert members.is_batched
    result = members.run(0, values)
    for k, value in enumerate(values):
        overrides = SWING | dict(zip(names, value.tolist(), strict=True))
        np.testing.assert_allclose(
            result.outputs["end"][k], ckc_pin.simulate("five_bar/swing", overrides).q_tree[-1], atol=TOLERANCE
        )
