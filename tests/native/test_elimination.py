"""Eliminations of eq. 1 without pivoting equal dense solutions; their work grows in proportion to chains of loops."""

from __future__ import annotations

import mpmath
import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Mechanism, Scene, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.kinematics.loading import build, load
from ckc_pin.mechanism.library import GeneratorSpec, generate, shipped
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from ckc_pin.scene.parts import load_scene_mechanism
from scripts.experiments.benchmark.growth import Case, exponent, write_case
from scripts.experiments.benchmark.mechanisms import parallel_chains
from scripts.experiments.mechanism_files import WIDE_LIMIT, urdf_joint, urdf_link, urdf_robot
from tests.property.mechanisms import closed_mechanism

KINDS = ("point", "point_2d", "hinge", "cylindrical", "universal", "prismatic", "weld", "distance")
TOLERANCE = 1e-11
ELIMINATIONS = (_core.SparseElimination, _core.ArticulatedElimination)
LINKS, LOOPS, MIN_JOINTS_IN_LOOP = 90, 6, 6  # of a random tree


def dense_acceleration(terms, u_tree):
    """Solve eq. 1 without its redundant rows by LU with pivoting."""
    rows, n = terms.mechanism.independent_rows, terms.mechanism.n
    D, J = np.triu(terms.D_tree), terms.at.J[rows]
    D = D + np.triu(D, 1).T
    A = np.block([[D, J.T], [J, np.zeros((len(rows), len(rows)))]])
    force = u_tree - terms.bias_tree + terms.damping_force
    return np.linalg.solve(A, np.concatenate([force, -terms.J_dot[rows] @ terms.v_tree]))[:n]


def relative_error(computed, expected):
    return np.abs(computed - expected).max() / np.abs(expected).max()


def random_tree(seed, *, free=False):
    """Return a mechanism of a random tree whose point loops are closed at its assembled configuration."""
    random = np.random.default_rng(seed)
    parents = [int(random.integers(max(0, k - 4), k)) for k in range(1, LINKS + 1)]
    elements = [urdf_link("0", 1.0, np.zeros(3), np.eye(3))]
    for k, parent in enumerate(parents, 1):
        mass, xyz, axis = random.uniform(0.5, 2.0), random.uniform(-0.5, 0.5, 3), random.normal(size=3)
        elements.append(urdf_link(str(k), mass, random.uniform(-0.2, 0.2, 3), 0.1 * mass * np.eye(3)))
        elements.append(urdf_joint(f"j{k}", "revolute", str(parent), str(k), xyz, (0.1, 0.2, 0.3), axis, WIDE_LIMIT))
    text = urdf_robot("random", elements)
    model = pin.buildModelFromXML(text)
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(model.nq))
    placement = [data.oMf[model.getFrameId(str(k))] for k in range(LINKS + 1)]
    moving = {0: set()}  # by link: the joints that move it
    for k, parent in enumerate(parents, 1):
        moving[k] = moving[parent] | {k}
    loops = []
    while len(loops) < LOOPS:
        a, b = random.choice(LINKS + 1, 2, replace=False)
        if len(moving[a] ^ moving[b]) < MIN_JOINTS_IN_LOOP:
            continue
        xyz = random.uniform(-0.3, 0.3, 3)
        frames = [(a, xyz), (b, placement[b].actInv(placement[a].act(xyz)))]
        frame_a, frame_b = ({"link": str(link), "xyz": at.tolist()} for link, at in frames)
        loops.append({"name": f"loop_{len(loops)}", "type": "point", "frame_a": frame_a, "frame_b": frame_b})
    return Mechanism.from_urdf(trees=[{"file": text, "root": "free" if free else "fixed"}], loops=loops)


def random_states(mechanism, count, seed, spread=0.1):
    """Yield terms at random states near the assembled configuration, off the manifold, and random forces."""
    random, n = np.random.default_rng(seed), mechanism.n
    for _ in range(count):
        at = mechanism.kinematics(mechanism.tree.integrate(mechanism.q_tree, spread * random.uniform(-1, 1, n)))
        yield Terms(mechanism, at, random.uniform(-1, 1, n)), random.uniform(-5, 5, n)


def count_equal_to_dense(mechanism, count, seed, kind):
    """Require equal accelerations at random states that need no pivoting, and return their number."""
    elimination, solved = kind(core_table(mechanism)), 0
    for terms, u_tree in random_states(mechanism, count, seed):
        computed = elimination.acceleration(terms.q_tree, terms.v_tree, u_tree)
        if computed is not None:
            solved += 1
            assert relative_error(computed, dense_acceleration(terms, u_tree)) <= TOLERANCE
    return solved


@pytest.mark.parametrize("elimination", ELIMINATIONS)
@pytest.mark.parametrize("name", shipped())
def test_shipped_mechanisms_equal_a_dense_solution(name, elimination):
    mechanism = load(name)
    assert count_equal_to_dense(mechanism, 50, 0, elimination) >= 45


@pytest.mark.parametrize("elimination", ELIMINATIONS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "variant", [{}, {"free": False}, {"redundant": True}, {"nonlinear": True}, {"rows_in": "world"}]
)
def test_random_loops_equal_a_dense_solution(kind, variant, elimination):
    closed = closed_mechanism(kind, seed=12, **variant)
    assert count_equal_to_dense(closed.mechanism, 20, 1, elimination) >= 15


@pytest.mark.parametrize("free", [False, True])
def test_bodies_move_and_press_as_those_of_pinocchio(free):
    """Of a random tree 1 km from the world's origin: bias forces, velocities and accelerations at zero v_dot."""
    mechanism = random_tree(3, free=free)
    elimination, model = _core.ArticulatedElimination(core_table(mechanism)), mechanism.tree.model
    data, random = model.createData(), np.random.default_rng(0)
    for _ in range(5):
        q_tree = mechanism.tree.integrate(mechanism.q_tree, random.uniform(-1, 1, mechanism.n))
        if free:
            q_tree[:3] = 1000.0, -200.0, 300.0
        v_tree = random.uniform(-1, 1, mechanism.n)
        bias, velocities, accelerations = elimination.motion(q_tree, v_tree)
        assert relative_error(bias, pin.nonLinearEffects(model, data, q_tree, v_tree)) <= TOLERANCE
        pin.forwardKinematics(model, data, q_tree, v_tree, np.zeros(mechanism.n))
        for joint in range(1, model.njoints):
            to_world = data.oMi[joint].toActionMatrix()
            for computed, motion in ((velocities, data.v[joint]), (accelerations, data.a[joint])):
                expected = to_world @ motion.vector
                assert np.abs(computed[:, joint] - expected).max() <= TOLERANCE * (1 + np.abs(expected).max())


@pytest.mark.parametrize("free", [False, True])
def test_unit_forces_accelerate_as_in_a_dense_solution(free):
    mechanism = random_tree(4, free=free)
    elimination, n = _core.ArticulatedElimination(core_table(mechanism)), mechanism.n
    at = [int(k) for k in np.random.default_rng(1).choice(n, 19, replace=False)]
    terms = Terms(mechanism, mechanism.kinematics(mechanism.q_tree), np.zeros(n))
    free_fall = dense_acceleration(terms, np.zeros(n))
    responses = elimination.unit_force_responses(mechanism.q_tree, at)
    assert responses is not None
    for k, response in zip(at, responses.T, strict=True):
        expected = dense_acceleration(terms, 1e3 * np.eye(n)[k]) - free_fall
        assert np.abs(1e3 * response - expected).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_core_equals_constraint_dynamics_of_pinocchio(seed, free):
    """Of a random tree with 90 joints and six loops, at its assembled configuration, where the loops are closed."""
    mechanism = random_tree(seed, free=free)
    core, random, n = _core.Core(core_table(mechanism)), np.random.default_rng(seed), mechanism.n
    assert core.has_elimination
    model, anchors = mechanism.tree.model, mechanism.closure.anchors
    points = [pin.SE3(np.eye(3), np.array(xyz)) for xyz in anchors.point_local]
    joints, pairs = [int(k) for k in anchors.point_joint], len(points) // 2
    constraints = pin.StdVec_RigidConstraintModel()
    for k in range(pairs):
        constraints.append(pin.RigidConstraintModel(
            pin.ContactType.CONTACT_3D, model, joints[k], points[k], joints[pairs + k], points[pairs + k],
            pin.ReferenceFrame.LOCAL))  # fmt: skip
    contact_data = pin.StdVec_RigidConstraintData()
    for constraint in constraints:
        contact_data.append(constraint.createData())
    data = model.createData()
    pin.initConstraintDynamics(model, data, constraints, contact_data)
    J = mechanism.assembled.J
    for _ in range(10):
        v_tree, u_tree = random.uniform(-1, 1, n), random.uniform(-5, 5, n)
        v_tree -= np.linalg.pinv(J) @ (J @ v_tree)
        settings = pin.ProximalSettings(1e-14, 1e-10, 100)
        expected = pin.constraintDynamics(
            model, data, mechanism.q_tree, v_tree, u_tree, constraints, contact_data, settings)  # fmt: skip
        computed = core.dae_acceleration(mechanism.q_tree, v_tree, u_tree, np.zeros(len(J)))
        assert relative_error(computed, expected) <= TOLERANCE


@pytest.mark.parametrize("name", ["tree", "free tree", "talos"])
def test_core_equals_its_projection(name):
    mechanism = load(name) if name == "talos" else random_tree(5, free=name == "free tree")
    assert mechanism.rank == mechanism.closure.rows  # redundant rows contradict each other off the manifold
    eliminating, projecting = _core.Core(core_table(mechanism)), _core.Core(core_table(mechanism))
    assert eliminating.has_elimination
    projecting.allow_elimination(False)
    correction = np.linspace(-1, 1, mechanism.closure.rows)
    errors = []
    for terms, u_tree in random_states(mechanism, 20, seed=2):
        state = terms.q_tree, terms.v_tree, u_tree, correction
        errors.append(relative_error(eliminating.dae_acceleration(*state), projecting.dae_acceleration(*state)))
    assert np.median(errors) > 0  # zero if a small pivot leads to projection
    assert np.max(errors) <= TOLERANCE


def test_small_mechanisms_and_chains_with_few_freedoms_use_projection():
    chain = build(*generate(GeneratorSpec(generator="n_four_bar", N=16)))
    for mechanism in [load(name) for name in shipped()] + [chain]:
        has_many_freedoms = mechanism.name == "talos"
        assert _core.Core(core_table(mechanism)).has_elimination == has_many_freedoms, mechanism.name


def pendulums(masses, friction=0.0, chains=1):
    """Return chains of thin rods in a plane, each rod 1 m long; all joints but the first of a chain have friction."""
    elements = [urdf_link("0", 1.0, np.zeros(3), np.eye(3))]
    rods = [(chain, k, mass) for chain in range(chains) for k, mass in enumerate(masses, 1)]
    for chain, k, mass in rods:
        link, parent = f"{chain}_{k}", f"{chain}_{k - 1}" if k > 1 else "0"
        elements.append(urdf_link(link, mass, np.array([0.5, 0.0, 0.0]), mass / 12 * np.diag([1e-6, 1.0, 1.0])))
        elements.append(urdf_joint(f"j{link}", "revolute", parent, link, (float(k > 1), 0, 0), axis=(0, 0, 1),
                                   limit=WIDE_LIMIT))  # fmt: skip
    joints = [{"name": f"j{chain}_{k}", "friction": friction} for chain, k, _ in rods if k > 1] if friction else []
    return Mechanism.from_urdf(urdf_robot("pendulums", elements), gravity=(0, -9.81, 0), joints=joints)


def test_a_small_pivot_falls_back_to_projection():
    """Loads of 10,000 tonnes hang on chains of light rods, whose own inertia is a difference of large numbers."""
    mechanism = pendulums([1.0] * 3 + [1e7], chains=6)
    table = core_table(mechanism)
    eliminating, projecting, eliminations = _core.Core(table), _core.Core(table), [kind(table) for kind in ELIMINATIONS]
    projecting.allow_elimination(False)
    assert eliminating.has_elimination
    for terms, u_tree in random_states(mechanism, 5, seed=3):
        assert all(of.acceleration(terms.q_tree, terms.v_tree, u_tree) is None for of in eliminations)
        state = terms.q_tree, terms.v_tree, u_tree, np.zeros(0)
        np.testing.assert_array_equal(eliminating.dae_acceleration(*state), projecting.dae_acceleration(*state))


def flat_squares():
    """Return three squares in a row, and their configuration where the rods lie flat and the loops lose rank."""
    mechanism = build(*generate(GeneratorSpec(generator="n_four_bar", N=3)))
    turn = np.where(np.arange(mechanism.n) <= 3, -np.pi / 2, np.pi / 2)
    return mechanism, mechanism.tree.integrate(mechanism.q_tree, turn)


def test_dependent_rows_are_detected():
    mechanism, flat = flat_squares()
    n = mechanism.n
    for elimination in [kind(core_table(mechanism)) for kind in ELIMINATIONS]:
        assert elimination.acceleration(mechanism.q_tree, np.zeros(n), np.zeros(n)) is not None
        assert elimination.acceleration(flat, np.zeros(n), np.zeros(n)) is None


@pytest.mark.parametrize("elimination", ELIMINATIONS)
def test_loops_stay_closed_near_a_loss_of_rank(elimination):
    """Without refinement J a differs from -J_dot v by up to 7e-14 of its terms."""
    mechanism, flat = flat_squares()
    n, random, worst = mechanism.n, np.random.default_rng(6), 0.0
    eliminated = elimination(core_table(mechanism))
    for _ in range(20):
        at = mechanism.kinematics(mechanism.tree.integrate(flat, 1e-3 * random.uniform(-1, 1, n)))
        terms, J = Terms(mechanism, at, random.uniform(-1, 1, n)), at.J
        a = eliminated.acceleration(terms.q_tree, terms.v_tree, random.uniform(-5, 5, n))
        J_dot_v = terms.J_dot @ terms.v_tree
        worst = max(worst, (np.abs(J @ a + J_dot_v) / (np.abs(J) @ np.abs(a) + np.abs(J_dot_v))).max())
    assert worst <= 4e-15


def test_rods_with_sticking_joints_move_as_one_rod():
    rods, t_end = 14, 1.0
    scene = Scene(
        pendulums([1.0] * rods, friction=1e6),
        formulation="dae",
        t_end=t_end,
        solver={"rtol": 1e-11, "terms": "pinocchio"},
    )
    run = simulate(scene)

    def rate(_, y):
        return [y[1], -1.5 * 9.81 / rods * np.cos(y[0])]

    expected = solve_ivp(rate, (0, t_end), [0, 0], rtol=1e-12, atol=1e-12, t_eval=run.t).y[0]
    assert run.status == "done"
    assert np.abs(run.q_tree[:, 0] - expected).max() <= 1e-9
    assert np.abs(run.q_tree[:, 1:]).max() <= 1e-12


@pytest.mark.parametrize("elimination", ELIMINATIONS)
@pytest.mark.parametrize("loops", ["all", 1])
def test_work_grows_in_proportion_to_the_number_of_squares(loops, elimination, tmp_path):
    work = {}
    for N in (5, 10, 20, 40):
        write_case(Case(N, N if loops == "all" else loops), tmp_path)
        mechanism = load(tmp_path / "mechanism.toml")
        work[N] = elimination(core_table(mechanism)).operations
    assert exponent(work, whole=True) <= 1.05


def test_elimination_of_deep_chains_is_as_exact_as_projection() -> None:
    """Near the root of a chain of 40 links D' loses five digits to both, beside a solution in 40 digits."""
    mechanism = load_scene_mechanism(parallel_chains(40, 17))
    v_tree = 0.3 * np.random.default_rng(0).normal(size=mechanism.n)
    terms = Terms(mechanism, mechanism.kinematics(mechanism.q_tree), v_tree)
    J, n = terms.at.J, mechanism.n
    with mpmath.workdps(40):
        A = mpmath.matrix(np.block([[terms.D_tree, J.T], [J, np.zeros((len(J), len(J)))]]).tolist())
        right = mpmath.matrix(np.concatenate([-terms.bias_tree, -terms.at.J_dot(v_tree) @ v_tree]).tolist())
        exact = np.array([float(x) for x in mpmath.lu_solve(A, right)[:n]])
    projected = dae_acceleration(terms, np.zeros(n))
    for kind in ELIMINATIONS:
        eliminated = kind(core_table(mechanism)).acceleration(mechanism.q_tree, v_tree, np.zeros(n))
        assert eliminated is not None
        assert relative_error(eliminated, exact) < 5e-10
        assert relative_error(eliminated, exact) < 3 * relative_error(projected, exact)
