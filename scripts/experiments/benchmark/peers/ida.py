"""Run works with SUNDIALS IDA through scikit-sundae, on eq. 1 as stabilised by Gear, Gupta and Leimkuhler.

    q_dot = v - J^T mu
    D' v_dot + C' v + h' = u' + J^T lambda
    phi(q) = 0
    J v = 0

Terms are ckc_pin's. There is no second derivative of phi, no solve for accelerations and no projection: IDA's Newton
iteration satisfies the constraints on both levels. mu is zero up to errors. Redundant rows are left out by a choice of
independent rows at the start.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.analysis.precision.motion import MAX_REPEATS, REPEAT_BELOW_S, Motion, motion_without_data
from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.run.ivp import Dae, as_ivp
from scripts.experiments.benchmark import ours
from scripts.experiments.benchmark.work import Work

__all__ = ["Ida", "Stabilised"]

FREE = 1e8  # absolute tolerance of mu and lambda, which excludes them from the error control
MAX_STEPS = 1_000_000  # replaces IDA's default bound on the number of steps


class Ida:
    """IDA with its own step control and interpolation to the instants; the residual is evaluated in NumPy."""

    name = "SUNDIALS IDA"
    packaged = True

    def missing(self, work: Work) -> str | None:
        try:
            metadata.version("scikit-sundae")
        except metadata.PackageNotFoundError:
            return "not installed: pip install 'ckc_pin[sundials]'"
        return "it integrates numbers, a free root has none" if work.mechanism.tree.free_roots else None

    def version(self) -> str:
        return f"scikit-sundae {metadata.version('scikit-sundae')}"

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        for rtol in ours.QUICK_TOLERANCES if quick else ours.TOLERANCES:
            yield f"rtol {rtol:.0e}"

    def check(self, work: Work) -> str:
        return "the terms are this program's"

    @one_blas_thread()
    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        from sksundae.ida import IDA

        dae = as_ivp(work.load(formulation="dae"))
        assert isinstance(dae, Dae)
        form, rtol, n = Stabilised(dae), float(setting.removeprefix("rtol ")), work.mechanism.n
        multipliers = 2 * len(form.rows)
        ida = IDA(
            form.residual,
            algebraic_idx=2 * n + np.arange(multipliers),
            rtol=rtol,
            atol=np.concatenate([np.full(2 * n, rtol / 100), np.full(multipliers, FREE)]),
            max_num_steps=MAX_STEPS,
        )
        walls: list[float] = []
        while not walls or (walls[-1] < REPEAT_BELOW_S and len(walls) < MAX_REPEATS):
            form.begin(budget)
            ida.init_step(0.0, *form.start)
            states, began = [dae.y0], perf_counter()
            for t in work.instants[1:]:
                try:
                    at = ida.step(t, tstop=work.t_end)
                except TimeoutError as error:
                    return motion_without_data("refused", str(error))
                if not at.success:
                    return motion_without_data("failed", str(at.message))
                states.append(np.array(at.y[: 2 * n]))
            walls.append(perf_counter() - began)
        q_tree, v_tree = np.split(np.array(states), 2, axis=1)
        return Motion("done", "", q_tree, v_tree, min(walls), rhs=form.count)


class Stabilised:
    """Stabilised equations in Y = (q, v, mu, lambda): consistent start and residual."""

    def __init__(self, dae: Dae) -> None:
        from scipy.linalg import qr

        self.dae, self.n = dae, dae.mechanism.n
        terms, rank = dae.terms(0.0, dae.y0), dae.mechanism.rank
        self.rows = qr(terms.at.J.T, mode="r", pivoting=True)[1][:rank]
        u_tree, zero = dae.force(0.0, terms), np.zeros(rank)
        acceleration = dae_acceleration(terms, u_tree)
        pull = terms.D_tree @ acceleration - _applied(terms, u_tree)
        multipliers = np.linalg.lstsq(terms.at.J[self.rows].T, pull, rcond=None)[0]
        self.start = (
            np.concatenate([dae.y0, zero, multipliers]),
            np.concatenate([terms.v_tree, acceleration, zero, zero]),
        )

    def begin(self, budget: float) -> None:
        self.deadline, self.count = perf_counter() + budget, 0

    def options(self, rtol: float) -> dict[str, Any]:
        """Return IDA's options."""
        motion, rank = 2 * self.n, len(self.rows)
        atol = np.concatenate([np.full(motion, rtol / 100), np.full(2 * rank, FREE)])
        return {
            "algebraic_idx": np.arange(motion, motion + 2 * rank),
            "rtol": rtol,
            "atol": atol,
            "max_num_steps": MAX_STEPS,
        }

    def residual(self, t: float, Y: Array, Y_dot: Array, residual: Array) -> None:
        if perf_counter() > self.deadline:
            raise TimeoutError("takes longer than the budget")
        self.count += 1
        n = self.n
        mu, multipliers = np.split(Y[2 * n :], 2)
        with np.errstate(all="ignore"):
            terms = self.dae.terms(t, Y[: 2 * n].copy())
            J = terms.at.J[self.rows]
            residual[:n] = Y_dot[:n] - terms.v_tree + J.T @ mu
            applied = _applied(terms, self.dae.force(t, terms))
            residual[n : 2 * n] = terms.D_tree @ Y_dot[n : 2 * n] - applied - J.T @ multipliers
            residual[2 * n :] = np.concatenate([terms.phi[self.rows], J @ terms.v_tree])


def _applied(terms: Terms, u_tree: Array) -> Array:
    """Return applied forces less C' v' + h', shape (n,): everything except inertia and constraint forces."""
    force = u_tree - terms.bias_tree
    return force + terms.damping_force if terms.mechanism.springs.any_damping else force
