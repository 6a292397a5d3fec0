"""Kinematics of a point against the five-bar's triangles, the delta's spheres, and differences."""

import numpy as np
import pytest

from ckc_pin import InputError, NumericalError, load, load_scene, simulate
from ckc_pin.base.sources import Sources
from ckc_pin.control.point_path import make_desired
from ckc_pin.control.workspace import follow_desired
from ckc_pin.kinematics.point import Point
from ckc_pin.kinematics.sigma import sigma
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close


def tip(model, q):
    """Return the tip: the lower intersection of two circles about the elbows."""
    left, right = model.l[0] * np.exp(1j * q[0]), model.base + model.l[2] * np.exp(1j * q[1])
    way = right - left
    cosine = (abs(way) ** 2 + model.l[1] ** 2 - model.l[3] ** 2) / (2 * abs(way) * model.l[1])
    return left + model.l[1] * way / abs(way) * np.exp(-1j * np.arccos(cosine))


def inverses(model, x):
    """Return all (theta_1, theta_3) with the tip at x + i y."""
    angles = []
    for base, l, m in ((0.0, *model.l[:2]), (model.base, *model.l[2:])):
        way = x - base
        bend = np.arccos((abs(way) ** 2 + l**2 - m**2) / (2 * abs(way) * l))
        angles.append([np.angle(way) + bend, np.angle(way) - bend])
    return np.array([(a, b) for a in angles[0] for b in angles[1]])


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@pytest.fixture(scope="module")
def pair():
    return load("five_bar"), FIVE_BAR


@pytest.fixture(scope="module")
def states(pair):
    mechanism, _ = pair
    return mechanism.independent_part(mechanism.q_tree) + np.random.default_rng(2).uniform(-0.4, 0.4, (8, 2))


def test_forward_kinematics_of_the_five_bar_and_delta(pair, states):
    mechanism, model = pair
    point = Point(mechanism)
    for q in states:
        x = tip(model, q)
        assert_close(point.forward(q), [x.real, x.imag, 0.0], 1e-12)
        assert_close(point.forward(dict(zip(mechanism.independent, q, strict=True))), point.forward(q), 0.0)


def test_point_jacobian_and_its_derivative_match_differences(pair, states):
    mechanism, model = pair
    point, h = Point(mechanism), 1e-4

    def tip_derivatives(q, direction):
        """Return first and second derivative of the tip by central differences of fourth order."""
        f = [tip(model, q + k * h * direction) for k in (-2, -1, 0, 1, 2)]
        return (f[0] - 8 * f[1] + 8 * f[3] - f[4]) / (12 * h), (-f[0] + 16 * f[1] - 30 * f[2] + 16 * f[3] - f[4]) / (
            12 * h**2
        )

    for q, q_dot in zip(states, np.random.default_rng(1).normal(size=(8, 2)), strict=True):
        at = sigma(mechanism, q).at
        velocity, acceleration = tip_derivatives(q, q_dot)
        assert_close(point.jacobian(at) @ q_dot, [velocity.real, velocity.imag, 0.0], 1e-9)
        assert_close(point.jacobian_dot(at, q_dot) @ q_dot, [acceleration.real, acceleration.imag, 0.0], 1e-5)


def test_inverse_kinematics_finds_four_solutions_and_follows_one_branch(pair, states):
    mechanism, model = pair
    point = Point(mechanism)
    for q in states:
        x = tip(model, q)
        expected = inverses(model, x)
        solutions = np.array([solution.q for solution in point.every_inverse([x.real, x.imag, 0.0])])
        assert len(solutions) == 4
        for one in expected:
            assert np.abs(wrapped(solutions - one)).max(axis=1).min() < 1e-9
        followed = point.inverse([x.real, x.imag, 0.0])
        assert np.abs(wrapped(expected - followed.q)).max(axis=1).min() < 1e-9
        assert np.all(np.sign(np.sin(followed.at.q_tree[[1, 3]])) == np.sign(np.sin(mechanism.q_tree[[1, 3]])))


def test_inverse_kinematics_of_the_delta_matches_closed_form():
    """Hinges are at radius 0.25 m, arms are 0.18 m and rods 0.45 m long; balls are 0.04 m from the plate's point."""
    mechanism = load("delta")
    point = Point(mechanism)
    for place in np.random.default_rng(4).uniform([-0.1, -0.1, -0.35], [0.1, 0.1, -0.25], (5, 3)):
        solution = point.inverse(place)
        assert_close(point.position(solution.at.q_tree), place, 1e-9)
        assert abs(solution.at.phi).max() < 1e-10
        for k, q in enumerate(solution.q):
            turn = 2 * np.pi * k / 3
            out = np.array([np.cos(turn), np.sin(turn), 0.0])
            elbow = (0.25 + 0.18 * np.cos(q)) * out - 0.18 * np.sin(q) * np.array([0.0, 0.0, 1.0])
            assert_close(np.linalg.norm(place + 0.04 * out - elbow), 0.45, 1e-9)


def test_inverse_kinematics_keeps_a_free_orientation():
    mechanism = load("three_rrr")
    point = Point(mechanism)
    solution = point.inverse(point.position(mechanism.q_tree) + np.array([0.02, -0.03, 0.0]))
    turned = [mechanism.kinematics(q).pose.rotation[mechanism.points["plate"].joint] for q in
              (mechanism.q_tree, solution.at.q_tree)]  # fmt: skip
    assert_close(turned[0], turned[1], 1e-10)


@pytest.mark.parametrize(
    ("x", "says"),
    [
        ([0.1, 0.1], "expected three finite numbers"),
        ([0.1, np.nan, 0.0], "expected three finite numbers"),
        ([5.0, 0.0, 0.0], "cannot be at"),
        ([0.15, -0.5, 0.1], "cannot be at"),  # out of the plane
        ({"w": 0.1}, "there are x, y, z"),
    ],
)
def test_unreachable_positions_are_rejected(pair, x, says):
    with pytest.raises(InputError, match=says):
        Point(pair[0]).inverse(x)


def path(mechanism, t_end=3.0, **desired):
    return make_desired({"point": "tip", **desired}, mechanism, Sources("test", None, {}), t_end)


CIRCLE = {"centre": [0.15, -0.42, 0.0], "radius": 0.06, "frequency": 2.0, "phase": 0.4}


@pytest.mark.parametrize(
    "desired",
    [{"circle": CIRCLE}, {"line": {"start": [0.1, -0.5, 0.0], "end": [0.25, -0.4, 0.0], "frequency": 1.5}}],
)
def test_a_path_of_the_tip_in_joint_coordinates(pair, desired):
    mechanism, model = pair
    follow = path(mechanism, **desired)
    h = 1e-4
    for t in np.random.default_rng(6).uniform(0.1, 2.9, 6):
        if "circle" in desired:
            x = 0.15 - 0.42j + 0.06 * np.exp(1j * (2.0 * t + 0.4))
        else:
            x = 0.175 - 0.45j - (0.075 + 0.05j) * np.cos(1.5 * t)
        q, q_dot, q_ddot = follow(t)
        assert np.abs(wrapped(inverses(model, x) - q)).max(axis=1).min() < 1e-9
        f = [follow(t + k * h)[0] for k in (-2, -1, 1, 2)]
        g = [follow(t + k * h)[1] for k in (-2, -1, 1, 2)]
        assert_close(q_dot, (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h), 1e-8)
        assert_close(q_ddot, (g[0] - 8 * g[1] + 8 * g[2] - g[3]) / (12 * h), 1e-8)
    assert follow.leaves_at is None
    assert follow_desired(mechanism, follow, 3.0).leaves_at is None


def test_a_table_of_the_tip(pair):
    mechanism, model = pair
    t = np.linspace(0.0, 3.0, 61)
    rows = "\n".join(f"{a},{0.15 + 0.05 * np.sin(a)},{-0.45 + 0.03 * np.cos(a)},0" for a in t)
    sources = Sources("test", None, {"x.csv": f"t,x,y,z\n{rows}\n"})
    follow = make_desired({"point": "tip", "file": "x.csv"}, mechanism, sources, 3.0)
    for a in (0.7, 1.93):
        x = 0.15 + 0.05 * np.sin(a) + 1j * (-0.45 + 0.03 * np.cos(a))
        assert np.abs(wrapped(inverses(model, x) - follow(a)[0])).max(axis=1).min() < 1e-6  # the spline's
    with pytest.raises(InputError, match=r"x\.csv: .* ends at t = 3 s, before the scene's t_end = 4 s"):
        make_desired({"point": "tip", "file": "x.csv"}, mechanism, sources, 4.0)


def test_a_path_that_leaves_the_workspace_is_rejected(pair):
    """The tip moves straight down and leaves the workspace where both chains are stretched."""
    mechanism, model = pair
    down = {"start": [model.base / 2, -0.5, 0.0], "end": [model.base / 2, -0.7, 0.0], "frequency": 1.0}
    follow = path(mechanism, line=down)
    depth = np.sqrt((model.l[0] + model.l[1]) ** 2 - model.base**2 / 4)
    leaves = np.arccos((0.6 - depth) / 0.1)
    assert follow.leaves_at == pytest.approx(leaves, abs=1e-6)
    assert follow_desired(mechanism, follow, 3.0).leaves_at == pytest.approx(leaves, abs=1e-6)
    with pytest.raises(NumericalError, match="leaves the workspace"):
        follow(2.5)


@pytest.mark.parametrize(
    ("name", "desired", "t_end"),
    [
        ("five_bar", {"point": "tip", "circle": CIRCLE}, 3.0),
        (
            "five_bar",
            {"point": "tip", "circle": {**CIRCLE, "frequency": 40.0}},
            3.0,
        ),  # chords are too far from the arc, so knots are solved one by one
        (
            "five_bar",
            {"point": "tip", "line": {"start": [0.1, -0.4, 0], "end": [0.2, -0.45, 0], "frequency": 2.0}},
            3.0,
        ),
        ("delta", {"point": "plate", "circle": {"centre": [0, 0, -0.29], "radius": 0.02, "frequency": 2.0}}, 2.0),
        ("three_rrr", {"point": "plate", "circle": {"centre": [0.01, 0.01, 0], "radius": 0.02, "frequency": 1.0}}, 9.0),
    ],
)
def test_interpolated_knots_equal_the_path(name, desired, t_end):
    """At each knot the point is on the closed form of the path."""
    mechanism = load(name)
    follow = make_desired(desired, mechanism, Sources("test", None, {}), t_end)
    together = follow._solve_interpolated()
    if desired.get("circle", {}).get("frequency") == 40.0:
        assert together is None
    else:
        assert_close(together, follow._follow_all(), 1e-9)
    for t, q_tree in zip(follow.times[::10], follow.knots[::10], strict=True):
        assert_close(mechanism.point_positions(q_tree)[desired["point"]], follow.path(t)[0], 1e-9)
        assert_close(mechanism.kinematics(q_tree).phi, 0.0, 1e-9)


@pytest.mark.parametrize(
    ("desired", "says"),
    [
        ({}, "needs exactly one of file, circle, line and waypoints"),
        ({"circle": CIRCLE, "line": {"start": [0, 0, 0], "end": [1, 0, 0], "frequency": 1.0}}, "needs exactly one of"),
        ({"circle": {**CIRCLE, "radius": -1.0}}, "radius"),
        ({"circle": {**CIRCLE, "normal": [0, 0, 0]}}, "normal must not be zero"),
        ({"circle": {**CIRCLE, "centre": [3.0, 0, 0]}}, "the start of the path cannot be reached"),
        ({"spiral": 1}, "spiral"),
    ],
)
def test_invalid_paths_are_rejected(pair, desired, says):
    with pytest.raises(InputError, match=says):
        path(pair[0], **desired)


def test_a_scene_with_a_path_runs():
    overrides = {"controller.desired": {"point": "tip", "circle": CIRCLE}, "t_end": 3.0, "solver.rtol": 1e-6}
    scene = load_scene("five_bar/tracking", overrides)
    finished = simulate(scene)
    x = 0.15 - 0.42j + 0.06 * np.exp(1j * (2.0 * finished.t + 0.4))
    reached = np.array([finished.mechanism.point_positions(q)["tip"] for q in finished.q_tree])
    gap = abs(reached[:, 0] + 1j * reached[:, 1] - x)
    assert finished.status == "done"
    assert gap[-1] < 0.1 * gap[0]  # e^-3 of the error in q, with Lambda = 1
