"""`ckc import` of MuJoCo's couplings, actuators on tendons and torque limits, against MuJoCo at random states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from ckc_pin import Mechanism
from ckc_pin.formats.exporting import export
from ckc_pin.formats.importing import read
from tests.conftest import assert_close
from tests.contract.helpers.models import has_note, model

EXACT = 1e-12
ACKERMANN = """
<body name="rack"><joint name="steer" axis="0 0 1" {ref}/><geom size=".02"/></body>
<body name="left" pos="0 .1 0"><joint name="left" axis="0 0 1"/><geom size=".02"/></body>
<body name="right" pos="0 -.1 0"><joint name="right" axis="0 0 1" {ref}/><geom size=".02"/></body>"""
STEERING = """<equality>
  <joint joint1="left" joint2="steer" polycoef="0 1 0.375 0.140625 -0.0722656"/>
  <joint joint1="right" joint2="steer" polycoef="0.1 1 -0.375 0.140625 0.0722656"/></equality>"""
WAIST = """
<body name="m1" pos=".1 0 0"><joint name="act_1" axis="0 0 1"/><geom size=".1"/></body>
<body name="m2" pos="-.1 0 0"><joint name="act_2" axis="0 0 1"/><geom size=".1"/></body>
<body name="yawed"><joint name="yaw" axis="0 0 1" ref="0.2"/><geom size=".1"/>
  <body name="torso" pos="0 0 .1"><joint name="roll" axis="1 0 0"/><geom size=".1"/></body></body>"""
TIED = """<tendon>
  <fixed name="roll_coupling"><joint joint="act_1" coef="0.29"/><joint joint="act_2" coef="-0.29"/>
    <joint joint="roll" coef="1"/></fixed>
  <fixed name="yaw_coupling" limited="true" range="{range}"><joint joint="act_1" coef="-0.21"/>
    <joint joint="act_2" coef="-0.21"/><joint joint="yaw" coef="1"/></fixed></tendon>
  <equality><tendon name="roll_kept" tendon1="roll_coupling"/></equality>
  <actuator><motor joint="act_1"/><motor joint="act_2"/></actuator>"""
CHAIN = """<body name="u"><joint name="j1" axis="0 0 1" {more}/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".02"/>
  <body name="v" pos=".4 0 0"><joint name="j2" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
  </body></body>"""


def set_state(mechanism: Mechanism, q_tree: Any, v_tree: Any, folder: Path) -> tuple[Any, Any]:
    """Return MuJoCo's model and data of the imported file, set to a state."""
    whole: Any = mujoco.MjModel.from_xml_path(str(folder / "thing.xml"))
    data: Any = mujoco.MjData(whole)
    for k, name in enumerate(mechanism.coordinates):
        data.qpos[whole.joint(name).qposadr[0]] = q_tree[k]
        data.qvel[whole.joint(name).dofadr[0]] = v_tree[k]
    mujoco.mj_forward(whole, data)
    return whole, data


def dofs(whole: Any, mechanism: Mechanism) -> list[int]:
    return [int(whole.joint(name).dofadr[0]) for name in mechanism.coordinates]


@pytest.mark.parametrize("ref", ["", 'ref="0.3"'])
def test_polynomials_of_joints_are_couplings(ref: str, tmp_path: Path) -> None:
    """Residuals and Jacobians equal MuJoCo's, whose polynomial counts from the reference pose."""
    draft = model(tmp_path, ACKERMANN.format(ref=ref), STEERING)
    mechanism, random = draft.build_mechanism(), np.random.default_rng(0)
    assert draft.left_out == []
    assert (mechanism.d, mechanism.rank) == (1, 2)
    for _ in range(5):
        q_tree = random.uniform(-1, 1, 3)
        whole, data = set_state(mechanism, q_tree, np.zeros(3), tmp_path)
        at = mechanism.kinematics(q_tree)
        assert_close(at.phi, data.efc_pos[: data.ne], 1e-9)  # numbers of the imported file have twelve digits
        rows = data.efc_J.reshape(-1, 3)[: data.ne][:, dofs(whole, mechanism)]
        assert_close(at.J, rows, 1e-9)


def test_tendons_of_three_joints_are_couplings(tmp_path: Path) -> None:
    draft = model(tmp_path, WAIST, TIED.format(range="-0.001 0.003"))
    mechanism, random = draft.build_mechanism(), np.random.default_rng(0)
    assert (mechanism.d, mechanism.rank, mechanism.independent) == (2, 2, ("act_1", "act_2"))
    assert [spec.name for spec, _ in draft.couplings] == ["roll_coupling", "yaw_coupling"]
    assert has_note(draft.guessed, "limits of tendon yaw_coupling", "a coupling at their middle, 0.001")
    assert not has_note(draft.left_out, "tendon")
    for _ in range(5):
        q_tree = random.uniform(-1, 1, 4)
        whole, data = set_state(mechanism, q_tree, np.zeros(4), tmp_path)
        phi = mechanism.kinematics(q_tree).phi
        assert_close(phi[0], data.efc_pos[0], EXACT)
        assert_close(phi[1], data.ten_length[1] - 0.001, EXACT)
        assert_close(mechanism.kinematics(q_tree).J[0], data.efc_J[:4][dofs(whole, mechanism)], EXACT)


def test_a_wide_limit_of_a_tendon_is_left_out(tmp_path: Path) -> None:
    draft = model(tmp_path, WAIST, TIED.format(range="-0.1 0.1"))
    assert draft.build_mechanism().d == 3
    assert has_note(draft.left_out, "a limit of tendon yaw_coupling")


def test_an_equality_of_one_joint_fixes_it(tmp_path: Path) -> None:
    body = '<body name="b"><joint name="j" axis="0 0 1" ref="0.3"/><geom size=".1"/></body>'
    draft = model(tmp_path, body, '<equality><joint joint1="j" polycoef="0.5 0 0 0 0"/></equality>')
    mechanism = draft.build_mechanism()
    assert draft.left_out == []
    assert mechanism.d == 0
    assert_close(mechanism.q_tree, [0.8], EXACT)


ACTUATORS = [  # of j1, with what else the joint has
    ('<motor name="m" joint="j1" gear="-2" forcerange="-1.5 4"/>', ""),
    ('<motor name="m" joint="j1" gear="3" ctrlrange="0 2"/>', ""),
    ('<general name="m" joint="j1" gear="2" gainprm="-3" ctrlrange="-1 2" forcerange="-5 1"/>', ""),
    ('<motor name="m" joint="j1" gear="-4"/>', 'actuatorfrcrange="-2 6"'),
    ('<motor name="m" joint="j1" gear="2" forcerange="-1 1"/>', 'actuatorfrcrange="-6 1"'),
    ('<motor name="m" tendon="t" gear="-2" forcerange="-1 3"/>', ""),
]


@pytest.mark.parametrize(("actuator", "more"), ACTUATORS)
def test_torque_limits_have_the_two_sides_of_mujocos(actuator: str, more: str, tmp_path: Path) -> None:
    """The forces of large controls on the joints."""
    tendon = '<tendon><fixed name="t"><joint joint="j1" coef="1"/><joint joint="j2" coef="2"/></fixed></tendon>'
    draft = model(tmp_path, CHAIN.format(more=more), f"{tendon}<actuator>{actuator}</actuator>")
    mechanism = draft.build_mechanism()
    assert draft.left_out == []
    whole, data = set_state(mechanism, np.zeros(2), np.zeros(2), tmp_path)
    gain = float(whole.actuator_gainprm[0, 0])
    for control in (-100.0, -0.2, 0.3, 100.0):
        data.ctrl[:] = control
        mujoco.mj_forward(whole, data)
        force = mechanism.motors.force(np.clip([gain * control], *mechanism.motors.torque_limit))
        assert_close(force, data.qfrc_actuator[dofs(whole, mechanism)], EXACT)


def test_limits_that_exclude_zero_are_left_out(tmp_path: Path) -> None:
    actuator = '<actuator><motor name="m" joint="j1" forcerange="1 4"/></actuator>'
    draft = model(tmp_path, CHAIN.format(more=""), actuator)
    assert has_note(draft.left_out, "torque limits 1 to 4 of actuator m, which exclude 0")


def test_rotor_of_an_actuator_on_a_tendon_has_mujocos_inertia(tmp_path: Path) -> None:
    """Of joints of one branch, because MuJoCo's mass matrix has no entries between branches."""
    tendon = '<tendon><fixed name="t"><joint joint="j1" coef="1"/><joint joint="j2" coef="-2"/></fixed></tendon>'
    actuator = '<actuator><motor name="m" tendon="t" gear="5" armature="0.03"/></actuator>'
    draft = model(tmp_path, CHAIN.format(more=""), tendon + actuator)
    mechanism, random = draft.build_mechanism(), np.random.default_rng(0)
    assert has_note(draft.guessed, "the rotor of motor m")
    for _ in range(5):
        q_tree = random.uniform(-3, 3, 2)
        whole, data = set_state(mechanism, q_tree, np.zeros(2), tmp_path)
        M = np.zeros((2, 2))
        mujoco.mj_fullM(whole, data, M)
        order = dofs(whole, mechanism)
        assert_close(mechanism.tree.mass_matrix(q_tree), M[np.ix_(order, order)], 1e-9)


def test_motors_on_several_joints_come_back_from_mujoco(tmp_path: Path) -> None:
    """Their tendons do not clash with that of a coupling of the same name."""
    links = "".join(
        f'<link name="{x}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        f'</inertial></link><joint name="j{x}" type="continuous"><parent link="base"/><child link="{x}"/></joint>'
        for x in "abcd"
    )
    motors: list[dict[str, Any]] = [
        {"name": "a1", "joint": "ja", "ratio": 50.0, "torque_limit": [-1.0, 0.0]},
        {"name": "a2", "joints": {"ja": 1.0, "jb": 2.0}, "ratio": 30.0, "rotor_inertia": 1e-4, "torque_limit": 2.0},
    ]
    coupling = {"name": "a2", "joints": {"jb": 1.0, "jc": -2.0, "jd": 0.5}, "offset": 0.3}
    robot = f'<robot name="r"><link name="base"/>{links}</robot>'
    mechanism = Mechanism.from_urdf(robot, motors=motors, couplings=[coupling])
    exported = export(mechanism, "mjcf")
    assert has_note(exported.differences, "the rotor of motor a2: MuJoCo neglects")
    (tmp_path / "thing.xml").write_text(exported.text, encoding="utf-8")
    draft = read(tmp_path / "thing.xml")
    again = draft.build_mechanism()
    assert draft.left_out == []
    assert again.actuated == mechanism.actuated
    order = [again.coordinates.index(name) for name in mechanism.coordinates]
    assert_close(again.motors.transmission[:, order], mechanism.motors.transmission, EXACT)
    assert_close(again.motors.torque_limit, mechanism.motors.torque_limit, EXACT)
    assert_close(again.tree.rotors[np.ix_(order, order)], mechanism.tree.rotors, EXACT)
    assert again.spec.coupling[0].joints == coupling["joints"]
