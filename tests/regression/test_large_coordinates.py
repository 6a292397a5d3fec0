"""Large coordinates: a crank after many turns and bodies far from the origin move like those near zero."""

from __future__ import annotations

import numpy as np
import pytest

import ckc_pin

TURNS = (100, 1000, 10_000)
FORMULATIONS = ("dae", "reduced", "spf")
# A four-bar on a free body in the plane z = 0, which falls and rotates.
URDF = """<robot name="falling"><link name="world"/>
<joint name="root" type="floating"><parent link="world"/><child link="base"/></joint>
{links}
<joint name="a" type="continuous"><parent link="base"/><child link="crank"/><axis xyz="0 0 1"/></joint>
<joint name="b" type="continuous"><parent link="crank"/><child link="rod"/>
<origin xyz="0.1 0 0"/><axis xyz="0 0 1"/></joint>
<joint name="c" type="continuous"><parent link="base"/><child link="rocker"/>
<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/></joint>
</robot>"""
LINK = """<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
LINKS = (("base", 0.0, 2.0), ("crank", 0.05, 0.3), ("rod", 0.14, 0.4), ("rocker", 0.1, 0.5))
MECHANISM = """name = "falling"
urdf = "falling.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["root.x", "root.y", "root.z", "root.rx", "root.ry", "root.rz", "a"]
[[loop]]
name = "tip"
type = "hinge"
frame_a = {link = "rod", xyz = [0.28, 0.0, 0.0]}
axis_a = [0.0, 0.0, 1.0]
frame_b = {link = "rocker", xyz = [0.2, 0.0, 0.0]}
axis_b = [0.0, 0.0, 1.0]
[q_guess]
a = 1.0
c = 1.5
"""


@pytest.fixture(scope="module")
def falling(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("falling")
    (folder / "falling.urdf").write_text(URDF.format(links="".join(LINK.format(*link) for link in LINKS)))
    (folder / "mechanism.toml").write_text(MECHANISM)
    (folder / "default.scene.toml").write_text('mechanism = "mechanism.toml"\ninitial.at = "assembled"\nt_end = 1.0\n')
    return str(folder)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("scene", ["slider_crank", "four_bar/turning"])
def test_crank_turns_accurately_after_many_turns(scene: str, formulation: str) -> None:
    """After more than a hundred turns; rounding at 512 rad exceeds 1e-13 rad."""
    run = ckc_pin.simulate(scene, {"t_end": 90.0, "formulation": formulation, "solver.output_dt": 1.0})
    assert run.status == "done", run.message
    assert run["crank"][-1] > 800
    assert run.max_phi < 1e-11
    assert np.ptp(run.energy) < 1e-6 * np.abs(run.energy).max()


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("turns", TURNS)
def test_motion_does_not_depend_on_initial_turns(turns: int, formulation: str) -> None:
    overrides = {"formulation": formulation, "t_end": 2.0, "solver.rtol": 1e-8}
    at, more = np.pi / 2, 2 * np.pi * turns
    expected = ckc_pin.simulate("four_bar/turning", overrides)
    q = dict(zip(expected.coordinates, expected.q_tree[0], strict=True)) | {"crank": at + more}
    turned = ckc_pin.simulate("four_bar/turning", overrides | {"initial": {"q": q, "q_dot": {"crank": 12.0}}})
    assert turned.status == "done", turned.message
    rounded = 1e-5 * turns / TURNS[-1]  # rounding of an angle of so many turns, amplified by the motion
    assert abs(turned["crank"][-1] - more - expected["crank"][-1]) < 1e-6 + rounded
    assert abs(turned["rocker"][-1] - expected["rocker"][-1]) < 1e-6 + rounded


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_free_fall_does_not_depend_on_position(falling: str, formulation: str) -> None:
    """The centre of mass falls freely and the rotation about it does not depend on the position."""
    start = {"a": 1.0, "root.x": 0.0, "root.y": 0.0, "root.z": 0.0, "root.rx": 0.0, "root.ry": 0.0, "root.rz": 0.0}
    overrides = {
        "formulation": formulation,
        "t_end": 2.0,
        "solver.rtol": 1e-9,
        "initial.at": None,
        "initial.q_dot.a": 5.0,
    }
    reference, far = (
        ckc_pin.simulate(falling, overrides | {"initial.q": start | {"root.x": x, "root.y": x}}) for x in (0.0, 3000.0)
    )
    assert (reference.status, far.status) == ("done", "done"), far.message
    for name in ("a", "b", "c", "root.rz"):
        assert abs(reference[name][-1] - far[name][-1]) < 1e-6
    assert abs(far["root.y"][-1] - reference["root.y"][-1] - 3000.0) < 1e-6
    long = ckc_pin.simulate(falling, overrides | {"initial.q": start, "t_end": 30.0, "solver.output_dt": 1.0})
    assert long.status == "done", long.message
    assert long["root.y"][-1] < -4000


def test_too_large_angle_stops_the_run() -> None:
    """An angle of 6e9 rad has a rounding error of 1e-6, so the loops do not close."""
    q = {"initial": {"q": {"crank": 2e9 * np.pi + np.pi / 2}, "q_dot": {"crank": 12.0}}, "t_end": 0.1}
    run = ckc_pin.simulate("four_bar/turning", q)
    assert run.status == "stopped"
    assert "nearly singular" in run.message
