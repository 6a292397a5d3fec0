"""Compiled terms against Pinocchio's and the reference's, before they are used."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.changes import TOGETHER
from ckc_pin.codegen.expressions import kept_rows
from ckc_pin.codegen.library import Library
from ckc_pin.codegen.order import elimination_order, eq_1, least_pivot
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Calls", "require_equal"]

STATES = 25  # on the closure, and as many off it
EQUAL = 1e-11  # relative to the largest entry
SOUND = (
    1e-3  # of J D'^-1 J^T's scaled eigenvalues, from which solutions of eq. 1 are compared: with less digits are lost
)
CANCELS = 1e3  # ratio of the accelerations without the loops to those with them, above which too many digits are lost
MASSLESS = 1e-12  # of the scaled eigenvalues of D': below that a motion moves no mass
DIFFERENCE = 1e-5  # rad, or of the mechanism's size, and of v' in their multiples a second
ALIKE = 1e-6  # derivatives and differences, relative
FROM_ZERO = 1e-2  # SI units: how far what is zero and may vary does
SPREAD = 0.5  # rad, or of the mechanism's size: how far states are from the assembled one


class Calls:
    """A library's functions, called from Python.

    Parameters
    ----------
    library : Library
    """

    def __init__(self, library: Library) -> None:
        self._library = ctypes.CDLL(library.path)
        self._pointer = ctypes.POINTER(ctypes.c_double)
        self._numbers = np.zeros(0)
        self._numbers = self.of_numbers(library.parameters)

    def __contains__(self, name: str) -> bool:
        return hasattr(self._library, name)

    def of_numbers(self, parameters: Array) -> Array:
        """Return what the functions take last, of other numbers of the mechanism."""
        return self.call("numbers", parameters)[0]

    def call(self, name: str, *arguments: Array, numbers: Array | None = None) -> list[Array]:
        """Return a function's results, vectors by columns of what they are, of other numbers too."""
        count = getattr(self._library, f"{name}_n_out")
        count.restype = ctypes.c_longlong
        results = [np.zeros(self.size(name, "out", k)) for k in range(count())]
        given = [np.ascontiguousarray(x, dtype=float) for x in arguments]
        if not name.startswith(("numbers", "change", "varied", "groups")):
            q, last = given[0], self._numbers if numbers is None else numbers
            given = [q, np.concatenate([np.cos(q), np.sin(q)]), *given[1:], last]
        getattr(self._library, name)(self._pointers(given), self._pointers(results), None, None, 0)
        return results

    def size(self, name: str, which: str, k: int) -> int:
        """How many numbers an argument ("in") of a function has, or a result ("out")."""
        sizes = getattr(self._library, f"{name}_sparsity_{which}")
        sizes.restype = ctypes.POINTER(ctypes.c_longlong)
        return int(sizes(k)[0] * sizes(k)[1])

    def _pointers(self, arrays: list[Array]) -> ctypes.Array[ctypes._Pointer[ctypes.c_double]]:
        return (self._pointer * len(arrays))(*(x.ctypes.data_as(self._pointer) for x in arrays))


def require_equal(mechanism: Mechanism, library: Library) -> None:
    """Compare at random states, on the closure and off it.

    Raises
    ------
    InputError
        A term that differs by more than 1e-11.
    """
    code, random = Calls(library), np.random.default_rng(0)
    compared, order = 0, elimination_order(mechanism, kept_rows(mechanism))
    for at, closed in _configurations(mechanism, random):
        v = random.uniform(-2, 2, mechanism.n) * mechanism.tree.step_scale
        if closed and mechanism.closure.rows:
            v = v - np.linalg.pinv(at.J, rcond=1e-9) @ (at.J @ v)
        terms = Terms(mechanism, at, v)
        _compare_terms(terms, code, random.uniform(-1, 1, mechanism.n))
        if mechanism.redundant and not closed:
            continue  # redundant rows contradict each other there
        found = _compare_solutions(terms, code, order, *random.uniform(-1, 1, (2, mechanism.n)))
        if found and "change" in code:
            _compare_change(terms, code, library.parameters, random)
        compared += found
    if not compared:
        raise InputError(
            f"{mechanism.name}: its acceleration would have to be eliminated with pivoting everywhere, which compiled "
            'terms do not do; take solver.terms = "pinocchio"'
        )


def _compare_terms(terms: Terms, code: Calls, x: Array) -> None:
    mechanism, at, q, v = terms.mechanism, terms.at, terms.q_tree, terms.v_tree
    found = dict(zip(("phi", "J"), code.call("place", q), strict=True))
    found["D_tree"] = code.call("inertia", q)[0]
    found |= zip(("bias_tree", "J_dot_v", "damping"), code.call("bias", q, v), strict=True)
    found["J_dot"] = code.call("jacobian_rate", q, v)[0]
    found["h_tree"] = code.call("rest", q)[0]
    found["potential"] = code.call("potential_energy", q)[0]
    D = np.triu(terms.D_tree)
    right = {
        "phi": at.phi, "J": at.J, "D_tree": D + np.triu(D, 1).T, "bias_tree": terms.bias_tree,
        "J_dot_v": terms.J_dot @ v, "damping": terms.damping_force, "J_dot": terms.J_dot, "h_tree": terms.h_tree,
        "potential": np.array([terms.potential_energy]),
    }  # fmt: skip
    if "coriolis" in code:
        found["C' x"], right["C' x"] = code.call("coriolis", q, v, x)[0], terms.C_tree @ x
    fast, J = float(np.abs(v).max()), float(np.abs(at.J).max(initial=0.0))
    scale = {  # of what they are sums of
        "phi": mechanism.size, "J_dot": J * fast, "J_dot_v": J * fast**2, "bias_tree": float(D.max()) * fast**2,
        "C' x": float(D.max()) * fast, "potential": float(np.abs(terms.h_tree).max()) * max(1.0, mechanism.size),
    }  # fmt: skip
    for name, wanted in right.items():
        _compare(mechanism, name, found[name], np.ravel(wanted, order="F"), scale.get(name, 0.0))


def _compare_solutions(terms: Terms, code: Calls, order: Sequence[int], u: Array, x: Array) -> bool:
    """Of eq. 1, its derivatives, and the step that closes the loops; False where that would lose digits."""
    mechanism, at, q, v = terms.mechanism, terms.at, terms.q_tree, terms.v_tree
    if not _sound(terms, order):
        return False
    try:
        wanted = dae_acceleration(terms, u)
    except NumericalError:
        return False
    if _cancels(terms, u, wanted):
        return False
    _compare(mechanism, "acceleration", code.call("acceleration", q, v, u, np.zeros(len(at.phi)))[0], wanted)
    residual = at.J @ x
    _compare(mechanism, "closing_step", code.call("closing_step", q, residual)[0], _closing_step(terms, residual), 1.0)
    if "jacobian" in code:
        _compare_derivatives(mechanism, code, q, v, u)
    return True


def _kept(terms: Terms) -> tuple[Array, Array]:
    """D' and the J of the rows that follow from no others.

    Where links without mass make D' singular, J^T W J is added, which changes no solution of eq. 1: they move with the
    loops. W is what makes rows as heavy as what else moves with them.
    """
    D, J = terms.D_tree, terms.at.J[kept_rows(terms.mechanism)]
    if not len(J) or _least(D) > MASSLESS:
        return D, J
    mobility = np.sum(J * (np.linalg.pinv(D, rcond=MASSLESS, hermitian=True) @ J.T).T, axis=1)
    most = float(mobility.max()) or 1.0
    return D + J.T @ (J / np.where(mobility > SOUND * most, mobility, most)[:, None]), J


def _least(symmetric: Array) -> float:
    """The least eigenvalue in units in which the diagonal is 1."""
    diagonal = np.diag(symmetric)
    if not np.all(diagonal > 0):
        return 0.0
    units = 1 / np.sqrt(diagonal)
    return float(np.linalg.eigvalsh(symmetric * np.outer(units, units))[0])


def _sound(terms: Terms, order: Sequence[int]) -> bool:
    D, J = _kept(terms)
    if not _least(D) > MASSLESS or (len(J) and not _least(J @ np.linalg.solve(D, J.T)) > SOUND):
        return False
    return D is terms.D_tree or least_pivot(eq_1(terms.D_tree, J), terms.mechanism.n, order) > SOUND


def _cancels(terms: Terms, u: Array, acceleration: Array) -> bool:
    """Whether light bodies carry loads that would accelerate them far more without the loops."""
    D, _ = _kept(terms)
    alone = np.linalg.solve(D, u - terms.bias_tree + terms.damping_force)
    reach = terms.mechanism.tree.step_scale
    return bool(np.abs(alone / reach).max() > CANCELS * np.abs(acceleration / reach).max())


def _closing_step(terms: Terms, residual: Array) -> Array:
    D, J = _kept(terms)
    multipliers = np.linalg.solve(J @ np.linalg.solve(D, J.T), residual[kept_rows(terms.mechanism)])
    return np.asarray(-np.linalg.solve(D, J.T @ multipliers))


def _compare_derivatives(mechanism: Mechanism, code: Calls, q: Array, v: Array, u: Array) -> None:
    """Of the acceleration, along every coordinate, rate and force."""
    tree, none = mechanism.tree, np.zeros(mechanism.closure.rows)
    flat, flat_by_u, _ = code.call("jacobian", q, v, u)
    by_state = flat.reshape(tree.nq + tree.n, -1, order="F")[tree.nq :]
    by_u = flat_by_u.reshape(tree.n, -1, order="F")
    size = float(np.abs(by_state).max())
    for k in range(tree.n):
        h = DIFFERENCE * tree.step_scale[k]
        along = np.eye(tree.n)[k]
        for name, found, at in (
            ("q'", by_state[:, : tree.nq] @ tree.configuration_rate(q, along), lambda x: (tree.integrate(q, x), v, u)),
            ("v'", by_state[:, tree.nq + k], lambda x: (q, v + x, u)),
            ("u'", by_u[:, k], lambda x: (q, v, u + x)),
        ):
            ahead, behind = (code.call("acceleration", *at(sign * h * along), none)[0] for sign in (1, -1))
            _compare(mechanism, f"the acceleration by {name}", found, (ahead - behind) / (2 * h), size, ALIKE)


def _compare_change(terms: Terms, code: Calls, own: Array, random: np.random.Generator) -> None:
    """Along directions of everything at once."""
    mechanism, tree, q, v = terms.mechanism, terms.mechanism.tree, terms.q_tree, terms.v_tree
    none, u = np.zeros(mechanism.closure.rows), random.uniform(-1, 1, tree.n) * tree.step_scale
    steps, faster, more = random.uniform(-1, 1, (3, TOGETHER, tree.n)) * tree.step_scale
    varied = random.uniform(-1, 1, (TOGETHER, len(own))) * np.where(own == 0.0, FROM_ZERO, own)
    state, acceleration, _ = code.call("state", q, v, u)
    _compare(mechanism, "acceleration with its change", acceleration, code.call("acceleration", q, v, u, none)[0])
    groups, rows = range(code.size("groups", "out", 0)), code.size("change", "in", 1) - 3 * tree.n
    by_numbers = [sum(code.call(f"varied_{k}", state, x)[0] for k in groups) for x in varied]
    along = np.hstack([steps, faster, np.pad(more, ((0, 0), (0, rows))) + by_numbers])
    alone = [code.call("change", state, x)[0] for x in along]

    def at(k: int, h: float) -> Array:
        there = tree.integrate(q, h * steps[k]), v + h * faster[k], u + h * more[k]
        return code.call("acceleration", *there, none, numbers=code.of_numbers(own + h * varied[k]))[0]

    h = DIFFERENCE
    for k, change in enumerate(alone):
        wanted = (8 * (at(k, h) - at(k, -h)) - (at(k, 2 * h) - at(k, -2 * h))) / (12 * h)
        _compare(mechanism, "the acceleration's change", change, wanted, 0.0, ALIKE)
    if "changes" in code:
        (together,) = code.call("changes", state, np.ravel(along, order="F"))
        _compare(mechanism, "the acceleration's changes", together, np.ravel(alone, order="F"))


def _configurations(mechanism: Mechanism, random: np.random.Generator) -> Iterator[tuple[Kinematics, bool]]:
    tree = mechanism.tree
    yield mechanism.assembled, True
    here = mechanism.independent_part(mechanism.q_tree)
    reach = tree.step_scale[mechanism.partition.q]
    for k in range(STATES):
        step = SPREAD * random.uniform(-1, 1, tree.n) * tree.step_scale
        yield mechanism.kinematics(tree.integrate(mechanism.q_tree, step)), False
        if not mechanism.splits_root:
            found = sigma(mechanism, here + SPREAD * random.uniform(-1, 1, mechanism.d) * reach * 0.9 ** (k % 10))
            if found.verdict == "converged":
                yield found.at, True


def _compare(
    mechanism: Mechanism, name: str, found: Array, wanted: Array, scale: float = 0.0, equal: float = EQUAL
) -> None:
    largest = max(scale, float(np.abs(wanted).max(initial=0.0)), 1e-300)
    off = float(np.abs(found - wanted).max(initial=0.0)) / largest
    if not off <= equal:
        raise InputError(f"{mechanism.name}: {name} as compiled is not what Pinocchio gives: off by {off:.1e}")
