"""Large sparse matrices of full row rank: singular values, null space and minimum-norm solutions.

The time of a singular value decomposition grows as n^3. A mechanism of many loops has few entries in each row of J,
and then J J^T is banded and is factorized in a time proportional to n. It has the square of J's condition number, so
this is limited to matrices whose rank is beyond doubt.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray

__all__ = [
    "FullRowRank",
    "determinant",
    "factorize_full_row_rank",
    "is_large_and_sparse",
    "smallest_singular_value",
    "sparse_lu",
]

MIN_ROWS = 200  # smaller matrices are decomposed densely
MAX_SHARE_OF_ENTRIES = 0.1
MIN_SINGULAR_VALUE = 1e-5  # relative to the largest; A A^T keeps six digits of the smallest then
SMALLEST_TOLERANCE, LARGEST_TOLERANCE = 1e-6, 1e-3  # relative, of eigenvalues; the largest ones lie close together


class FullRowRank:
    """Factorization of A A^T of a sparse matrix A with independent rows. Use `factorize_full_row_rank` to create one.

    Attributes
    ----------
    smallest, largest : float
        Singular values of A.
    """

    def __init__(self, rows: Any, factor: Any, smallest: float, largest: float) -> None:
        self._rows = rows
        self._factor = factor
        self.smallest = smallest
        self.largest = largest

    def minimum_norm(self, right: Array) -> Array:
        """Return the x of minimum norm with A x = right; right has shape (m,) or (m, k)."""
        x = self._rows.T @ self._factor.solve(right)
        return np.asarray(x + self._rows.T @ self._factor.solve(right - self._rows @ x))  # one step of refinement

    def null_space(self) -> Array:
        """Return an orthonormal basis of the null space, shape (n, n - m)."""
        m, n = self._rows.shape
        basis = np.random.default_rng(0).normal(size=(n, n - m))
        for _ in range(2):  # the second pass removes the rounding errors of the first
            basis, _ = np.linalg.qr(basis - self.minimum_norm(self._rows @ basis))
        return basis


def is_large_and_sparse(matrix: Array) -> bool:
    """Whether sparse factorizations of a matrix cost less than dense ones."""
    return len(matrix) >= MIN_ROWS and bool(np.count_nonzero(matrix) <= MAX_SHARE_OF_ENTRIES * matrix.size)


def factorize_full_row_rank(matrix: Array) -> FullRowRank | None:
    """Factorize a large sparse matrix whose rows are independent; None if it is small, dense, or may lack rank.

    Parameters
    ----------
    matrix : (m, n) array
    """
    m, n = matrix.shape
    if m > n or not is_large_and_sparse(matrix):
        return None
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import LinearOperator, eigsh

    rows = csr_array(matrix)
    gram = (rows @ rows.T).tocsc()
    factor = sparse_lu(gram, symmetric=True)
    if factor is None:
        return None
    start = 1.0 + 0.1 * (np.arange(m) % 7)  # equal entries could be orthogonal to the vector of a symmetric mechanism
    inverse = LinearOperator((m, m), matvec=factor.solve, dtype=float)
    largest, inverse_of_smallest = (
        float(eigsh(a, k=1, which="LA", tol=tolerance, v0=start, return_eigenvectors=False)[0])
        for a, tolerance in ((gram, LARGEST_TOLERANCE), (inverse, SMALLEST_TOLERANCE))
    )
    if not inverse_of_smallest * MIN_SINGULAR_VALUE**2 * largest < 1:
        return None
    return FullRowRank(rows, factor, inverse_of_smallest**-0.5, largest**0.5)


def smallest_singular_value(matrix: Array) -> float:
    """Return the smallest singular value of a square or tall matrix, which has at least one column."""
    full = factorize_full_row_rank(matrix)
    return full.smallest if full else float(np.linalg.svd(matrix, compute_uv=False)[matrix.shape[1] - 1])


def determinant(factor: Any) -> float:
    """Return the determinant of a matrix from SuperLU's factorization P_r A P_c = L U."""
    signs = [_parity(permutation) for permutation in (factor.perm_r, factor.perm_c)]
    return float(signs[0] * signs[1] * np.prod(factor.U.diagonal()))


def _parity(permutation: IntArray) -> int:
    """Return 1 for an even permutation, -1 for an odd one."""
    remaining, sign = set(range(len(permutation))), 1
    while remaining:  # a cycle of k elements consists of k - 1 transpositions
        start = k = remaining.pop()
        while (k := int(permutation[k])) != start:
            remaining.remove(k)
            sign = -sign
    return sign


def sparse_lu(matrix: Any, *, symmetric: bool = False) -> Any:
    """Return SuperLU's factorization of a square matrix, None if a pivot is zero.

    Parameters
    ----------
    matrix : sparse array, or (n, n) array
    symmetric : bool
        The matrix is symmetric and positive definite.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    try:
        return splu(csc_array(matrix), **(options if symmetric else {}))
    except RuntimeError:  # exactly singular
        return None
