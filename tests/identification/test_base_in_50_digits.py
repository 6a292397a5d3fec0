"""Base parameters of a slider-crank against singular values in 50 digits, of equations of the test's own.

With one freedom, tau = M q'' + M' q'^2 / 2 + V'. M and V are linear in mass, first moment and inertia of each link.
"""

from __future__ import annotations

import mpmath as mp
import numpy as np

from ckc_pin import load
from ckc_pin.identification.pseudo_inertia import MOMENTS
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.structure import structural_directions

CRANK, ROD, GRAVITY = mp.mpf("0.1"), mp.mpf("0.3"), mp.mpf("9.81")
PLANAR = ("mass", "moment.x", "moment.y", "origin_inertia.izz")
LINKS = ("crank_link", "rod_link", "slider_link")


def rod_angle(q):
    return -mp.asin(CRANK * mp.sin(q) / ROD)


PLACES = (  # x, y and angle of each link's frame
    (lambda q: mp.mpf(0), lambda q: mp.mpf(0), lambda q: q),
    (lambda q: CRANK * mp.cos(q), lambda q: CRANK * mp.sin(q), rod_angle),
    (lambda q: CRANK * mp.cos(q) + ROD * mp.cos(rod_angle(q)), lambda q: mp.mpf(0), lambda q: mp.mpf(0)),
)


def column(place, number, q, rate, acceleration):
    """Return the crank's torque for a unit of one number of a link."""
    x, y, angle = place

    def mass(s):
        dx, dy, turn = (mp.diff(f, s) for f in (x, y, angle))
        a = angle(s)
        return {"mass": dx**2 + dy**2, "moment.x": 2 * turn * (dy * mp.cos(a) - dx * mp.sin(a)),
                "moment.y": -2 * turn * (dx * mp.cos(a) + dy * mp.sin(a)),
                "origin_inertia.izz": turn**2}[number]  # fmt: skip

    def height(s):
        values = {"mass": y(s), "moment.x": mp.sin(angle(s)), "moment.y": mp.cos(angle(s))}
        return GRAVITY * values.get(number, mp.mpf(0))

    return mass(q) * acceleration + mp.diff(mass, q) * rate**2 / 2 + mp.diff(height, q)


def test_rank_and_space_equal_those_in_50_digits():
    regressor = TorqueRegressor(load("slider_crank"), ["link.*.inertial"])
    assert regressor.links == list(LINKS)
    with mp.workdps(50):
        states = [
            [mp.mpf(int(x)) / 1000 for x in row] for row in np.random.default_rng(0).integers(-2000, 2000, (24, 3))
        ]
        rows = mp.matrix([[column(place, number, *state) for place in PLACES for number in PLANAR] for state in states])
        gram = rows.T * rows
        values, vectors = mp.eigsy(gram)
        rank = sum(x > mp.mpf(10) ** -25 * max(values) for x in values)
        null = np.array([[float(vectors[i, k]) for k in range(len(values) - rank)] for i in range(len(values))])
    names = [f"link.{link}.{number}" for link in LINKS for number in PLANAR]
    at = [regressor.names.index(name) for name in names]
    directions = structural_directions(regressor)
    assert directions.shape[1] == rank
    assert len(MOMENTS) * len(LINKS) == len(directions)
    # Vectors without influence in 50 digits are orthogonal to all directions with influence, and the ranks are equal.
    scaled = null / regressor.scale[at, None]
    scaled /= np.linalg.norm(scaled, axis=0)
    assert np.abs(directions[at].T @ scaled).max() < 1e-8
    others = np.delete(directions, at, axis=0)
    assert np.abs(others).max() < 1e-8
