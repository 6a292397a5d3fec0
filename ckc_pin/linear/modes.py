"""Eigenvalues and modes of linear models, with exact zeros and real mode shapes where they exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns

__all__ = ["MIN_DAMPING_RATIO", "ComplexArray", "Mode", "compute_eigenvalues", "compute_modes", "select_modes"]

ComplexArray = NDArray[np.complex128]

MIN_DAMPING_RATIO = 1e-12  # smaller damping ratios are printed as zero
ENTRY_ROUNDING = 64 * np.finfo(float).eps  # relative rounding error of an entry of A
ZERO_TOLERANCE = ENTRY_ROUNDING ** (1 / 3)  # relative size that rounding gives to a triple zero eigenvalue
REAL_PART_TOLERANCE = 1e-14  # relative to |eigenvalue|; smaller real parts are rounding
EQUAL_TOLERANCE = 1e-8  # relative distance below which eigenvalues are equal
SHAPE_RANK_TOLERANCE = 1e-5  # relative to the largest singular value of mode shapes
RIGID_RANK_TOLERANCE = 1e-9  # relative to the largest singular value of A, whose rows are normalized


@dataclass(frozen=True, eq=False)
class Mode:
    """A mode of a linear model: a real eigenvalue or a pair of complex conjugate ones.

    Attributes
    ----------
    eigenvalue : complex
        1/s. Of a pair, the one with positive imaginary part. Exactly zero if it is zero up to rounding.
    frequency : float
        Undamped natural frequency of a pair, |eigenvalue| / (2 pi), Hz; 0 for a real eigenvalue.
    damping_ratio : float
        -Re / |eigenvalue|; NaN for the eigenvalue zero.
    shape : (n,) complex array
        Mode shape in coordinates of the tree. The largest component is 1 rad, or the mechanism's size for a sliding
        joint. Equal eigenvalues have a basis of their eigenspace, which is real if possible.
    """

    eigenvalue: complex
    frequency: float
    damping_ratio: float
    shape: ComplexArray

    @property
    def description(self) -> str:
        """Frequency and damping ratio of a pair, or the real eigenvalue."""
        if not self.eigenvalue:
            return "rigid, 0 1/s"
        if not self.frequency:
            return f"{self.eigenvalue.real + 0.0:.6g} 1/s"
        ratio = 0.0 if abs(self.damping_ratio) < MIN_DAMPING_RATIO else self.damping_ratio
        return f"{self.frequency:.4g} Hz, damping ratio {ratio:.3g}"


def compute_eigenvalues(A: Array, units: Array | None = None) -> ComplexArray:
    """Return the eigenvalues of a matrix, by decreasing real part and with conjugates side by side.

    Parameters
    ----------
    A : (2 d, 2 d) array
    units : (d,) array, optional
        Scale of each coordinate: 1 rad, or the mechanism's size.

    Returns
    -------
    (2 d,) complex array
        Eigenvalues and real parts that are zero up to rounding are exactly zero.
    """
    values, _ = _decompose(A, units)
    values.real[np.abs(values.real) <= REAL_PART_TOLERANCE * np.abs(values)] = 0.0
    return values[np.lexsort((-values.imag, np.round(np.abs(values.imag), 9), -np.round(values.real, 9)))]


def compute_modes(A: Array, motions: Array, units: Array, step_scale: Array) -> tuple[Mode, ...]:
    """Return the modes of a linear model, by increasing |eigenvalue|.

    Parameters
    ----------
    A : (2 d, 2 d) array
    motions : (n, d) array
        Velocity of the tree for a unit rate of each coordinate of the state.
    units : (d,) array
        Scale of each coordinate of the state: 1 rad, or the mechanism's size.
    step_scale : (n,) array
        The same for each coordinate of the tree.
    """
    values, vectors = _decompose(A, units)
    order = [int(k) for k in np.argsort(np.abs(values), kind="stable") if values[k].imag >= 0]
    d, modes = len(A) // 2, list[Mode]()
    while order:
        first = values[order[0]]
        equal = [k for k in order if abs(values[k] - first) <= EQUAL_TOLERANCE * abs(first)]
        order = [k for k in order if k not in equal]
        shapes = (motions @ (vectors[:d, equal] if first else _find_rigid_motions(A, units))) / step_scale[:, None]
        if len(equal) > 1:
            shapes = _find_real_basis(shapes)
        for place, k in enumerate(equal):
            # The double zero of a rigid motion, for position and rate, has one shape.
            shape = shapes[:, place * shapes.shape[1] // len(equal)]
            largest = shape[int(np.argmax(np.abs(shape) > (1 - EQUAL_TOLERANCE) * np.abs(shape).max()))]
            modes.append(
                _create_mode(complex(values[k]), shape / largest * step_scale if largest else shape * step_scale)
            )
    return tuple(modes)


def select_modes(modes: tuple[Mode, ...], max_count: int) -> list[int]:
    """Return the indices of the modes to show first: oscillations, then decays and growths, then rigid motions.

    The selected indices are in increasing order.
    """
    rank = sorted(range(len(modes)), key=lambda k: (not modes[k].frequency, not modes[k].eigenvalue))
    return sorted(rank[:max_count])


def _create_mode(value: complex, shape: ComplexArray) -> Mode:
    size = abs(value)
    frequency = size / (2 * np.pi) if value.imag > 0 else 0.0
    return Mode(value, frequency, -value.real / size if size else float("nan"), shape)


def _decompose(A: Array, units: Array | None) -> tuple[ComplexArray, ComplexArray]:
    """Return eigenvalues and right eigenvectors, with eigenvalues that are zero up to rounding set to zero.

    An eigenvalue is zero if rounding errors in the rows of A can move it to zero, to first order.
    """
    import scipy.linalg

    scale = np.ones(len(A)) if units is None else np.tile(units, 2)
    values, left_vectors, right_vectors = scipy.linalg.eig(A * scale / scale[:, None], left=True, right=True)
    row_sizes = np.maximum(np.abs(A * scale / scale[:, None]).max(axis=1, initial=0.0), 1.0)
    rounding = ENTRY_ROUNDING * (np.abs(left_vectors).T @ row_sizes) * np.abs(right_vectors).sum(axis=0)
    sizes = np.abs(values)
    small = sizes <= ZERO_TOLERANCE * max(float(sizes.max(initial=0.0)), 1.0)
    values[small & (sizes * np.abs(np.sum(left_vectors.conj() * right_vectors, axis=0)) <= rounding)] = 0.0
    return values, scale[:, None] * right_vectors


def _find_rigid_motions(A: Array, units: Array) -> ComplexArray:
    """Return a basis of displacements that change no rate, (d, r), with at least one column."""
    scale, d = np.tile(units, 2), len(units)
    scaled = A * scale / scale[:, None]
    _, values, directions = np.linalg.svd(scaled / np.maximum(np.abs(scaled).max(axis=1, keepdims=True), 1.0))
    rank = min(int(np.sum(values > RIGID_RANK_TOLERANCE * values[0])), len(A) - 1)
    return (scale[:, None] * directions[rank:].T)[:d].astype(complex)


def _find_real_basis(shapes: ComplexArray) -> ComplexArray:
    """Return a real basis of the span of mode shapes, or the shapes themselves if there is no real basis.

    Each basis vector is the only one that moves one of the pivot coordinates.
    """
    parts = np.hstack([shapes.real, shapes.imag]) / np.linalg.norm(shapes)
    basis, values, _ = np.linalg.svd(parts, full_matrices=False)
    rank = int(np.sum(values > SHAPE_RANK_TOLERANCE * values[0]))
    if rank > shapes.shape[1]:
        return shapes
    pivots: IntArray = np.sort(pivoted_columns(basis[:, :rank].T)[0][:rank])
    return (basis[:, :rank] @ np.linalg.inv(basis[pivots, :rank])).astype(complex)
