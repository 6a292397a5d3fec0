"""The nearest singular configuration in all of q, against closed forms and samples that do not use the package."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from ckc_pin import load, load_scene
from ckc_pin.analysis.map.desired_path import read_desired
from ckc_pin.analysis.map.nearest import find_nearest_singular
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

# --- five-bar: phi_z is singular where the elbows are l2 + l4 apart, or coincide ----------------------------------


def elbow_gap(theta_1, theta_3):
    """Vector between the elbows, as a complex number."""
    return FIVE_BAR.l[0] * np.exp(1j * theta_1) - FIVE_BAR.base - FIVE_BAR.l[2] * np.exp(1j * theta_3)


def stretched(count):
    """Points of the curve on which the elbows are l2 + l4 apart, with theta_3 in (-pi, pi], shape (m, 2)."""
    theta_1 = np.linspace(-np.pi, np.pi, count)
    way = FIVE_BAR.l[0] * np.exp(1j * theta_1) - FIVE_BAR.base
    cosine = (abs(way) ** 2 + FIVE_BAR.l[2] ** 2 - (FIVE_BAR.l[1] + FIVE_BAR.l[3]) ** 2) / (
        2 * abs(way) * FIVE_BAR.l[2]
    )
    exists = abs(cosine) <= 1
    angles = [np.angle(way[exists]) + sign * np.arccos(cosine[exists]) for sign in (1, -1)]
    return np.vstack([np.column_stack([theta_1[exists], np.angle(np.exp(1j * angle))]) for angle in angles])


def coinciding():
    """The two configurations in which the elbows coincide, shape (2, 2)."""
    l, base = FIVE_BAR.l, FIVE_BAR.base
    x = (base**2 + l[0] ** 2 - l[2] ** 2) / (2 * base)
    elbows = x + 1j * np.sqrt(l[0] ** 2 - x**2) * np.array([1, -1])
    return np.column_stack([np.angle(elbows), np.angle(elbows - base)])


def find_nearest(name, overrides=None):
    mechanism = load(name.split("/")[0])
    trajectory = read_desired(load_scene(name, overrides), mechanism)
    return find_nearest_singular(mechanism, trajectory.desired, trajectory.t)


def test_distance_of_the_trajectory_of_eq_21_equals_the_closed_form():
    nearest = find_nearest("five_bar/tracking")
    t = np.linspace(0.0, 9.5, 40001)
    q_d = np.column_stack([np.pi / 3 * np.sin(t), np.pi / 4 * (1 - np.cos(t))])
    singular = np.vstack([stretched(400001), coinciding()])
    turns = 2 * np.pi * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    images = (singular[:, None] + turns).reshape(-1, 2)
    is_close = np.all((images > q_d.min(axis=0) - 0.5) & (images < q_d.max(axis=0) + 0.5), axis=1)
    distances, _ = cKDTree(images[is_close]).query(q_d)
    assert nearest.distance == pytest.approx(distances.min(), abs=1e-7)
    assert nearest.t == pytest.approx(t[np.argmin(distances)], abs=2e-3)
    assert (nearest.kind, nearest.unit) == ("fold", "rad")
    assert abs(elbow_gap(*nearest.q)) == pytest.approx(FIVE_BAR.l[1] + FIVE_BAR.l[3], abs=1e-11)
    assert_close(nearest.q_d, [np.pi / 3 * np.sin(nearest.t), np.pi / 4 * (1 - np.cos(nearest.t))], 1e-12)


def test_isolated_configuration_with_coinciding_elbows_is_found():
    """Straight lines in q pass it by."""
    upper = coinciding()[0]
    target = np.add(upper, (0.15, -0.1))
    assert np.hypot(*(stretched(100001) - target).T).min() > 0.3
    q_d = dict(zip(("theta_1", "theta_3"), map(float, target), strict=True))
    nearest = find_nearest("five_bar/set_point", {"controller.q_d": q_d})
    assert (nearest.kind, nearest.t) == ("locked", 0.0)
    assert_close(nearest.q, upper, 1e-9)
    assert nearest.distance == pytest.approx(np.hypot(0.15, 0.1), abs=1e-9)


# --- 3-RRR: phi_z is singular where the lines of the distal links meet in one point ------------------------------

BASES = np.array([[0.0, 0.35], [-0.303109, -0.175], [0.303109, -0.175]])
CORNERS = 0.1 * np.array([[0.0, 1.0], [-np.sqrt(0.75), -0.5], [np.sqrt(0.75), -0.5]])  # from the plate's centre
LINK = 0.2


def legs(pose):
    """Motor angles (..., 3) and the determinant of the distal links' lines at plate poses (..., 3): x, y, rotation.

    All elbows are bent as assembled. NaN where a corner is out of reach.
    """
    x, y, angle = np.moveaxis(np.asarray(pose, float), -1, 0)[..., None]
    lever = np.stack([np.cos(angle) * CORNERS[:, 0] - np.sin(angle) * CORNERS[:, 1],
                      np.sin(angle) * CORNERS[:, 0] + np.cos(angle) * CORNERS[:, 1]], axis=-1)  # fmt: skip
    corner = np.stack([x, y], axis=-1) + lever
    way = corner - BASES
    with np.errstate(invalid="ignore"):
        a = np.arctan2(way[..., 1], way[..., 0]) + np.arccos(np.linalg.norm(way, axis=-1) / (2 * LINK))
    distal = corner - BASES - LINK * np.stack([np.cos(a), np.sin(a)], axis=-1)
    moment = lever[..., 0] * distal[..., 1] - lever[..., 1] * distal[..., 0]
    rows = np.concatenate([distal / LINK, moment[..., None] / LINK**2], axis=-1)
    return a, np.where(np.isnan(a).any(axis=-1), np.nan, np.linalg.det(np.nan_to_num(rows)))


def circle(t):
    """q_d of three_rrr/circle, shape (..., 3)."""
    phases = np.array([0.0, -2 * np.pi / 3, 2 * np.pi / 3])
    return np.array([-0.675, 1.419, 3.514]) + 0.3 * np.sin(2.0 * np.asarray(t)[..., None] + phases)


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def test_distance_with_three_freedoms_equals_that_of_samples():
    # samples of the singular surface, from changes of sign on a grid of plate poses
    grid = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 61)] * 2, np.linspace(-1.6, 1.6, 161), indexing="ij"), axis=-1)
    _, det = legs(grid)
    with np.errstate(invalid="ignore"):
        cells = np.argwhere(det[..., :-1] * det[..., 1:] < 0)
    i, j, k = cells.T
    part = det[i, j, k] / (det[i, j, k] - det[i, j, k + 1])
    poses = grid[i, j, k] + part[:, None] * (grid[i, j, k + 1] - grid[i, j, k])
    t = np.linspace(0.0, 6.0, 601)
    middle = np.array([-0.675, 1.419, 3.514])
    q = middle + wrap(legs(poses)[0] - middle)
    valid = np.isfinite(q).all(axis=1)
    distances, rows = cKDTree(q[valid]).query(circle(t))
    # the nearest samples of each interval of time, refined by SciPy over pose and time
    minima = []
    for interval in np.array_split(np.arange(len(t)), 12):
        first = interval[np.argmin(distances[interval])]
        start = np.append(poses[valid][rows[first]], t[first])
        solution = minimize(
            lambda x: np.sum(wrap(legs(x[:3])[0] - circle(x[3])) ** 2),
            start,
            method="SLSQP",
            bounds=[(-0.2, 0.2), (-0.2, 0.2), (-1.6, 1.6), (0.0, 6.0)],
            constraints={"type": "eq", "fun": lambda x: legs(x[:3])[1]},
            options={"ftol": 1e-15, "maxiter": 300},
        )
        if abs(legs(solution.x[:3])[1]) < 1e-9:
            minima.append(np.sqrt(solution.fun))
    assert min(minima) == pytest.approx(distances.min(), abs=2e-3)

    nearest = find_nearest("three_rrr/circle")
    assert nearest.distance == pytest.approx(min(minima), abs=1e-8)
    assert nearest.kind == "fold"
    assert_close(nearest.q_d, circle(nearest.t), 1e-12)


def test_crank_that_turns_all_the_way_round_has_no_singular_configuration():
    rest = np.zeros(1)
    assert find_nearest_singular(load("four_bar"), lambda t: (np.array([1.5]), rest, rest), np.zeros(1)) is None
