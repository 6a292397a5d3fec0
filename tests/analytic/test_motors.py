"""Motors as a mechanism's file describes them: gears, rotors, and that q takes the coordinates they are on."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Mechanism, Scene, load, simulate
from ckc_pin.codegen.library import compile_terms
from ckc_pin.dynamics import Terms
from ckc_pin.mechanism.library import library
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

INDEPENDENT = 'independent = ["theta_1", "theta_3"]\n'
ACTUATED = 'actuated = ["theta_1", "theta_3"]\n'


def five_bar_with(folder: Path, motors: str, independent: str = INDEPENDENT) -> Mechanism:
    """Return the shipped five-bar with other motors."""
    for file in ("five_bar.urdf", "mechanism.toml"):
        text = (library() / "five_bar" / file).read_text("utf-8")
        if file == "mechanism.toml":
            assert INDEPENDENT in text
            assert ACTUATED in text
            text = text.replace(INDEPENDENT, independent).replace(ACTUATED, motors)
        (folder / file).write_text(text, "utf-8")
    return load(folder / "mechanism.toml")


def test_rotor_inertia_is_reflected_through_the_gear(tmp_path: Path) -> None:
    """Its energy is J (ratio theta_dot)^2 / 2: ratio^2 J on the diagonal of D' of eq. 24."""
    motors = """
[[motor]]
joint = "theta_3"
ratio = -50.0
rotor_inertia = 2e-6
[[motor]]
name = "second"
joints = {theta_3 = 3.0}
rotor_inertia = 1e-4
"""
    mechanism = five_bar_with(tmp_path, motors)
    rng = np.random.default_rng(1)
    for _ in range(5):
        q_tree = rng.uniform(-3, 3, 4)
        D = FIVE_BAR.D_tree(q_tree)
        D[2, 2] += 50.0**2 * 2e-6 + 3.0**2 * 1e-4
        assert_close(mechanism.tree.evaluate(pin.crba, q_tree), D, 1e-14)


def test_a_motor_does_the_same_work_on_both_sides_of_its_gear(tmp_path: Path) -> None:
    motors = """
[[motor]]
joint = "theta_1"
ratio = 20.0
torque_limit = 3.0
[[motor]]
name = "belt"
joints = {theta_3 = 1.0, theta_4 = -0.5}
ratio = 4.0
speed_limit = 100.0
"""
    mechanism = five_bar_with(tmp_path, motors)
    assert mechanism.actuated == ("theta_1", "belt")
    assert_close(mechanism.motors.force(np.array([2.0, 3.0])), [40.0, 0.0, 12.0, -6.0], 1e-15)
    assert mechanism.motors.torque_limit.tolist() == [[-3.0, -np.inf], [3.0, np.inf]]
    assert mechanism.motors.speed_limit.tolist() == [np.inf, 100.0]
    rng = np.random.default_rng(2)
    tau, v_tree = rng.standard_normal(2), rng.standard_normal(4)
    shafts = np.array([20.0 * v_tree[0], 4.0 * (v_tree[2] - 0.5 * v_tree[3])])
    assert_close(mechanism.motors.force(tau) @ v_tree, tau @ shafts, 1e-13)


def test_rotor_of_a_motor_on_several_joints_couples_their_inertias(tmp_path: Path) -> None:
    """Its energy is J (ratio w . theta_dot)^2 / 2, so ratio^2 J w w^T is added to D' of eq. 24, in all terms."""
    motors = """
[[motor]]
joint = "theta_1"
[[motor]]
name = "differential"
joints = {theta_2 = 1.0, theta_3 = -0.5, theta_4 = 0.25}
ratio = 10.0
rotor_inertia = 1e-3
"""
    mechanism = five_bar_with(tmp_path, motors)
    w = 10.0 * np.array([0.0, 1.0, -0.5, 0.25])
    rng, library_terms = np.random.default_rng(1), compile_terms(mechanism)
    for _ in range(5):
        q_tree, v_tree, u_tree = rng.uniform(-3, 3, (3, 4))
        at = mechanism.kinematics(q_tree)
        D = FIVE_BAR.D_tree(q_tree) + 1e-3 * np.outer(w, w)
        terms = Terms(mechanism, at, v_tree)
        assert_close(np.triu(terms.D_tree), np.triu(D), 1e-14)
        for core in (_core.Core(core_table(mechanism)), _core.Core(core_table(mechanism, library_terms))):
            native = core.terms(q_tree, v_tree)
            assert_close(native["D_tree"], D, 1e-14)
            assert_close(native["D"], at.rho.T @ D @ at.rho, 1e-10, relative=True)
            assert_close(native["bias_tree"], terms.bias_tree, 1e-12)
            saddle = np.block([[D, -at.J.T], [at.J, np.zeros((2, 2))]])
            expected = np.linalg.solve(saddle, np.concatenate([u_tree - terms.bias_tree, -native["J_dot_v"].ravel()]))[
                :4
            ]
            assert_close(core.dae_acceleration(q_tree, v_tree, u_tree, np.zeros(2)), expected, 1e-9, relative=True)


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
@pytest.mark.parametrize(("terms", "mass"), [("pinocchio", 1.0), ("generated", 1.0), ("pinocchio", 1e7)])
def test_shared_rotor_makes_the_motion_of_the_extended_equation(formulation: str, terms: str, mass: float) -> None:
    """Two wheels with a rotor between them: (diag(I) + J w w^T) a = gravity's torques, integrated by SciPy.

    With a mass of 1e7 kg the DAE compares its rounding with that of mass levels.
    """
    wheel = """<link name="{0}w"><inertial><origin xyz="{1} 0 0"/><mass value="{2}"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="{0}" type="continuous"><parent link="base"/><child link="{0}w"/><axis xyz="0 0 1"/></joint>"""
    parts = "".join(wheel.format(name, arm, m) for name, arm, m in (("a", 0.1, 1.0), ("b", 0.2, mass), ("c", 0.3, 1.0)))
    motor = {"name": "m", "joints": {"a": 1.0, "b": -1.0}, "ratio": 5.0, "rotor_inertia": 2e-3}
    mechanism = Mechanism.from_urdf(
        f'<robot name="w"><link name="base"/>{parts}</robot>', gravity=[0, -9.81, 0], motors=[motor],
        couplings=[{"joint": "c", "other": "a", "ratio": 0.5}],
    )  # fmt: skip
    w, s = np.array([5.0, -5.0]), np.array([0.5, 0.0])
    D = np.diag([0.02, 0.01 + 0.04 * mass]) + 0.1 * np.outer(s, s) + 2e-3 * np.outer(w, w)

    def motion(t: float, x: np.ndarray) -> np.ndarray:
        gravity = -9.81 * (np.array([0.1, 0.2 * mass]) * np.cos(x[:2]) + 0.3 * np.cos(0.5 * x[0]) * s)
        return np.concatenate([x[2:], np.linalg.solve(D, gravity)])

    reference = solve_ivp(motion, (0, 1.0), [0.3, -0.4, 1.0, 0.5], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    start = {"q": {"a": 0.3, "b": -0.4}, "q_dot": {"a": 1.0, "b": 0.5}}
    scene = Scene(mechanism, formulation=formulation, initial=start, t_end=1.0)
    run = simulate(scene, {"solver.rtol": 1e-11, "solver.atol": 1e-13, "solver.terms": terms})
    assert mechanism.independent == ("a", "b")
    assert_close(run.q[-1], reference[:2], 1e-8)
    assert_close(run.q_dot[-1], reference[2:], 1e-7)
    assert_close(run["energy.total"], run["energy.total"][0], 1e-9 * mass)


@pytest.mark.parametrize("pair", list(combinations(range(4), 2)), ids=str)
def test_independent_coordinates_prefer_motors(tmp_path: Path, pair: tuple[int, int]) -> None:
    """In the motors' order, where the determinant of the other two columns of the appendix' J is not small."""
    names = [f"theta_{k + 1}" for k in pair[::-1]]
    mechanism = five_bar_with(tmp_path, f"actuated = {names}\n".replace("'", '"'), "")
    J = FIVE_BAR.J(mechanism.q_tree)
    others = [k for k in range(4) if k not in pair]
    assert abs(np.linalg.det(J[:, others])) > 0.03 * np.abs(J).max() ** 2
    assert list(mechanism.independent) == names == list(mechanism.actuated)


def test_motors_stay_dependent_if_phi_z_would_be_singular(tmp_path: Path) -> None:
    """With nearly aligned distal links theta_1 and theta_3 do not determine the configuration, so only one is in q."""
    shipped = library() / "five_bar"
    (tmp_path / "five_bar.urdf").write_text((shipped / "five_bar.urdf").read_text("utf-8"), "utf-8")
    text = (shipped / "mechanism.toml").read_text("utf-8").replace(INDEPENDENT, "")
    before, _, after = text.partition("[q_guess]")
    q_tree = nearly_stretched()
    guess = "".join(f"theta_{k + 1} = {x!r}\n" for k, x in enumerate(q_tree.tolist()))
    (tmp_path / "mechanism.toml").write_text(f"{before}[q_guess]\n{guess}{after[after.index('[[') :]}", "utf-8")
    mechanism = load(tmp_path / "mechanism.toml")
    assert_close(mechanism.q_tree, q_tree, 1e-9)
    assert abs(FIVE_BAR.s(mechanism.q_tree)) < 2e-3
    assert mechanism.actuated == ("theta_1", "theta_3")
    assert len({"theta_1", "theta_3"} & set(mechanism.independent)) == 1
    z = [mechanism.tree.index[name] for name in mechanism.dependent]
    assert abs(np.linalg.det(FIVE_BAR.J(mechanism.q_tree)[:, z])) > 0.01


def nearly_stretched() -> np.ndarray:
    """Return a closed configuration with the distal links 1e-3 rad from alignment."""
    l = FIVE_BAR.l
    reach = np.sqrt(l[1] ** 2 + l[3] ** 2 + 2 * l[1] * l[3] * np.cos(1e-3))  # between the elbows
    theta_1 = 2.0
    left = l[0] * np.array([np.cos(theta_1), np.sin(theta_1)])

    def elbow_gap(theta_3: float) -> float:
        right = l[2] * np.array([np.cos(theta_3), np.sin(theta_3)]) + [FIVE_BAR.base, 0.0]
        return float(np.linalg.norm(right - left)) - reach

    low, high = 0.0, 2.0
    assert elbow_gap(low) > 0 > elbow_gap(high)
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if elbow_gap(middle) > 0 else (low, middle)
    return np.asarray(FIVE_BAR.sigma(np.array([theta_1, low])), dtype=float)


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_a_motor_that_only_pushes(formulation: str) -> None:
    """With limits [0, 3], a set-point controller cannot pull: between limits I a = -K_P e - K_V v, else I a = limit."""
    link = """<link name="w"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
      </inertial></link><joint name="a" type="continuous"><parent link="base"/><child link="w"/><axis xyz="0 0 1"/>
      </joint>"""
    motor = {"joint": "a", "ratio": 2.0, "torque_limit": [0.0, 3.0]}
    mechanism = Mechanism.from_urdf(f'<robot name="r"><link name="base"/>{link}</robot>', motors=[motor])
    law = {"type": "set_point", "K_P": 20.0, "K_V": 1.0, "q_d": {"a": 0.5}}

    def motion(t: float, x: np.ndarray) -> list[float]:
        return [x[1], 2 * float(np.clip((-20.0 * (x[0] - 0.5) - x[1]) / 2, 0.0, 3.0)) / 0.1]

    reference = solve_ivp(motion, (0, 0.5), [0.0, 0.0], "DOP853", rtol=1e-12, atol=1e-13, max_step=1e-3).y[:, -1]
    scene = Scene(mechanism, formulation=formulation, initial={"q": {"a": 0.0}}, controller=law, t_end=0.5)
    run = simulate(scene, {"solver.rtol": 1e-11, "solver.atol": 1e-13})
    assert (run.tau.min(), run.tau.max()) == (0.0, 3.0)
    assert_close(run.q[-1], reference[:1], 1e-7)
    assert_close(run.q_dot[-1], reference[1:], 1e-7)
