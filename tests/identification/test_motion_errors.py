"""Errors and standard deviations of many inertias that runs of a delta are fitted to.

Most of the 115 unknowns are hardly determined. The requirement that bodies can exist then moves the estimate by up to
two standard deviations, towards the truth. Standard deviations do not count that, so errors are smaller than they say.
"""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import identify, load
from ckc_pin.identification.motion_runs import read_motion, simulate_with_derivatives
from ckc_pin.identification.motions import make_unknowns
from ckc_pin.identification.pseudo_inertia import pseudo_inertia
from ckc_pin.identification.records import read_record
from scripts.experiments.identification_trials import CASES, load_case, measure_motion

NAMES = ("link.*.inertial", "joint.*.damping")
NOISE = 10 * CASES["delta"].noise  # of `measure_motion`


def fit():
    """Return the result from true start values, and the values of its unknowns."""
    result = identify(load_case("delta"), measure_motion("delta", 0), NAMES, method="motion")
    unknowns = make_unknowns(load("delta", dict(result.values)), NAMES)
    return result, dict(zip(unknowns.names, unknowns.start, strict=True))


def evaluate(combination, values):
    return sum(c * values[name] for name, c in combination.coefficients.items())


def linear_problem():
    """Return derivatives of the measured values by unknown and start, in units of the noise, and the errors."""
    mechanism, data = load_case("delta"), measure_motion("delta", 0)
    unknowns = make_unknowns(mechanism, NAMES)
    motion = read_motion(mechanism, read_record(data, mechanism), [])
    exact = read_motion(mechanism, read_record(_without_noise(), mechanism), [])
    run = simulate_with_derivatives(unknowns, exact, np.zeros(len(unknowns.names)), exact.q, exact.q_dot)
    columns = np.concatenate([run.by_unknown, run.by_start], axis=2)
    errors = motion.values - exact.values
    return unknowns, columns.reshape(-1, columns.shape[2]) / NOISE, errors.ravel() / NOISE


def _without_noise():
    """Return the exact measurements, from those with noise of a known seed."""
    data = dict(measure_motion("delta", 0))
    random = np.random.default_rng(0)
    for name in load_case("delta").independent:
        data[name] = data[name] - NOISE * random.normal(size=len(data["t"]))
    return data


def test_standard_deviations_are_those_of_linear_least_squares():
    """Without the requirement that bodies can exist, errors are as large as standard deviations say."""
    result, values = fit()
    unknowns, columns, errors = linear_problem()
    truth = dict(zip(unknowns.names, unknowns.start, strict=True))
    u, s, v = np.linalg.svd(columns, full_matrices=False)
    keep = s > 1e-6 * s[0]  # the data do not determine the other directions
    u, s, v = u[:, keep], s[keep], v[keep, : len(unknowns.names)]
    ratios, constrained, free = [], [], []
    for x in result.base:
        row = np.array([x.coefficients.get(name, 0.0) for name in unknowns.names]) * unknowns.scale
        along = (v @ row) / s
        ratios.append(x.std / np.linalg.norm(along))
        free.append(along @ (u.T @ errors) / x.std)
        constrained.append((evaluate(x, values) - evaluate(x, truth)) / x.std)
    assert np.array(ratios) == pytest.approx(1.0, abs=0.05)
    assert 0.6 <= np.sqrt(np.mean(np.square(free))) <= 1.5
    assert np.sqrt(np.mean(np.square(constrained))) <= 0.7 * np.sqrt(np.mean(np.square(free)))
    bodies = [np.array([values[unknowns.names[k]] for k in at]) for at in unknowns.bodies]
    assert all(np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0 for body in bodies)
