"""Factorizations of small dense matrices, through LAPACK without the overhead of checks.

SciPy's `linalg` takes 0.3 s to import, more than Pinocchio itself, so it is loaded at first use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Factorization", "null_space", "one_blas_thread"]

Array = NDArray[np.float64]

_lapack: Any = None
_blas: Any = None


def _routines() -> Any:
    global _lapack
    if _lapack is None:
        from scipy.linalg import lapack

        _lapack = lapack
    return _lapack


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep BLAS on one thread within a `with` block.

    A mechanism's matrices are small: threads cost more than they give, and with the cores busy the
    factorization of a 200 x 200 matrix took 0.9 s instead of 4 ms.
    """
    global _blas
    if _blas is None:
        from threadpoolctl import ThreadpoolController

        _routines()  # loads the BLAS that is to be limited
        _blas = ThreadpoolController().select(user_api="blas").lib_controllers
    before = [library.num_threads for library in _blas]  # threadpoolctl's own `limit` asks for much else: 60 us
    try:
        for library in _blas:
            library.set_num_threads(1)
        yield
    finally:
        for library, threads in zip(_blas, before, strict=True):
            library.set_num_threads(threads)


class Factorization:
    """LU of a square matrix, QR of a tall one, with solves by either.

    A tall matrix is what redundant loops give: its least-squares solution is the exact one where the
    right-hand side is consistent, as it is for every motion that the loops allow.

    Parameters
    ----------
    matrix : (m, k) array, m >= k
        Finite entries; full column rank unless `singular` says otherwise.
    """

    __slots__ = ("_lu", "_pivots", "_q", "_r", "shape", "singular")

    def __init__(self, matrix: Array) -> None:
        self.shape = matrix.shape
        lapack = _routines()
        if matrix.shape[0] == matrix.shape[1]:
            self._q = None
            if matrix.shape[0]:
                self._lu, self._pivots, info = lapack.dgetrf(matrix)
            else:
                self._lu, self._pivots, info = matrix, np.zeros(0, np.int32), 0
            self.singular = info > 0
        else:
            self._q, self._r = np.linalg.qr(matrix)
            self.singular = not bool(np.all(np.diagonal(self._r)))

    def solve(self, right: Array) -> Array:
        """Solve A x = right (least squares when tall), right of shape (m,) or (m, p)."""
        if right.ndim == 2:
            return _by_columns(self.solve, right, self.shape[1])
        if self.shape[1] == 0:
            return np.zeros(0)
        if self._q is None:
            x, _ = _routines().dgetrs(self._lu, self._pivots, right)
        else:
            x, _ = _routines().dtrtrs(self._r, self._q.T @ right)
        return np.asarray(x)

    def solve_transposed(self, right: Array) -> Array:
        """Solve A^T x = right (minimum norm when tall), right of shape (k,) or (k, p)."""
        if right.ndim == 2:
            return _by_columns(self.solve_transposed, right, self.shape[0])
        if self.shape[1] == 0:
            return np.zeros(self.shape[0])
        if self._q is None:
            x, _ = _routines().dgetrs(self._lu, self._pivots, right, trans=1)
            return np.asarray(x)
        y, _ = _routines().dtrtrs(self._r, right, trans=1)
        return np.asarray(self._q @ y)

    def determinant(self) -> float:
        """Return the determinant; a tall matrix has none (ValueError)."""
        if self._q is not None:
            raise ValueError("a tall matrix has no determinant")
        swaps = int(np.sum(self._pivots != np.arange(len(self._pivots))))
        return float(np.prod(np.diagonal(self._lu))) * (-1.0) ** swaps


def _by_columns(solve: Callable[[Array], Array], right: Array, rows: int) -> Array:
    """Solve for one column at a time.

    For several at once OpenBLAS starts its threads whatever the size: with the cores busy that made a
    2 x 2 solve take 3 ms instead of 0.7 us.
    """
    x = np.empty((rows, right.shape[1]))
    for k in range(right.shape[1]):
        x[:, k] = solve(right[:, k])
    return x


def null_space(jacobian: Array, rank: int, residual: Array) -> tuple[Array, Array, Array]:
    """Split the tangent space by a pivoted QR of J: J P = Q [R S].

    The basis is that of the columns which the pivoting left over, with ones and zeros exact in their rows. An
    orthonormal one would mix the rounding of all columns: where a light link moves far and a heavy one by 1e-4 of
    that, the heavy one's part would be off by as much as the light one's.

    Parameters
    ----------
    jacobian : (m, n) array
    rank : int
        The rank of J, known from the assembled configuration.
    residual : (m,) array, or (m, k)
        With redundant rows consistent.

    Returns
    -------
    tangent : (n, n - rank) array
        Basis of the velocities that the loops allow; no entry is much larger than 1.
    particular : (n,) array, or (n, k)
        x with J x = -residual that leaves the same columns alone.
    pivots : (rank,) array
        Sizes of R's diagonal, which falls.
    """
    m, n = jacobian.shape
    tangent, particular = np.zeros((n, n - rank)), np.zeros((n, *residual.shape[1:]))
    if m == 0:
        return np.eye(n), particular, np.zeros(0)
    lapack = _routines()
    factored, order, tau, _, _ = lapack.dgeqp3(jacobian)
    order -= 1
    r = factored[:rank, :rank]
    pivots = np.abs(np.diagonal(r))
    tangent[order[rank:]] = np.eye(n - rank)
    if rank and pivots[-1] > 0:
        right = residual.reshape(m, -1)
        turned, _, _ = lapack.dormqr("L", "T", factored[:, : len(tau)], tau, right, max(1, right.shape[1]))
        tangent[order[:rank]] = -lapack.dtrtrs(r, factored[:rank, rank:])[0]
        particular[order[:rank]] = -lapack.dtrtrs(r, turned[:rank])[0].reshape(rank, *residual.shape[1:])
    return tangent, particular, pivots
