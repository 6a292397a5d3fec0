"""Motions without derivative: simultaneous mode transitions, special starts, and forces exactly at their limit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.sensitivity.sliders import force, joint, write_sliders

TIGHT = {"solver.rtol": 1e-11, "solver.atol": 1e-13}
LOOPS = "tests/sensitivity/loops"


def end(result: Sensitivities, parameter: str) -> Any:
    """Derivatives of all coordinates, then of all rates, at the last instant."""
    assert result.run.status == "done", result.run.message
    return np.stack([result.q_tree, result.v_tree])[:, -1, :, result.parameters.index(parameter)].ravel()


def one_sided(scene: str | Path, parameter: str, value: float, h: float) -> Any:
    """The same derivatives by a one-sided difference of two runs."""
    here, there = (simulate(scene, {**TIGHT, parameter: x}) for x in (value, value + h))
    assert here.status == there.status == "done"
    return np.concatenate([there.q_tree[-1] - here.q_tree[-1], there.v_tree[-1] - here.v_tree[-1]]) / h


def test_simultaneous_reversals_of_separate_parts_have_derivatives(tmp_path: Path) -> None:
    """Two equal sliders side by side do not act on each other."""
    more = "".join(joint(name, friction=0.5) + force(name, -3.0) for name in ("x", "y"))
    scene = write_sliders(tmp_path, more, q_dot=(1.0, 1.0), masses=(1.0, 1.0))
    result = sensitivities(scene, ["initial.q_dot.x", "initial.q.y"], TIGHT)
    t_reversal = 1.0 / 3.5
    expected = [t_reversal + 2.5 * (1.0 - t_reversal) / 3.5, 0.0, 2.5 / 3.5, 0.0]
    assert end(result, "initial.q_dot.x") == pytest.approx(expected, abs=1e-9)
    assert end(result, "initial.q.y") == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-9)


def test_simultaneous_reversals_of_connected_parts_have_no_derivative(tmp_path: Path) -> None:
    """The second slider is on the first, so the first reversal changes the time of the other one."""
    more = "".join(joint(name, friction=0.5) for name in ("x", "y")) + force("x", -10.0) + force("y", -6.5)
    scene = write_sliders(tmp_path, more, q_dot=(1.0, 1.0), masses=(1.0, 1.0), on="one")
    result = sensitivities(scene, ["initial.q.x", "initial.q_dot.x"], TIGHT)
    assert result.run.status == "stopped"
    assert "y begins to move from rest, and after a step in initial.q_dot.x" in result.run.message
    assert result.run.t[-1] == pytest.approx(1.0 / 3.5, abs=1e-8)
    assert result.q_tree[-1, :, 1] == pytest.approx([1.0 / 3.5, 0.0], abs=1e-8)  # the derivative up to there
    assert end(sensitivities(scene, ["initial.q.x"], TIGHT), "initial.q.x") == pytest.approx([1, 0, 0, 0], abs=1e-9)
    above, below = (one_sided(scene, "initial.q_dot.x", 1.0, h) for h in (1e-6, -1e-6))
    assert np.abs(above - below).max() > 0.05


def test_a_start_assembled_at_a_stop_has_no_derivative_by_the_stop(tmp_path: Path) -> None:
    scene = write_sliders(tmp_path, joint("x", restitution=0.5) + force("x", -2.0), upper=0.0)
    overrides = {**TIGHT, "initial": {"at": "assembled"}}
    result = sensitivities(scene, ["joint.x.lower", "joint.x.upper"], overrides)
    assert result.run.status == "stopped"
    assert "at the start: x is assembled at its stop, and a step in joint.x.upper moves its start" in result.run.message
    assert sensitivities(scene, ["joint.x.lower"], overrides).run.status == "done"
    moved = [simulate(scene, {**overrides, "joint.x.upper": h}).q_tree[0, 0] for h in (-1e-3, 1e-3)]
    assert moved == pytest.approx([-1e-3, 0.0], abs=1e-12)


def test_the_stop_of_a_start_assembled_away_from_the_guess_is_rejected(tmp_path: Path) -> None:
    scene = write_sliders(tmp_path, joint("x", restitution=0.5), upper=-0.1)
    with pytest.raises(InputError, match=r"joint\.x\.upper: q_guess is beyond this stop"):
        sensitivities(scene, ["joint.x.upper"], {"initial": {"at": "assembled"}})


def test_a_joint_pressed_on_its_stop_keeps_the_others_speed(tmp_path: Path) -> None:
    """With a small rate in either direction x is soon at rest on its stop, and y keeps its speed."""
    more = joint("x", restitution=0.5) + force("x", 2.0)
    scene = write_sliders(tmp_path, more, upper=0.0, on="one")
    expected = [0.0, 1.0, 0.0, 1.0]
    result = sensitivities(scene, ["initial.q_dot.x"], TIGHT)
    assert end(result, "initial.q_dot.x") == pytest.approx(expected, abs=1e-9)
    for h in (1e-5, -1e-5):
        assert one_sided(scene, "initial.q_dot.x", 0.0, h) == pytest.approx(expected, abs=1e-3)


def test_sliding_caused_by_a_joint_at_its_stop_has_no_derivative(tmp_path: Path) -> None:
    """The momentum of x starts y in either direction at the instant at which y begins to slide."""
    more = joint("x", restitution=0.5) + force("x", 2.0) + joint("y", friction=0.3) + force("y", 0.8)
    scene = write_sliders(tmp_path, more, upper=0.0, on="one")
    result = sensitivities(scene, ["initial.q_dot.x"], TIGHT)
    assert result.run.status == "stopped"
    assert "at the start: y begins to move from rest, and after a step in initial.q_dot.x" in result.run.message
    above, below = (one_sided(scene, "initial.q_dot.x", 0.0, h) for h in (1e-5, -1e-5))
    assert np.abs(above - below).max() > 0.05


def test_an_impact_that_pushes_another_joint_off_its_stop(tmp_path: Path) -> None:
    """y hits x, which is pressed on its lower stop. x then has the speed (1 + e) m_2 u / (m_1 + m_2)."""
    e, u, press, one, two = 0.4, 1.5, 0.6, 1.3, 0.7
    more = joint("x", restitution=0.0) + joint("y", restitution=e) + force("x", -press)
    scene = write_sliders(tmp_path, more, q=(-9.0, 8.7), q_dot=(0.0, u), on="one", scene="")
    result = sensitivities(scene, ["joint.y.restitution", "initial.q_dot.y", "link.one.mass"], TIGHT)
    remaining, total = 1.0 - 0.3 / u, one + two  # time after the impact
    assert result.run.q_tree[-1, 0] == pytest.approx(
        -9.0 + (1 + e) * two * u / total * remaining - press / one * remaining**2 / 2, abs=1e-9
    )
    by_e = np.array([two * u / total * remaining, -u * remaining, two * u / total, -u])
    assert end(result, "joint.y.restitution") == pytest.approx(by_e, abs=1e-8)
    earlier = 0.3 / u**2  # derivative of the time of the impact, negated
    x = (1 + e) * two / total * (remaining + u * earlier) - press / one * remaining * earlier
    v = (1 + e) * two / total - press / one * earlier
    assert end(result, "initial.q_dot.y")[[0, 2]] == pytest.approx([x, v], abs=1e-8)
    by_mass = -(1 + e) * two * u / total**2
    slower = press / one**2
    assert end(result, "link.one.mass")[[0, 2]] == pytest.approx(
        [by_mass * remaining + slower * remaining**2 / 2, by_mass + slower * remaining], abs=1e-8
    )


COUPLED = '[[coupling]]\njoint = "y"\nother = "x"\nratio = 1.0\noffset = 0.0\n'


@pytest.mark.parametrize(("name", "status"), [("joint.x.restitution", "stopped"), ("initial.q_dot.x", "done")])
def test_simultaneous_stops_of_coupled_joints(name: str, status: str, tmp_path: Path) -> None:
    """Two coupled joints hit their stops at the same instant, and only one of their restitutions counts."""
    more = COUPLED + joint("x", restitution=0.5) + joint("y", restitution=0.5)
    scene = Path(write_sliders(tmp_path, more, q_dot=(1.5, 0.0), upper=0.3))
    urdf = tmp_path / "sliders.urdf"
    urdf.write_text(urdf.read_text().replace('upper="9.0"', 'upper="0.3"'))
    mechanism = tmp_path / "sliders.toml"
    mechanism.write_text(mechanism.read_text().replace('independent = ["x", "y"]', 'independent = ["x"]'))
    scene.write_text(scene.read_text().replace(", y = 0.0", ""))
    result = sensitivities(scene, [name], TIGHT)
    assert result.run.status == status, result.run.message
    if status == "stopped":
        assert "hit their stops at the same instant, and a step in joint.x.restitution" in result.run.message
        above, below = (one_sided(scene, name, 0.5, h) for h in (1e-5, -1e-5))
        assert above == pytest.approx(0.0, abs=1e-5)
        assert np.abs(below).max() > 0.5


def test_joints_that_loops_immobilize_have_no_events() -> None:
    """Rates that are zero up to rounding trigger no events, and do not affect a reversal just before."""
    names = ["link.L3.mass", "link.L8.mass"]
    scene = f"{LOOPS}/immobile_joints"
    alone = [sensitivities(scene, [name]) for name in names]
    for order in (names, names[::-1]):
        result = sensitivities(scene, order)
        for name, single in zip(names, alone, strict=True):
            assert end(result, name) == pytest.approx(end(single, name), abs=1e-9)
    mass = 1.0
    for text in Path(f"{scene}/immobile_joints.urdf").read_text().split("<link name=")[1:]:
        if text.startswith('"L8"'):
            mass = float(text.partition('<mass value="')[2].partition('"')[0])
    expected = one_sided(scene, "link.L8.mass", mass, 1e-5)
    assert np.abs(end(alone[1], "link.L8.mass") - expected).max() <= 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("rtol", [1e-8, 1e-10, 1e-12])
def test_decaying_bounces_of_two_joints_have_derivatives(rtol: float) -> None:
    """Two joints bounce at the same time. After the last bounces, all rates have zero derivatives."""
    result = sensitivities(f"{LOOPS}/bounces_die_out", ["link.L1.mass", "joint.j4.friction"], {"solver.rtol": rtol})
    assert np.abs(end(result, "link.L1.mass")[11:]).max() < 1e-9
    j4 = result.run.coordinates.index("j4")
    expected = one_sided(f"{LOOPS}/bounces_die_out", "joint.j4.friction", 0.036806215917608125, 1e-6)[j4]
    assert end(result, "joint.j4.friction")[j4] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("of", ["force", "friction"])
def test_a_holding_force_at_its_limit_has_no_derivative(of: str, formulation: str, tmp_path: Path) -> None:
    """No force presses the joint on its stop, or friction is exactly sufficient."""
    if of == "force":
        parameter, more = "gravity.x", joint("x", restitution=0.5)
    else:
        parameter, more = "joint.x.friction", joint("x", friction=2.0) + force("x", 2.0)
    scene = write_sliders(tmp_path, more, upper=0.0, q_dot=(0.0, 1.0))
    overrides = {**TIGHT, "formulation": formulation}
    result = sensitivities(scene, [parameter], overrides)
    assert result.run.status == "stopped"
    assert (
        f"the holding force of x is at its limit, and one sign of a step in {parameter} releases x"
        in result.run.message
    )
    value = 0.0 if of == "force" else 2.0
    above, below = (one_sided(scene, parameter, value, h) for h in (1e-5, -1e-5))
    assert np.abs(above - below).max() > 0.3
    assert end(sensitivities(scene, ["gravity.y", "initial.q_dot.y"], overrides), "initial.q_dot.y") == pytest.approx(
        [0.0, 1.0, 0.0, 1.0], abs=1e-9
    )
