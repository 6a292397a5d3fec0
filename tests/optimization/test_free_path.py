"""Paths that the program finds: no singular configuration and no limit on them, by models that share no code."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, NumericalError, Plan, load, optimize
from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.optimization.free_path import FreeSpace, search_path
from ckc_pin.optimization.limits import make_limits
from ckc_pin.optimization.path import CoordinatePath
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.spec import KeepOutSpec, LimitsSpec, SphereSpec
from scripts.experiments.identification_trials import load_case
from tests.analytic.five_bar import FiveBar
from tests.optimization.small_models import require_replay, table

FIVE_BAR = FiveBar.from_table(1, 2, 4, 3)
# Behind configurations that the straight line from the assembled one cannot pass.
HIDDEN = [[-1.89, 2.78], [-2.61, 2.09], [-1.99, 2.91], [-1.45, 2.28], [2.79, -1.89]]
TARGET = {"q": {"theta_1": -1.0, "theta_3": -1.9}}


def sine(q: Array) -> float:
    """Return the sine of the angle between the distal links: 0 where singular, -1 where the links do not reach."""
    try:
        return float(FIVE_BAR.s(FIVE_BAR.sigma(q)))
    except ValueError:
        return -1.0


def places(plan: Plan, count: int = 2000) -> Array:
    return plan.motion(np.linspace(0.0, plan.t_end, count))[0]


@cache
def path_to(*target: float) -> CoordinatePath:
    """Return the five-bar's path without limits from the assembled configuration."""
    five_bar = load("five_bar")
    end = sigma(five_bar, np.array(target)).at.q_tree
    return search_path(five_bar, make_limits(LimitsSpec(), five_bar), five_bar.q_tree, end)


@pytest.mark.parametrize("target", HIDDEN)
def test_a_path_leads_around_singular_configurations(target: list[float]) -> None:
    five_bar, path = load("five_bar"), path_to(*target)
    s = np.linspace(0.0, 1.0, 5001)
    start = five_bar.q_tree[[0, 2]]
    straight = [sine(start + x * (target - start)) for x in s]
    assert min(straight) < 1e-3
    q, q_s, q_ss = path.q(s)
    assert np.abs(q[[0, -1]] - [start, target]).max() < 1e-12
    assert min(sine(x) for x in q) > 1e-3
    # Derivatives are continuous: those from both sides of breaks are equal.
    for x in path.q.breaks[1:-1]:
        sides = [path.q(np.array([x + h]))[1:] for h in (-1e-9, 1e-9)]
        for k, scale in enumerate((q_s, q_ss)):
            assert np.abs(sides[0][k] - sides[1][k]).max() < 1e-5 * np.abs(scale).max()


def test_places_near_singular_configurations_are_followed() -> None:
    """The sine of the angle between the distal links is 0.0095 on the line. Longer steps would lead beyond it."""
    five_bar = load("five_bar")
    start, end = five_bar.q_tree[[0, 2]], np.array([2.0, -5.0])
    q = start + np.outer(np.linspace(0, 1, 24), end - start)
    q_tree = ReducedDynamics(five_bar).follow(five_bar.q_tree, q)
    assert q_tree is not None
    expected = np.array([FIVE_BAR.sigma(x) for x in q])
    assert np.abs(np.exp(1j * q_tree) - np.exp(1j * expected)).max() < 1e-9


def test_no_path_leads_where_another_aspect_is() -> None:
    """A flat parallelogram is singular: the signs of the knee's angle are two aspects."""
    leg = load_case("leg")
    end = leg.tree.from_coordinates(
        leg.vector({"hip": -1.2, "knee": -0.4, "support": -0.4, "ankle": 0.4}, leg.coordinates, "end")
    )
    with pytest.raises(InputError, match=r"not connected: in the map .* `from` is in aspect \d .* another aspect"):
        search_path(leg, make_limits(LimitsSpec(), leg), leg.q_tree, end)


@pytest.mark.parametrize("path", [None, {"shape": "free"}])
def test_a_point_stays_out_of_a_sphere(path: dict[str, Any] | None) -> None:
    five_bar = load("five_bar")
    start, end = five_bar.q_tree[[0, 2]], np.array([0.0, 0.5])

    def tip(q: Array) -> Array:
        q_tree = FIVE_BAR.sigma(q)
        return FIVE_BAR.l[0] * direction(q_tree[0]) + FIVE_BAR.l[1] * direction(q_tree[0] + q_tree[1])

    centre = tip((start + end) / 2)
    sphere = {"centre": [*centre.tolist(), 0.0], "radius": 0.03}
    plan = optimize(five_bar, to={"q": {"theta_1": end[0], "theta_3": end[1]}}, path=path,
                    limits={"torque": 5.0, "keep_out": [{"sphere": sphere, "points": ["tip"]}]})  # fmt: skip
    distance = min(float(np.linalg.norm(tip(q) - centre)) for q in places(plan))
    assert distance > 0.03 * (1 - 2e-3)
    assert (
        distance < 0.045 or path is None
    )  # the straight line leads through the centre; a fast motion may go elsewhere
    require_replay(plan, 5.0)


def direction(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def test_a_path_keeps_the_limit_of_singularity() -> None:
    """The smallest singular value of phi_z, by the model of the appendix, is at least half its value at the start."""
    target = HIDDEN[3]

    def smallest(q: Array) -> float:
        return float(np.linalg.svd(FIVE_BAR.phi_z(FIVE_BAR.sigma(q)), compute_uv=False)[-1])

    def margin(q: Array) -> float:
        return min(smallest(x) for x in q) / smallest(q[0])

    assert margin(path_to(*target).q(np.linspace(0.0, 1.0, 1000))[0]) < 0.5 - 1e-3
    plan = optimize("five_bar", to={"q": dict(zip(("theta_1", "theta_3"), target, strict=True))},
                    path={"shape": "free"}, limits={"torque": 5.0, "singularity": 0.5}, intervals=50)  # fmt: skip
    assert margin(places(plan)) > 0.5 * (1 - 1e-4)


def test_a_dependent_coordinate_stays_within_its_limits() -> None:
    five_bar = load("five_bar")
    end = sigma(five_bar, np.array(HIDDEN[0])).at.q_tree

    def angles(path: CoordinatePath) -> Array:
        return np.unwrap([FIVE_BAR.sigma(x)[1] for x in path.q(np.linspace(0, 1, 3000))[0]])

    free = angles(path_to(*HIDDEN[0]))
    bound = (float(free.max()) + float(free[[0, -1]].max())) / 2
    assert free.max() > bound + 0.02
    limits = make_limits(LimitsSpec(q={"theta_2": (-10.0, bound)}), five_bar)
    assert angles(search_path(five_bar, limits, five_bar.q_tree, end)).max() < bound + 1e-4


def test_the_path_around_a_disc_is_nearly_the_shortest() -> None:
    """Between two places at equal distances, it has two tangents and an arc."""
    mechanism, distance, radius = table(), 0.5, 0.2
    limits = make_limits(
        LimitsSpec(keep_out=[KeepOutSpec(sphere=SphereSpec(centre=(0.0, 0.0, 0.0), radius=radius), points=["bead"])]),
        mechanism,
    )
    path = search_path(mechanism, limits, np.array([-distance, 0.0]), np.array([distance, 0.0]))
    q = path.q(np.linspace(0, 1, 4001))[0]
    length = sum(float(np.linalg.norm(b - a)) for a, b in pairwise(q))
    angle = np.arccos(radius / distance)
    shortest = 2 * np.sqrt(distance**2 - radius**2) + radius * (np.pi - 2 * angle)
    assert np.linalg.norm(q, axis=1).min() > radius - 1e-6
    assert shortest - 1e-9 < length < 1.1 * shortest


def test_an_enclosed_place_is_not_reached() -> None:
    """Discs around the target leave no gap."""
    mechanism = table()
    centres = [(0.3 * np.cos(a), 0.3 * np.sin(a), 0.0) for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
    spheres = [KeepOutSpec(sphere=SphereSpec(centre=x, radius=0.12), points=["bead"]) for x in centres]
    limits = make_limits(LimitsSpec(keep_out=spheres), mechanism)
    with pytest.raises(NumericalError, match=r"no path from `from` to `to` was found in \d+ attempts"):
        search_path(mechanism, limits, np.array([-0.8, 0.0]), np.zeros(2))


@pytest.mark.parametrize("name", ["delta", "stewart", "two_ur5"])
def test_paths_of_spatial_mechanisms_are_closed_and_regular(name: str) -> None:
    """det phi_z keeps its sign along dense places."""
    mechanism = load(name)
    limits = make_limits(LimitsSpec(), mechanism)
    space = FreeSpace(mechanism, limits, mechanism.q_tree)
    random = np.random.default_rng(2)
    step = 0.5 * space.scale * random.uniform(-1, 1, (1, mechanism.d))
    end = space.follow(space.node(mechanism.q_tree), step)[0]
    path = search_path(mechanism, limits, mechanism.q_tree, end.q_tree[0])
    at, signs = mechanism.assembled, set[float]()
    for q in path.q(np.linspace(0, 1, 200))[0][1:]:
        solution = sigma(mechanism, q, at, anywhere=False)
        assert solution.verdict == "converged"
        at = solution.at
        J = at.J
        free = space.task.extended.free
        signs.add(float(np.sign(np.linalg.det(J[free][:, mechanism.partition.z]))))
    assert np.abs(at.q_tree - end.q_tree[0]).max() < 1e-7
    assert len(signs) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": {"shape": "free", "q": {"theta_1": [0.0], "theta_3": [0.0]}}}, "path.q does not belong to shape"),
        ({"path": {"shape": "free", "rounding": 0.1}}, "path.rounding does not belong to shape"),
        ({"to": None}, 'expected either `to` or `path`, got neither; path.shape = "free" needs both'),
        ({"path": {"shape": "lines"}}, "got both"),
        (
            {"start": {"at": "assembled", "q_dot": {"theta_1": 1.0}}},
            "from.q_dot: a motion along a path begins and ends at",
        ),
        ({"to": {"at": "assembled"}}, "to: the same configuration as `from`"),
        ({"minimize": {"tracking": 1.0}}, "minimize.tracking: not supported along a path"),
        ({"limits": {"torque": 2.0, "singularity": 1.0}}, "to: sigma_min(phi_z) is"),
    ],
)
def test_wrong_input_is_explained(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"to": TARGET, "path": {"shape": "free"}, "limits": {"torque": 2.0}, **change}
    with pytest.raises(InputError) as error:
        optimize("five_bar", **arguments)
    assert message in str(error.value)


def test_an_imported_leg_is_planned_and_replayed() -> None:
    plan = optimize(load_case("leg"), to={"q": {"hip": -0.6, "knee": 1.3}}, limits={"torque": 3.0}, intervals=20)
    require_replay(plan, 3.0)
