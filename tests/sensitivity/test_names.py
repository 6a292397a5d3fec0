"""Every number of a mechanism that has a name, in space too, against extrapolated differences of tight runs."""

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
from tests.sensitivity.changed import TIGHT, written
from tests.sensitivity.spatial import arms, tethered

CLOSE = 1e-8  # of the largest
MOTION = ("q_tree", "v_tree")


def differences(scene: str, name: str, h: float, overrides: dict[str, Any], parts: tuple[str, ...] = MOTION) -> Any:
    """By the mechanism's own parameters, whose values tests/contract compares with files that say them."""
    loaded = ckc_pin.load_scene(scene, overrides)
    own = with_components(values_of(*_files(loaded)))[name]
    h *= max(0.25, abs(own))

    def value(x: float) -> Any:
        run = simulate(scene, {**overrides, name: x})
        assert run.status == "done"
        return np.concatenate([getattr(run, part) for part in parts], axis=1)

    one, two, four = ((value(own + x) - value(own - x)) / (2 * x) for x in (h, h / 2, h / 4))
    return (16 * (4 * four - two) - (4 * two - one)) / 45


def _files(scene: Any) -> Any:
    mechanism = ckc_pin.load(scene.sources.folder / scene.spec.mechanism)
    return mechanism.spec, mechanism.urdf


def agree(found: Sensitivities, scene: str, overrides: dict[str, Any], *, parts: tuple[str, ...] = MOTION,
          h: float = 4e-4, tolerance: float = CLOSE, zero: tuple[str, ...] = ()) -> None:  # fmt: skip
    assert found.run.status == "done"
    ours = np.concatenate([getattr(found, part) for part in parts], axis=1)
    for k, name in enumerate(found.parameters):
        wanted = differences(scene, name, h, overrides, parts)
        assert name in zero or np.abs(wanted).max() > 1e-4, name
        assert np.abs(ours[:, :, k] - wanted).max() <= tolerance * max(1e-3, np.abs(wanted).max()), name


@pytest.mark.parametrize("kind", ["weld", "prismatic", "hinge", "universal", "point"])
def test_of_what_turns_and_places_in_space(kind: str, tmp_path: Path) -> None:
    """Joints, fixed ones, frames of loops, a gear's ratio and a rotor."""
    scene = arms(tmp_path, kind)
    names = [
        "joint.lc.rpy",
        "joint.rb.xyz",
        "joint.lfix.rpy",
        "joint.lend.xyz",
        "joint.rb.armature",
        "coupling.0.ratio",
    ]
    names += ["loop.hold.frame_a.rpy", "loop.hold.frame_b.rpy.y", "joint.lend.rpy.x"] if kind != "point" else []
    found = sensitivities(scene, names, TIGHT)
    agree(found, scene, TIGHT)


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_of_what_is_fixed_to_the_world(formulation: str, tmp_path: Path) -> None:
    scene = arms(tmp_path, "hinge", formulation)
    names = ["joint.la.rpy", "joint.rfix.xyz.y", "joint.rfix.rpy.z", "joint.w.rpy.x", "link.lbend.com",
             "coupling.0.offset", "spring.0.frame_a.xyz.z", "link.lhand.inertia.ixy"]  # fmt: skip
    agree(sensitivities(scene, names, TIGHT), scene, TIGHT, zero=("link.lbend.com.z",))


def test_of_a_free_root(tmp_path: Path) -> None:
    scene = tethered(tmp_path)
    names = ["link.body.mass", "gravity.x", "spring.0.frame_a.xyz.x", "joint.root.rpy.x", "joint.root.xyz.z"]
    found = sensitivities(scene, names, TIGHT)
    for k, name in enumerate(names):  # places, in the body's axes; rotations as vectors are no twists
        wanted = differences(scene, name, 4e-4, TIGHT, ("q_tree",))[:, :3]
        every = zip(found.run.q_tree, found.q_tree[:, :3, k], strict=True)
        ours = np.array([pin.exp3(q[3:]) @ change for q, change in every])
        assert np.abs(wanted).max() > 1e-4, name
        assert np.abs(ours - wanted).max() <= CLOSE * np.abs(wanted).max(), name


def test_of_where_a_free_root_starts(tmp_path: Path) -> None:
    """In the world's axes, and by its rotation vector."""
    scene = tethered(tmp_path)
    start = dict(ckc_pin.load_scene(scene).spec.initial.q)
    names = [f"root.{name}" for name in ("x", "z", "rx", "rz")]
    found = sensitivities(scene, [f"initial.q.{name}" for name in names], TIGHT)
    h = 2e-3
    for k, name in enumerate(names):
        runs = [
            [simulate(scene, {**TIGHT, f"initial.q.{name}": start[name] + x / s}) for x in (h, -h)] for s in (1, 2, 4)
        ]
        one, two, four = (
            (more.q_tree - less.q_tree) / (2 * h / s) for (more, less), s in zip(runs, (1, 2, 4), strict=True)
        )
        wanted = ((16 * (4 * four - two) - (4 * two - one)) / 45)[:, :3]
        every = zip(found.run.q_tree, found.q_tree[:, :3, k], strict=True)
        ours = np.array([pin.exp3(q[3:]) @ change for q, change in every])
        assert np.abs(ours - wanted).max() <= CLOSE * np.abs(wanted).max(), name


def test_what_does_nothing_has_no_effect(tmp_path: Path) -> None:
    scene = arms(tmp_path, "hinge", more='[[motor]]\njoint = "ra"\nratio = 5.0\nspeed_limit = 3.0\n' + REST)
    found = sensitivities(scene, ["motor.ra.speed_limit"], TIGHT)
    assert not np.concatenate([found.q_tree, found.v_tree], axis=1).any()


REST = "".join(f'[[motor]]\njoint = "{name}"\n' for name in ("rb", "la"))
MOTOR = """[[motor]]
joint = "a"
ratio = 4.0
rotor_inertia = 0.01
torque_limit = {limit}
"""
SET_POINT = '[controller]\ntype = "set_point"\nK_P = 6.0\nK_V = 0.7\nq_d = { a = 0.9 }\n'
TORQUES = '[controller]\ntype = "torques"\nfile = "tau.csv"\ninterpolation = "linear"\n'


def driven(
    folder: Path,
    controller: str,
    limit: float,
    formulation: str = "dae",
    torques: str = "t,a\n0,0.4\n0.5,0.1\n2,-0.3\n",
) -> str:
    scene = written(folder, more=controller, formulation=formulation)
    path = folder / "bars.toml"
    text = path.read_text(encoding="utf-8").replace('actuated = ["a"]\n', "")
    path.write_text(text + MOTOR.format(limit=limit), encoding="utf-8")
    (folder / "tau.csv").write_text(torques, encoding="utf-8")
    return scene


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_of_motors_and_what_they_do(formulation: str, tmp_path: Path) -> None:
    """Torques over time act by the gear; those of eq. 14 are u by the gear, and only the rotor is felt."""
    names = ["motor.a.ratio", "motor.a.rotor_inertia", "link.crank.mass", "joint.c.xyz.x", "initial.q.a"]
    for controller in (TORQUES, SET_POINT):
        scene = driven(tmp_path / controller.split('"')[1], controller, 50.0, formulation)
        found = sensitivities(scene, names, TIGHT)
        some = Sensitivities(
            found.run, found.parameters[:4], found.q_tree[:, :, :4], found.v_tree[:, :, :4], found.u[:, :, :4],
            found.tau[:, :, :4], None, found.sensitivity_parameters[:4],
        )  # fmt: skip
        agree(some, scene, TIGHT, parts=("q_tree", "v_tree", "u", "tau"))


def test_of_a_limit_that_is_reached(tmp_path: Path) -> None:
    scene = driven(tmp_path, TORQUES, 0.25, torques="t,a\n0,0.4\n2,0.3\n")
    found = sensitivities(scene, ["motor.a.torque_limit", "motor.a.ratio"], TIGHT)
    assert np.abs(found.run.tau).max() == 0.25
    agree(found, scene, TIGHT, parts=("q_tree", "v_tree", "u", "tau"))


def test_a_limit_that_two_give_has_no_derivative(tmp_path: Path) -> None:
    scene = driven(tmp_path, SET_POINT + "torque_limit = 50.0\n", 50.0)
    with pytest.raises(InputError, match="exists on one side only"):
        sensitivities(scene, ["motor.a.torque_limit"])
    found = sensitivities(scene, ["motor.a.torque_limit"], {"controller.torque_limit": 40.0, "t_end": 0.1})
    assert not found.q_tree.any()  # the other one is the smaller


def test_of_motors_that_share_a_force(tmp_path: Path) -> None:
    """Two for one freedom: u is known, whose part is whose is not."""
    scene = driven(tmp_path, SET_POINT, 50.0)
    with (tmp_path / "bars.toml").open("a", encoding="utf-8") as file:
        file.write('[[motor]]\njoint = "c"\n')
    found = sensitivities(scene, ["link.crank.mass", "joint.c.xyz.x"], TIGHT)
    assert np.isnan(found.tau).all()
    agree(found, scene, TIGHT, parts=("q_tree", "v_tree", "u"))
    assert not sensitivities(scene, ["motor.c.ratio"]).q_tree.any()  # without a rotor it is tau's alone


def test_lengths_that_cannot_be_other_ones_are_refused() -> None:
    """Bricard's linkage moves only because its lengths are special; its masses may be any."""
    mechanism = ckc_pin.load("bricard")
    start = dict(zip(mechanism.independent, mechanism.independent_part(mechanism.q_tree).tolist(), strict=True))
    overrides = {"t_end": 0.01, "initial": {"q": start}}
    assert sensitivities("bricard", ["link.rod_1.mass"], overrides).run.status == "done"
    with pytest.raises(InputError, match=r"joint\.hinge_2\.xyz\.x: with another value .* hinge_4\.e2\.b"):
        sensitivities("bricard", ["joint.hinge_2.xyz.x"], overrides)


def test_through_an_impact(tmp_path: Path) -> None:
    scene = written(tmp_path, {"joint.c.upper": 1.9}, stop=True)
    path = tmp_path / "bars.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("stops = true", "stops = true\narmature = 0.05"))
    found = sensitivities(scene, ["joint.c.armature", "joint.c.rpy.z", "joint.b.rpy.z", "joint.c.upper"], TIGHT)
    assert any("bounces" in event["name"] for event in found.run.events)
    agree(found, scene, TIGHT)


def test_of_u(tmp_path: Path) -> None:
    """Of eq. 14 on the five-bar, its compensation and gains, by name."""
    names = [
        "link.link_2.mass",
        "controller.K_P",
        "controller.K_V.theta_3",
        "joint.theta_2.xyz.x",
        "initial.q_dot.theta_1",
    ]
    overrides = {**TIGHT, "t_end": 0.5, "solver.output_dt": 0.1}
    found = sensitivities("five_bar/set_point", names, overrides)
    scene = ckc_pin.load_scene("five_bar/set_point").spec
    values = {"link.link_2.mass": values_of(*_mechanism("five_bar"))["link.link_2.mass"], "initial.q_dot.theta_1": 0.0}
    values |= {"joint.theta_2.xyz.x": values_of(*_mechanism("five_bar"))["joint.theta_2.xyz"][0]}  # type: ignore[index]
    values |= {"controller.K_P": scene.controller.K_P}  # type: ignore[union-attr]
    for name, own in values.items():
        h = 1e-3 * max(0.3, abs(own))  # type: ignore[arg-type]
        one, two, four = (
            (simulate("five_bar/set_point", {**overrides, name: own + x}).u  # type: ignore[operator]
             - simulate("five_bar/set_point", {**overrides, name: own - x}).u) / (2 * x)  # type: ignore[operator]
            for x in (h, h / 2, h / 4)
        )  # fmt: skip
        wanted = (16 * (4 * four - two) - (4 * two - one)) / 45
        k = found.parameters.index(name)
        assert np.abs(found.u[:, :, k] - wanted).max() <= CLOSE * np.abs(wanted).max(), name
        assert np.array_equal(found.of("u.theta_3", name), found.u[:, 1, k])
    assert np.array_equal(found.tau, found.u)
    assert np.array_equal(found.of("v.theta_2", names[0]), found.v_tree[:, found.run.coordinates.index("theta_2"), 0])
    with pytest.raises(
        InputError, match=r"no 'u\.theta_2'; there are theta_1.*v\.theta_1.*u\.theta_1, u\.theta_3, tau\."
    ):
        found.of("u.theta_2", names[0])


def _mechanism(name: str) -> Any:
    mechanism = ckc_pin.load(name)
    return mechanism.spec, mechanism.urdf


def test_stops_have_names_and_are_checked(tmp_path: Path) -> None:
    written(tmp_path, stop=True)
    path = tmp_path / "bars.toml"
    mechanism = ckc_pin.load(path, {"joint.c.upper": 1.9, "joint.c.lower": -2.0})
    at = mechanism.tree.index["c"]
    assert (mechanism.joints.lower[at], mechanism.joints.upper[at]) == (-2.0, 1.9)
    with pytest.raises(MechanismError, match=r"joint 'c': its lower limit -1 is above the upper one -2"):
        ckc_pin.load(path, {"joint.c.upper": -2.0, "joint.c.lower": -1.0})
    written(tmp_path)  # no stops: its limits do nothing
    with pytest.raises(InputError, match=r"no 'joint\.c\.upper'; there are joint\.c\.xyz.*joint\.c\.damping"):
        ckc_pin.load(path, {"joint.c.upper": 1.9})


def test_every_name_of_a_mechanism_is_known_and_no_other(tmp_path: Path) -> None:
    """What `ckc_pin.load` takes can be asked for, and the words for what it does not take are the same."""
    scene = written(tmp_path, stop=True)
    mechanism = ckc_pin.load(tmp_path / "bars.toml")
    names = [name for name, x in values_of(mechanism.spec, mechanism.urdf).items() if not isinstance(x, tuple)]
    found = sensitivities(scene, names, {"t_end": 0.01, "friction_smoothing": 0.1})
    assert found.parameters == tuple(names)
    for name in ("link.crank.weight", "spring.7.rest", "joint.z.xyz"):
        messages = []
        with pytest.raises(InputError) as error:
            sensitivities(scene, [name])
        messages.append(str(error.value).partition(": no ")[2])
        with pytest.raises(InputError) as error:
            ckc_pin.load(tmp_path / "bars.toml", {name: 1.0})
        messages.append(str(error.value).partition(": no ")[2])
        assert messages[0] == messages[1]
