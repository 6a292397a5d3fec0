"""Massless links are fine where every allowed motion moves some mass; a motion that moves none is named."""

from __future__ import annotations

from pathlib import Path

import pytest

import ckc_pin

LINK = (
    '<link name="{0}"><inertial><mass value="{1}"/>'
    '<inertia ixx="{1}" iyy="{1}" izz="{1}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="{3} 0 0"/><axis xyz="0 0 1"/></joint>'
)


def chain(folder: Path, masses: tuple[float, float]) -> Path:
    """Two links in a row, no loop."""
    links = '<link name="base"/>' + LINK.format("upper", masses[0]) + LINK.format("lower", masses[1])
    joints = JOINT.format("shoulder", "base", "upper", 0.0) + JOINT.format("elbow", "upper", "lower", 1.0)
    (folder / "chain.urdf").write_text(f'<robot name="chain">{links}{joints}</robot>')
    (folder / "mechanism.toml").write_text('name = "chain"\nurdf = "chain.urdf"\ngravity = [0.0, -9.81, 0.0]\n')
    (folder / "default.scene.toml").write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 0.1\n[initial.q]\nshoulder = 0.1\nelbow = 0.2\n'
    )
    return folder


def test_a_massless_link_that_carries_one_with_mass(tmp_path: Path) -> None:
    assert ckc_pin.simulate(chain(tmp_path, (0.0, 1.0))).status == "done"


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_a_motion_that_moves_no_mass_is_named(tmp_path: Path, formulation: str) -> None:
    with pytest.raises(ckc_pin.InputError, match="along elbow moves no mass"):
        ckc_pin.simulate(chain(tmp_path, (1.0, 0.0)), {"formulation": formulation})
