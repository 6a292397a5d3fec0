"""Null spaces of many Jacobians along a motion, against the singular value decomposition."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from ckc_pin.base.linear_algebra import null_spaces
from tests.analytic.five_bar import Array
from tests.conftest import assert_close


def turning_jacobians(redundant: int) -> Array:
    """Return Jacobians of rank 4 with 7 columns, whose null space turns so far that no choice of columns stays good."""
    random = np.random.default_rng(5)
    mix, skew = random.standard_normal((4 + redundant, 4)), random.standard_normal((7, 7))
    start = np.linalg.qr(random.standard_normal((7, 4)))[0].T
    return np.array([mix @ start @ scipy.linalg.expm(t * (skew - skew.T)) for t in np.linspace(0.0, 1.5, 40)])


@pytest.mark.parametrize("redundant", [0, 2])
def test_null_spaces_along_a_motion(redundant: int) -> None:
    jacobians = turning_jacobians(redundant)
    bases, has_rank = null_spaces(jacobians, 4)
    assert has_rank.all()
    assert np.abs(bases).max() <= 2.0
    choices = set()
    for jacobian, basis in zip(jacobians, bases, strict=True):
        expected = scipy.linalg.null_space(jacobian, rcond=1e-9)
        assert expected.shape == basis.shape
        assert_close(expected @ (expected.T @ basis), basis, 1e-13)
        free = [int(np.flatnonzero((basis == np.eye(3)[k]).all(axis=1))[0]) for k in range(3)]
        choices.add(tuple(free))
    assert 1 < len(choices) < 20


@pytest.mark.parametrize("at", [0, 11])
def test_null_spaces_tell_where_rank_is_lost(at: int) -> None:
    jacobians = turning_jacobians(0)
    jacobians[at, 3] = jacobians[at, :3].sum(axis=0)
    bases, has_rank = null_spaces(jacobians, 4)
    assert np.flatnonzero(~has_rank).tolist() == [at]
    assert_close(np.delete(jacobians @ bases, at, axis=0), 0, 1e-13)


def test_null_spaces_without_rows() -> None:
    bases, has_rank = null_spaces(np.zeros((3, 0, 2)), 0)
    assert has_rank.all()
    np.testing.assert_array_equal(bases, np.tile(np.eye(2), (3, 1, 1)))
