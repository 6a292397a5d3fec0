"""Check of compiled terms against Pinocchio's terms and the reference formulation, before they are used."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.c_source import MEMBERS
from ckc_pin.codegen.derivatives import DIRECTIONS
from ckc_pin.codegen.elimination import elimination_order, saddle_point_matrix, smallest_pivot_ratio
from ckc_pin.codegen.library import Library
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = [
    "TERMS_TOLERANCE",
    "CompiledFunctions",
    "reference_acceleration",
    "reference_terms",
    "require_equal_terms",
    "sample_configurations",
]

STATES = 25  # compared on the constraint manifold, and as many off it
STATE_SPREAD = 0.5  # rad, or times the mechanism's size: distance of the states from the assembled configuration
MAX_HALVINGS = 6  # of the distance of a closed state that the loops do not let the mechanism reach
TERMS_TOLERANCE = 1e-11  # relative to the largest entry
DERIVATIVES_TOLERANCE = 1e-6  # derivatives against differences, relative
DIFFERENCE_STEP = 1e-5  # rad, or times the mechanism's size; for v' in these units per second
# Solutions of eq. 1 are compared only where few digits are lost:
MIN_ROW_EIGENVALUE = 1e-3  # of J D'^-1 J^T, scaled to unit diagonal
MAX_CANCELLATION = 1e3  # ratio of the accelerations without the loops to those with them
MASSLESS = 1e-12  # scaled eigenvalues of D' below which a motion has no inertia
CHANGE_FROM_ZERO = 1e-2  # SI units: how far an argument that is zero is changed


class CompiledFunctions:
    """A compiled library's functions as Python calls.

    Parameters
    ----------
    library : Library
    """

    def __init__(self, library: Library) -> None:
        self._library = ctypes.CDLL(library.path)
        self._pointer = ctypes.POINTER(ctypes.c_double)
        self._numbers = np.zeros(0)
        self._numbers = self.numbers_of(library.parameters)

    def __contains__(self, name: str) -> bool:
        return hasattr(self._library, name)

    def numbers_of(self, parameters: Array) -> Array:
        """Return the last argument of the functions for other parameters of the mechanism."""
        return self.call("numbers", parameters)[0]

    def call(self, name: str, *arguments: Array, numbers: Array | None = None) -> list[Array]:
        """Return a function's results as vectors, matrices by columns."""
        inputs = list(arguments)
        if not name.startswith(("numbers", "change", "varied", "groups")):
            q, last = inputs[0], self._numbers if numbers is None else numbers
            inputs = [q, np.concatenate([np.cos(q), np.sin(q)]), *inputs[1:], last]
        return self._run(name, inputs)

    def call_of_members(self, name: str, q: Array, *arguments: Array, numbers: Array) -> list[Array]:
        """Return a function's results for `MEMBERS` members of an ensemble.

        Each argument and result has one column per member. Its rows are the entries that `call` takes or returns.
        """
        inputs = [q, np.vstack([np.cos(q), np.sin(q)]), *arguments, numbers]
        return [x.reshape(-1, MEMBERS) for x in self._run(f"{name}_of_members", inputs)]

    def _run(self, name: str, arguments: list[Array]) -> list[Array]:
        count = getattr(self._library, f"{name}_n_out")
        count.restype = ctypes.c_longlong
        inputs = [_aligned(np.asarray(x, dtype=float)) for x in arguments]
        results = [_aligned(np.zeros(self.size(name, "out", k))) for k in range(count())]
        getattr(self._library, name)(self._pointers(inputs), self._pointers(results), None, None, 0)
        return results

    def size(self, name: str, side: str, k: int) -> int:
        """Return the number of entries of a function's k-th argument (`side` = "in") or result ("out")."""
        sizes = getattr(self._library, f"{name}_sparsity_{side}")
        sizes.restype = ctypes.POINTER(ctypes.c_longlong)
        return int(sizes(k)[0] * sizes(k)[1])

    def _pointers(self, arrays: list[Array]) -> ctypes.Array[ctypes._Pointer[ctypes.c_double]]:
        return (self._pointer * len(arrays))(*(x.ctypes.data_as(self._pointer) for x in arrays))


def _aligned(x: Array) -> Array:
    """Return a copy whose address is a multiple of 64."""
    memory = np.empty(x.size + 8)
    start = -memory.ctypes.data % 64 // memory.itemsize
    copy = memory[start : start + x.size].reshape(x.shape)
    copy[...] = x
    return copy


def require_equal_terms(mechanism: Mechanism, library: Library) -> None:
    """Compare compiled terms with Pinocchio's at random states, on the constraint manifold and off it.

    Raises
    ------
    InputError
        A term differs by more than 1e-11, or eq. 1 cannot be solved without pivoting at any state.
    """
    functions, random = CompiledFunctions(library), np.random.default_rng(0)
    compared, order = 0, elimination_order(mechanism, mechanism.independent_rows)
    for at, is_closed in sample_configurations(mechanism, random):
        v = random.uniform(-2, 2, mechanism.n) * mechanism.tree.step_scale
        if is_closed and mechanism.closure.rows:
            v = v - np.linalg.pinv(at.J, rcond=1e-9) @ (at.J @ v)
        terms = Terms(mechanism, at, v)
        _compare_terms(terms, functions, random.uniform(-1, 1, mechanism.n))
        if mechanism.redundant and not is_closed:
            continue  # redundant rows contradict each other there
        if "acceleration_of_members" in functions:
            _compare_members(terms, functions, library.parameters, random)
        is_comparable = _compare_solutions(terms, functions, order, *random.uniform(-1, 1, (2, mechanism.n)))
        if is_comparable and "change" in functions:
            _compare_directional_derivatives(terms, functions, library.parameters, random)
        compared += is_comparable
    if not compared:
        raise InputError(
            f"{mechanism.name}: its acceleration would have to be eliminated with pivoting everywhere, which compiled "
            'terms do not do; take solver.terms = "pinocchio"'
        )


def _compare_terms(terms: Terms, functions: CompiledFunctions, x: Array) -> None:
    mechanism, q, v = terms.mechanism, terms.q_tree, terms.v_tree
    ours = dict(zip(("phi", "J"), functions.call("place", q), strict=True))
    ours["D_tree"] = functions.call("inertia", q)[0]
    ours |= zip(("bias_tree", "J_dot_v", "damping"), functions.call("bias", q, v), strict=True)
    ours["J_dot"] = functions.call("jacobian_rate", q, v)[0]
    ours["h_tree"] = functions.call("rest", q)[0]
    ours["potential"] = functions.call("potential_energy", q)[0]
    reference = reference_terms(terms)
    if "coriolis" in functions:
        scale = float(np.abs(terms.D_tree).max()) * float(np.abs(v).max())
        ours["C' x"], reference["C' x"] = functions.call("coriolis", q, v, x)[0], (terms.C_tree @ x, scale)
    for name, (expected, scale) in reference.items():
        _require_equal(mechanism, name, ours[name], np.ravel(expected, order="F"), scale)


def reference_terms(terms: Terms) -> dict[str, tuple[Array, float]]:
    """Return the terms of Pinocchio and of the constraint rows by name, with the size of summands that may cancel."""
    mechanism, at, v = terms.mechanism, terms.at, terms.v_tree
    D = np.triu(terms.D_tree)
    speed, J = float(np.abs(v).max()), float(np.abs(at.J).max(initial=0.0))
    return {
        "phi": (at.phi, mechanism.size),
        "J": (at.J, 0.0),
        "D_tree": (D + np.triu(D, 1).T, 0.0),
        "bias_tree": (terms.bias_tree, float(D.max()) * speed**2),
        "J_dot_v": (terms.J_dot @ v, J * speed**2),
        "damping": (terms.damping_force, 0.0),
        "J_dot": (terms.J_dot, J * speed),
        "h_tree": (terms.h_tree, 0.0),
        "potential": (np.array([terms.potential_energy]), float(np.abs(terms.h_tree).max()) * max(1.0, mechanism.size)),
    }


def _compare_solutions(terms: Terms, functions: CompiledFunctions, order: Sequence[int], u: Array, x: Array) -> bool:
    """Compare solutions of eq. 1, its derivatives and the closing step; return False where they would lose digits."""
    mechanism, at, q, v = terms.mechanism, terms.at, terms.q_tree, terms.v_tree
    acceleration = reference_acceleration(terms, order, u)
    if acceleration is None:
        return False
    ours = functions.call("acceleration", q, v, u, np.zeros(len(at.phi)))[0]
    _require_equal(mechanism, "acceleration", ours, acceleration)
    residual = at.J @ x
    step = functions.call("closing_step", q, residual)[0]
    _require_equal(mechanism, "closing_step", step, _closing_step(terms, residual), 1.0)
    if "jacobian" in functions:
        _compare_derivatives(mechanism, functions, q, v, u)
    return True


def reference_acceleration(terms: Terms, order: Sequence[int], u: Array) -> Array | None:
    """Return eq. 1's acceleration under the force u', or None where elimination in an order would lose digits."""
    if not _is_well_conditioned(terms, order):
        return None
    try:
        acceleration = dae_acceleration(terms, u)
    except NumericalError:
        return None
    return None if _cancels(terms, u, acceleration) else acceleration


def _regular_system(terms: Terms) -> tuple[Array, Array]:
    """Return a regular D' and the J of the kept rows.

    Where links without mass make D' singular, J^T W J is added. That changes no solution of eq. 1, because such links
    move with the loops. W gives each row the inertia of the other bodies that move with it.
    """
    D, J = terms.D_tree, terms.at.J[terms.mechanism.independent_rows]
    if not len(J) or _smallest_scaled_eigenvalue(D) > MASSLESS:
        return D, J
    mobility = np.sum(J * (np.linalg.pinv(D, rcond=MASSLESS, hermitian=True) @ J.T).T, axis=1)
    largest = float(mobility.max()) or 1.0
    return D + J.T @ (J / np.where(mobility > MIN_ROW_EIGENVALUE * largest, mobility, largest)[:, None]), J


def _smallest_scaled_eigenvalue(symmetric: Array) -> float:
    """Return the smallest eigenvalue of a symmetric matrix scaled to unit diagonal."""
    diagonal = np.diag(symmetric)
    if not np.all(diagonal > 0):
        return 0.0
    scale = 1 / np.sqrt(diagonal)
    return float(np.linalg.eigvalsh(symmetric * np.outer(scale, scale))[0])


def _is_well_conditioned(terms: Terms, order: Sequence[int]) -> bool:
    """Return whether elimination without pivoting keeps enough digits at a state."""
    D, J = _regular_system(terms)
    if not _smallest_scaled_eigenvalue(D) > MASSLESS:
        return False
    if len(J) and not _smallest_scaled_eigenvalue(J @ np.linalg.solve(D, J.T)) > MIN_ROW_EIGENVALUE:
        return False
    matrix = saddle_point_matrix(terms.D_tree, J)
    return D is terms.D_tree or smallest_pivot_ratio(matrix, terms.mechanism.n, order) > MIN_ROW_EIGENVALUE


def _cancels(terms: Terms, u: Array, acceleration: Array) -> bool:
    """Return whether light bodies carry loads that would accelerate them far more without the loops."""
    D, _ = _regular_system(terms)
    unconstrained = np.linalg.solve(D, u - terms.bias_tree + terms.damping_force)
    reach = terms.mechanism.tree.step_scale
    return bool(np.abs(unconstrained / reach).max() > MAX_CANCELLATION * np.abs(acceleration / reach).max())


def _closing_step(terms: Terms, residual: Array) -> Array:
    D, J = _regular_system(terms)
    multipliers = np.linalg.solve(J @ np.linalg.solve(D, J.T), residual[terms.mechanism.independent_rows])
    return np.asarray(-np.linalg.solve(D, J.T @ multipliers))


def _compare_derivatives(mechanism: Mechanism, functions: CompiledFunctions, q: Array, v: Array, u: Array) -> None:
    """Compare partial derivatives of the acceleration with respect to q', v' and u' with central differences."""
    tree, no_correction = mechanism.tree, np.zeros(mechanism.closure.rows)
    flat, flat_by_u, _ = functions.call("jacobian", q, v, u)
    by_state = flat.reshape(tree.nq + tree.n, -1, order="F")[tree.nq :]
    by_u = flat_by_u.reshape(tree.n, -1, order="F")
    size = float(np.abs(by_state).max())
    for k in range(tree.n):
        h = DIFFERENCE_STEP * tree.step_scale[k]
        unit = np.eye(tree.n)[k]
        for name, ours, moved in (
            ("q'", by_state[:, : tree.nq] @ tree.configuration_rate(q, unit), lambda x: (tree.integrate(q, x), v, u)),
            ("v'", by_state[:, tree.nq + k], lambda x: (q, v + x, u)),
            ("u'", by_u[:, k], lambda x: (q, v, u + x)),
        ):
            forward, backward = (
                functions.call("acceleration", *moved(sign * h * unit), no_correction)[0] for sign in (1, -1)
            )
            difference = (forward - backward) / (2 * h)
            _require_equal(mechanism, f"the acceleration by {name}", ours, difference, size, DERIVATIVES_TOLERANCE)


def _compare_members(
    terms: Terms, functions: CompiledFunctions, parameters: Array, random: np.random.Generator
) -> None:
    """Compare the functions that compute several members in one call with those that compute one, digit by digit.

    The members are at states near that of `terms`, each with parameters of its own.
    """
    mechanism, rows = terms.mechanism, terms.mechanism.closure.rows
    q, v, u, residual = (
        x[:, None] + random.uniform(-STATE_SPREAD, STATE_SPREAD, (len(x), MEMBERS))
        for x in (terms.q_tree, terms.v_tree, np.zeros(mechanism.n), np.zeros(rows))
    )
    numbers = np.array([functions.numbers_of(parameters * random.uniform(0.9, 1.1)) for _ in range(MEMBERS)]).T
    arguments = {
        "acceleration": (v, u, np.zeros((rows, MEMBERS))), "place": (), "closing_step": (residual,), "inertia": (),
        "potential_energy": (), "jacobian_rate": (v,),
    }  # fmt: skip
    for name, others in arguments.items():
        if f"{name}_of_members" not in functions:
            continue
        together = functions.call_of_members(name, q, *others, numbers=numbers)
        for k in range(MEMBERS):
            alone = functions.call(name, q[:, k], *(x[:, k] for x in others), numbers=numbers[:, k])
            if not all(np.array_equal(x[:, k], y, equal_nan=True) for x, y in zip(together, alone, strict=True)):
                raise InputError(f"{mechanism.name}: compiled {name} of several members has other digits than of one")


def _compare_directional_derivatives(
    terms: Terms, functions: CompiledFunctions, parameters: Array, random: np.random.Generator
) -> None:
    """Compare directional derivatives with differences, along directions of q', v', u' and all parameters."""
    mechanism, tree, q, v = terms.mechanism, terms.mechanism.tree, terms.q_tree, terms.v_tree
    no_correction, u = np.zeros(mechanism.closure.rows), random.uniform(-1, 1, tree.n) * tree.step_scale
    dq, dv, du = random.uniform(-1, 1, (3, DIRECTIONS, tree.n)) * tree.step_scale
    size = np.where(parameters == 0.0, CHANGE_FROM_ZERO, parameters)
    dp = random.uniform(-1, 1, (DIRECTIONS, len(parameters))) * size
    state, acceleration, _ = functions.call("state", q, v, u)
    plain = functions.call("acceleration", q, v, u, no_correction)[0]
    _require_equal(mechanism, "acceleration with its change", acceleration, plain)
    groups, rows = range(functions.size("groups", "out", 0)), functions.size("change", "in", 1) - 3 * tree.n
    by_parameters = [sum(functions.call(f"varied_{k}", state, x)[0] for k in groups) for x in dp]
    directions = np.hstack([dq, dv, np.pad(du, ((0, 0), (0, rows))) + by_parameters])
    derivatives = [functions.call("change", state, x)[0] for x in directions]

    def acceleration_at(k: int, h: float) -> Array:
        moved = tree.integrate(q, h * dq[k]), v + h * dv[k], u + h * du[k]
        moved_numbers = functions.numbers_of(parameters + h * dp[k])
        return functions.call("acceleration", *moved, no_correction, numbers=moved_numbers)[0]

    h = DIFFERENCE_STEP
    for k, derivative in enumerate(derivatives):
        difference = 8 * (acceleration_at(k, h) - acceleration_at(k, -h))
        difference = (difference - (acceleration_at(k, 2 * h) - acceleration_at(k, -2 * h))) / (12 * h)
        _require_equal(mechanism, "the acceleration's change", derivative, difference, tolerance=DERIVATIVES_TOLERANCE)
    if "changes" in functions:
        (together,) = functions.call("changes", state, np.ravel(directions, order="F"))
        _require_equal(mechanism, "the acceleration's changes", together, np.ravel(derivatives, order="F"))


def sample_configurations(mechanism: Mechanism, random: np.random.Generator) -> Iterator[tuple[Kinematics, bool]]:
    """Yield configurations, and whether their loops are closed."""
    tree = mechanism.tree
    yield mechanism.assembled, True
    q = mechanism.independent_part(mechanism.q_tree)
    reach = tree.step_scale[mechanism.partition.q]
    for k in range(STATES):
        step = STATE_SPREAD * random.uniform(-1, 1, tree.n) * tree.step_scale
        yield mechanism.kinematics(tree.integrate(mechanism.q_tree, step)), False
        step_q = STATE_SPREAD * random.uniform(-1, 1, mechanism.d) * reach * 0.9 ** (k % 10)
        for _ in range(0 if mechanism.splits_root else MAX_HALVINGS):
            closed = sigma(mechanism, q + step_q, anywhere=False)
            if closed.verdict == "converged":
                yield closed.at, True
                break
            step_q = step_q / 2  # A search for configurations beyond singular ones takes longer than all else here.


def _require_equal(
    mechanism: Mechanism,
    name: str,
    ours: Array,
    reference: Array,
    scale: float = 0.0,
    tolerance: float = TERMS_TOLERANCE,
) -> None:
    largest = max(scale, float(np.abs(reference).max(initial=0.0)), 1e-300)
    error = float(np.abs(ours - reference).max(initial=0.0)) / largest
    if not error <= tolerance:
        raise InputError(
            f"{mechanism.name}: the compiled {name.removeprefix('the ')} differs from Pinocchio's by {error:.1e}"
        )
