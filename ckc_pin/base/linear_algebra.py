"""Factorizations of small dense matrices, null spaces, pivoted column selection, and BLAS on one thread.

LU comes from eigenpy, which Pinocchio depends on, and QR from NumPy. Importing `scipy.linalg` would take 0.3 s, longer
than Pinocchio itself. For a 4 x 4 matrix `numpy.linalg.solve` takes ten times as long as a stored factorization.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from threading import Lock
from typing import Any

import eigenpy
import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.sparse import determinant, is_large_and_sparse, sparse_lu

__all__ = [
    "MIN_PIVOT",
    "Factorization",
    "null_space",
    "null_spaces",
    "one_blas_thread",
    "pivoted_columns",
    "remove_direction",
]

TIE_TOLERANCE = 1e-8  # relative: of pivots closer than this the first is taken, since rounding differs by machine
MIN_PIVOT = 1e-12  # of the largest pivot of a Jacobian: below it the Jacobian has lost rank
SHARED_PIVOT_RATIO = 0.1  # of the smallest pivot of the matrix whose choice of columns other matrices share
MAX_SHARED_ENTRY = 2.0  # of a basis of a null space; with a choice of its own hardly an entry is larger than 1
MIN_SPARSE_SIZE = 20_000  # entries of a matrix whose zeros are worth skipping
MIN_THREADED_SIZE = 32  # rows or columns of a matrix; OpenBLAS uses threads from 48 on, measured on two cores
SCIPY = "scipy.linalg"  # comes with a BLAS library of its own


class _OneThread:
    """Counts the `with` blocks of all Python threads that keep BLAS on one thread, and restores the previous number."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.blocks = 0
        self.libraries: Any = None
        self.includes_scipy = False  # whether SciPy's BLAS is among the libraries
        self.before: list[int] = []

    def enter(self) -> None:
        with self.lock:
            if not self.blocks and (self.libraries is None or (SCIPY in sys.modules and not self.includes_scipy)):
                from threadpoolctl import ThreadpoolController

                self.libraries = ThreadpoolController().select(user_api="blas").lib_controllers
                self.includes_scipy = SCIPY in sys.modules
            if not self.blocks:  # threadpoolctl's `limit` would query every library again, which takes 60 us
                self.before = [library.num_threads for library in self.libraries]
                for library in self.libraries:
                    library.set_num_threads(1)
            self.blocks += 1

    def leave(self) -> None:
        with self.lock:
            self.blocks -= 1
            if not self.blocks:
                for library, threads in zip(self.libraries, self.before, strict=True):
                    library.set_num_threads(threads)


_one_thread = _OneThread()


@contextmanager
def one_blas_thread(*, with_scipy: bool = False, size: float = math.inf) -> Iterator[None]:
    """Keep BLAS on one thread within a `with` block.

    The matrices of a mechanism are small, so threads cost more than they save. On a busy machine the factorization of
    a 200 x 200 matrix took 0.9 s with threads and 4 ms without.

    Parameters
    ----------
    with_scipy : bool
        Import `scipy.linalg` first, for a block that calls it. SciPy has a BLAS of its own, which cannot be limited
        before it is loaded.
    size : float
        Rows or columns of the largest matrix. For small ones BLAS takes one thread without being told, and to find its
        libraries takes longer than to assemble a small mechanism.
    """
    if size < MIN_THREADED_SIZE:
        yield
        return
    if with_scipy:
        import_module(SCIPY)
    _one_thread.enter()
    try:
        yield
    finally:
        _one_thread.leave()


class Factorization:
    """Factorization of a square matrix (LU) or a tall one (QR), stored to solve several right-hand sides.

    Redundant constraints make phi_z tall. Its least-squares solution is exact if the right-hand side is consistent,
    which it is for every motion that the loops allow.

    Parameters
    ----------
    matrix : (m, k) array, m >= k
        Finite entries.

    Attributes
    ----------
    shape : tuple of int
    singular : bool
        A pivot is exactly zero, so that the matrix cannot be solved with.
    """

    __slots__ = ("_lu", "_lu_transposed", "_matrix", "_q", "_sparse_lu", "shape", "singular")

    def __init__(self, matrix: Array) -> None:
        self.shape = matrix.shape
        if matrix.shape[0] == matrix.shape[1]:
            self._q, self._matrix = None, matrix
        else:
            self._q, self._matrix = np.linalg.qr(matrix)
        self._sparse_lu = sparse_lu(self._matrix) if is_large_and_sparse(self._matrix) else None
        if self._sparse_lu:
            self.singular = False
            return
        self._lu = eigenpy.PartialPivLU(self._matrix)  # after QR the matrix is R, whose LU factorization is R itself
        self._lu_transposed: Any = None
        self.singular = not bool(np.all(np.diagonal(self._lu.matrixLU())))

    def solve(self, right: Array) -> Array:
        """Solve A x = right, in the least-squares sense if A is tall; right has shape (m,) or (m, p)."""
        if right.ndim == 2:
            return _solve_columns(self.solve, right, self.shape[1])
        if self.shape[1] == 0:
            return np.zeros(0)
        lu = self._sparse_lu or self._lu
        return np.ravel(lu.solve(right if self._q is None else self._q.T @ right))

    def solve_transposed(self, right: Array) -> Array:
        """Solve A^T x = right, with minimum norm if A is tall; right has shape (k,) or (k, p)."""
        if right.ndim == 2:
            return _solve_columns(self.solve_transposed, right, self.shape[0])
        if self.shape[1] == 0:
            return np.zeros(self.shape[0])
        if self._sparse_lu:
            x = np.ravel(self._sparse_lu.solve(right, "T"))
        else:
            if self._lu_transposed is None:
                self._lu_transposed = eigenpy.PartialPivLU(self._matrix.T)
            x = np.ravel(self._lu_transposed.solve(right))
        return x if self._q is None else np.asarray(self._q @ x)

    def determinant(self) -> float:
        """Return the determinant (ValueError for a tall matrix)."""
        if self._q is not None:
            raise ValueError("determinant: the matrix is not square")
        if self._sparse_lu:
            return determinant(self._sparse_lu)
        return float(self._lu.determinant()) if self.shape[0] else 1.0


def _solve_columns(solve: Callable[[Array], Array], right: Array, rows: int) -> Array:
    """Solve for one column after the other.

    For several columns at once OpenBLAS starts threads whatever the size. On a busy machine that made a 2 x 2 solve
    take 3 ms instead of 0.7 us.
    """
    x = np.empty((rows, right.shape[1]))
    for k in range(right.shape[1]):
        x[:, k] = solve(right[:, k])
    return x


def null_space(jacobian: Array, rank: int, residual: Array) -> tuple[Array, Array, bool]:
    """Return a basis of the null space of J and a particular solution of J x = -residual, by a pivoted QR of J.

    The basis vectors have exact ones and zeros in the columns that the pivoting did not choose. An orthonormal basis
    would mix the rounding errors of all columns: if a light link moves far and a heavy one by 1e-4 of that, the error
    of the heavy link's part would be as large as the light link's.

    Parameters
    ----------
    jacobian : (m, n) array
    rank : int
        The rank of J, from the assembled configuration.
    residual : (m,) array, or (m, k)
        Consistent if rows of J are redundant.

    Returns
    -------
    tangent : (n, n - rank) array
        Basis of the null space; no entry is much larger than 1.
    particular : (n,) array, or (n, k)
        A solution of J x = -residual that is zero in the same columns.
    has_rank : bool
        False if the smallest pivot is at most `MIN_PIVOT` times the largest.
    """
    tangent, particular, pivots, _ = _null_space(jacobian, rank, residual)
    return tangent, particular, _has_rank(pivots)


def _has_rank(pivots: Array) -> bool:
    return not len(pivots) or bool(pivots[-1] > MIN_PIVOT * pivots[0])


def _null_space(jacobian: Array, rank: int, residual: Array) -> tuple[Array, Array, Array, IntArray]:
    """Return basis and solution of `null_space`, the pivots (rank,), decreasing, and the columns that they chose."""
    n = jacobian.shape[1]
    tangent, particular = np.zeros((n, n - rank)), np.zeros((n, *residual.shape[1:]))
    order, pivots = pivoted_columns(jacobian)
    order, remaining, pivots = order[:rank], order[rank:], pivots[:rank]
    tangent[remaining] = np.eye(n - rank)
    if rank and pivots[-1] > 0:
        basis = Factorization(jacobian[:, order])
        tangent[order] = -basis.solve(jacobian[:, remaining])
        particular[order] = -basis.solve(residual)
    return tangent, particular, pivots, order


def null_spaces(jacobians: Array, rank: int) -> tuple[Array, BoolArray]:
    """Return bases of the null spaces of Jacobians along a motion, each as `null_space` returns it.

    A choice of columns serves all matrices for which it is nearly as good as their own.

    Parameters
    ----------
    jacobians : (count, m, n) array
    rank : int

    Returns
    -------
    bases : (count, n, n - rank) array
    has_rank : (count,) array of bool
    """
    count, rows, n = jacobians.shape
    bases, has_rank, active = np.empty((count, n, n - rank)), np.ones(count, bool), np.arange(count)
    while len(active):
        first, active = active[0], active[1:]
        bases[first], _, pivots, chosen = _null_space(jacobians[first], rank, np.zeros(rows))
        has_rank[first] = _has_rank(pivots)
        if not len(active) or not has_rank[first]:
            continue
        remaining = np.setdiff1d(np.arange(n), chosen)
        q, r = np.linalg.qr(jacobians[active][:, :, chosen])
        pivot = np.abs(np.diagonal(r, axis1=1, axis2=2)).min(axis=1, initial=np.inf)
        serves = pivot > SHARED_PIVOT_RATIO * pivots.min(initial=np.inf) if rank else np.ones(len(active), bool)
        right = np.swapaxes(q[serves], 1, 2) @ jacobians[active[serves]][:, :, remaining]
        entries = -np.linalg.solve(r[serves], right)
        is_small = np.abs(entries).max(axis=(1, 2), initial=0.0) <= MAX_SHARED_ENTRY
        serves[serves] = is_small
        basis = np.zeros((int(is_small.sum()), n, n - rank))
        basis[:, chosen] = entries[is_small]
        basis[:, remaining] = np.eye(n - rank)
        bases[active[serves]], active = basis, active[~serves]
    return bases, has_rank


def pivoted_columns(matrix: Array) -> tuple[IntArray, Array]:
    """Order columns as a pivoted QR factorization does.

    The next column is the one with the largest part orthogonal to the columns before it. Of columns that are equal up
    to rounding, the first is taken, so that the order is the same on every machine.

    Parameters
    ----------
    matrix : (m, n) array

    Returns
    -------
    order : (n,) int array
    pivots : (min(m, n),) array
        Norms of the orthogonal parts, decreasing up to rounding: the absolute values of the diagonal of R.
    """
    remainder = matrix.copy()
    order = np.arange(matrix.shape[1])
    sizes = np.linalg.norm(remainder, axis=0)
    pivots = np.zeros(min(matrix.shape))
    for k in range(len(pivots)):
        left = sizes[order[k:]]
        largest = left.max()
        if not largest > 0:
            break
        best = int(np.argmax(left > (1 - TIE_TOLERANCE) * largest))
        order[[k, k + best]] = order[[k + best, k]]
        pivots[k] = left[best]
        remove_direction(remainder, remainder[:, order[k]] / left[best], order[k + 1 :], sizes)
    return order, pivots


def remove_direction(matrix: Array, direction: Array, columns: IntArray, sizes: Array) -> None:
    """Make columns orthogonal to a unit vector, and update their norms; zeros of a sparse matrix take no time.

    Parameters
    ----------
    matrix : (m, n) array, changed
    direction : (m,) array
    columns : int array
    sizes : (n,) array, changed
        Norms of all columns.
    """
    if matrix.size < MIN_SPARSE_SIZE:
        block = matrix[:, columns]
        block -= direction[:, None] * (direction @ block)
        matrix[:, columns] = block
        sizes[columns] = np.sqrt(np.einsum("ij,ij->j", block, block))
    else:
        rows = np.flatnonzero(direction)
        parts = direction[rows] @ matrix[rows]
        columns = columns[np.flatnonzero(parts[columns])]
        matrix[np.ix_(rows, columns)] -= np.outer(direction[rows], parts[columns])
        sizes[columns] = np.linalg.norm(matrix[:, columns], axis=0)
