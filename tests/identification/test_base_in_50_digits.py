"""Base parameters against singular values in 50 digits, of equations of the test's own.

The generalized forces of planar links follow from Newton and Euler's equations and virtual work. They are linear in
mass, first moment and inertia of each link.
"""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.identification.pseudo_inertia import MOMENTS
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.structure import structural_directions

GRAVITY = mp.mpf("9.81")
PLANAR = ("mass", "moment.x", "moment.y", "origin_inertia.izz")


def slider_crank_places(q):
    """Return x, y and angle of the frames of crank, rod and slider."""
    crank, rod = mp.mpf("0.1"), mp.mpf("0.3")
    x, y = crank * mp.cos(q), crank * mp.sin(q)
    angle = -mp.asin(y / rod)
    return 0, 0, q, x, y, angle, x + rod * mp.cos(angle), 0, 0


def five_bar_places(left, right):
    """Return x, y and angle of the frames of link_1 to link_4, with the tip below the elbows."""
    proximal, distal, base = mp.mpf("0.2794"), mp.mpf("0.3048"), mp.mpf("0.3048")
    x, y = proximal * mp.cos(left), proximal * mp.sin(left)
    right_x, right_y = base + proximal * mp.cos(right), proximal * mp.sin(right)
    turn, half = mp.atan2(right_y - y, right_x - x), mp.hypot(right_x - x, right_y - y) / 2
    below = mp.acos(half / distal)
    return 0, 0, left, x, y, turn - below, base, 0, right, right_x, right_y, turn + below - mp.pi


CASES = {
    "slider_crank": (slider_crank_places, ("crank_link", "rod_link", "slider_link"), (0.0,), 2.0),
    "five_bar": (five_bar_places, ("link_1", "link_2", "link_3", "link_4"), (-1.434, -1.707), 0.5),
}


def rows_of(places, q, rates, accelerations):
    """Return the generalized forces (d rows) of a unit of each number of each link."""
    d, count = len(q), len(places(*q))

    def derivative(k, *along):
        orders = tuple(along.count(i) for i in range(d))
        return mp.diff(lambda *x: mp.mpf(places(*x)[k]), q if d > 1 else q[0], orders if d > 1 else orders[0])

    first = [[derivative(k, i) for i in range(d)] for k in range(count)]
    second = [
        sum(first[k][i] * accelerations[i] for i in range(d))
        + sum(derivative(k, i, j) * rates[i] * rates[j] for i in range(d) for j in range(d))
        for k in range(count)
    ]
    rows = [[] for _ in range(d)]
    for k in range(0, count, 3):
        angle = places(*q)[k + 2]
        rate = sum(first[k + 2][i] * rates[i] for i in range(d))
        a_x, a_y, turning = second[k], second[k + 1] + GRAVITY, second[k + 2]
        moments = {"moment.x": (mp.cos(angle), mp.sin(angle)), "moment.y": (-mp.sin(angle), mp.cos(angle))}
        loads = [(a_x, a_y, mp.mpf(0))]  # force and torque about the frame's origin
        loads += [(-turning * y - rate**2 * x, turning * x - rate**2 * y, x * a_y - y * a_x)
                  for x, y in moments.values()]  # fmt: skip
        loads.append((mp.mpf(0), mp.mpf(0), turning))
        for i in range(d):
            rows[i] += [sum(load[j] * first[k + j][i] for j in range(3)) for load in loads]
    return rows


@pytest.mark.parametrize("name", CASES)
def test_rank_and_space_equal_those_in_50_digits(name):
    places, links, middle, reach = CASES[name]
    regressor = TorqueRegressor(load(name), ["link.*.inertial"])
    assert regressor.links == list(links)
    d, random = len(middle), np.random.default_rng(0)
    with mp.workdps(50):
        rows = []
        for _ in range(24):
            q, rates, accelerations = (
                [mp.mpf(int(1000 * x)) / 1000 for x in row]
                for row in (middle + random.uniform(-reach, reach, d), *random.uniform(-2, 2, (2, d)))
            )
            rows += rows_of(places, q, rates, accelerations)
        values, vectors = mp.eigsy(mp.matrix(rows).T * mp.matrix(rows))
        rank = sum(x > mp.mpf(10) ** -25 * max(values) for x in values)
        null = np.array([[float(vectors[i, k]) for k in range(len(values) - rank)] for i in range(len(values))])
    at = [regressor.names.index(f"link.{link}.{number}") for link in links for number in PLANAR]
    directions = structural_directions(regressor)
    assert directions.shape[1] == rank
    assert len(MOMENTS) * len(links) == len(directions)
    # Vectors without influence in 50 digits are orthogonal to all directions with influence, and the ranks are equal.
    scaled = null / regressor.scale[at, None]
    scaled /= np.linalg.norm(scaled, axis=0)
    assert np.abs(directions[at].T @ scaled).max() < 1e-8
    others = np.delete(directions, at, axis=0)
    assert np.abs(others).max() < 1e-8
