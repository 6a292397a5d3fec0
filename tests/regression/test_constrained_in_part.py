"""A partly constrained free root: a rigid body on a ball joint, compared with a pendulum and a spinning top."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, check, load, simulate, terms
from tests.conftest import assert_close

BODY = """<robot name="b"><link name="body"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
MECHANISM = """name = "top"
[[tree]]
file = "b.urdf"
root = "free"
[[loop]]
name = "ball"
type = "point"
frame_a = "body"
frame_b = "world"
"""
SCENE = 'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\n[initial]\nat = "assembled"\n'


@pytest.fixture
def top(tmp_path: Path) -> Path:
    (tmp_path / "b.urdf").write_text(BODY)
    (tmp_path / "mechanism.toml").write_text(MECHANISM)
    (tmp_path / "default.scene.toml").write_text(SCENE)
    return tmp_path


def test_body_on_ball_joint_swings_as_a_pendulum(top: Path) -> None:
    """About y: (0.02 + 1 * 0.1^2) angle'' = 1 * 9.81 * 0.1 cos(angle), from level."""
    run = simulate(top / "default.scene.toml", {"solver.rtol": 1e-10})
    angle = solve_ivp(lambda t, y: [y[1], 0.981 * np.cos(y[0]) / 0.03], (0, 1), [0, 0], rtol=1e-12, atol=1e-13)
    rotation = run.q_tree[-1]
    assert_close(np.sin(rotation[4]), np.sin(angle.y[0, -1]), 1e-8)
    assert_close(run.v_tree[-1], [0, 0, 0, 0, angle.y[1, -1], 0], 1e-7)
    assert run.max_phi <= 1e-12


def test_spinning_top_conserves_energy_and_vertical_angular_momentum(top: Path) -> None:
    spin = {"root.rx": 20.0, "root.rz": 1.0}
    run = simulate(top / "default.scene.toml", {"solver.rtol": 1e-10, "initial.q_dot": spin})
    assert run.status == "done"
    assert_close(run.energy, run.energy[0], 1e-7)
    # inertia about the pivot times the angular velocity in body axes, rotated to the world
    inertia = np.diag([0.01, 0.03, 0.04])
    vertical = []
    for row, v in zip(run.q_tree, run.v_tree, strict=True):
        rotation = _rotation(row[3:])
        vertical.append(float((rotation @ inertia @ v[3:])[2]))
    assert np.ptp(vertical) < 1e-7
    assert np.ptp(run.v_tree[:, 3]) > 1e-3  # not a pure spin


@pytest.mark.parametrize(
    "overrides", [{"formulation": "reduced"}, {"formulation": "spf"}, {"initial.at": "equilibrium"}]
)
def test_formulations_and_starts_that_need_q_are_rejected(top: Path, overrides: dict[str, str]) -> None:
    with pytest.raises(InputError, match=r"constrain a free root in part.*run it as a DAE"):
        simulate(top / "default.scene.toml", overrides)


def test_check_reports_the_partly_constrained_root(top: Path) -> None:
    result = check(top / "mechanism.toml")
    assert (result.d, result.rank) == (3, 3)
    assert any("constrain a free root in part" in warning for warning in result.warnings)
    with pytest.raises(InputError, match="constrain a free root in part"):
        terms(load(top / "mechanism.toml"), {"root.rx": 0.1, "root.ry": 0.0, "root.rz": 0.0})


def test_free_root_rates_are_in_body_axes(top: Path) -> None:
    """After a quarter turn about z, motion along the body's x is motion along the world's y."""
    (top / "mechanism.toml").write_text(MECHANISM.partition("[[loop]]")[0])
    turned, thrown = {"root.rz": np.pi / 2}, {"root.x": 2.0, "root.ry": 0.3}
    start = {"q": {f"root.{k}": 0.0 for k in ("x", "y", "z", "rx", "ry", "rz")} | turned, "q_dot": thrown}
    run = simulate(top / "default.scene.toml", {"initial": start, "t_end": 1e-6, "solver.output_dt": 1e-6})
    moved = run.q_tree[-1] - run.q_tree[0]
    assert_close(moved[:3] / 1e-6, [0, 2, 0], 1e-4)
    first = _rotation(run.q_tree[-1][3:])[:, 0]
    assert_close(first, [0, 1, -0.3e-6], 1e-10)


def _rotation(rotvec: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(rotvec))
    x, y, z = rotvec / angle if angle else np.zeros(3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
