"""Set-point control's claims against closed forms (pendulums) and the five-bar of the appendix in numpy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Mechanism, load
from ckc_pin.analysis.certificate import Certificate, certify, rest_height
from ckc_pin.analysis.explored import explore
from ckc_pin.analysis.gradient import bound_along, chart_step, explore_branch, gradient_bounds
from ckc_pin.analysis.walk import follow, least, margin, margin_gradient, same_configuration, way
from ckc_pin.control import SetPoint
from ckc_pin.control.desired import Harmonics
from ckc_pin.control.spec import HarmonicsSpec
from ckc_pin.errors import InputError
from ckc_pin.kinematics.assembly import assembled
from ckc_pin.kinematics.branches import assembly_branches
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.simulation.initial import Start
from ckc_pin.simulation.simulate import simulate
from scripts.experiments.paper import set_point
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.lyapunov import derivative, record
from scripts.experiments.paper.set_point_experiments import (
    DENSE,
    NEAR,
    SCENE,
    Case,
    along_run,
    equilibria_of,
    gradient_error,
    load_case,
)
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import Pair, assert_close

G, EDGE = 9.81, 1e-9


def pendulum(links: int) -> Mechanism:
    """A chain of point masses of 1 kg on massless rods of 1 m, angles from +x, gravity along -y."""
    parts, parent, x = ['<link name="base"/>'], "base", 0.0
    for k in range(1, links + 1):
        parts.append(
            f'<link name="rod{k}"><inertial><origin xyz="1 0 0"/><mass value="1"/>'
            '<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="q{k}" type="continuous"><parent link="{parent}"/><child link="rod{k}"/>'
            f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
        parent, x = f"rod{k}", 1.0
    spec = MechanismSpec(name="pendulum", urdf="p.urdf", gravity=(0.0, -G, 0.0))
    urdf = f'<robot name="p">{"".join(parts)}</robot>'
    return assembled(spec, Sources("pendulum", None, {"p.urdf": urdf}))


def at_rest(mechanism: Mechanism, q: list[float]) -> Start:
    found = sigma(mechanism, np.array(q))
    assert found.verdict == "converged"
    return Start(found.at, np.zeros(mechanism.d), np.zeros(mechanism.closure.rows))


def five_bar_U(case: Case, q: Array) -> float:
    """V_L at rest by the numpy five-bar."""
    q_d = case.controller.q_d
    h_d, V_d = FIVE_BAR.h(FIVE_BAR.sigma(q_d)), FIVE_BAR.potential_energy(FIVE_BAR.sigma(q_d))
    e = q - q_d
    return float(FIVE_BAR.potential_energy(FIVE_BAR.sigma(q)) - V_d - e @ h_d + e @ case.controller.K_P @ e / 2)


def five_bar_gradient(q: Array, step: float, branch: int = 1) -> Array:
    """dh/dq by fourth-order central differences of the numpy five-bar's h."""
    h = [[FIVE_BAR.h(FIVE_BAR.sigma(q + k * step * e, branch)) for k in (1, -1, 2, -2)] for e in np.eye(2)]
    return np.array([(8 * (a - b) - (c - d)) / (12 * step) for a, b, c, d in h]).T


def five_bar_border(s: float, count: int) -> Array:
    """Points (theta_1, theta_3) with |s| = s: with l2 = l4 the elbows are 2 l2 sin(gamma/2) apart, s = sin gamma."""
    l, points = FIVE_BAR.l, []
    for gamma in (np.arcsin(s), np.pi - np.arcsin(s)):
        distance = 2 * l[1] * np.sin(gamma / 2)
        for theta_1 in np.linspace(-np.pi, np.pi, count, endpoint=False):
            x, y = l[0] * np.cos(theta_1) - FIVE_BAR.base, l[0] * np.sin(theta_1)
            r = np.hypot(x, y)
            cosine = (l[2] ** 2 + r**2 - distance**2) / (2 * l[2] * r)
            if abs(cosine) <= 1:
                points += [[theta_1, np.arctan2(y, x) + sign * np.arccos(cosine)] for sign in (1, -1)]
    return np.array(points)


# --- dh/dq and its bound -----------------------------------------------------------------------------------------


def test_gradient_is_the_derivative_of_the_appendix_h(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    error, asymmetry, used = gradient_error(mechanism, 30)
    assert used > 15
    assert error < 1e-9
    assert asymmetry < 1e-14


@pytest.mark.parametrize(("s_min", "finer"), [(0.5, 1e-3), (0.1, 1e-4)])
def test_bounds_are_the_extremes_on_the_border(five_bar: Pair, s_min: float, finer: float) -> None:
    mechanism, _ = five_bar
    step = chart_step(mechanism, 36)
    (bound,) = gradient_bounds(mechanism, explore_branch(mechanism, mechanism.assembled, 36), [s_min], step)
    border = [five_bar_gradient(q, finer) for q in five_bar_border(s_min, 600)]
    assert_close(bound.norm, max(np.linalg.norm(g, 2) for g in border), 1e-3, relative=True)
    assert_close(
        bound.low, min(np.linalg.eigvalsh((g + g.T) / 2)[0] for g in border), 5e-3, relative=True
    )  # the border is sampled
    for q, value in ((bound.norm_q, bound.norm), (bound.low_q, -bound.low)):
        assert abs(FIVE_BAR.s(FIVE_BAR.sigma(q))) >= s_min * (1 - 1e-6)
        assert value <= np.linalg.norm(five_bar_gradient(q, finer), 2) * (1 + 1e-5)


def test_the_other_branch_is_the_mirror_image(five_bar: Pair) -> None:
    """Reflected in the base line gravity points up: dh/dq changes its sign."""
    mechanism, _ = five_bar
    own, other = assembly_branches(mechanism)
    step = chart_step(mechanism, 20)
    bounds = [gradient_bounds(mechanism, explore_branch(mechanism, at, 20), [0.6], step)[0] for at in (own, other)]
    assert_close(bounds[1].norm, bounds[0].norm, 2e-3, relative=True)
    assert_close(bounds[1].low, -bounds[0].norm, 2e-3, relative=True)  # the norm is a positive eigenvalue's
    assert bounds[0].low > bounds[1].low + 1


def test_bound_along_a_trajectory(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    waves = [(np.pi / 3, 1.0, 0.0)], [(np.pi / 4, 1.0, -np.pi / 2)]
    desired = Harmonics([HarmonicsSpec(harmonics=waves[0]), HarmonicsSpec(offset=np.pi / 4, harmonics=waves[1])])
    times = np.linspace(0, 2 * np.pi, 100)
    gradients = [five_bar_gradient(desired(t)[0], 1e-3) for t in times]
    found = bound_along(mechanism, desired, times)
    assert_close(found.norm, max(np.linalg.norm(g, 2) for g in gradients), 1e-8, relative=True)
    with pytest.raises(InputError, match="leaves the branch"):
        bound_along(load("five_bar_as_printed"), desired, times)


def test_margin_is_the_sine_between_the_distal_links(five_bar: Pair) -> None:
    mechanism, numpy_twin = five_bar
    for q in np.random.default_rng(1).uniform(-0.8, 0.8, (10, 2)):
        at = sigma(mechanism, q).at
        assert_close(margin(at), abs(numpy_twin.s(numpy_twin.sigma(q))), 1e-12)
        s = [[abs(numpy_twin.s(numpy_twin.sigma(q + sign * 1e-5 * e))) for sign in (1, -1)] for e in np.eye(2)]
        assert_close(margin_gradient(at), [(a - b) / 2e-5 for a, b in s], 1e-8)
    assert margin(pendulum(2).assembled) == 1.0


# --- exploring a branch ------------------------------------------------------------------------------------------


def test_flood_finds_the_disc_and_its_edges() -> None:
    mechanism = pendulum(2)
    centre = mechanism.assembled
    explored = explore(mechanism, centre, np.full(2, 0.1), lambda at: float(np.sum(at.q_tree**2)), 1.0)
    lattice = [(i, j) for i in range(-12, 13) for j in range(-12, 13) if 0.01 * (i * i + j * j) <= 1]
    assert len(explored.nodes) == len(lattice)
    assert len(explored.edges) == sum((i + 1, j) in lattice for i, j in lattice) * 2
    assert explored.water == sorted(explored.water)
    assert not explored.ends
    assert not explored.sampled
    assert not explored.full


def test_water_has_to_rise_over_the_ridge() -> None:
    """A node behind a ridge is connected at the ridge's height, not at its own."""
    mechanism = pendulum(1)

    def height(at) -> float:
        return float(np.sin(at.q_tree[0]) ** 2)

    explored = explore(mechanism, mechanism.assembled, np.full(1, 0.1), height, 2.0, np.array([63]))
    far = min(range(len(explored.nodes)), key=lambda k: abs(explored.nodes[k].q_tree[0] - 3.1))
    assert np.sin(explored.nodes[far].q_tree[0]) ** 2 < 0.01
    assert_close(explored.water[far], 1.0, 0.01)
    assert len(explored.nodes) == 63  # the lattice meets itself after a turn


def test_rays_stay_below_the_level() -> None:
    mechanism = pendulum(3)
    explored = explore(mechanism, mechanism.assembled, np.full(3, 0.2), lambda at: float(np.sum(at.q_tree**2)), 1.0)
    radii = np.array([np.linalg.norm(at.q_tree) for at in explored.nodes])
    assert explored.sampled
    assert radii.max() <= 1.0 < radii.max() + 0.2
    directions = np.array([np.sign(at.q_tree) for at in explored.nodes[1:]])
    assert len(np.unique(directions, axis=0)) == 8


def test_least_goes_down_to_a_constrained_minimum() -> None:
    mechanism = pendulum(2)
    found = least(
        mechanism,
        sigma(mechanism, np.array([1.0, 1.0])).at,
        lambda at: float(1 + np.sum(at.q_tree**2)),
        np.full(2, 0.1),
        lambda at: at if at.q_tree[0] >= 0.5 else None,
    )
    assert_close(found.q_tree, [0.5, 0.0], 3e-3)


def test_follow_stops_where_the_loops_cannot_close(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    at, reached = follow(mechanism, sigma(mechanism, np.array([0.0, 0.5])).at, np.array([3.0, -0.5]))
    assert 0 < reached < 1
    assert margin(at) < 0.01
    back, whole = follow(mechanism, at, np.array([0.0, 0.5]) - mechanism.independent_part(at.q_tree))
    assert whole == 1.0
    assert_close(mechanism.independent_part(back.q_tree), [0.0, 0.5], 1e-12)
    turned = mechanism.kinematics(back.q_tree + np.array([0, 2 * np.pi, 0, 0]))
    assert same_configuration(mechanism, back, turned)
    assert_close(way(mechanism, back, turned), np.zeros(2), 1e-12)


# --- the gain condition ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("K_P", "q", "holds"), [(12.0, -1.0, True), (12.0, 2.5, True), (5.0, 1.0, False), (5.0, 0.2, True)]
)
def test_certificate_of_a_pendulum(K_P: float, q: float, holds: bool) -> None:
    """h = g cos q and dh/dq = -g sin q: U and its second derivative are known."""
    mechanism, q_d = pendulum(1), 0.1
    controller = SetPoint(mechanism, np.array([[K_P]]), np.eye(1), np.array([q_d]))

    def U(x: float) -> float:
        return G * (np.sin(x) - np.sin(q_d)) - G * np.cos(q_d) * (x - q_d) + K_P * (x - q_d) ** 2 / 2

    found = certify(mechanism, controller, at_rest(mechanism, [q]))
    assert_close(found.level, U(q), 1e-12)
    # the interval around q_d, up to where U first passes the level
    ways = [np.arange(0.0, 20.0, 1e-4) * sign for sign in (1, -1)]
    ends = [q_d + x[np.argmax(np.array([U(q_d + y) for y in x]) > U(q) + EDGE)] for x in ways]
    inside = np.linspace(ends[1], ends[0], 100_001)
    least_eigenvalue = float(np.min(K_P - G * np.sin(inside)))
    assert (found.status == "certified") is holds is (least_eigenvalue > 0)
    assert_close(found.least_eigenvalue, least_eigenvalue, 0.02)
    assert not found.sampled
    assert found.least_margin == 1.0
    if not holds:
        fails = float(np.arcsin(K_P / G))  # where the second derivative changes its sign first
        assert_close(found.safe_level, U(fails), 0.05 * found.level)
        assert "has the eigenvalue" in found.reason


def test_three_freedoms_are_sampled_and_say_so() -> None:
    mechanism = pendulum(3)
    target = np.array([0.3, 0.1, -0.2])
    stiff = SetPoint(mechanism, 200.0 * np.eye(3), np.eye(3), target)
    found = certify(mechanism, stiff, at_rest(mechanism, [0.8, 0.3, 0.0]), divisions=8)
    assert (found.status, found.sampled) == ("certified", True)
    assert found.points > 300
    # |V's second derivative| is at most the sum of the weights' moments
    assert 200 - G * (3 + 2 * 2 + 1 * 3) * 3 < found.least_eigenvalue < 200
    weak = certify(
        mechanism, SetPoint(mechanism, 60.0 * np.eye(3), np.eye(3), target), at_rest(mechanism, [2.0, 0, 0]), 8
    )
    assert (weak.status, weak.sampled) == ("not certified", True)
    assert weak.least_eigenvalue < 0
    upright = SetPoint(mechanism, np.eye(3), np.eye(3), np.array([np.pi / 2, 0, 0]))
    assert "lower at the start" in certify(mechanism, upright, at_rest(mechanism, [-1.0, 0, 0])).reason


def test_certified_start_of_the_five_bar() -> None:
    case = load_case(NEAR)
    found = case.certificate(24)
    assert found.status == "certified"
    assert found.safe_level == found.level
    assert_close(found.level, five_bar_U(case, np.array([0.3, 0.5])), 1e-12)
    grid = [
        q
        for x in np.linspace(-0.56, 0.56, 33)
        for y in np.linspace(-0.56, 0.56, 33)
        if five_bar_U(case, q := case.controller.q_d + np.array([x, y])) <= found.level
    ]
    eigenvalues = [np.linalg.eigvalsh(case.controller.K_P + five_bar_gradient(q, 1e-3))[0] for q in grid]
    margins = [abs(FIVE_BAR.s(FIVE_BAR.sigma(q))) for q in grid]
    assert min(eigenvalues) - 0.05 < found.least_eigenvalue < min(eigenvalues) + 1e-3
    assert min(margins) - 0.03 < found.least_margin < min(margins) + 1e-3


def test_the_scene_is_not_certified_because_its_set_reaches_type_2() -> None:
    case = load_case()
    found = case.certificate(24)
    assert found.status == "not certified"
    assert "singular" in found.reason
    assert np.isnan(found.least_eigenvalue)
    assert found.least_margin == 0.0
    fold = five_bar_border(0.02, 4000)  # of this close to singular, U differs little from the fold's
    lowest = min(five_bar_U(case, q) for q in fold)
    assert_close(found.safe_level, lowest, 0.01, relative=True)


def test_an_isolated_singular_point_between_lattice_points_is_found() -> None:
    """Type 1 is a point: with gains so large no lattice point near it fails, but the search between them does."""
    gains = {"controller.K_P": 3000.0, "controller.q_d": {"theta_1": 0.9, "theta_3": 1.9}}
    case = load_case({**gains, "initial.at": None, "initial.q": {"theta_1": 0.75, "theta_3": 1.65}})
    assert np.hypot(0.9 - 0.993865, 1.9 - 2.147728) < np.hypot(0.15, 0.25)
    found = case.certificate(12)
    assert found.status == "not certified"
    assert "near theta_1 = 0.99" in found.reason
    assert "theta_3 = 2.14" in found.reason


def test_what_the_argument_does_not_cover_is_said() -> None:
    case = load_case(NEAR)
    mechanism = case.mechanism
    other = next(x for x in assembly_branches(mechanism)[1:])
    there, _ = follow(mechanism, other, np.array([0.3, 0.5]) - mechanism.independent_part(other.q_tree))
    beside = replace(case, start=replace(case.start, at=there))
    q = mechanism.independent_part(there.q_tree)
    assert_close(q, [0.3, 0.5], 1e-12)
    certificate = replace(case, start=beside.start).certificate(12)
    assert certificate.status == "not certified"
    off = replace(case, start=replace(case.start, w=np.array([1e-3, 0.0])))
    assert "off phi = 0" in off.certificate().reason
    model = SetPoint(load("five_bar"), case.controller.K_P, case.controller.K_V, case.controller.q_d)
    assert "another model" in certify(mechanism, model, case.start).reason
    with pytest.raises(InputError, match="set-point"):
        load_case(scene="five_bar/tracking")


# --- eq. 15 ------------------------------------------------------------------------------------------------------


def test_one_solution_where_the_gain_condition_holds() -> None:
    case = load_case(NEAR)
    (only,) = equilibria_of(case, 10, 60)
    assert only.kind == "minimum"
    assert_close(only.q, case.controller.q_d, 1e-9)


def test_low_gains_have_other_solutions_and_runs_end_there() -> None:
    low = {"controller.K_P": 0.5}
    case = load_case(low)
    found = equilibria_of(case, 12, 60)
    q_d, h_d = case.controller.q_d, FIVE_BAR.h(FIVE_BAR.sigma(case.controller.q_d))
    for x in found:
        h = FIVE_BAR.h(FIVE_BAR.sigma(x.q))
        assert_close(h - h_d, 0.5 * (q_d - x.q), 1e-9)
        hessian = 0.5 * np.eye(2) + five_bar_gradient(x.q, 1e-4)
        assert (x.kind == "minimum") is bool(np.all(np.linalg.eigvalsh(hessian) > 0))
        assert_close(x.height, five_bar_U(case, x.q), 1e-10)
    assert {x.kind for x in found} == {"minimum", "saddle"}
    run = simulate(SCENE, {**low, "t_end": 60.0})
    end = run.q_tree[-1, [0, 2]]
    assert np.abs(end - q_d).max() > 0.5
    assert min(np.abs(end - x.q).max() for x in found if x.kind == "minimum") < 1e-6


# --- the Lyapunov function along runs ----------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_rate_of_the_lyapunov_function(formulation: str) -> None:
    run, found = along_run({**DENSE, "formulation": formulation, "t_end": 0.3, "solver.output_dt": 1e-3})
    assert found.monotone
    assert found.mismatch < 1e-6
    assert_close(found.value, [five_bar_V(run.q_tree[k], run.v_tree[k]) for k in range(len(run.t))], 1e-10)
    wrong = record(run, lambda k: 1.1 * float(found.predicted[k]))
    assert wrong.mismatch > 0.05
    rising = record(replace(run, lyapunov=found.value[::-1].copy()), lambda k: 1.0)
    assert not rising.monotone


def five_bar_V(q_tree: Array, v_tree: Array) -> float:
    q_d = np.full(2, np.pi / 4)
    at_d = FIVE_BAR.sigma(q_d)
    e = q_tree[[0, 2]] - q_d
    return float(
        FIVE_BAR.energy(q_tree, v_tree) - FIVE_BAR.potential_energy(at_d) - e @ FIVE_BAR.h(at_d) + 10 * e @ e / 2
    )


def test_derivative_of_samples() -> None:
    t = np.linspace(0, 1, 101)
    assert_close(derivative(t, np.exp(-3 * t)), -3 * np.exp(-3 * t), 1e-9)


# --- the claims --------------------------------------------------------------------------------------------------


CHOSEN = ("equilibrium, K_P = 10 I", "(0.3, 0.5), K_P = 10 I", "equilibrium, K_P = 0.5 I")


@pytest.fixture(scope="module")
def certified() -> dict[str, tuple[Case, Certificate]]:
    cases = {name: load_case(set_point.ROWS[name]) for name in CHOSEN}
    return {name: (case, case.certificate(12)) for name, case in cases.items()}


def complete(claim: Claim, figures: Path) -> str:
    """Return the verdict of a claim whose table and figures are whole."""
    assert all((figures / name).stat().st_size > 5_000 for name in claim.figures)
    assert claim.table is not None
    assert all(len(row) == len(claim.table[0]) for row in claim.table[1])
    return claim.verdict


def test_verdict_on_the_gain_condition(certified: dict[str, tuple[Case, Certificate]], tmp_path: Path) -> None:
    case, own = certified[CHOSEN[0]]
    run, found = along_run({**DENSE, "formulation": "reduced", "t_end": 0.3})
    assert complete(set_point.gain_claim(case, own, certified, run, tmp_path), tmp_path) == "holds with a condition"
    assert complete(set_point.lyapunov_claim({"reduced": found}, tmp_path), tmp_path) == "holds"
    rising = record(replace(run, lyapunov=found.value[::-1].copy()), lambda k: 1.0)
    assert complete(set_point.lyapunov_claim({"reduced": rising}, tmp_path), tmp_path) == "does not hold"


def test_verdict_on_uniqueness(certified: dict[str, tuple[Case, Certificate]], tmp_path: Path) -> None:
    solutions = {name: equilibria_of(case, 10, 30) for name, (case, _) in certified.items()}
    assert complete(set_point.uniqueness_claim(certified, solutions), tmp_path) == "holds"
    two = {**solutions, CHOSEN[1]: solutions[CHOSEN[1]] * 2}  # where the gain condition is certified
    assert complete(set_point.uniqueness_claim(certified, two), tmp_path) == "does not hold"


def test_verdict_on_the_bound(five_bar: Pair, tmp_path: Path) -> None:
    mechanism, case = five_bar[0], load_case()
    step = chart_step(mechanism, 16)
    explored = explore_branch(mechanism, mechanism.assembled, 16)
    rising = [gradient_bounds(mechanism, explored, [0.5, 0.1, 0.05], step)]
    right = (1e-11, 1e-15, 43)
    assert complete(set_point.gradient_claim(case, right, rising, tmp_path), tmp_path) == "holds with a condition"
    flat = [[replace(bound, norm=3.0) for bound in rising[0]]]
    assert complete(set_point.gradient_claim(case, right, flat, tmp_path), tmp_path) == "holds"


def test_rest_height_is_the_controllers_function_at_rest() -> None:
    case = load_case(NEAR)
    assert_close(rest_height(case.mechanism, case.controller, case.start.at), case.level, 1e-14)
