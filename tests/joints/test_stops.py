"""Joint stops against closed forms: times of impacts, and the motion after them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.special import ellipk

from ckc_pin import InputError, Run, load, sensitivities, simulate
from ckc_pin.native import RhsFailure, StopReason
from ckc_pin.run.stop_reasons import describe_stop
from ckc_pin.scene.spec import SolverSpec
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close
from tests.joints.conftest import FORMULATIONS, Make, slide

TIGHT = {"solver.rtol": 1e-12}
G = 9.81

PENDULUM = """<link name="rod"><inertial><origin xyz="0 0 -0.6"/><mass value="1.7"/>
    <inertia ixx="0.05" iyy="0.08" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="theta" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="9" effort="1" velocity="1"/></joint>"""


def bounce_times(run: Run) -> list[float]:
    return [float(event["t"]) for event in run.events if event["name"].endswith("bounces")]


def stop(joint: str, restitution: float) -> str:
    return f'[[joint]]\nname = "{joint}"\nstops = true\nrestitution = {restitution!r}\n'


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("restitution", [0.3, 0.7])
def test_times_of_a_bouncing_pendulum(scene_of: Make, formulation: str, restitution: float) -> None:
    """Half a period, an elliptic integral, is between two impacts. Each one multiplies sin(amplitude / 2) by e."""
    start = 2.1
    scene = scene_of(PENDULUM, stop("theta", restitution), f"q = {{theta = {start}}}\n", 6.0)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    rate = np.sqrt(1.7 * G * 0.6 / (0.08 + 1.7 * 0.36))
    k = np.sin(start / 2)
    t, expected = ellipk(k**2) / rate, []
    while t < 6.0 and len(expected) < 12:
        expected.append(t)
        k *= restitution
        t += 2 * ellipk(k**2) / rate
    times = bounce_times(run)[: len(expected)]
    assert len(times) >= 5
    assert_close(times, expected[: len(times)], 1e-10)
    assert run.dissipated is not None
    assert_close(run.energy + run.dissipated, np.full(len(run.t), run.energy[0]), 1e-9)
    assert run.q_tree.min() > -1e-11


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_decaying_bounces_end_in_contact(scene_of: Make, formulation: str) -> None:
    """Infinitely many bounces take a finite time. Contact begins after those higher than 1e-10 of the drop."""
    scene = scene_of(
        slide("x", "base", "ball", 2.0, 0.0), "gravity = [-9.81, 0, 0]\n" + stop("x", 0.5), "q = {x = 1.0}\n", 3.0
    )
    run = simulate(scene, {"solver.rtol": 1e-10, "formulation": formulation})
    flight = np.sqrt(2 / G)
    ends = flight + np.cumsum(np.r_[0.0, flight * 2 * 0.5 ** np.arange(1, 60)])
    times = bounce_times(run)
    assert_close(times, ends[: len(times)], 1e-10)
    rise = 0.25 ** (len(times) + 1)
    assert rise < 1e-10 < 4 * rise
    touches = [event for event in run.events if event["name"] == "x touches"]
    assert len(touches) == 1
    assert ends[len(times) - 1] < touches[0]["t"] < ends[-1]
    resting = run.t > touches[0]["t"]
    assert_close(run.q_tree[resting], np.zeros((resting.sum(), 1)), 1e-12)
    assert run.stats["rhs"] < 1000
    without = simulate(scene, {"solver.rtol": 1e-10, "t_end": 0.4})
    assert without.events == []


def test_contact_ends_when_its_force_is_zero(scene_of: Make) -> None:
    """A block on a stop is pulled by a spring whose other end swings away."""
    urdf = slide("x", "base", "block", 1.0, 0.0) + slide("far", "base", "swing", 50.0)
    mechanism = (
        '[[spring]]\nframe_a = "block"\nframe_b = {link = "swing", xyz = [10.0, 0.0, 0.0]}\nrest_length = 10.0\n'
        'stiffness = 20.0\n[[force]]\njoint = "x"\nvalue = -4.0\n' + stop("x", 0.0)
    )
    scene = scene_of(urdf, mechanism, "q = {x = 0.0, far = 0.0}\nq_dot = {x = 0.0, far = 0.5}\n", 1.0)
    run = simulate(scene, TIGHT)
    assert [event["name"] for event in run.events] == ["x touches", "x leaves"]
    rate = np.sqrt(20.0 / 50.0)  # the far mass on the spring, the block at rest
    assert_close(run.events[1]["t"], np.arcsin(4.0 / 20.0 / 0.5 * rate) / rate, 1e-10)


def test_a_joint_that_keeps_sticking_has_one_event(scene_of: Make) -> None:
    """One block sticks all the time while another one bounces."""
    urdf = slide("a", "base", "one", 1.0) + slide("b", "base", "two", 1.0, 0.0)
    mechanism = 'gravity = [-9.81, 0, 0]\n[[joint]]\nname = "a"\nfriction = 20.0\n' + stop("b", 0.5)
    run = simulate(scene_of(urdf, mechanism, "q = {a = 0.0, b = 1.0}\n", 3.0), TIGHT)
    names = [event["name"] for event in run.events]
    assert names.count("a sticks") == 1
    assert names.count("b bounces") > 10
    assert names.count("b touches") == 1
    assert set(names) == {"a sticks", "b bounces", "b touches"}


def test_a_start_beyond_a_stop_is_refused(scene_of: Make) -> None:
    scene = scene_of(slide("x", "base", "block", 1.0, 0.0), stop("x", 0.5), "q = {x = -0.25}\n", 1.0)
    with pytest.raises(InputError, match=r"initial: x = -0.25 is beyond its stops, 0 to 1000"):
        simulate(scene)
    assert simulate(scene, {"initial.q.x": 0.0}).status == "done"


def test_simultaneous_impacts_lose_energy_without_penetration(scene_of: Make) -> None:
    """Three blocks in contact, whose gaps are joints, hit a wall together."""
    urdf = (
        slide("a", "base", "one", 1.0, 0.0) + slide("b", "one", "two", 1.0, 0.0) + slide("c", "two", "three", 1.0, 0.0)
    )
    joints = stop("a", 0.6) + stop("b", 0.6) + stop("c", 0.6)
    start = "q = {a = 1.0, b = 0.0, c = 0.0}\nq_dot = {a = -1.0, b = 0.0, c = 0.0}\n"
    run = simulate(scene_of(urdf, joints, start, 4.0), TIGHT)
    assert run.status == "done"
    assert run.q_tree.min() > -1e-12
    assert run.dissipated is not None
    assert np.all(np.diff(run.dissipated) >= -1e-14)
    assert_close(run.energy + run.dissipated, np.full(len(run.t), 1.5), 1e-12)
    # the stack meets the wall at t = 1; gaps' rates are differences of the blocks' velocities
    gaps = np.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
    after = run.v_tree[run.t > 1.0][0]
    assert_close(after, reflect_gap_rates(gaps @ gaps.T, np.array([-1.0, 0.0, 0.0]), 0.6), 1e-12)
    assert np.all(after >= 0.0)


def reflect_gap_rates(A: np.ndarray[Any, Any], g: np.ndarray[Any, Any], e: float) -> np.ndarray[Any, Any]:
    """Return gap rates after rounds that reflect all approaching gaps together, by Lawson and Hanson's NNLS."""
    while np.any(g < -1e-13):
        at = np.flatnonzero(g < -1e-13)
        root = np.linalg.cholesky(A[np.ix_(at, at)])
        impulses, _ = nnls(root.T, -np.linalg.solve(root, g[at]))
        g = g + (1 + e) * A[:, at] @ impulses
    return g


def test_a_mechanism_is_assembled_within_its_stops(with_joints: Make) -> None:
    """Without stops theta_2 would assemble at 0.248, which is beyond either pair of stops."""
    joints, free = {"theta_2": {"stops": True}}, load("five_bar")
    for lower, upper in [(0.4, 2.0), (-2.0, -0.3)]:
        folder = with_joints("five_bar", joints, {"theta_2": (lower, upper)})
        bar = load(folder)
        there = bar.tree.to_coordinates(bar.q_tree)
        assert lower - 1e-9 < there[1] < upper + 1e-9
        assert np.abs(FIVE_BAR.phi(there)).max() < 1e-12
        assert any("theta_2 = " in said and "without stops 0.2478" in said for said in bar.warnings)
        if lower > 0:
            # The assembled configuration is the one nearest to the guess.
            assert np.linalg.norm(there - free.tree.to_coordinates(free.q_tree)) < 0.5
        run = simulate(folder / "swing.scene.toml", {"initial": {"at": "assembled"}, "t_end": 0.1})
        assert run.status == "done"
        assert run.max_phi < 1e-12
        column = run.q_tree[:, run.column("theta_2")]
        assert lower - 1e-10 < column.min() <= column.max() < upper + 1e-10


def test_stops_that_cannot_be_assembled_are_reported_by_a_run(with_joints: Make) -> None:
    folder = with_joints("delta", {"swing_1a": {"stops": True}, "arm_1": {"stops": True}}, {
        "swing_1a": (2.5, 2.6), "arm_1": (1.5, 1.6),
    })  # fmt: skip
    delta = load(folder)
    assert_close(delta.q_tree, load("delta").q_tree, 0)
    with pytest.raises(InputError, match=r"is beyond its stops, .* give another initial.q, or a q_guess within"):
        simulate(folder / "default.scene.toml")


LINK = """<link name="{name}"><inertial><origin xyz="{x} {y} 0"/><mass value="{m}"/>
<inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
HINGE = """<joint name="{name}" type="revolute"><parent link="{on}"/><child link="{to}"/><origin xyz="{x} 0 0"/>
<axis xyz="0 0 1"/><limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>"""


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_bounces_decay_while_another_joint_rests_on_its_stop(tmp_path: Path, restitution: float) -> None:
    """Only the contact force of the other joint makes the bouncing joint return.

    Without restitution the other joint stays at its stop. With restitution each bounce throws it off, and it returns.
    """
    parts = '<link name="ground"/>' + LINK.format(name="upper", x=0.365, y=-0.055, m=1.624)
    parts += LINK.format(name="lower", x=0.264, y=-0.075, m=0.995)
    parts += HINGE.format(name="a", on="ground", to="upper", x=0.285, low=-0.424, high=0.241)
    parts += HINGE.format(name="b", on="upper", to="lower", x=0.277, low=-0.518, high=0.274)
    (tmp_path / "two.urdf").write_text(f'<robot name="two">{parts}</robot>')
    stops = "".join(
        f'[[joint]]\nname = "{name}"\nstops = true\nrestitution = {e}\n' for name, e in (("a", restitution), ("b", 0.3))
    )
    (tmp_path / "two.toml").write_text(
        f'name = "two"\nurdf = "two.urdf"\ngravity = [1.587, -9.81, 0.0]\nindependent = ["a", "b"]\n{stops}'
    )
    (tmp_path / "two.scene.toml").write_text(
        'mechanism = "two.toml"\nformulation = "dae"\nt_end = 2.0\ninitial.q = { a = -0.1323, b = -0.2151 }\n'
        "initial.q_dot = { a = -0.583, b = 0.0 }\nsolver.rtol = 1e-10\nsolver.max_rhs = 20000\n"
    )
    run = simulate(tmp_path / "two.scene.toml")
    assert run.status == "done"
    assert run.q_tree[-1] == pytest.approx([-0.424, -0.518], abs=1e-9)
    assert_close(run.v_tree[-1], [0.0, 0.0], 1e-30)
    times = np.array([event["t"] for event in run.events if event["name"].startswith("b ")])
    thrown_off = any(event["name"] == "a leaves" for event in run.events)
    assert thrown_off == (restitution > 0.0)
    if not thrown_off:
        assert np.diff(times)[-3:] / np.diff(times)[-4:-1] == pytest.approx([0.3] * 3, rel=1e-2)


def test_stop_reasons_at_contacts_name_joints_and_forces() -> None:
    """No known scene ends for these reasons, so the messages are tested with a stand-in for the loop."""
    bar = load("five_bar")
    failure = SimpleNamespace(
        reason=RhsFailure.NONE, message="", u=np.zeros(2), sigma_min=1.0, margin=1.0,
        q_tree=bar.q_tree, q=[0, 2], z=[1, 3],
    )  # fmt: skip
    transitions = [SimpleNamespace(t=t, coordinate=k) for t, k in ((0.1, 3), (0.5, 0), (0.5, 2))]
    loop: Any = SimpleNamespace(
        t=0.5, failure=lambda: failure, joint_transitions=lambda: transitions,
        locked_joints=lambda: [SimpleNamespace(coordinate=0, force=2.5, lower=-2.0, upper=2.0)],
    )  # fmt: skip

    def message(reason: StopReason) -> str:
        stop: Any = SimpleNamespace(reason=reason, t=0.5, value=0.0, which=2)
        return str(describe_stop(stop, loop, bar, SolverSpec(), []))

    chatter, contact, beyond = map(message, (StopReason.CHATTER, StopReason.CONTACT_UNSOLVED, StopReason.BEYOND_STOP))
    assert "theta_1, theta_3 change between sticking, sliding and touching again and again at this instant" in chatter
    for text in (chatter, contact):
        assert "(forces on the joints at rest: theta_1 2.5 N m, -2 to 2 being possible); a scene with" in text
    assert "theta_3 has passed its stop within a step; a solver.max_step shorter than" in beyond


def test_joints_fixed_by_loops_have_no_events(tmp_path: Path) -> None:
    """The pins of a triangle of rods cannot turn. A joint at a dead centre, which rests for an instant only, can."""
    parts = LINK.format(name="a", x=0.1, y=0.0, m=1.0) + LINK.format(name="b", x=0.1, y=0.0, m=1.0)
    parts = '<link name="ground"/>' + LINK.format(name="wheel", x=0.2, y=0.0, m=1.0) + parts
    parts += HINGE.format(name="turn", on="ground", to="wheel", x=0.0, low=-9, high=9)
    parts += HINGE.format(name="pin_a", on="wheel", to="a", x=0.0, low=1.0471975511965976, high=2.0)
    parts += HINGE.format(name="pin_b", on="wheel", to="b", x=1.0, low=0.0, high=3.0)
    (tmp_path / "truss.urdf").write_text(f'<robot name="truss">{parts}</robot>')
    truss = (
        'name = "truss"\nurdf = "truss.urdf"\nindependent = ["turn"]\nq_guess = { pin_a = 1.05, pin_b = 2.1 }\n'
        "{joints}"
        '[[loop]]\nname = "top"\ntype = "hinge"\nframe_a = { link = "a", xyz = [1, 0, 0] }\n'
        'frame_b = { link = "b", xyz = [1, 0, 0] }\n'
    )
    (tmp_path / "s.scene.toml").write_text(
        'mechanism = "truss.toml"\nformulation = "dae"\nt_end = 1.0\n'
        'initial.at = "assembled"\ninitial.q_dot = { turn = 3.0 }\n'
    )
    runs = []
    for joints in ("", stop("pin_a", 0.5) + '[[joint]]\nname = "pin_b"\nfriction = 0.7\n'):
        (tmp_path / "truss.toml").write_text(truss.replace("{joints}", joints))
        runs.append(simulate(tmp_path / "s.scene.toml"))
    free, locked = runs
    assert locked.events == []
    assert locked.stats["rhs"] == free.stats["rhs"]
    assert_close(locked.q_tree, free.q_tree, 0)
    assert any(
        "do nothing in joints that the loops do not let move: pin_a, pin_b" in text
        for text in locked.mechanism.warnings
    )
    unmoved = sensitivities(tmp_path / "s.scene.toml", ["joint.pin_b.friction", "joint.pin_a.lower"])
    assert unmoved.run.status == "done"
    assert not unmoved.q_tree.any()
    assert not load("andrews").freedoms.immobile.any()
    assert not load("slider_crank_spatial").freedoms.immobile.any()
