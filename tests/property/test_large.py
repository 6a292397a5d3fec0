"""Sparse factorizations and wrenches, which large mechanisms use, against dense decompositions and small mechanisms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import load, simulate
from ckc_pin.base.linear_algebra import Factorization
from ckc_pin.base.sparse import MIN_ROWS, factorize_full_row_rank, smallest_singular_value
from ckc_pin.mechanism import pose as poses
from ckc_pin.mechanism.library import GeneratorSpec
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rank import compute_rank
from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.regression.test_reference_cases import pendulum_constant


def random_sparse(rows: int, columns: int, seed: int) -> Array:
    """A chain of blocks, as loops in a row have them, with a few entries elsewhere."""
    random = np.random.default_rng(seed)
    matrix = np.zeros((rows, columns))
    for i in range(rows):
        at = np.unique(np.clip(i * columns // rows + random.integers(-3, 4, 4), 0, columns - 1))
        matrix[i, at] = random.normal(size=len(at))
        matrix[i, random.integers(columns)] += random.normal()
        matrix[i, i] += 3.0
    return matrix


@pytest.mark.parametrize("seed", range(5))
def test_sparse_factorization_agrees_with_dense_decompositions(seed: int) -> None:
    random = np.random.default_rng(seed)
    m, n = MIN_ROWS + 20 * seed, MIN_ROWS + 25 * seed + 7
    matrix = random_sparse(m, n, seed)
    full = factorize_full_row_rank(matrix)
    assert full is not None
    values = np.linalg.svd(matrix, compute_uv=False)
    assert_close(full.smallest / values[-1], 1.0, 1e-6)
    assert_close(full.largest / values[0], 1.0, 1e-3)
    right = random.normal(size=m)
    assert_close(full.minimum_norm(right), np.linalg.lstsq(matrix, right, rcond=None)[0], 1e-11)
    basis = full.null_space()
    assert basis.shape == (n, n - m)
    assert_close(matrix @ basis, 0.0, 1e-12)
    assert_close(basis.T @ basis, np.eye(n - m), 1e-12)


def test_lost_rank_is_left_to_the_dense_decomposition() -> None:
    matrix = random_sparse(MIN_ROWS, MIN_ROWS + 10, 0)
    matrix[17] = matrix[3] - 2.0 * matrix[40]
    assert factorize_full_row_rank(matrix) is None
    report = compute_rank(matrix)
    assert report.rank == MIN_ROWS - 1
    assert report.is_certain
    matrix[17, 17] += 1e-6  # not exactly
    assert factorize_full_row_rank(matrix) is None
    matrix[17, 17] += 1e-2
    assert compute_rank(matrix).rank == MIN_ROWS


@pytest.mark.parametrize("seed", range(4))
def test_large_factorization_solves_and_has_the_sign_of_the_determinant(seed: int) -> None:
    random = np.random.default_rng(seed)
    matrix = random_sparse(MIN_ROWS, MIN_ROWS, seed)[random.permutation(MIN_ROWS)]
    factor, right = Factorization(matrix), random.normal(size=(MIN_ROWS, 2))
    assert_close(matrix @ factor.solve(right), right, 1e-11)
    assert_close(matrix.T @ factor.solve_transposed(right), right, 1e-11)
    assert_close(factor.determinant() / np.linalg.det(matrix), 1.0, 1e-9)
    assert_close(smallest_singular_value(matrix) / np.linalg.svd(matrix, compute_uv=False)[-1], 1.0, 1e-6)


@pytest.mark.parametrize("name", ["five_bar", "stewart", "talos", "bricard", "two_ur5", "slider_crank_spatial"])
def test_jacobian_by_wrenches_equals_that_by_points(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mechanism = load(name)
    tree, closure, random = mechanism.tree, mechanism.closure, np.random.default_rng(0)
    for _ in range(5):
        q = tree.integrate(mechanism.q_tree, random.normal(size=tree.n) * tree.step_scale)
        by_points = closure.jacobian(Pose(tree, closure.anchors, q))
        monkeypatch.setattr(poses, "MIN_WRENCH_SIZE", 0)
        by_wrenches = closure.jacobian(Pose(tree, closure.anchors, q))
        monkeypatch.undo()
        assert_close(by_wrenches, by_points, 1e-12)


@pytest.mark.parametrize("name", ["five_bar", "stewart", "talos", "two_ur5"])
def test_motions_of_bodies_and_points_are_derivatives_of_their_positions(name: str) -> None:
    mechanism = load(name)
    tree, anchors, random = mechanism.tree, mechanism.closure.anchors, np.random.default_rng(0)
    q = tree.integrate(mechanism.q_tree, random.normal(size=tree.n) * tree.step_scale)
    tangent, h = random.normal(size=(tree.n, 3)), 1e-6
    joints = [k for k in range(1, tree.model.njoints) if tree.model.inertias[k].mass > 0]

    def positions(q_tree: Array) -> Array:
        placement, _ = tree.kinematics(q_tree)
        rotation = placement[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
        centres = [rotation[k] @ tree.model.inertias[k].lever + placement[k, 9:] for k in joints]
        return np.concatenate([*centres, *Pose(tree, anchors, q_tree).p])

    motions = np.vstack([tree.centre_of_mass_motions(q, tangent), Pose(tree, anchors, q).p_motions(tangent)])
    for k in range(3):
        forward, backward = (positions(tree.integrate(q, s * h * tangent[:, k])) for s in (1.0, -1.0))
        assert_close(motions[:, k], (forward - backward) / (2 * h), 1e-7)


def test_many_squares_move_as_one_pendulum() -> None:
    """All rods keep one angle and all bars stay level: theta_ddot = -k cos(theta) for every number of squares."""
    N = 150
    mechanism = load(GeneratorSpec(generator="n_four_bar", N=N))
    assert (mechanism.n, mechanism.d, mechanism.redundant) == (2 * N + 1, 1, ())
    signs = [1.0 if name.startswith("theta") else -1.0 for name in mechanism.coordinates]
    assert_close(mechanism.assembled.rho[:, 0], signs, 1e-10)
    assert mechanism.assembled.phi_z_factor.determinant() != 0.0
    start = {"initial.q": {"theta_0": 1.2}, "initial.q_dot": {"theta_0": -1.0}, "t_end": 0.3, "solver.rtol": 1e-9}
    k = pendulum_constant(N)
    pendulum = solve_ivp(lambda _, y: [y[1], -k * np.cos(y[0])], (0, 0.3), [1.2, -1.0], rtol=1e-11, atol=1e-12)
    for formulation in ("dae", "reduced"):
        run = simulate("n_four_bar", {"mechanism.N": N, "formulation": formulation, **start})
        assert run.status == "done"
        assert_close(run["theta_0"][-1], pendulum.y[0, -1], 1e-8)
        assert_close(run[f"theta_{N}"][-1], pendulum.y[0, -1], 1e-8)
