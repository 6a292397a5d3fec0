"""The factorization of the loops' matrices, against NumPy's."""

import numpy as np
import pytest

from ckc_pin.native import _core


def random_pattern(rng, rows, columns, width):
    """Return rows of a band whose columns are shuffled, as chains of loops have them, and some rows across all."""
    order = rng.permutation(columns)
    pattern = []
    for i in range(rows):
        first = min(max(int(i * columns / rows) - width // 2, 0), columns - width)
        band = order[first : first + width]
        pattern.append(sorted({int(order[i * columns // rows]), *map(int, band[rng.random(width) < 0.6])}))
    for i in rng.integers(0, rows, 2):
        pattern[i] = sorted({*pattern[i], *map(int, rng.integers(0, columns, 3))})
    return pattern


def random_matrix(rng, pattern, columns):
    """Return a matrix whose entries in the pattern have very different sizes, so that rows are exchanged."""
    a = np.zeros((len(pattern), columns))
    for i, places in enumerate(pattern):
        a[i, places] = rng.normal(size=len(places)) * 10.0 ** rng.uniform(-3, 0, len(places))
    return a


@pytest.mark.parametrize("size", [1, 2, 6, 7, 12, 40, 150])
def test_solutions_are_numpys(size):
    """The same factorization is used again, with other fill-in each time."""
    rng = np.random.default_rng(size)
    for _ in range(5):
        pattern = random_pattern(rng, size, size, min(size, 5))
        factor = _core.Factor(size, size, pattern)
        for _ in range(8):
            a, b = random_matrix(rng, pattern, size), rng.normal(size=size)
            x, ratio = factor.solve(a, b)
            assert not factor.singular
            assert 0.0 < ratio <= 1.0
            bound = 1e-13 * np.linalg.cond(a) * np.abs(x).max()
            assert np.abs(x - np.linalg.solve(a, b)).max() <= bound
            assert np.abs(a @ x - b).max() <= 1e-13 * (np.abs(a) @ np.abs(x)).max()


@pytest.mark.parametrize("size", [3, 9, 30])
def test_singular_matrices_are_seen(size):
    """A column without entries, a row without entries, and two equal rows."""
    rng = np.random.default_rng(size)
    full = [list(range(size))] * size
    a = rng.integers(-3, 4, (size, size)).astype(float) + 10 * np.eye(size)
    without_column = [[j for j in row if j != 1] for row in full]
    no_column, no_row, equal = a.copy(), a.copy(), a.copy()
    no_column[:, 1] = 0.0
    no_row[1] = 0.0
    equal[0] = equal[1]
    without_row = [full[0], [], *full[2:]]
    for pattern, matrix in (
        (full, no_column), (without_column, no_column), (full, no_row), (without_row, no_row), (full, equal),
    ):  # fmt: skip
        factor = _core.Factor(size, size, pattern)
        _, ratio = factor.solve(matrix, np.ones(size))
        assert factor.singular or matrix is equal  # where rounding may leave a pivot
        assert ratio < 1e-15


@pytest.mark.parametrize(("rows", "columns"), [(3, 2), (12, 7)])
def test_tall_matrices_are_solved_in_the_least_squares_sense(rows, columns):
    rng = np.random.default_rng(rows)
    a, b = rng.normal(size=(rows, columns)), rng.normal(size=rows)
    x, _ = _core.Factor(rows, columns, [list(range(columns))] * rows).solve(a, b)
    assert np.abs(x - np.linalg.lstsq(a, b, rcond=None)[0]).max() < 1e-13
