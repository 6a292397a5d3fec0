"""Eigenvalues and modes of a linear model: zeros are exact, and shapes real where they can be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns

__all__ = ["NO_DAMPING", "ComplexArray", "Mode", "eigenvalues_of", "modes_of", "telling"]

ComplexArray = NDArray[np.complex128]

NO_DAMPING = 1e-12  # a damping ratio as small as that is printed as none
SLACK = 64 * np.finfo(float).eps  # roundings in an entry of A
BLOCK = SLACK ** (1 / 3)  # of its size: what these make of a triple zero, and more than they do of a double one
NEITHER = 1e-14  # of an eigenvalue's size: a real part that is rounding
EQUAL = 1e-8  # of their size: eigenvalues no further from each other are one
REAL = 1e-5  # of the size of shapes: what is left of them beside real ones is rounding
FLAT = 1e-9  # of the largest singular value of A, by rows: motions that nothing brings back


@dataclass(frozen=True, eq=False)
class Mode:
    """One real eigenvalue, or a pair of conjugate ones.

    Attributes
    ----------
    eigenvalue : complex
        1/s; of a pair the one above the real axis. Zero, exactly, where it is but for rounding.
    frequency : float
        Of a pair without its damping, |eigenvalue| / (2 pi), Hz; 0 of a real one.
    damping_ratio : float
        -Re / |eigenvalue|; NaN at zero.
    shape : (n,) complex array
        How the tree's coordinates move, the largest part one (in radians, or in the mechanism's size). Of eigenvalues
        that are equal a basis of their shapes, a real one where there is.
    """

    eigenvalue: complex
    frequency: float
    damping_ratio: float
    shape: ComplexArray

    @property
    def says(self) -> str:
        """Frequency and damping ratio of a pair, or the eigenvalue, in words."""
        if not self.eigenvalue:
            return "rigid, 0 1/s"
        if not self.frequency:
            return f"{self.eigenvalue.real + 0.0:.6g} 1/s"
        ratio = 0.0 if abs(self.damping_ratio) < NO_DAMPING else self.damping_ratio
        return f"{self.frequency:.4g} Hz, damping ratio {ratio:.3g}"


def eigenvalues_of(A: Array, units: Array | None = None) -> ComplexArray:
    """Return a matrix's eigenvalues by falling real parts, conjugate ones side by side; what is zero is so exactly."""
    values, _ = _decomposed(A, units)
    values.real[np.abs(values.real) <= NEITHER * np.abs(values)] = 0.0
    return values[np.lexsort((-values.imag, np.round(np.abs(values.imag), 9), -np.round(values.real, 9)))]


def modes_of(A: Array, motions: Array, units: Array, reach: Array) -> tuple[Mode, ...]:
    """Return the modes of a linear model, in rising order of |eigenvalue|.

    Parameters
    ----------
    A : (2 d, 2 d) array
    motions : (n, d) array
        What each coordinate of the states moves of the tree.
    units : (d,) array
        What those coordinates are measured in, one radian or the mechanism's size.
    reach : (n,) array
        The same by coordinate of the tree.
    """
    values, vectors = _decomposed(A, units)
    order = [int(k) for k in np.argsort(np.abs(values), kind="stable") if values[k].imag >= 0]
    d, found = len(A) // 2, list[Mode]()
    while order:
        first = values[order[0]]
        alike = [k for k in order if abs(values[k] - first) <= EQUAL * abs(first)]
        order = [k for k in order if k not in alike]
        shapes = (motions @ (vectors[:d, alike] if first else _at_rest(A, units))) / reach[:, None]
        if len(alike) > 1:
            shapes = _real(shapes)
        for place, k in enumerate(alike):  # a double zero, of place and rate, has one shape
            shape = shapes[:, place * shapes.shape[1] // len(alike)]
            largest = shape[int(np.argmax(np.abs(shape) > (1 - EQUAL) * np.abs(shape).max()))]
            found.append(_mode(complex(values[k]), shape / largest * reach if largest else shape * reach))
    return tuple(found)


def telling(modes: tuple[Mode, ...], most: int) -> list[int]:
    """Return which modes say most of a mechanism, in their order: those that swing, then decays, then rigid motions."""
    rank = sorted(range(len(modes)), key=lambda k: (not modes[k].frequency, not modes[k].eigenvalue))
    return sorted(rank[:most])


def _mode(value: complex, shape: ComplexArray) -> Mode:
    size = abs(value)
    frequency = size / (2 * np.pi) if value.imag > 0 else 0.0
    return Mode(value, frequency, -value.real / size if size else float("nan"), shape)


def _decomposed(A: Array, units: Array | None) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues and vectors; zero is what rounding in the rows of A may have made of zero, to first order."""
    import scipy.linalg

    scale = np.ones(len(A)) if units is None else np.tile(units, 2)
    values, left, right = scipy.linalg.eig(A * scale / scale[:, None], left=True, right=True)
    rows = np.maximum(np.abs(A * scale / scale[:, None]).max(axis=1, initial=0.0), 1.0)
    off = SLACK * (np.abs(left).T @ rows) * np.abs(right).sum(axis=0)
    sizes = np.abs(values)
    small = sizes <= BLOCK * max(float(sizes.max(initial=0.0)), 1.0)
    values[small & (sizes * np.abs(np.sum(left.conj() * right, axis=0)) <= off)] = 0.0
    return values, scale[:, None] * right


def _at_rest(A: Array, units: Array) -> ComplexArray:
    """Basis of the changes of place that leave every rate as it is, (d, r); a single one where rounding hides them."""
    scale, d = np.tile(units, 2), len(units)
    scaled = A * scale / scale[:, None]
    _, values, directions = np.linalg.svd(scaled / np.maximum(np.abs(scaled).max(axis=1, keepdims=True), 1.0))
    rank = min(int(np.sum(values > FLAT * values[0])), len(A) - 1)
    return (scale[:, None] * directions[rank:].T)[:d].astype(complex)


def _real(shapes: ComplexArray) -> ComplexArray:
    """Return a real basis of what shapes span, each alone in one coordinate; themselves where there is none."""
    parts = np.hstack([shapes.real, shapes.imag]) / np.linalg.norm(shapes)
    basis, values, _ = np.linalg.svd(parts, full_matrices=False)
    rank = int(np.sum(values > REAL * values[0]))
    if rank > shapes.shape[1]:
        return shapes
    order: IntArray = np.sort(pivoted_columns(basis[:, :rank].T)[0][:rank])
    return (basis[:, :rank] @ np.linalg.inv(basis[order, :rank])).astype(complex)
