"""Symbolic elimination in any order against a dense solve, and the elimination order of a mechanism's unknowns."""

from __future__ import annotations

import casadi as cs
import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.codegen.elimination import SymmetricFactor, elimination_order
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma

N, ROWS = 7, 4
ORDERS = [
    (6, 5, 4, 3, 2, 1, 0, 7, 8, 9, 10),
    (0, 1, 7, 2, 8, 3, 4, 9, 5, 10, 6),
    (3, 9, 6, 5, 7, 0, 10, 4, 8, 2, 1),
]


def system(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return D, positive definite, and J of full rank, both with zeros."""
    L = np.tril(random.uniform(-1, 1, (N, N)) * (random.uniform(size=(N, N)) < 0.4), -1) + np.diag(
        random.uniform(1, 2, N)
    )
    J = random.uniform(-1, 1, (ROWS, N))
    J[:2, 4:] = J[2:, 1:3] = 0.0
    return L @ L.T, J


@pytest.mark.parametrize("order", ORDERS)
def test_elimination_in_any_order_solves_the_system(order: tuple[int, ...]) -> None:
    random = np.random.default_rng(0)
    for _ in range(5):
        D, J = system(random)
        A = np.block([[D, np.zeros((N, ROWS))], [J, np.zeros((ROWS, ROWS))]])
        entries = {(int(i), int(j)): cs.SX(A[i, j]) for i, j in np.argwhere(A) if j <= i}
        factor = SymmetricFactor(entries, N, order, 1e-12)
        b = {1: 0.7, 4: -0.3, 8: 1.1}
        solution = factor.solve({k: cs.SX(x) for k, x in b.items()})
        right = np.zeros(N + ROWS)
        right[list(b)] = list(b.values())
        dense = np.linalg.solve(np.block([[D, -J.T], [J, np.zeros((ROWS, ROWS))]]), right)
        ours = np.array([float(solution.get(k, 0.0)) for k in range(N + ROWS)])
        assert np.abs(ours - dense).max() <= 1e-9 * np.abs(dense).max()
        assert float(factor.accurate_pivots) == N + ROWS


def test_a_cancelled_pivot_is_not_accurate() -> None:
    """Two rows are nearly equal."""
    offset = 1e-4
    entries = {(0, 0): 2.0, (1, 1): 3.0, (2, 0): 1.0, (2, 1): 1.0, (3, 0): 1.0, (3, 1): 1.0 + offset}

    def accurate_pivots() -> float:
        factor = SymmetricFactor({k: cs.SX(x) for k, x in entries.items()}, 2, (0, 1, 2, 3), 1e-4)
        return float(factor.accurate_pivots)

    assert accurate_pivots() == 3
    entries[3, 1] = -1.0
    assert accurate_pivots() == 4


@pytest.mark.parametrize("name", ["five_bar", "andrews", "bricard", "delta", "stewart"])
def test_pivots_of_a_mechanism_are_not_small(name: str) -> None:
    """The elimination order was chosen at other configurations than these."""
    mechanism, random = load(name), np.random.default_rng(4)
    kept, n = mechanism.independent_rows, mechanism.n
    order = elimination_order(mechanism, kept)
    assert sorted(order) == list(range(n + len(kept)))
    q = mechanism.independent_part(mechanism.q_tree)
    reach = mechanism.tree.step_scale[mechanism.partition.q]
    for _ in range(10):
        at = sigma(mechanism, q + 0.3 * random.uniform(-1, 1, mechanism.d) * reach).at
        D, J = np.triu(Terms(mechanism, at, np.zeros(n)).D_tree), at.J[kept]
        D = D + np.triu(D, 1).T
        A = np.block([[D, J.T], [J, np.zeros((len(kept), len(kept)))]])[np.ix_(order, order)]
        ours = A.copy()
        for k in range(len(A) - 1):
            ours[k + 1 :, k + 1 :] -= np.outer(ours[k + 1 :, k], ours[k, k + 1 :]) / ours[k, k]
        signs = np.where(np.array(order) < n, 1.0, -1.0)
        assert (np.diag(ours) * signs > 0).all()
        b = np.where(signs > 0, random.uniform(-1, 1, len(A)), 0.0)
        L, U = np.tril(ours / np.diag(ours), -1) + np.eye(len(A)), np.triu(ours)
        ours, pivoted = np.linalg.solve(U, np.linalg.solve(L, b))[signs > 0], np.linalg.solve(A, b)[signs > 0]
        assert np.abs(ours - pivoted).max() <= 1e-10 * np.abs(pivoted).max()


def test_arms_of_the_delta_are_eliminated_before_the_plate() -> None:
    """Fifteen coordinates of the arms and fifteen rows come before the plate's coordinates."""
    mechanism = load("delta")
    order = elimination_order(mechanism, mechanism.independent_rows)
    plate = [mechanism.coordinates.index(f"plate_place.{x}") for x in ("x", "y", "z", "rx", "ry", "rz")]
    assert min(order.index(k) for k in plate) == 30
