"""Stability of a closed loop: the result, its description and its warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Row, Summary, format_eigenvalues, to_pairs

__all__ = ["Stability", "compute_time_constant"]

DECAY_TOLERANCE = 1e-9  # relative to the fastest eigenvalue; slower decays count as none
MIN_REPORTED_OFFSET = 1e-6  # rad or m


@dataclass(frozen=True, repr=False)
class Stability(HasSummary):
    """Stability of a closed loop, from its exact linearization at a target or along a desired motion.

    Attributes
    ----------
    stable : bool or None
        None if the stability is unknown. Other attributes that are unknown are None, too.
    reason : str or None
        Why the stability is unknown.
    eigenvalues : (2 d,) complex array or None
        Of the closed loop at the target, 1/s, by decreasing real part. Of tracking, at the start of the motion; they
        do not determine the stability of the motion.
    least_K_P : (d, d) array or None
        Set point: the smallest multiple of K_P with K_P + dh/dq positive definite, above which eq. 14 is stable. Zero
        if the loop is stable without K_P. None if the loop does not come to rest at its target, because the position
        of rest then depends on K_P.
    least_eigenvalue : float or None
        Set point: smallest eigenvalue of K_P + dh/dq, N m/rad, the stiffness in the weakest direction.
    offset : (d,) array or None
        Set point: position of rest minus target, rad or m. It is not zero if the controller compensates the h of
        another model. Tracking: largest error of a run that starts on the desired motion, caused by sampling, delay,
        friction or another model.
    slowest : float or None
        Time constant of the slowest decay, s; infinite without decay. Of tracking, over the whole motion.
    growth, largest_growth : float or None
        Tracking: factor by which the variational equation multiplies the worst initial error until the end of the
        motion, and at most during the motion. Errors are measured by the square root of eq. 18's function.
    sampled : bool
        Whether stability, `slowest` and `growth` are those of the loop with its sampling and delay.
    multiplier : float or None
        Set point with sampling: largest factor of an error from one sample to the next, including the delay.
    leaves_out : tuple of str
        Parts of the scene that the linear model ignores: "sensor and drive", "torque limits", "stops", "dry friction".
    """

    stable: bool | None
    reason: str | None = None
    eigenvalues: NDArray[np.complex128] | None = None
    least_K_P: Array | None = None
    least_eigenvalue: float | None = None
    offset: Array | None = None
    slowest: float | None = None
    growth: float | None = None
    largest_growth: float | None = None
    sampled: bool = False
    multiplier: float | None = None
    leaves_out: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON-ready data (docs/reference/json.md)."""
        return {
            **vars(self),
            "eigenvalues": None if self.eigenvalues is None else to_pairs(self.eigenvalues),
            "least_K_P": None if self.least_K_P is None else self.least_K_P.tolist(),
            "offset": None if self.offset is None else self.offset.tolist(),
        }

    def summary(self) -> Summary:
        """Return stability and eigenvalues, as `repr` and a notebook show them."""
        rows: list[Row] = [("closed loop", self.describe())]
        if self.least_K_P is not None:
            rows.append(("least K_P", _format_gain(self.least_K_P)))
        if self.least_eigenvalue is not None:
            rows.append(("stiffness", f"{self.least_eigenvalue:.4g} N m/rad in the weakest direction"))
        return Summary("Stability", rows)

    def describe(self) -> str:
        """Return one line: whether the closed loop is stable, how fast errors decay, and its eigenvalues."""
        if self.stable is None:
            return f"stability unknown: {self.reason}"
        verdict = "stable" if self.stable else "UNSTABLE"
        undamped = self.eigenvalues is not None and not self.eigenvalues[0].real
        if undamped and not (self.stable or self.sampled or self.growth is not None):
            verdict = "not asymptotically stable, without damping,"
        if self.leaves_out:
            verdict += f", {' and '.join(self.leaves_out)} left out,"
        as_sampled = " as sampled" if self.sampled else ""
        eigenvalues = format_eigenvalues(self.eigenvalues)
        if self.growth is not None and self.largest_growth is not None and self.offset is not None:
            offset = float(self.offset.max())
            off = ""
            if self.stable and offset > MIN_REPORTED_OFFSET:
                off = f", a run deviates from it by up to {offset:.2g} rad or m"
            return (
                f"{verdict} along the motion{as_sampled}: errors grow to {_format_factor(self.largest_growth)} at "
                f"most, to {_format_factor(self.growth)} at its end{off}; eigenvalues at its start {eigenvalues} 1/s"
            )
        if self.multiplier is not None:
            verdict += f"{as_sampled}, factor {self.multiplier:.6g} a sample,"
        slowest = "" if self.slowest is None or np.isinf(self.slowest) else f", slowest decay {self.slowest:.3g} s"
        where = "where it comes to rest" if self.least_K_P is None else "at its target"
        return f"{verdict} {where}{slowest}: eigenvalues {eigenvalues} 1/s"

    def list_warnings(self, independent: Sequence[str]) -> list[str]:
        """Return warnings of an unstable loop, of unknown stability and of rest away from the target.

        Parameters
        ----------
        independent : sequence of str
            Names of the independent coordinates, in the order of `least_K_P` and `offset`.
        """
        if self.stable:
            return self._warn_of_offset(independent)
        if self.stable is None:
            return [f"the stability of the closed loop is unknown: {self.reason}"]
        if self.growth is not None:
            along = "along the desired motion" + (" as sampled" if self.sampled else "")
            remedy = (
                "sample more often, reduce the delay, or choose other gains"
                if self.sampled
                else "increase Lambda and K_D"
            )
            return [
                f"the closed loop is unstable {along}: an error may be {_format_factor(self.growth)} as large at its "
                f"end; {remedy}"
            ]
        assert self.eigenvalues is not None
        assert self.least_eigenvalue is not None
        rightmost = float(self.eigenvalues[0].real)
        if self.least_eigenvalue <= 0:
            remedy = ""
            if self.least_K_P is not None:
                remedy = f"; the least K_P in its proportions is {_format_gain(self.least_K_P, independent)}"
            return [
                f"the closed loop is unstable at its target: eigenvalue {rightmost:.3g} 1/s, and K_P + dh/dq has the "
                f"eigenvalue {self.least_eigenvalue:.4g}{remedy}"
            ]
        if self.multiplier is not None and rightmost < -DECAY_TOLERANCE * np.abs(self.eigenvalues).max():
            return [
                f"the closed loop is unstable as sampled: errors grow by a factor of {self.multiplier:.6g} a sample. "
                "Without sampling and delay they would decay; sample more often, reduce the delay, or reduce the gains"
            ]
        return [
            "the closed loop does not come to rest at its target: an oscillation about it is damped neither by K_V nor "
            "by the joints; give K_V, or increase it"
        ]

    def _warn_of_offset(self, independent: Sequence[str]) -> list[str]:
        if self.offset is None or self.least_K_P is not None or self.growth is not None:
            return []
        offsets = ", ".join(f"{name} {x:+.4g}" for name, x in zip(independent, self.offset, strict=True))
        return [
            f"the closed loop comes to rest off its target ({offsets}): the controller's model has another h there "
            "than the mechanism"
        ]


def compute_time_constant(rate: float) -> float:
    """Return the time in which ``exp(rate t)`` falls to 1/e, s; infinite without decay."""
    return -1.0 / rate if rate < 0 else float("inf")


def _format_factor(growth: float) -> str:
    return f"{growth:.3g} times" if np.isfinite(growth) else "more than 1e308 times"


def _format_gain(K_P: Array, names: Sequence[str] = ()) -> str:
    """Return a multiple of the identity as a number, a diagonal matrix by name, and others as a nested list."""
    diagonal = np.diagonal(K_P)
    if np.array_equal(K_P, diagonal[0] * np.eye(len(K_P))):
        return f"{diagonal[0]:.6g}"
    if names and np.array_equal(K_P, np.diag(diagonal)):
        return ", ".join(f"{name} = {x:.6g}" for name, x in zip(names, diagonal, strict=True))
    return str(np.round(K_P, 4).tolist())
