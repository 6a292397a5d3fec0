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


def rods(folder: Path, count: int) -> str:
    """Write slider-cranks whose coupler is a rod between two ball joints; its mass centre is on its axis to 2e-9 m."""
    text, loops = '<robot name="rods"><link name="base"/>', ""
    for k in range(count):
        angle = 2 * np.pi * k / count

        def link(name: str, xyz: str, k: int = k) -> str:
            return (
                f'<link name="{name}_{k}"><inertial><origin xyz="{xyz}"/><mass value="0.1"/>'
                '<inertia ixx="1e-5" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            )

        def joint(name: str, kind: str, parent: str, axis: str, xyz: str, k: int = k, angle: float = angle) -> str:
            rpy = f"{0.1 * k} {0.2 * k} {angle}" if parent == "base" else "0 0 0"
            child = {"ball_z": "rod"}.get(name, name)
            base = parent if parent == "base" else f"{parent}_{k}"
            limit = '<limit lower="-9" upper="9" effort="1" velocity="1"/>' if kind == "prismatic" else ""
            return (
                f'<joint name="{name}_{k}" type="{kind}"><parent link="{base}"/><child link="{child}_{k}"/>'
                f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
            )

        text += link("crank", "0 0 0.02") + link("rod", "0.0425 8e-11 -1.9e-9") + link("slide", "0 0 0")
        text += f'<link name="ball_x_{k}"/><link name="ball_y_{k}"/>'
        text += joint("crank", "continuous", "base", "0 1 0", "0 0 0")
        text += joint("ball_x", "continuous", "crank", "1 0 0", "0 0 0.05")
        text += joint("ball_y", "continuous", "ball_x", "0 1 0", "0 0 0")
        text += joint("ball_z", "continuous", "ball_y", "0 0 1", "0 0 0")
        text += joint("slide", "prismatic", "base", "1 0 0", "0 0 0")
        loops += (
            f'[[loop]]\nname = "pin_{k}"\ntype = "point"\nframe_a = {{link = "rod_{k}", xyz = [0.085, 0, 0]}}\n'
            f'frame_b = {{link = "slide_{k}", xyz = [0.085, 0, 0.05]}}\n'
        )
    (folder / "rods.urdf").write_text(text + "</robot>")
    motors = f"actuated = {[f'crank_{k}' for k in range(count)]}"
    (folder / "mechanism.toml").write_text(f'name = "rods"\nurdf = "rods.urdf"\n{motors}\n{loops}')
    return str(folder / "mechanism.toml")


def test_each_rod_that_spins_freely_is_named(tmp_path: Path) -> None:
    """Six equal rods: their spins are one subspace, of which a singular vector mixes several rods."""
    (idle,) = [warning for warning in load(rods(tmp_path, 6)).warnings if "idle freedoms" in warning]
    names = idle.rpartition(": ")[2].split(", ")
    assert sorted(name.rpartition("_")[2] for name in names) == [str(k) for k in range(6)]
    assert all(name.startswith("ball_") for name in names)
