"""Impacts at several stops at once, against exact answers: billiards, cradles, symmetric and jammed mechanisms."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Run, simulate
from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.joints.conftest import FORMULATIONS, Make, slide

G = 9.81
TIGHT = {"solver.rtol": 1e-12}
NAMES = "abcdefgh"


def stop(joint: str, restitution: float) -> str:
    return f'[[joint]]\nname = "{joint}"\nstops = true\nrestitution = {restitution!r}\n'


def table(values: list[float]) -> str:
    return "{" + ", ".join(f"{name} = {float(x)!r}" for name, x in zip(NAMES, values, strict=False)) + "}"


def stack(
    scene_of: Make, masses: list[float], e: list[float], q: list[float], rates: list[float], t_end: float,
    gravity: float = 0.0, ground: bool = True,
) -> Path:  # fmt: skip
    """Write sliders on a line, each on a stop of the one before; the first one on a wall if `ground`."""
    urdf, joints, above = "", "", "base"
    for k, mass in enumerate(masses):
        urdf += slide(NAMES[k], above, f"body_{k}", mass, 0.0 if k or ground else -1e3)
        joints += stop(NAMES[k], e[k]) if k or ground else ""
        above = f"body_{k}"
    start = f"q = {table(q)}\nq_dot = {table(rates)}\n"
    return scene_of(urdf, f"gravity = [{-gravity!r}, 0, 0]\n{joints}", start, t_end)


def body_velocities(run: Run) -> Array:
    """Return the bodies' velocities in the world by row."""
    return np.cumsum(run.v_tree[:, [run.column(name) for name in NAMES[: len(run.coordinates)]]], axis=1)


def assert_energy_balance(run: Run, tolerance: float = 1e-10) -> None:
    assert run.dissipated is not None
    largest = np.abs(run.energy).max()
    assert np.all(np.diff(run.dissipated) >= -1e-12 * largest)
    assert_close((run.energy + run.dissipated) / largest, np.full(len(run.t), run.energy[0] / largest), tolerance)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(("k", "count"), [(0, 3), (1, 31), (2, 314), (3, 3141)])
def test_number_of_collisions_between_wall_and_heavy_mass_gives_pi(
    scene_of: Make, formulation: str, k: int, count: int
) -> None:
    """floor(pi 10^k) impacts for a mass of 100^k (Galperin)."""
    scene = stack(scene_of, [1.0, 100.0**k], [1.0, 1.0], [1.0, 1.0], [0.0, -1.0], 20.0)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    assert [event["of"] for event in run.events] == ["stop"] * count
    assert_close(run.energy / run.energy[0], np.ones(len(run.t)), 1e-9)
    light, heavy = body_velocities(run)[-1]
    assert -1e-12 < light < heavy


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("apart", [0.0, 0.125])
def test_last_body_of_a_cradle_leaves_at_the_speed_of_the_first(
    scene_of: Make, formulation: str, n: int, apart: float
) -> None:
    """Equal elastic sliders, in contact or apart: the impact propagates from pair to pair."""
    gaps, rates = [0.0, 0.5, *[apart] * (n - 2)], [1.5, -1.5, *[0.0] * (n - 2)]
    scene = stack(scene_of, [1.0] * n, [1.0] * n, gaps, rates, 2.0, ground=False)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    assert_close(body_velocities(run)[-1], [*[0.0] * (n - 1), 1.5], 1e-12)
    assert_energy_balance(run)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("ratio", [1.0, 1e3])
def test_symmetric_impacts_leave_the_middle_body_at_rest(
    scene_of: Make, formulation: str, e: float, ratio: float
) -> None:
    scene = stack(scene_of, [1.0, ratio, 1.0], [e] * 3, [0.0, 0.5, 0.5], [1.0, -1.0, -1.0], 1.0, ground=False)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    assert_close(body_velocities(run)[-1], [-e, 0.0, e], 1e-12)
    assert {event["coordinate"] for event in run.events} == {"b", "c"}
    assert_close([event["t"] for event in run.events], 0.5, 1e-12)
    assert_energy_balance(run)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("ratio", [1.0, 1e4])
def test_inelastic_impact_on_a_light_body_keeps_it_at_rest(scene_of: Make, formulation: str, ratio: float) -> None:
    scene = stack(scene_of, [1.0, ratio], [0.0, 0.0], [0.0, 0.5], [0.0, 0.0], 1.0, gravity=G)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    landed = np.sqrt(2 * 0.5 / G)
    landing = [event for event in run.events if event["t"] > 0]
    assert {event["name"] for event in landing} <= {"a touches", "b touches"}
    assert_close([event["t"] for event in landing], landed, 1e-12)
    assert_close(run.v_tree[run.t > landed], np.zeros((1, 2)), 1e-13)
    assert_close(run.q_tree[run.t > landed], np.zeros((1, 2)), 1e-13)
    assert run.dissipated is not None
    assert_close(run.dissipated[-1], ratio * G * 0.5, 1e-10 * ratio)
    assert_energy_balance(run)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_separating_contact_gets_no_impulse(scene_of: Make, formulation: str) -> None:
    """A unit mass hits the wall while a heavy one in contact with it moves away: several impacts at one instant."""
    masses, rates = np.array([1.0, 1000.0]), np.array([-1.0, 0.0])
    while True:  # impacts with the wall and the other body in turn, until nothing approaches
        if rates[0] < 0:
            rates[0] *= -1
        elif rates[1] < rates[0]:
            rates = 2 * (masses @ rates) / masses.sum() - rates
        else:
            break
    scene = stack(scene_of, [1.0, 1000.0], [1.0, 1.0], [0.0, 0.0], [-1.0, 1.0], 1.0)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    assert_close(body_velocities(run)[-1], rates, 1e-12)
    assert_close(run.energy, np.full(len(run.t), 0.5), 1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("e_x", "e_y"), list(product([0.0, 0.5, 1.0], repeat=2)))
def test_jammed_racks_lose_all_kinetic_energy(
    scene_of: Make, formulation: str, way: float, e_x: float, e_y: float
) -> None:
    """Two racks geared against each other, y = -x, are both at their lower stops."""
    urdf = slide("x", "base", "one", 1.0, 0.0) + slide("y", "base", "two", 1.0, 0.0)
    gear = '[[coupling]]\njoint = "y"\nother = "x"\nratio = -1.0\n'
    mechanism = f'gravity = [0, 0, 0]\nindependent = ["x"]\n{stop("x", e_x)}{stop("y", e_y)}{gear}'
    scene = scene_of(urdf, mechanism, f"q = {{x = 0.0}}\nq_dot = {{x = {way}}}\n", 0.1)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    assert np.all(np.abs(run.q_tree) < 1e-14)
    assert np.all(np.abs(run.v_tree[1:]) < 1e-14)
    assert run.dissipated is not None
    assert_close(run.dissipated[-1], 1.0, 1e-12)
    assert len(run.events) <= 4


FOOT = """<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0"
  iyz="0"/></inertial></link>"""


def rod(scene_of: Make, e: float, tilt: float, height: float) -> Path:
    """Write a rod of 2 m on two vertical sliders, each with a stop at 0; on one of them it also slides along x."""
    guide = (
        '<joint name="{}" type="prismatic"><parent link="{}"/><child link="{}"/><origin xyz="{} 0 0"/><axis xyz="{}"/>'
    )
    limit = '<limit lower="{}" upper="10" effort="1" velocity="1"/></joint>'
    urdf = FOOT.format(name="left_foot", mass=0.3) + FOOT.format(name="right_foot", mass=0.2)
    urdf += FOOT.format(name="slot", mass=0.1)
    urdf += '<link name="rod"><inertial><origin xyz="1 0 0"/><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.7" '
    urdf += 'ixy="0" ixz="0" iyz="0"/></inertial></link>'
    urdf += guide.format("left", "base", "left_foot", -1.0, "0 1 0") + limit.format(0.0)
    urdf += guide.format("right", "base", "right_foot", 1.0, "0 1 0") + limit.format(0.0)
    urdf += guide.format("along", "right_foot", "slot", 0.0, "1 0 0") + limit.format(-10.0)
    urdf += (
        '<joint name="turn" type="continuous"><parent link="left_foot"/><child link="rod"/><axis xyz="0 0 1"/></joint>'
    )
    loop = (
        '[[loop]]\nname = "end"\ntype = "point_2d"\nframe_a = {link = "rod", xyz = [2.0, 0.0, 0.0]}\nframe_b = "slot"\n'
    )
    mechanism = f'gravity = [0, {-G}, 0]\nindependent = ["left", "right"]\n{loop}{stop("left", e)}{stop("right", e)}'
    start = f"q = {{left = {height!r}, right = {height + tilt!r}}}\n"
    return scene_of(urdf, mechanism, start, 0.8)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("e", [0.0, 0.3, 1.0])
def test_a_rod_that_lands_on_both_ends_rises_without_rotation(scene_of: Make, formulation: str, e: float) -> None:
    run = simulate(rod(scene_of, e, 0.0, 0.5), {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    landed = np.sqrt(2 * 0.5 / G)
    assert_close([event["t"] for event in run.events[:2]], landed, 1e-11)
    assert {event["coordinate"] for event in run.events[:2]} == {"left", "right"}
    ends = run.v_tree[:, [run.column("left"), run.column("right")]]
    flight = (run.t > landed + 1e-9) & (run.t < landed * (1 + 2 * e) - 1e-9)
    expected = e * G * landed - G * (run.t - landed)
    if e > 0:
        assert_close(ends[flight], np.repeat(expected[flight, None], 2, axis=1), 1e-10)
    else:
        assert np.all(np.abs(ends[run.t > landed + 1e-9]) < 1e-12)
    assert_energy_balance(run, 1e-9)


@pytest.mark.parametrize("e", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("tilt", [1e-13, 1e-12, 1e-11])
def test_nearly_simultaneous_impacts_do_not_depend_on_tolerance(scene_of: Make, e: float, tilt: float) -> None:
    """The limit is not unique. All tolerances must give the same motion, and energy must not increase."""
    scene = rod(scene_of, e, tilt, 0.5)
    runs = [
        simulate(scene, {"formulation": formulation, "solver.rtol": rtol, "t_end": 0.4})
        for formulation in FORMULATIONS
        for rtol in (1e-7, 1e-10, 1e-12)
    ]
    for run in runs:
        assert run.status == "done"
        assert_energy_balance(run, 1e-6)
        assert_close(run.v_tree[-1], runs[-1].v_tree[-1], 1e-5)
