"""Whether a derivative exists: where several joints change at one instant, at a start, and for idle parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.sensitivity.sliders import force, joint, sliders

TIGHT = {"solver.rtol": 1e-11, "solver.atol": 1e-13}
LOOPS = "tests/sensitivity/loops"


def end(found: Sensitivities, parameter: str) -> Any:
    """Derivatives of all coordinates, then of all rates, at the last instant."""
    assert found.run.status == "done", found.run.message
    return np.stack([found.q_tree, found.v_tree])[:, -1, :, found.parameters.index(parameter)].ravel()


def one_sided(scene: str | Path, parameter: str, value: float, h: float) -> Any:
    """The same by a difference of two runs, on the side of h."""
    here, there = (simulate(scene, {**TIGHT, parameter: x}) for x in (value, value + h))
    assert here.status == there.status == "done"
    return np.concatenate([there.q_tree[-1] - here.q_tree[-1], there.v_tree[-1] - here.v_tree[-1]]) / h


def test_separate_parts_that_turn_at_once_have_derivatives(tmp_path: Path) -> None:
    """Two equal sliders beside each other: each turns at its own time, and neither acts on the other."""
    more = "".join(joint(name, friction=0.5) + force(name, -3.0) for name in ("x", "y"))
    scene = sliders(tmp_path, more, q_dot=(1.0, 1.0), masses=(1.0, 1.0))
    found = sensitivities(scene, ["initial.q_dot.x", "initial.q.y"], TIGHT)
    turn = 1.0 / 3.5
    expected = [turn + 2.5 * (1.0 - turn) / 3.5, 0.0, 2.5 / 3.5, 0.0]
    assert end(found, "initial.q_dot.x") == pytest.approx(expected, abs=1e-9)
    assert end(found, "initial.q.y") == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-9)


def test_connected_parts_that_turn_at_once_have_none(tmp_path: Path) -> None:
    """The second slider on the first: whichever turns first changes the time at which the other one does."""
    more = "".join(joint(name, friction=0.5) for name in ("x", "y")) + force("x", -10.0) + force("y", -6.5)
    scene = sliders(tmp_path, more, q_dot=(1.0, 1.0), masses=(1.0, 1.0), on="one")
    found = sensitivities(scene, ["initial.q.x", "initial.q_dot.x"], TIGHT)
    assert found.run.status == "stopped"
    assert "y begins to move from rest, and with another initial.q_dot.x" in found.run.message
    assert found.run.t[-1] == pytest.approx(1.0 / 3.5, abs=1e-8)
    assert found.q_tree[-1, :, 1] == pytest.approx([1.0 / 3.5, 0.0], abs=1e-8)  # the derivative up to there
    assert end(sensitivities(scene, ["initial.q.x"], TIGHT), "initial.q.x") == pytest.approx([1, 0, 0, 0], abs=1e-9)
    above, below = (one_sided(scene, "initial.q_dot.x", 1.0, h) for h in (1e-6, -1e-6))
    assert np.abs(above - below).max() > 0.05


def test_a_start_assembled_at_a_stop_has_no_derivative_by_the_stop(tmp_path: Path) -> None:
    scene = sliders(tmp_path, joint("x", restitution=0.5) + force("x", -2.0), upper=0.0)
    overrides = {**TIGHT, "initial": {"at": "assembled"}}
    found = sensitivities(scene, ["joint.x.lower", "joint.x.upper"], overrides)
    assert found.run.status == "stopped"
    assert "at the start: x is assembled at its stop, and with another joint.x.upper" in found.run.message
    assert sensitivities(scene, ["joint.x.lower"], overrides).run.status == "done"
    moved = [simulate(scene, {**overrides, "joint.x.upper": h}).q_tree[0, 0] for h in (-1e-3, 1e-3)]
    assert moved == pytest.approx([-1e-3, 0.0], abs=1e-12)


def test_a_start_assembled_beyond_the_guess_is_refused_by_the_stop(tmp_path: Path) -> None:
    scene = sliders(tmp_path, joint("x", restitution=0.5), upper=-0.1)
    with pytest.raises(InputError, match=r"joint\.x\.upper: q_guess leads beyond this stop"):
        sensitivities(scene, ["joint.x.upper"], {"initial": {"at": "assembled"}})


def test_a_joint_at_its_stop_passes_its_momentum_on(tmp_path: Path) -> None:
    """Thrown against or off the stop that it is pressed on, it is soon at rest there, and y keeps its speed."""
    more = joint("x", restitution=0.5) + force("x", 2.0)
    scene = sliders(tmp_path, more, upper=0.0, on="one")
    expected = [0.0, 1.0, 0.0, 1.0]
    found = sensitivities(scene, ["initial.q_dot.x"], TIGHT)
    assert end(found, "initial.q_dot.x") == pytest.approx(expected, abs=1e-9)
    for h in (1e-5, -1e-5):
        assert one_sided(scene, "initial.q_dot.x", 0.0, h) == pytest.approx(expected, abs=1e-3)


def test_friction_behind_a_joint_at_its_stop_has_no_derivative(tmp_path: Path) -> None:
    """The momentum of x sets y in motion, one way or the other, where y begins to slide."""
    more = joint("x", restitution=0.5) + force("x", 2.0) + joint("y", friction=0.3) + force("y", 0.8)
    scene = sliders(tmp_path, more, upper=0.0, on="one")
    found = sensitivities(scene, ["initial.q_dot.x"], TIGHT)
    assert found.run.status == "stopped"
    assert "at the start: y begins to move from rest, and with another initial.q_dot.x" in found.run.message
    above, below = (one_sided(scene, "initial.q_dot.x", 0.0, h) for h in (1e-5, -1e-5))
    assert np.abs(above - below).max() > 0.05


def test_an_impact_that_pushes_another_joint_off_its_stop(tmp_path: Path) -> None:
    """x, pressed on its lower stop, is hit by y, which slides on it: (1 + e) m_2 u / (m_1 + m_2) is its speed then."""
    e, u, press, one, two = 0.4, 1.5, 0.6, 1.3, 0.7
    more = joint("x", restitution=0.0) + joint("y", restitution=e) + force("x", -press)
    scene = sliders(tmp_path, more, q=(-9.0, 8.7), q_dot=(0.0, u), on="one", scene="")
    found = sensitivities(scene, ["joint.y.restitution", "initial.q_dot.y", "link.one.mass"], TIGHT)
    left, total = 1.0 - 0.3 / u, one + two  # time after the impact
    assert found.run.q_tree[-1, 0] == pytest.approx(
        -9.0 + (1 + e) * two * u / total * left - press / one * left**2 / 2, abs=1e-9
    )
    by_e = np.array([two * u / total * left, -u * left, two * u / total, -u])
    assert end(found, "joint.y.restitution") == pytest.approx(by_e, abs=1e-8)
    later = 0.3 / u**2  # how much earlier it comes
    x = (1 + e) * two / total * (left + u * later) - press / one * left * later
    v = (1 + e) * two / total - press / one * later
    assert end(found, "initial.q_dot.y")[[0, 2]] == pytest.approx([x, v], abs=1e-8)
    by_mass = -(1 + e) * two * u / total**2
    slower = press / one**2
    assert end(found, "link.one.mass")[[0, 2]] == pytest.approx(
        [by_mass * left + slower * left**2 / 2, by_mass + slower * left], abs=1e-8
    )


COUPLED = '[[coupling]]\njoint = "y"\nother = "x"\nratio = 1.0\noffset = 0.0\n'


@pytest.mark.parametrize(("name", "status"), [("joint.x.restitution", "stopped"), ("initial.q_dot.x", "done")])
def test_stops_of_joints_that_move_only_together(name: str, status: str, tmp_path: Path) -> None:
    """Geared together, both hit stops at 0.3 at once: the smaller restitution counts, which is one's or the other's."""
    more = COUPLED + joint("x", restitution=0.5) + joint("y", restitution=0.5)
    scene = Path(sliders(tmp_path, more, q_dot=(1.5, 0.0), upper=0.3))
    urdf = tmp_path / "sliders.urdf"
    urdf.write_text(urdf.read_text().replace('upper="9.0"', 'upper="0.3"'))
    mechanism = tmp_path / "sliders.toml"
    mechanism.write_text(mechanism.read_text().replace('independent = ["x", "y"]', 'independent = ["x"]'))
    scene.write_text(scene.read_text().replace(", y = 0.0", ""))
    found = sensitivities(scene, [name], TIGHT)
    assert found.run.status == status, found.run.message
    if status == "stopped":
        assert "thrown back by their stops at once, and with another joint.x.restitution" in found.run.message
        above, below = (one_sided(scene, name, 0.5, h) for h in (1e-5, -1e-5))
        assert above == pytest.approx(0.0, abs=1e-5)
        assert np.abs(below).max() > 0.5


def test_joints_that_loops_hold_still_change_no_verdict() -> None:
    """Rates that are zero up to rounding have no time; what has turned round just before stays as it is."""
    names = ["link.L3.mass", "link.L8.mass"]
    scene = f"{LOOPS}/immobile_joints"
    alone = [sensitivities(scene, [name]) for name in names]
    for order in (names, names[::-1]):
        found = sensitivities(scene, order)
        for name, own in zip(names, alone, strict=True):
            assert end(found, name) == pytest.approx(end(own, name), abs=1e-9)
    mass = 1.0
    for text in Path(f"{scene}/immobile_joints.urdf").read_text().split("<link name=")[1:]:
        if text.startswith('"L8"'):
            mass = float(text.partition('<mass value="')[2].partition('"')[0])
    expected = one_sided(scene, "link.L8.mass", mass, 1e-5)
    assert np.abs(end(alone[1], "link.L8.mass") - expected).max() <= 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("rtol", [1e-8, 1e-10, 1e-12])
def test_bounces_that_die_out_end_without_a_verdict(rtol: float) -> None:
    """Two joints bounce ever lower at once: where the last of them are over, all is at rest with every parameter."""
    found = sensitivities(f"{LOOPS}/bounces_die_out", ["link.L1.mass", "joint.j4.friction"], {"solver.rtol": rtol})
    assert np.abs(end(found, "link.L1.mass")[11:]).max() < 1e-9
    j4 = found.run.coordinates.index("j4")
    expected = one_sided(f"{LOOPS}/bounces_die_out", "joint.j4.friction", 0.036806215917608125, 1e-6)[j4]
    assert end(found, "joint.j4.friction")[j4] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("of", ["force", "friction"])
def test_joints_locked_by_a_force_at_its_limit_have_no_derivative(of: str, formulation: str, tmp_path: Path) -> None:
    """Nothing presses it on its stop, or friction is just enough: with a little more of a force it moves."""
    if of == "force":
        parameter, more = "gravity.x", joint("x", restitution=0.5)
    else:
        parameter, more = "joint.x.friction", joint("x", friction=2.0) + force("x", 2.0)
    scene = sliders(tmp_path, more, upper=0.0, q_dot=(0.0, 1.0))
    overrides = {**TIGHT, "formulation": formulation}
    found = sensitivities(scene, [parameter], overrides)
    assert found.run.status == "stopped"
    assert f"the force that holds x is at its limit, and with another {parameter}" in found.run.message
    value = 0.0 if of == "force" else 2.0
    above, below = (one_sided(scene, parameter, value, h) for h in (1e-5, -1e-5))
    assert np.abs(above - below).max() > 0.3
    assert end(sensitivities(scene, ["gravity.y", "initial.q_dot.y"], overrides), "initial.q_dot.y") == pytest.approx(
        [0.0, 1.0, 0.0, 1.0], abs=1e-9
    )
