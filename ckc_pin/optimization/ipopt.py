"""IPOPT for a nonlinear program whose values and derivatives come from Python functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from ckc_pin.base.arrays import Array, Immutable, IntArray

__all__ = ["Ipopt", "NonlinearProgram", "Optimum", "make_settings", "merge_patterns", "nonzeros"]

CONSTRAINT_TOLERANCE = 1e-9
WARM_BARRIER = 1e-6  # first barrier parameter of a warm start


class NonlinearProgram(Protocol):
    """Minimize a cost of variables within bounds of the variables and of constraints."""

    size: int
    rows: int
    bounds: Array
    jacobian_pattern: Any
    hessian_pattern: Any

    def constraints(self, w: Array) -> tuple[float, Array]:
        """Return the cost and all constraints."""

    def gradient(self, w: Array) -> Array:
        """Return the gradient of the cost."""

    def jacobian(self, w: Array) -> Array:
        """Return the nonzeros of the constraints' Jacobian."""

    def hessian(self, w: Array, factor: float, multipliers: Array) -> Array:
        """Return the nonzeros of the Lagrangian's Hessian, upper triangle."""


class Optimum(Immutable, frozen=True):
    """Variables, multipliers of their bounds and of the constraints, IPOPT's status, and iterations."""

    w: Array
    bound_multipliers: Array
    multipliers: Array
    status: str
    iterations: int


class Ipopt:
    """IPOPT on a program.

    Parameters
    ----------
    program : NonlinearProgram
    iterations : int
        Largest number.
    tolerance : float
        Relative to the scaled problem.
    warm : bool
        Begin close to a solution.
    """

    def __init__(self, program: NonlinearProgram, *, iterations: int, tolerance: float, warm: bool) -> None:
        import casadi as cs

        self.program = program
        n, rows = program.size, program.rows
        column, none = cs.Sparsity.dense(n, 1), cs.Sparsity(0, 0)
        one, g = cs.Sparsity.dense(1, 1), cs.Sparsity.dense(rows, 1)
        jacobian, hessian = program.jacobian_pattern, program.hessian_pattern
        variables = {"x": column, "p": none}

        def cost(x: list[Array]) -> Array:
            return np.array([program.constraints(x[0])[0]])

        def constraints(x: list[Array]) -> Array:
            return program.constraints(x[0])[1]

        functions = [
            _callback("nlp", variables, {"f": (one, cost), "g": (g, constraints)}),
            _callback("grad_f", variables,
                      {"f": (one, cost), "grad_f_x": (column, lambda x: program.gradient(x[0]))}),
            _callback("jac_g", variables,
                      {"g": (g, constraints), "jac_g_x": (jacobian, lambda x: program.jacobian(x[0]))}),
            _callback("hess_lag", {**variables, "lam_f": one, "lam_g": g},
                      {"triu_hess_gamma_x_x": (hessian, lambda x: program.hessian(x[0], float(x[2][0]), x[3]))}),
        ]  # fmt: skip
        settings = make_settings(iterations, tolerance)
        if warm:
            settings |= {"warm_start_init_point": "yes", "mu_init": WARM_BARRIER, "mu_strategy": "monotone",
                         "warm_start_bound_push": 1e-8, "warm_start_mult_bound_push": 1e-8}  # fmt: skip
        nlp, grad_f, jac_g, hess = functions
        self._functions = functions
        self._solver = cs.nlpsol("plan", "ipopt", nlp, {
            "grad_f": grad_f, "jac_g": jac_g, "hess_lag": hess, "no_nlp_grad": True, "print_time": False,
            "calc_lam_p": False, "show_eval_warnings": False, "ipopt": settings,
        })  # fmt: skip

    def solve(self, w: Array, bounds: Array, last: Optimum | None = None) -> Optimum:
        """Minimize from w, within bounds (2, variables), with the multipliers of a solution nearby."""
        arguments = {"x0": np.clip(w, *bounds), "lbx": bounds[0], "ubx": bounds[1],
                     "lbg": self.program.bounds[0], "ubg": self.program.bounds[1]}  # fmt: skip
        if last is not None:
            arguments |= {"lam_x0": last.bound_multipliers, "lam_g0": last.multipliers}
        result = self._solver(**arguments)
        x, lam_x, lam_g = (result[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        stats = self._solver.stats()
        return Optimum(x, lam_x, lam_g, str(stats["return_status"]), int(stats["iter_count"]))


def make_settings(iterations: int, tolerance: float) -> dict[str, Any]:
    """Return IPOPT's options for a largest number of iterations and a relative tolerance."""
    return {
        "print_level": 0, "sb": "yes", "max_iter": iterations, "tol": tolerance,
        "constr_viol_tol": CONSTRAINT_TOLERANCE, "acceptable_tol": 100 * tolerance,
        "acceptable_constr_viol_tol": CONSTRAINT_TOLERANCE, "acceptable_iter": 5, "mu_strategy": "adaptive",
    }  # fmt: skip


def nonzeros(matrix: Any) -> Any:
    """Return a sparse matrix's nonzeros as a dense column."""
    import casadi as cs

    return cs.densify(cs.vertcat(*matrix.nonzeros())) if matrix.nnz() else cs.SX(0, 1)


def merge_patterns(parts: Sequence[tuple[Any, Any]], rows: int, columns: int) -> tuple[Any, IntArray]:
    """Return a CasADi sparsity with the entries of several lists of rows and columns, and the place of each entry."""
    import casadi as cs

    row, column = (np.concatenate([part[k] for part in parts]).astype(np.int64) for k in (0, 1))
    keys, places = np.unique(column * rows + row, return_inverse=True)
    starts = np.searchsorted(keys, np.arange(columns + 1) * rows)
    return cs.Sparsity(rows, columns, starts.tolist(), (keys % rows).tolist()), places


def _callback(name: str, inputs: dict[str, Any], outputs: dict[str, tuple[Any, Callable[[list[Array]], Array]]]) -> Any:
    """Return a CasADi function of vectors. Each output has a pattern, and a Python function that gives its nonzeros."""
    import casadi as cs

    patterns, evaluations = zip(*outputs.values(), strict=True)
    sizes = [pattern.nnz() for pattern in inputs.values()]

    class Function(cs.Callback):
        def __init__(self) -> None:
            cs.Callback.__init__(self)
            self.construct(name, {})

        def get_n_in(self) -> int:
            return len(inputs)

        def get_n_out(self) -> int:
            return len(outputs)

        def get_name_in(self, k: int) -> str:
            return list(inputs)[k]

        def get_name_out(self, k: int) -> str:
            return list(outputs)[k]

        def get_sparsity_in(self, k: int) -> Any:
            return list(inputs.values())[k]

        def get_sparsity_out(self, k: int) -> Any:
            return patterns[k]

        def has_eval_buffer(self) -> bool:
            return True

        def eval_buffer(self, arguments: Sequence[memoryview | None], results: Sequence[memoryview | None]) -> int:
            # An argument of None is zero, and a result of None is not needed.
            x = [np.zeros(n) if a is None else np.frombuffer(a) for a, n in zip(arguments, sizes, strict=True)]
            for result, compute in zip(results, evaluations, strict=True):
                if result is not None:
                    np.frombuffer(result)[:] = compute(x)
            return 0

    return Function()
