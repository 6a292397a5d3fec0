"""Rounded numbers in files: their last digits do not change the analysis of a mechanism."""

from __future__ import annotations

from math import sin
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import inverse_dynamics, load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.rank import choose_dependent, redundant_rows
from tests.conftest import assert_close
from tests.regression.test_inverse_forward import assert_integrates_back, waves

# Bennett's linkage: opposite links are equal, a / sin(alpha) = b / sin(beta); two of its five rows are independent.
A, ALPHA, BETA = 0.6, 0.4, 1.1
B = A * sin(BETA) / sin(ALPHA)
GUESS = (0.7, -3.33, -0.73)

LINK = (
    '<link name="{0}"><inertial><origin xyz="0.1 0.02 0.01"/><mass value="1"/>'
    '<inertia ixx="0.01" iyy="0.011" izz="0.012" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="{3} 0 0" rpy="{4} 0 0"/><axis xyz="0 0 1"/></joint>'
)


def bennett(folder: Path, digits: int) -> Path:
    folder.mkdir()
    b = round(B, digits)
    chain = [("j1", "base", "one", 0, 0), ("j2", "one", "two", A, ALPHA), ("j3", "two", "three", b, BETA)]
    links = ['<link name="base"/>', *(LINK.format(name) for name in ("one", "two", "three"))]
    (folder / "bennett.urdf").write_text(
        f'<robot name="bennett">{"".join(links)}{"".join(JOINT.format(*joint) for joint in chain)}</robot>'
    )
    (folder / "mechanism.toml").write_text(
        'name = "bennett"\nurdf = "bennett.urdf"\n'
        f"q_guess = {{j1 = {GUESS[0]}, j2 = {GUESS[1]}, j3 = {GUESS[2]}}}\n"
        '[[loop]]\nname = "pin"\ntype = "hinge"\n'
        f'frame_a = {{link = "three", xyz = [{A}, 0.0, 0.0], rpy = [{ALPHA}, 0.0, 0.0]}}\n'
        f'frame_b = {{link = "world", xyz = [{-b}, 0.0, 0.0], rpy = [{-BETA}, 0.0, 0.0]}}\n'
    )
    return folder


@pytest.mark.parametrize("digits", [8, 7, 6])
def test_rounded_mechanism_assembles_like_the_exact_one(digits: int, tmp_path: Path) -> None:
    """Another start with a slightly smaller residual lies on the other side of a folded configuration."""
    exact, result = load(bennett(tmp_path / "exact", 17)), load(bennett(tmp_path / "rounded", digits))
    assert np.abs(exact.assembled.phi).max() < 1e-12
    assert np.abs(exact.q_tree - GUESS).max() < 0.2
    assert result.d == exact.d == 1
    assert 1e-11 < np.abs(result.assembled.phi).max() < 10.0**-digits
    assert any("numbers in the files are rounded" in warning for warning in result.warnings)
    assert np.abs(result.q_tree - exact.q_tree).max() < 1e4 * 10.0**-digits


def test_sigma_does_not_depend_on_the_path(tmp_path: Path) -> None:
    """z is the same from every start, within the tolerance of the closure."""
    mechanism = load(bennett(tmp_path / "rounded", 6))
    assert np.abs(mechanism.assembled.phi).max() > 1e-9
    q = mechanism.q_tree[mechanism.partition.q]
    ends = [sigma(mechanism, q + 0.1, sigma(mechanism, q + away).at).at.q_tree for away in (0.0, 0.099999, 0.3, -0.4)]
    assert_close(np.ptp(ends, axis=0), 0.0, 1e-13)


def test_inverse_dynamics_reproduces_the_motion_of_rounded_mechanism(tmp_path: Path) -> None:
    """Accurate to rounding, although the loops close to six digits only."""
    scene = bennett(tmp_path / "rounded", 6) / "default.scene.toml"
    scene.write_text('mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 0.1\ninitial.at = "assembled"\n')
    overrides = waves(load(scene.parent), 0.1)
    assert_integrates_back(scene, overrides, inverse_dynamics(scene, overrides))


def test_rounding_does_not_select_equivalent_coordinates() -> None:
    """Two identical legs, each with a rod that spins between two joints, in randomly rotated axes."""
    random = np.random.default_rng(1)
    leg = random.normal(size=(3, 4))
    leg[:, 3] = -leg[:, 2]  # the rod's other end spins the other way
    jacobian = np.kron(np.eye(2), np.vstack([leg, leg]))
    turned = [np.linalg.qr(random.normal(size=(12, 12)))[0] @ jacobian for _ in range(30)]
    assert {tuple(choose_dependent(J, 6)) for J in turned} == {(0, 1, 3, 4, 5, 7)}
    mixed = [np.linalg.qr(random.normal(size=(8, 8)))[0] for _ in range(30)]
    assert {tuple(redundant_rows(jacobian @ Q, 6)) for Q in mixed} == {tuple(redundant_rows(jacobian, 6))}
