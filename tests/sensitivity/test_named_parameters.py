"""All named parameters of planar and spatial mechanisms against extrapolated differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import ckc_pin
from ckc_pin import InputError, MechanismError, simulate
from ckc_pin.mechanism.parameters import values_of, with_components
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.conftest import remember
from tests.sensitivity.four_bar import TIGHT, write_four_bar
from tests.sensitivity.spatial import write_arms, write_tethered_body

TOLERANCE = 1e-8  # relative to the largest
MOTION = ("q_tree", "v_tree")


@remember
def differences(scene: str, name: str, h: float, overrides: dict[str, Any], parts: tuple[str, ...] = MOTION) -> Any:
    """Finite differences of runs with overrides; tests/contract compares overrides with edited files."""
    loaded = ckc_pin.load_scene(scene, overrides)
    present = with_components(values_of(*_files(loaded)))[name]
    h *= max(0.25, abs(present))

    def value(x: float) -> Any:
        run = simulate(scene, {**overrides, name: x})
        assert run.status == "done"
        return np.concatenate([getattr(run, part) for part in parts], axis=1)

    one, two = ((value(present + x) - value(present - x)) / (2 * x) for x in (h / 2, h / 4))
    return (4 * two - one) / 3


def _files(scene: Any) -> Any:
    mechanism = ckc_pin.load(scene.sources.folder / scene.spec.mechanism)
    return mechanism.spec, mechanism.urdf


def agree(result: Sensitivities, scene: str, overrides: dict[str, Any], *, parts: tuple[str, ...] = MOTION,
          h: float = 4e-4, tolerance: float = TOLERANCE, zero: tuple[str, ...] = ()) -> None:  # fmt: skip
    assert result.run.status == "done"
    ours = np.concatenate([getattr(result, part) for part in parts], axis=1)
    for k, name in enumerate(result.parameters):
        expected = differences(scene, name, h, overrides, parts)
        assert name in zero or np.abs(expected).max() > 1e-4, name
        assert np.abs(ours[:, :, k] - expected).max() <= tolerance * max(1e-3, np.abs(expected).max()), name


@pytest.mark.parametrize("kind", ["weld", "prismatic", "hinge", "universal", "point"])
def test_placements_in_space(kind: str, tmp_path: Path) -> None:
    """Placements of joints, fixed joints and loop frames, a gear ratio and a rotor."""
    scene = write_arms(tmp_path, kind)
    names = [
        "joint.lc.rpy",
        "joint.rb.xyz",
        "joint.lfix.rpy",
        "joint.lend.xyz",
        "joint.rb.armature",
        "coupling.0.ratio",
    ]
    names += ["loop.hold.frame_a.rpy", "loop.hold.frame_b.rpy.y", "joint.lend.rpy.x"] if kind != "point" else []
    result = sensitivities(scene, names, TIGHT)
    agree(result, scene, TIGHT)


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_placements_on_the_base(formulation: str, tmp_path: Path) -> None:
    scene = write_arms(tmp_path, "hinge", formulation)
    names = ["joint.la.rpy", "joint.rfix.xyz.y", "joint.rfix.rpy.z", "joint.w.rpy.x", "link.lbend.com",
             "coupling.0.offset", "spring.0.frame_a.xyz.z", "link.lhand.inertia.ixy"]  # fmt: skip
    agree(sensitivities(scene, names, TIGHT), scene, TIGHT, zero=("link.lbend.com.z",))


def test_a_free_root(tmp_path: Path) -> None:
    scene = write_tethered_body(tmp_path)
    names = ["link.body.mass", "gravity.x", "spring.0.frame_a.xyz.x", "joint.root.rpy.x", "joint.root.xyz.z"]
    result = sensitivities(scene, names, TIGHT)
    for k, name in enumerate(names):  # positions only, because the derivative of a rotation vector is not a twist
        expected = differences(scene, name, 4e-4, TIGHT, ("q_tree",))[:, :3]
        rows = zip(result.run.q_tree, result.q_tree[:, :3, k], strict=True)
        ours = np.array([pin.exp3(q[3:]) @ derivative for q, derivative in rows])
        assert np.abs(expected).max() > 1e-4, name
        assert np.abs(ours - expected).max() <= TOLERANCE * np.abs(expected).max(), name


def test_the_start_of_a_free_root(tmp_path: Path) -> None:
    """Its position in world axes, and its rotation vector."""
    scene = write_tethered_body(tmp_path)
    start = dict(ckc_pin.load_scene(scene).spec.initial.q)
    names = [f"root.{name}" for name in ("x", "z", "rx", "rz")]
    result = sensitivities(scene, [f"initial.q.{name}" for name in names], TIGHT)
    h = 2e-3
    for k, name in enumerate(names):
        runs = [[simulate(scene, {**TIGHT, f"initial.q.{name}": start[name] + x / s}) for x in (h, -h)] for s in (2, 4)]
        one, two = ((more.q_tree - less.q_tree) / (2 * h / s) for (more, less), s in zip(runs, (2, 4), strict=True))
        expected = ((4 * two - one) / 3)[:, :3]
        rows = zip(result.run.q_tree, result.q_tree[:, :3, k], strict=True)
        ours = np.array([pin.exp3(q[3:]) @ derivative for q, derivative in rows])
        assert np.abs(ours - expected).max() <= TOLERANCE * np.abs(expected).max(), name


def test_an_idle_parameter_has_zero_derivatives(tmp_path: Path) -> None:
    scene = write_arms(tmp_path, "hinge", more='[[motor]]\njoint = "ra"\nratio = 5.0\nspeed_limit = 3.0\n' + REST)
    result = sensitivities(scene, ["motor.ra.speed_limit"], TIGHT)
    assert not np.concatenate([result.q_tree, result.v_tree], axis=1).any()


REST = "".join(f'[[motor]]\njoint = "{name}"\n' for name in ("rb", "la"))
MOTOR = """[[motor]]
joint = "a"
ratio = 4.0
rotor_inertia = 0.01
torque_limit = {limit}
"""
SET_POINT = '[controller]\ntype = "set_point"\nK_P = 6.0\nK_V = 0.7\nq_d = { a = 0.9 }\n'
TORQUES = '[controller]\ntype = "torques"\nfile = "tau.csv"\ninterpolation = "linear"\n'


def write_driven_four_bar(
    folder: Path,
    controller: str,
    limit: float | str,
    formulation: str = "dae",
    torques: str = "t,a\n0,0.4\n0.5,0.1\n2,-0.3\n",
) -> str:
    scene = write_four_bar(folder, more=controller, formulation=formulation)
    path = folder / "bars.toml"
    text = path.read_text(encoding="utf-8").replace('actuated = ["a"]\n', "")
    path.write_text(text + MOTOR.format(limit=limit), encoding="utf-8")
    (folder / "tau.csv").write_text(torques, encoding="utf-8")
    return scene


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_parameters_of_motors(formulation: str, tmp_path: Path) -> None:
    """The gear ratio scales torques over time. With eq. 14 u is given, so only the rotor has an effect."""
    names = ["motor.a.ratio", "motor.a.rotor_inertia", "link.crank.mass", "joint.c.xyz.x", "initial.q.a"]
    for controller in (TORQUES, SET_POINT):
        scene = write_driven_four_bar(tmp_path / controller.split('"')[1], controller, 50.0, formulation)
        result = sensitivities(scene, names, TIGHT)
        mechanism_parameters = Sensitivities(
            result.run, result.parameters[:4], result.q_tree[:, :, :4], result.v_tree[:, :, :4], result.u[:, :, :4],
            result.tau[:, :, :4], None, result.sensitivity_parameters[:4],
        )  # fmt: skip
        agree(mechanism_parameters, scene, TIGHT, parts=("q_tree", "v_tree", "u", "tau"))


def test_a_torque_limit_that_is_reached(tmp_path: Path) -> None:
    scene = write_driven_four_bar(tmp_path, TORQUES, 0.25, torques="t,a\n0,0.4\n2,0.3\n")
    result = sensitivities(scene, ["motor.a.torque_limit", "motor.a.ratio"], TIGHT)
    assert np.abs(result.run.tau).max() == 0.25
    agree(result, scene, TIGHT, parts=("q_tree", "v_tree", "u", "tau"))


@pytest.mark.parametrize("torques", ["t,a\n0,0.4\n2,0.3\n", "t,a\n0,-0.4\n2,-0.3\n"], ids=["upper", "lower"])
def test_a_torque_limit_with_two_sides(torques: str, tmp_path: Path) -> None:
    """The motion depends on the limit that is reached."""
    scene = write_driven_four_bar(tmp_path, TORQUES, "[-0.1, 0.25]", torques=torques)
    names = ["motor.a.torque_limit.lower", "motor.a.torque_limit.upper"]
    result = sensitivities(scene, names, TIGHT)
    is_upper = "-" not in torques
    assert set(result.run.tau[:, 0]) == {0.25 if is_upper else -0.1}
    idle = names[0] if is_upper else names[1]
    agree(result, scene, TIGHT, parts=("q_tree", "v_tree", "u", "tau"), zero=(idle,))
    assert not result.q_tree[:, :, names.index(idle)].any()


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_parameters_of_a_motor_on_several_joints(formulation: str, tmp_path: Path) -> None:
    """Its rotor couples the inertias of the joints. The gear ratio scales the torque, too."""
    motor = '[[motor]]\nname = "m"\njoints = { ra = 1.0, lb = -0.5, w = 2.0 }\nratio = 3.0\nrotor_inertia = 0.01\n'
    scene = write_arms(tmp_path, "hinge", formulation, motor)
    names = ["motor.m.rotor_inertia", "motor.m.ratio", "link.lhand.mass"]
    for terms in ("pinocchio", "generated"):
        result = sensitivities(scene, names, {**TIGHT, "solver.terms": terms})
        assert result.run.stats["terms"] == terms
        agree(result, scene, TIGHT, h=2e-3, tolerance=2e-8)  # The same differences, by Pinocchio's terms


def test_equal_torque_limits_of_motor_and_controller_are_rejected(tmp_path: Path) -> None:
    scene = write_driven_four_bar(tmp_path, SET_POINT + "torque_limit = 50.0\n", 50.0)
    with pytest.raises(InputError, match="exists on one side only"):
        sensitivities(scene, ["motor.a.torque_limit"])
    result = sensitivities(scene, ["motor.a.torque_limit"], {"controller.torque_limit": 40.0, "t_end": 0.1})
    assert not result.q_tree.any()  # the controller's limit is smaller


def test_motors_that_share_a_force(tmp_path: Path) -> None:
    """With two motors for one freedom u has derivatives, but tau has not."""
    scene = write_driven_four_bar(tmp_path, SET_POINT, 50.0)
    with (tmp_path / "bars.toml").open("a", encoding="utf-8") as file:
        file.write('[[motor]]\njoint = "c"\n')
    result = sensitivities(scene, ["link.crank.mass", "joint.c.xyz.x"], TIGHT)
    assert np.isnan(result.tau).all()
    agree(result, scene, TIGHT, parts=("q_tree", "v_tree", "u"))
    assert not sensitivities(scene, ["motor.c.ratio"]).q_tree.any()  # without a rotor only tau depends on the ratio


def test_lengths_that_redundant_rows_determine_are_rejected() -> None:
    """Bricard's linkage moves only with its special lengths, but with any masses."""
    mechanism = ckc_pin.load("bricard")
    start = dict(zip(mechanism.independent, mechanism.independent_part(mechanism.q_tree).tolist(), strict=True))
    overrides = {"t_end": 0.01, "initial": {"q": start}}
    assert sensitivities("bricard", ["link.rod_1.mass"], overrides).run.status == "done"
    with pytest.raises(InputError, match=r"joint\.hinge_2\.xyz\.x: .* redundant rows .* hinge_4\.e2\.b"):
        sensitivities("bricard", ["joint.hinge_2.xyz.x"], overrides)


def test_an_impact(tmp_path: Path) -> None:
    scene = write_four_bar(tmp_path, {"joint.c.upper": 1.9}, stop=True)
    path = tmp_path / "bars.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("stops = true", "stops = true\narmature = 0.05"))
    result = sensitivities(scene, ["joint.c.armature", "joint.c.rpy.z", "joint.b.rpy.z", "joint.c.upper"], TIGHT)
    assert any("bounces" in event["name"] for event in result.run.events)
    agree(result, scene, TIGHT)


def test_derivatives_of_u(tmp_path: Path) -> None:
    """Eq. 14 on the five-bar with its gravity compensation and gains."""
    names = [
        "link.link_2.mass",
        "controller.K_P",
        "controller.K_V.theta_3",
        "joint.theta_2.xyz.x",
        "initial.q_dot.theta_1",
    ]
    overrides = {**TIGHT, "t_end": 0.5, "solver.output_dt": 0.1}
    result = sensitivities("five_bar/set_point", names, overrides)
    scene = ckc_pin.load_scene("five_bar/set_point").spec
    values = {"link.link_2.mass": values_of(*_mechanism("five_bar"))["link.link_2.mass"], "initial.q_dot.theta_1": 0.0}
    values |= {"joint.theta_2.xyz.x": values_of(*_mechanism("five_bar"))["joint.theta_2.xyz"][0]}  # type: ignore[index]
    values |= {"controller.K_P": scene.controller.K_P}  # type: ignore[union-attr]
    for name, value in values.items():
        h = 1e-3 * max(0.3, abs(value))  # type: ignore[arg-type]
        one, two, four = (
            (simulate("five_bar/set_point", {**overrides, name: value + x}).u  # type: ignore[operator]
             - simulate("five_bar/set_point", {**overrides, name: value - x}).u) / (2 * x)  # type: ignore[operator]
            for x in (h, h / 2, h / 4)
        )  # fmt: skip
        expected = (16 * (4 * four - two) - (4 * two - one)) / 45
        k = result.parameters.index(name)
        assert np.abs(result.u[:, :, k] - expected).max() <= TOLERANCE * np.abs(expected).max(), name
        assert np.array_equal(result.of("u.theta_3", name), result.u[:, 1, k])
    assert np.array_equal(result.tau, result.u)
    assert np.array_equal(
        result.of("v.theta_2", names[0]), result.v_tree[:, result.run.coordinates.index("theta_2"), 0]
    )
    with pytest.raises(InputError, match=r"\['u\.theta_2'\]: no such quantity; the nearest names are .*'u\.theta_1'"):
        result.of("u.theta_2", names[0])


def _mechanism(name: str) -> Any:
    mechanism = ckc_pin.load(name)
    return mechanism.spec, mechanism.urdf


def test_stops_are_named_parameters(tmp_path: Path) -> None:
    write_four_bar(tmp_path, stop=True)
    path = tmp_path / "bars.toml"
    mechanism = ckc_pin.load(path, {"joint.c.upper": 1.9, "joint.c.lower": -2.0})
    at = mechanism.tree.index["c"]
    assert (mechanism.joints.lower[at], mechanism.joints.upper[at]) == (-2.0, 1.9)
    with pytest.raises(MechanismError, match=r"joint 'c': its lower limit -1 is above the upper one -2"):
        ckc_pin.load(path, {"joint.c.upper": -2.0, "joint.c.lower": -1.0})
    write_four_bar(tmp_path)  # without stops the limits have no effect
    with pytest.raises(InputError, match=r"no 'joint\.c\.upper'; there are joint\.c\.xyz.*joint\.c\.damping"):
        ckc_pin.load(path, {"joint.c.upper": 1.9})


def test_load_and_sensitivities_accept_the_same_names(tmp_path: Path) -> None:
    """Both reject other names with the same message."""
    scene = write_four_bar(tmp_path, stop=True)
    mechanism = ckc_pin.load(tmp_path / "bars.toml")
    names = [name for name, x in values_of(mechanism.spec, mechanism.urdf).items() if not isinstance(x, tuple)]
    result = sensitivities(scene, names, {"t_end": 0.01, "friction_smoothing": 0.1})
    assert result.parameters == tuple(names)
    for name in ("link.crank.weight", "spring.7.rest", "joint.z.xyz"):
        messages = []
        with pytest.raises(InputError) as error:
            sensitivities(scene, [name])
        messages.append(str(error.value).partition(": no ")[2])
        with pytest.raises(InputError) as error:
            ckc_pin.load(tmp_path / "bars.toml", {name: 1.0})
        messages.append(str(error.value).partition(": no ")[2])
        assert messages[0] == messages[1]


def test_directions_are_sums_of_derivatives_with_respect_to_inertial_parameters() -> None:
    direction = {"link.link_2.mass": 0.7, "link.link_2.com.x": -0.2, "link.link_4.inertia.izz": 3.0}
    scene = ckc_pin.load_scene("five_bar/swing", {"t_end": 0.3})
    result = sensitivities(scene, [*direction, "joint.theta_2.xyz.x"], directions={"all": direction})
    assert result.parameters == (*direction, "joint.theta_2.xyz.x", "all")
    expected = result.q_tree[:, :, :3] @ np.array(list(direction.values()))
    assert result.q_tree[:, :, 4] == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())
    with pytest.raises(InputError, match=r"directions: joint.theta_2.xyz.x is no mass, centre of mass or inertia"):
        sensitivities(scene, ["link.link_2.mass"], directions={"all": {"joint.theta_2.xyz.x": 1.0}})
