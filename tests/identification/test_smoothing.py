"""Errors of smooth functions that are fitted to measurements, against exact motions."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin.identification.smoothing import fit_smooth

WAVES = ((0.25, 2.5), (0.15, 7.5), (0.05, 12.5))


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_errors_are_those_of_noise(noise):
    """Smoothing that is best for values makes errors of accelerations 1.3 to 3 times as large as noise does."""
    t, random = np.linspace(0.0, 4.0, 1001), np.random.default_rng(0)
    inside = t[100:-100:20]
    ratios = []
    for _ in range(20):
        phases = random.uniform(0, 2 * np.pi, len(WAVES))
        exact = [sum(a * w**k * np.sin(w * t + p + k * np.pi / 2) for (a, w), p in zip(WAVES, phases, strict=True))
                 for k in range(3)]  # fmt: skip
        fit = fit_smooth("wave", t, exact[0] + noise * random.normal(size=len(t)))
        errors = fit.values(inside) - np.array(exact)[:, 100:-100:20]
        std = [
            np.linalg.norm(fit.errors(inside, gains), axis=1)
            for gains in np.einsum("ok,ij->okij", np.eye(3), np.eye(len(inside)))
        ]
        ratios.append(errors / std)
    assert np.sqrt(np.mean(np.square(ratios), axis=(0, 2))) == pytest.approx(1.0, abs=0.12)


def test_accelerations_of_a_smooth_motion_have_little_noise():
    """A spline of degree seven leaves errors of 0.008 to 0.011 rad/s^2; the limit of known frequencies is 0.0007."""
    t, random = np.linspace(0.0, 4.0, 1001), np.random.default_rng(0)
    wave, acceleration = (sum(s * a * w**k * np.sin(w * t) for a, w in WAVES) for k, s in ((0, 1), (2, -1)))
    fits = [fit_smooth("wave", t, wave + 1e-4 * random.normal(size=len(t))) for _ in range(10)]
    errors = [fit.values(t)[2] - acceleration for fit in fits]
    assert np.sqrt(np.mean(np.square(errors)[:, 100:-100])) <= 0.005


def test_errors_in_a_gap_are_those_of_noise():
    t, random = np.linspace(0.0, 4.0, 1001), np.random.default_rng(0)
    inside = t[450:550:10]
    at = np.zeros((3, len(inside), len(inside)))
    at[2] = np.eye(len(inside))
    ratios = []
    for phase in random.uniform(0, 2 * np.pi, 20):
        wave, acceleration = (a * np.sin(9 * t + phase) for a in (0.2, -0.2 * 81))
        measured = wave + 1e-4 * random.normal(size=len(t))
        measured[450:550] = np.nan
        fit = fit_smooth("wave", t, measured)
        std = np.linalg.norm(fit.errors(inside, at), axis=1)
        ratios.append((fit.values(inside)[2] - acceleration[450:550:10]) / std)
        assert std.max() >= 1.5 * fit.std[2]
    assert 0.5 <= np.sqrt(np.mean(np.square(ratios))) <= 1.5


def test_piecewise_motion_is_followed():
    """A motion between two rests, by polynomials of degree five, has jumps of the third derivative."""
    t, random = np.linspace(0.0, 3.0, 1501), np.random.default_rng(0)
    s = np.clip(t - 1.0, 0.0, 1.0)
    exact, acceleration = s**3 * (10 - 15 * s + 6 * s**2), 60 * s - 180 * s**2 + 120 * s**3
    errors = [
        fit_smooth("step", t, exact + 1e-4 * random.normal(size=len(t))).values(t)[2] - acceleration for _ in range(5)
    ]
    assert np.sqrt(np.mean(np.square(errors)[:, 150:-150])) <= 0.03 * np.sqrt(np.mean(acceleration**2))


def test_span_ends_where_accelerations_are_extrapolated():
    t = np.linspace(0.0, 4.0, 1001)
    fit = fit_smooth("wave", t, np.sin(5 * t) + 1e-4 * np.random.default_rng(0).normal(size=len(t)))
    gains = np.zeros((3, len(t), len(t[::20])))
    gains[2, ::20] = np.eye(len(t[::20]))
    std = np.linalg.norm(fit.errors(t, gains), axis=1)
    is_used = (t[::20] >= fit.span[0]) & (t[::20] <= fit.span[1])
    assert std[is_used].max() <= 3.3 * fit.std[2]
    assert std[~is_used].min() >= 2.4 * fit.std[2]
    assert 0.8 * len(is_used) <= is_used.sum() < len(is_used)
