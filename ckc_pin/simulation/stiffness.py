"""What method "auto" takes where damping or a controller may make the motion stiff, by the eigenvalues.

A mode that dies many times over within the run has to be resolved only until it is dead, but binds an
explicit method to its time constant for the whole of it.
"""

from __future__ import annotations

import numpy as np

from ckc_pin.mechanism.tree import Array

__all__ = ["bdf_rtol", "choose"]

DEATHS = 100  # time constants within the run
APART = 30  # the ratio of rates from which the motion is slow beside the mode
QUIET = 1000  # time constants of the slowest mode within the run: it is over, and the rest is rest
RINGING = 10  # |imaginary / real part| from which a mode is an oscillation that has to be resolved


def choose(jacobian: Array, t_end: float, held: int = 0) -> str:
    """Return the name of a SciPy method.

    Parameters
    ----------
    jacobian : (k, k) array
        Of the right-hand side, 1/s.
    t_end : float
        How long the run goes on, s.
    held : int
        Eigenvalues that are zero because a closure holds their directions; left out.

    Returns
    -------
    str
        "DOP853"; "BDF" for modes that decay; "Radau" for those that ring while they decay, on which BDF's
        higher orders are not stable.
    """
    modes = np.linalg.eigvals(jacobian)
    modes = modes[np.argsort(np.abs(modes))[held:]]
    decays = -modes.real * t_end
    fast = modes[np.argmax(decays)]
    apart = abs(fast) >= APART * np.abs(modes).min()
    if decays.max() < DEATHS or not (apart or decays.min() > QUIET) or abs(fast.imag) > RINGING * abs(fast.real):
        return "DOP853"
    return "BDF" if abs(fast.imag) <= abs(fast.real) else "Radau"


def bdf_rtol(rtol: float, held: int = 0) -> float:
    """Tolerance of BDF's local errors for which the error along a run is about rtol.

    Local errors of tolerance tol at order 5 mean steps as tol^(1/6), so errors as tol^(5/6). The factors were
    measured on the tracking of eq. 21: 7e-7 at 1e-6, 8e-10 at 1e-9. Of directions that a closure holds the errors
    are controlled too, though closing takes them away: there the same steps may be had for a larger tolerance.
    """
    return max((6.0 if held else 2.3) * rtol**1.2, 100 * float(np.finfo(float).eps))
