"""Moving by hand: closed forms of the five-bar and slider-crank, stops, and random mechanisms."""

import numpy as np
import pytest

from ckc_pin import Mechanism, load
from ckc_pin.kinematics.moving import drag_point, move_coordinate
from tests.analytic.five_bar import FIVE_BAR
from tests.analytic.test_point import inverses, tip, wrapped
from tests.conftest import assert_close

CRANK, ROD = 0.1, 0.3  # m, of slider_crank


@pytest.fixture(scope="module")
def five_bar():
    return load("five_bar")


@pytest.fixture(scope="module")
def slider_crank():
    return load("slider_crank")


def value(mechanism, at, name):
    return mechanism.tree.to_coordinates(at.q_tree)[mechanism.tree.index[name]]


def drag_to_rest(mechanism, at, joint, point, target, normal=None):
    """Drag until the movement has reached its target or ended."""
    for _ in range(200):
        movement = drag_point(mechanism, at, joint, point, target, normal)
        at = movement.at
        assert np.abs(at.phi).max(initial=0.0) <= mechanism.tolerance
        if movement.reached or movement.end:
            return movement
    raise AssertionError("the drag does not end")


def test_dragged_tip_of_the_five_bar_reaches_its_target_on_the_same_branch(five_bar):
    frame = five_bar.points["tip"]
    random = np.random.default_rng(3)
    at = five_bar.assembled
    for _ in range(20):
        q = five_bar.independent_part(five_bar.q_tree) + random.uniform(-0.4, 0.4, 2)
        target = tip(FIVE_BAR, q)
        movement = drag_to_rest(five_bar, at, frame.joint, frame.translation, np.array([target.real, target.imag, 0]))
        at = movement.at
        assert movement.reached
        reached = five_bar.independent_part(at.q_tree)
        errors = np.abs(wrapped(inverses(FIVE_BAR, target) - reached)).max(axis=1)
        assert errors.min() < 1e-8  # one of the four configurations of the triangles
        position = tip(FIVE_BAR, reached)  # the tip stays below the line of the elbows
        assert abs(position - target) < 1e-8


def test_distance_along_the_normal_does_not_count(five_bar):
    frame = five_bar.points["tip"]
    target = tip(FIVE_BAR, five_bar.independent_part(five_bar.q_tree) + np.array([0.1, -0.2]))
    position = np.array([target.real, target.imag, 7.0])
    normal = np.array([0.0, 0.0, 2.0])
    movement = drag_to_rest(five_bar, five_bar.assembled, frame.joint, frame.translation, position, normal)
    reached = five_bar.point_positions(movement.at.q_tree)["tip"]
    assert movement.reached
    assert_close(reached[:2], position[:2], 1e-8)


def test_target_out_of_reach_leads_to_the_nearest_point_of_the_crank_circle(slider_crank):
    joint = slider_crank.tree.joint_index("crank", "test") + 1
    point, target = np.array([CRANK, 0.0, 0.0]), np.array([0.3, 0.4, 0.0])
    movement = drag_to_rest(slider_crank, slider_crank.assembled, joint, point, target)
    assert movement.end == "the point cannot come nearer"
    assert value(slider_crank, movement.at, "crank") == pytest.approx(np.arctan2(0.4, 0.3), abs=1e-3)


def test_dependent_coordinate_ends_at_its_turning_point(slider_crank):
    """The slider's stroke ends where crank and rod are in line."""
    for target, end in ((1.0, CRANK + ROD), (-1.0, ROD - CRANK)):
        movement = move_coordinate(slider_crank, slider_crank.assembled, "slider", target)
        assert movement.end == "slider cannot go any further on this branch"
        assert value(slider_crank, movement.at, "slider") == pytest.approx(end, abs=1e-6)
    reached = move_coordinate(slider_crank, slider_crank.assembled, "slider", 0.35)
    crank = np.arccos((0.35**2 + CRANK**2 - ROD**2) / (2 * 0.35 * CRANK))
    assert reached.reached
    assert value(slider_crank, reached.at, "crank") == pytest.approx(crank, abs=1e-10)


def test_independent_coordinate_ends_at_the_singular_configuration(five_bar):
    """Det phi_z = 0 where the distal links are in line: the elbows are as far apart as both are long."""
    q = five_bar.independent_part(five_bar.q_tree)
    for direction in (1.0, -1.0):
        movement = move_coordinate(five_bar, five_bar.assembled, "theta_1", q[0] + direction * 3.1)
        assert movement.end == "phi_z is singular there"
        assert value(five_bar, movement.at, "theta_3") == pytest.approx(q[1], abs=1e-14)
        angle = value(five_bar, movement.at, "theta_1")
        l = FIVE_BAR.l
        gap = abs(FIVE_BAR.base + l[2] * np.exp(1j * q[1]) - l[0] * np.exp(1j * angle))
        assert min(abs(gap - l[1] - l[3]), abs(gap - abs(l[1] - l[3]))) < 1e-6


LIMITED = """<robot name="limited"><link name="base"/>
  {links}
  <joint name="a" type="revolute"><parent link="base"/><child link="left"/><axis xyz="0 0 1"/>
    <limit lower="-0.5" upper="0.6" effort="1" velocity="1"/></joint>
  <joint name="b" type="continuous"><parent link="left"/><child link="coupler"/><origin xyz="1 0 0"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="c" type="revolute"><parent link="base"/><child link="right"/><origin xyz="2 0 0"/>
    <axis xyz="0 0 1"/><limit lower="1.4" upper="1.9" effort="1" velocity="1"/></joint></robot>"""
LINK = """<link name="{}"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


@pytest.fixture(scope="module")
def limited():
    """A parallelogram: a and c turn by the same angle, so that the nearer stop of both ends a movement."""
    links = "".join(LINK.format(name) for name in ("left", "coupler", "right"))
    return Mechanism.from_urdf(
        LIMITED.format(links=links).replace('lower="-0.5" upper="0.6"', 'lower="1.0" upper="2.2"'),
        loops=[{"name": "pin", "type": "point_2d", "frame_a": {"link": "coupler", "xyz": [2, 0, 0]},
                "frame_b": {"link": "right", "xyz": [1, 0, 0]}}],
        joints=[{"name": "a", "stops": True}, {"name": "c", "stops": True}],
        q_guess={"a": 1.5, "b": -1.5, "c": 1.5},
        independent=["a"],
    )  # fmt: skip


def test_coordinate_ends_at_the_first_stop_of_any_joint(limited):
    for target, end in ((2.0, 1.9), (1.2, 1.4)):
        movement = move_coordinate(limited, limited.assembled, "a", target)
        side = "upper" if target > 1.5 else "lower"
        assert movement.end == f"c is at its {side} stop, {end:g} rad"
        assert value(limited, movement.at, "a") == pytest.approx(end, abs=1e-6)
    movement = move_coordinate(limited, limited.assembled, "c", 3.0)
    assert movement.end == "c is at its upper stop, 1.9 rad"
    assert value(limited, movement.at, "c") == pytest.approx(1.9, abs=1e-12)


def test_drag_ends_at_a_stop(limited):
    joint = limited.tree.joint_index("a", "test") + 1
    movement = drag_to_rest(limited, limited.assembled, joint, np.array([1.0, 0, 0]), np.array([-1.0, 0.0, 0.0]))
    assert movement.end == "c is at its upper stop, 1.9 rad"
    assert value(limited, movement.at, "c") == pytest.approx(1.9, abs=1e-8)
    assert value(limited, movement.at, "c") <= 1.9 + 2e-9


@pytest.mark.parametrize(
    "name", ["five_bar", "delta", "stewart", "bricard", "two_ur5", "talos", "three_rrr", "flyball"]
)
def test_random_drags_stay_closed_on_one_branch(name):
    mechanism = load(name)
    random = np.random.default_rng(5)
    at = mechanism.assembled
    square = at.phi_z.shape[0] == at.phi_z.shape[1]
    sign = np.linalg.slogdet(at.phi_z)[0] if square else 1.0
    for _ in range(3):
        joint = int(random.integers(1, mechanism.tree.model.njoints))
        start = at.pose.translation[joint].copy()
        rate = random.uniform(0.1, 0.5, 3)
        for k in range(15):
            target = start + 0.5 * mechanism.size * np.sin(rate * k)
            at = drag_point(mechanism, at, joint, np.zeros(3), target).at
            assert np.abs(at.phi).max(initial=0.0) <= 1e-10 * mechanism.size
            if square:
                assert np.linalg.slogdet(at.phi_z)[0] == sign
    names = random.choice(mechanism.coordinates, 4)
    for coordinate in names:
        target = value(mechanism, at, coordinate) + random.uniform(-0.3, 0.3)
        movement = move_coordinate(mechanism, at, coordinate, target)
        at = movement.at
        assert movement.reached or movement.end
        assert np.abs(at.phi).max(initial=0.0) <= 1e-10 * mechanism.size
        if movement.reached:
            assert value(mechanism, at, coordinate) == pytest.approx(target, abs=1e-10)


def test_no_step_past_a_singular_configuration_with_redundant_rows():
    """A planar four-bar closed by a hinge has five rows of rank 2. Its rocker's dead centre separates two branches."""
    links = "".join(LINK.format(name) for name in ("left", "coupler", "right"))
    mechanism = Mechanism.from_urdf(
        LIMITED.format(links=links).replace("revolute", "continuous"),
        loops=[{"name": "pin", "type": "hinge", "frame_a": {"link": "coupler", "xyz": [1.6, 0, 0]},
                "frame_b": {"link": "right", "xyz": [1.2, 0, 0]}}],
        q_guess={"a": 1.2, "b": -0.6, "c": 1.9},
        independent=["c"],
    )  # fmt: skip
    assert mechanism.closure.rows > mechanism.rank
    # a + b are stretched at the dead centre: |(2, 0) + 1.2 (cos c, sin c)| = 2.6
    for target in (-3.0, 4.0):
        movement = move_coordinate(mechanism, mechanism.assembled, "c", target)
        c = value(mechanism, movement.at, "c")
        distance = np.hypot(2 + 1.2 * np.cos(c), 1.2 * np.sin(c))
        if not movement.reached:
            assert movement.end == "phi_z is singular there"
            assert min(abs(distance - 2.6), abs(distance - 0.6)) < 1e-6
        b = wrapped(value(mechanism, movement.at, "b"))
        assert b < 0  # the coupler's elbow stays on its side
