"""Errors of smoothing splines against exact waves."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin.identification.measured_motion import fit_spline

WAVES = ((0.25, 2.5), (0.15, 7.5), (0.05, 12.5))


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_errors_are_those_of_noise(noise):
    """Smoothing that is best for values makes errors of accelerations 1.3 to 3 times as large as noise does."""
    t, random = np.linspace(0.0, 4.0, 1001), np.random.default_rng(0)
    ratios = []
    for _ in range(20):
        phases = random.uniform(0, 2 * np.pi, len(WAVES))
        exact = [sum(a * w**k * np.sin(w * t + p + k * np.pi / 2) for (a, w), p in zip(WAVES, phases, strict=True))
                 for k in range(3)]  # fmt: skip
        fit = fit_spline("wave", t, exact[0] + noise * random.normal(size=len(t)))
        inside = slice(100, -100)
        errors = fit.values(t[inside]) - np.array(exact)[:, inside]
        ratios.append(np.sqrt(np.mean(errors**2, axis=1)) / fit.std)
    assert np.sqrt(np.mean(np.square(ratios), axis=0)) == pytest.approx(1.0, abs=0.12)
