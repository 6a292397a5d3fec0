"""The tree's coordinates as symbols, with the cosines and sines of the angles among them as symbols of their own.

Who calls the code computes those once for all of its functions, several at a time; derivatives by q' count them as the
functions of q' that they are.
"""

from __future__ import annotations

from typing import Any

__all__ = ["Angles"]


class Angles:
    """q' (nq), and cosine and sine of each of its numbers (nq each), of which only those of angles are ever used.

    Parameters
    ----------
    nq : int

    Attributes
    ----------
    q, trig : casadi.SX of nq and 2 nq
        The latter are the cosines, then the sines.
    """

    def __init__(self, nq: int) -> None:
        import casadi as cs

        self.q, self.trig = cs.SX.sym("q", nq), cs.SX.sym("trig", 2 * nq)
        self._cosines, self._sines = self.trig[:nq], self.trig[nq:]

    def turn(self, at: int) -> tuple[Any, Any]:
        """Return cosine and sine of the number at a place of q'."""
        return self._cosines[at], self._sines[at]

    def jacobian(self, x: Any) -> Any:
        """Return d x / d q'."""
        import casadi as cs

        direct, by_cosine, by_sine = (cs.jacobian(x, of) for of in (self.q, self._cosines, self._sines))
        return direct - cs.mtimes(by_cosine, cs.diag(self._sines)) + cs.mtimes(by_sine, cs.diag(self._cosines))

    def along(self, x: Any, q_dot: Any) -> Any:
        """Return the rate of x while q' moves with q_dot."""
        import casadi as cs

        rates = cs.vertcat(q_dot, -self._sines * q_dot, self._cosines * q_dot)
        return cs.jtimes(x, cs.vertcat(self.q, self.trig), rates)

    def in_q(self, x: Any) -> Any:
        """Return x as a function of q' alone."""
        import casadi as cs

        return cs.substitute(x, self.trig, cs.vertcat(cs.cos(self.q), cs.sin(self.q)))
