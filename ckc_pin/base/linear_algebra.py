"""Factorizations of small dense matrices: LU by eigenpy, which Pinocchio brings along, QR by NumPy.

SciPy's `linalg` takes 0.3 s to import, more than Pinocchio itself, and `numpy.linalg.solve` is ten times
slower for a 4 x 4 matrix than a factorization that is kept.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from threading import Lock
from typing import Any

import eigenpy
import numpy as np

from ckc_pin.base.arrays import Array, IntArray

__all__ = ["Factorization", "null_space", "one_blas_thread", "pivoted_columns"]

TIED = 1e-8  # of a pivot: less than that apart, rounding would choose, on each machine another
SCIPY = "scipy.linalg"  # loaded by who needs it, with a BLAS of its own


class _OneThread:
    """How many `with` blocks keep BLAS on one thread, in all of Python's threads, and what it had before them."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.blocks = 0
        self.libraries: Any = None
        self.of_scipy = False  # whether SciPy's own BLAS is one of them
        self.before: list[int] = []

    def enter(self) -> None:
        with self.lock:
            if not self.blocks and (self.libraries is None or (SCIPY in sys.modules and not self.of_scipy)):
                from threadpoolctl import ThreadpoolController

                self.libraries = ThreadpoolController().select(user_api="blas").lib_controllers
                self.of_scipy = SCIPY in sys.modules
            if not self.blocks:  # threadpoolctl's own `limit` asks for much else: 60 us
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
def one_blas_thread(*, with_scipy: bool = False) -> Iterator[None]:
    """Keep BLAS on one thread within a `with` block.

    A mechanism's matrices are small: threads cost more than they give, and with the cores busy the
    factorization of a 200 x 200 matrix took 0.9 s instead of 4 ms.

    Parameters
    ----------
    with_scipy : bool
        Import `scipy.linalg` first, for a block that calls it. SciPy has a BLAS of its own, which cannot be limited
        before it is loaded.
    """
    if with_scipy:
        import_module(SCIPY)
    _one_thread.enter()
    try:
        yield
    finally:
        _one_thread.leave()


class Factorization:
    """LU of a square matrix, QR of a tall one, with solves by either.

    A tall matrix is what redundant loops give: its least-squares solution is the exact one where the
    right-hand side is consistent, as it is for every motion that the loops allow.

    Parameters
    ----------
    matrix : (m, k) array, m >= k
        Finite entries; full column rank unless `singular` says otherwise.
    """

    __slots__ = ("_lu", "_lu_transposed", "_matrix", "_q", "shape", "singular")

    def __init__(self, matrix: Array) -> None:
        self.shape = matrix.shape
        if matrix.shape[0] == matrix.shape[1]:
            self._q, self._matrix = None, matrix
        else:
            self._q, self._matrix = np.linalg.qr(matrix)
        self._lu = eigenpy.PartialPivLU(self._matrix)  # of a triangle it is the triangle
        self._lu_transposed: Any = None
        self.singular = not bool(np.all(np.diagonal(self._lu.matrixLU())))

    def solve(self, right: Array) -> Array:
        """Solve A x = right (least squares when tall), right of shape (m,) or (m, p)."""
        if right.ndim == 2:
            return _by_columns(self.solve, right, self.shape[1])
        if self.shape[1] == 0:
            return np.zeros(0)
        return np.ravel(self._lu.solve(right if self._q is None else self._q.T @ right))  # eigenpy makes (1, 1) of one

    def solve_transposed(self, right: Array) -> Array:
        """Solve A^T x = right (minimum norm when tall), right of shape (k,) or (k, p)."""
        if right.ndim == 2:
            return _by_columns(self.solve_transposed, right, self.shape[0])
        if self.shape[1] == 0:
            return np.zeros(self.shape[0])
        if self._lu_transposed is None:
            self._lu_transposed = eigenpy.PartialPivLU(self._matrix.T)
        x = np.ravel(self._lu_transposed.solve(right))
        return x if self._q is None else np.asarray(self._q @ x)

    def determinant(self) -> float:
        """Return the determinant; a tall matrix has none (ValueError)."""
        if self._q is not None:
            raise ValueError("a tall matrix has no determinant")
        return float(self._lu.determinant()) if self.shape[0] else 1.0


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
    n = jacobian.shape[1]
    tangent, particular = np.zeros((n, n - rank)), np.zeros((n, *residual.shape[1:]))
    order, pivots = pivoted_columns(jacobian)
    order, left_over, pivots = order[:rank], order[rank:], pivots[:rank]
    tangent[left_over] = np.eye(n - rank)
    if rank and pivots[-1] > 0:
        basis = Factorization(jacobian[:, order])
        tangent[order] = -basis.solve(jacobian[:, left_over])
        particular[order] = -basis.solve(residual)
    return tangent, particular, pivots


def pivoted_columns(matrix: Array) -> tuple[IntArray, Array]:
    """Order columns as a pivoted QR does: next is the one of which most is left beside those before it.

    Of several that are as large, but for rounding, the first.

    Parameters
    ----------
    matrix : (m, n) array

    Returns
    -------
    order : (n,) int array
    pivots : (min(m, n),) array
        What is left of each, falling but for rounding: the sizes of R's diagonal.
    """
    left = matrix.copy()
    order = np.arange(matrix.shape[1])
    pivots = np.zeros(min(matrix.shape))
    for k in range(len(pivots)):
        sizes = np.linalg.norm(left[:, order[k:]], axis=0)
        largest = sizes.max()
        if not largest > 0:
            break
        best = int(np.argmax(sizes > (1 - TIED) * largest))
        order[[k, k + best]] = order[[k + best, k]]
        pivots[k] = sizes[best]
        direction = left[:, order[k]] / sizes[best]
        rest = order[k + 1 :]
        left[:, rest] -= np.outer(direction, direction @ left[:, rest])
    return order, pivots
