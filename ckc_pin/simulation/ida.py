"""SUNDIALS IDA on eq. 1 as Gear, Gupta and Leimkuhler stabilise it: a second opinion, with no step in common.

    q_dot = v - J^T mu
    D' v_dot + C' v + h' = u' + J^T lambda
    phi(q) = 0
    J v = 0

Nothing is differentiated twice, solved for an acceleration or projected: IDA's Newton iteration closes the loops on
both levels. mu is zero but for errors. Of redundant rows those are taken that determine the motion at the start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import qr

from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.systems import Dae

__all__ = ["Ida"]

FREE = 1e8  # absolute tolerance of mu and lambda: they are not part of the error that is controlled
MANY = 1_000_000  # of IDA's own bounds on steps


class Ida:
    """IDA with what the step loop asks of a SciPy solver.

    Parameters
    ----------
    rate : callable
        y' at (t, y), for y' at the start and at the ends of steps.
    t : float
    y : (2 n,) array
        q' and v', on the closure.
    t_bound : float
    system : Dae
    count : callable
        Called as count(t) for every residual.
    rtol, atol : float
    max_step : float
    first_step : float, optional

    Raises
    ------
    InputError
        scikit-sundae is not installed; a free root, whose rotation is no number to integrate.
    """

    nlu = 0

    def __init__(
        self,
        rate: Callable[[float, Array], Array],
        t: float,
        y: Array,
        t_bound: float,
        *,
        system: Dae,
        count: Callable[[float], None],
        rtol: float,
        atol: float,
        max_step: float = 0.0,
        first_step: float = 0.0,
    ) -> None:
        try:
            from sksundae.ida import IDA
        except ImportError:
            raise InputError(
                "solver: method IDA needs SUNDIALS: install scikit-sundae (pip install 'ckc_pin[sundials]'), "
                'or take method = "auto"'
            ) from None
        if not system.mechanism.tree.flat:
            raise InputError(
                "solver: IDA integrates coordinates as numbers, and the rotation of a free root is none; "
                'take method = "auto"'
            )
        self.system, self.count, self.rate = system, count, rate
        self.n = system.mechanism.n
        self.t_old, self.t, self.t_bound, self.status = t, t, t_bound, "running"
        self.y = y.copy()
        self.f = rate(t, y)
        self.njev = 0
        self.step_size: float | None = first_step or None
        start, slope = self._consistent(t, y)
        rank = len(self.rows)
        absolute = np.concatenate([np.full(2 * self.n, atol), np.full(2 * rank, FREE)])
        self._ida: Any = IDA(
            self._residual,
            algebraic_idx=np.arange(2 * self.n, 2 * self.n + 2 * rank),
            rtol=rtol,
            atol=absolute,
            max_step=max_step,
            first_step=first_step,
            max_num_steps=MANY,
        )
        self._ida.init_step(t, start, slope)

    def _consistent(self, t: float, y: Array) -> tuple[Array, Array]:
        """Y = (q, v, mu, lambda) and its rate at a state on the closure; chooses the rows."""
        terms = self.system.terms(t, y)
        rank = self.system.mechanism.rank
        self.rows = qr(terms.at.J.T, mode="r", pivoting=True)[1][:rank]
        u_tree = self.system.force(t, terms)
        acceleration = dae_acceleration(terms, u_tree)
        force = terms.D_tree @ acceleration - self._applied(terms, u_tree)
        multipliers = np.linalg.lstsq(terms.at.J[self.rows].T, force, rcond=None)[0]
        zero = np.zeros(rank)
        return (
            np.concatenate([y, zero, multipliers]),
            np.concatenate([y[self.n :], acceleration, zero, zero]),
        )

    def _applied(self, terms: Terms, u_tree: Array) -> Array:
        """Everything but inertia and the loops' forces, shape (n,)."""
        force = u_tree - terms.bias_tree
        return force + terms.damping_force if terms.mechanism.springs.any_damping else force

    def _residual(self, t: float, Y: Array, Y_dot: Array, residual: Array) -> None:
        self.count(t)
        n, mechanism = self.n, self.system.mechanism
        q, v = Y[:n].copy(), Y[n : 2 * n].copy()
        mu, multipliers = np.split(Y[2 * n :], 2)
        with np.errstate(all="ignore"):
            terms = Terms(mechanism, mechanism.kinematics(q), v)
            J = terms.at.J[self.rows]
            residual[:n] = Y_dot[:n] - v + J.T @ mu
            applied = self._applied(terms, self.system.force(t, terms))
            residual[n : 2 * n] = terms.D_tree @ Y_dot[n : 2 * n] - applied - J.T @ multipliers
            residual[2 * n :] = np.concatenate([terms.phi[self.rows], J @ v])

    def step(self) -> str | None:
        """Advance by one of IDA's own steps; the reason when it cannot."""
        done = self._ida.step(self.t_bound, method="onestep", tstop=self.t_bound)
        self.njev = int(done.njev)
        if not done.success:
            self.status = "failed"
            return f"SUNDIALS gave up: {done.message}"
        if not done.t > self.t:
            self.status = "failed"
            return "the step became so short that t does not change any more"
        self.t_old, self.t = self.t, float(done.t)
        self.step_size = self.t - self.t_old
        self.y = np.array(done.y[: 2 * self.n])
        self.f = np.array(done.yp[: 2 * self.n])
        if self.t >= self.t_bound:
            self.status = "finished"
        return None
