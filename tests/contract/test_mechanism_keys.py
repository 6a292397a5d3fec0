"""Keys of mechanism.toml and of scenes that mechanisms with a free root, or a drive, need."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import InputError, MechanismError, load, simulate, terms

BODY = """<robot name="body">
  <link name="body"><inertial><mass value="2"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="continuous"><parent link="body"/><child link="arm"/><axis xyz="0 0 1"/></joint>
</robot>
"""
MECHANISM = """name = "body"
gravity = [0.0, 0.0, 0.0]
[[tree]]
file = "body.urdf"
root = "{root}"
[q_guess]
{guess}
"""


def write(folder: Path, root: str, guess: str, extra: str = "") -> Path:
    (folder / "body.urdf").write_text(BODY)
    (folder / "mechanism.toml").write_text(MECHANISM.format(root=root, guess=guess) + extra)
    return folder


@pytest.mark.parametrize("key", ["root.z = 0.5", '"root.z" = 0.5', "root = {z = 0.5}"])
def test_coordinates_of_a_free_root_in_a_table(tmp_path: Path, key: str) -> None:
    mechanism = load(write(tmp_path, "free", f"{key}\nturn = 0.25"))
    expected = {"root.z": 0.5, "turn": 0.25}
    assert mechanism.coordinates == ("root.x", "root.y", "root.z", "root.rx", "root.ry", "root.rz", "turn")
    numbers = mechanism.tree.to_coordinates(mechanism.q_tree)
    assert numbers == pytest.approx([expected.get(name, 0.0) for name in mechanism.coordinates])


def test_start_as_assembled(tmp_path: Path) -> None:
    write(tmp_path, "free", "root.z = 0.5\nroot.rx = 0.2\nturn = 0.25")
    scene = tmp_path / "default.scene.toml"
    scene.write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 0.1\n'
        '[initial]\nat = "assembled"\n[initial.q_dot]\nroot.y = 0.3\n'
    )
    run = simulate(scene)
    start = dict(zip(run.coordinates, run.q_tree[0], strict=True))
    assert (start["root.z"], start["root.rx"], start["turn"]) == pytest.approx((0.5, 0.2, 0.25))
    moved = simulate(scene, {"initial.q_dot.root.y": 0.6})
    assert [r.v_tree[0, r.column("root.y")] for r in (run, moved)] == pytest.approx([0.3, 0.6])
    with pytest.raises(InputError, match='at = "assembled" or q, not both'):
        simulate(scene, {"initial.q.turn": 0.1})


def test_constant_torque_is_a_force_with_a_potential(tmp_path: Path) -> None:
    mechanism = load(write(tmp_path, "fixed", "turn = 0.0", '[[force]]\njoint = "turn"\nvalue = 0.7\n'))
    at = terms(mechanism, {"turn": 0.4})
    assert at.h == pytest.approx([-0.7])
    assert at.potential_energy == pytest.approx(-0.7 * 0.4)
    inertia = 0.02 + 1 * 0.5**2
    (tmp_path / "default.scene.toml").write_text(
        'mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 1.0\n[initial]\nat = "assembled"\n'
    )
    run = simulate(tmp_path / "default.scene.toml")
    assert run.q_tree[-1] == pytest.approx([0.7 / inertia / 2])
    assert np.ptp(run.energy) <= 1e-9


@pytest.mark.parametrize("key", ["force", "spring"])
def test_joint_forces_need_joints_with_one_freedom(tmp_path: Path, key: str) -> None:
    extra = {"force": "value = 1.0", "spring": "stiffness = 1.0"}[key]
    write(tmp_path, "free", "turn = 0.0", f'[[{key}]]\njoint = "root.rx"\n{extra}\n')
    with pytest.raises(MechanismError, match=f"{key} 1: no joint of one freedom called 'root.rx'; there are turn"):
        load(tmp_path)


def test_a_number_that_is_none(tmp_path: Path) -> None:
    write(tmp_path, "fixed", "turn = 0.0", '[[force]]\njoint = "turn"\nvalue = nan\n')
    with pytest.raises(InputError, match=r"force\[0\]\.value = nan: expected a finite number"):
        load(tmp_path)
