"""Warnings about idle freedoms: bodies that spin without moving their centre of mass."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ckc_pin import linearize, load

BODY = """<robot name="body"><link name="body"><inertial><mass value="{mass}"/>
<inertia ixx="0.02" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
WIRE_RADIUS_M, WIRE_LENGTH_M = 0.3, 0.8  # m: where the wires are, and how long


def write_hanging_body(folder: Path, extra: str) -> str:
    (folder / "body.urdf").write_text(BODY.format(mass=2.0))
    (folder / "mechanism.toml").write_text(
        'name = "hung"\nq_guess = { "root.z" = -0.8 }\n[[tree]]\nfile = "body.urdf"\nroot = "free"\n' + extra
    )
    return str(folder / "mechanism.toml")


def three_wires(frame: str) -> str:
    return "".join(
        frame.format(k=k, x=WIRE_RADIUS_M * np.cos(angle), y=WIRE_RADIUS_M * np.sin(angle))
        for k, angle in enumerate(2 * np.pi * np.arange(3) / 3)
    )


def test_torsion_of_a_plate_on_three_wires_is_not_idle(tmp_path: Path) -> None:
    """The plate rises when it turns; its frequency is the closed form of a trifilar pendulum."""
    extra = three_wires(
        '[[loop]]\nname = "wire_{k}"\ntype = "distance"\nlength = 0.8\nframe_a = {{ link = "body", xyz = '
        '[{x}, {y}, 0.0] }}\nframe_b = {{ link = "world", xyz = [{x}, {y}, 0.0] }}\n'
    )
    mechanism = load(write_hanging_body(tmp_path, extra))
    assert not any("idle" in warning for warning in mechanism.warnings)
    rates = np.abs(linearize(mechanism, "assembled").eigenvalues.imag)
    assert np.abs(rates - np.sqrt(2.0 * 9.81 * WIRE_RADIUS_M**2 / (0.03 * WIRE_LENGTH_M))).min() < 1e-8


def test_spin_of_a_body_hung_above_its_centre_is_idle(tmp_path: Path) -> None:
    extra = '[[loop]]\nname = "ball"\ntype = "point"\nframe_a = { link = "body", xyz = [0.0, 0.0, 0.2] }\n'
    extra += 'frame_b = { link = "world", xyz = [0.0, 0.0, -0.6] }\n'
    (idle,) = [warning for warning in load(write_hanging_body(tmp_path, extra)).warnings if "idle freedoms" in warning]
    assert idle.endswith(": root.rz")


def test_freedoms_of_bodies_on_springs_are_not_idle(tmp_path: Path) -> None:
    extra = '[[loop]]\nname = "ball"\ntype = "point"\nframe_a = { link = "body", xyz = [0.0, 0.0, 0.2] }\n'
    extra += 'frame_b = { link = "world", xyz = [0.0, 0.0, -0.6] }\n[[spring]]\nstiffness = 3.0\n'
    extra += (
        'frame_a = { link = "body", xyz = [0.1, 0.0, 0.0] }\nframe_b = { link = "world", xyz = [0.2, 0.3, -0.8] }\n'
    )
    assert not any("idle" in warning for warning in load(write_hanging_body(tmp_path, extra)).warnings)
