"""Motions through singular configurations: their condition and their replay by equations that share no code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from ckc_pin import InputError, Mechanism, Plan, optimize, simulate
from ckc_pin.base.arrays import Array
from tests.analytic.five_bar import E, FiveBar
from tests.optimization.small_models import require_replay

FIVE_BAR = FiveBar.from_table(1, 2, 4, 3)
NAMES = ("theta_1", "theta_2", "theta_3", "theta_4")
# On other assembly branches of the five-bar.
TARGETS = [[1.184, -0.698], [1.443, -2.038], [-1.888, 2.778]]
CRANK, ROD, SLIDER = (0.1, 0.4), (0.3, 0.6), 1.0  # m, kg; both links are uniform bars, 20 mm square


def close(chain: list[float], elbow: int) -> dict[str, float]:
    """Return the angles with these of the left chain, by trigonometry of the right one."""
    l, a, b = FIVE_BAR.l, *np.cumsum(chain)
    tip = np.array([l[0] * np.cos(a) + l[1] * np.cos(b) - FIVE_BAR.base, l[0] * np.sin(a) + l[1] * np.sin(b)])
    bend = elbow * np.arccos((tip @ tip - l[2] ** 2 - l[3] ** 2) / (2 * l[2] * l[3]))
    proximal = np.arctan2(tip[1], tip[0]) - np.arctan2(l[3] * np.sin(bend), l[2] + l[3] * np.cos(bend))
    turned = (proximal + np.pi) % (2 * np.pi) - np.pi
    return dict(zip(NAMES, [*chain, float(turned), float(bend)], strict=True))


@pytest.fixture(scope="module", params=range(len(TARGETS)))
def plan(request: pytest.FixtureRequest) -> Plan:
    target = close(TARGETS[request.param], -1)
    return optimize("five_bar", to={"q": target}, limits={"torque": 3.0}, cross_singularities=True)


def integrate(plan: Plan) -> Any:
    """Integrate eq. 1 of the appendix with the torques of a plan."""

    def rate(t: float, x: Array) -> Array:
        tau = np.array([np.interp(t, plan.torque_t, column) for column in plan.torque.T])
        return np.concatenate([x[4:], FIVE_BAR.acceleration_and_multipliers(x[:4], x[4:], tau)[0]])

    x = plan.quantities[0, :8]
    for begin, end in zip(plan.torque_t[:-1], plan.torque_t[1:], strict=True):
        x = solve_ivp(rate, (begin, end), x, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    return x


def test_the_appendix_reaches_the_target_beyond_the_singularity(plan: Plan) -> None:
    signs = [np.sign(np.linalg.det(FIVE_BAR.phi_z(q))) for q in plan.quantities[[0, -1], :4]]
    assert signs[0] != signs[1]
    assert np.abs(integrate(plan) - plan.quantities[-1, :8]).max() < 2e-6
    assert np.abs(plan.quantities[-1, 4:8]).max() < 1e-9  # at rest
    require_replay(plan, 3.0)


def test_no_force_is_needed_where_the_motors_have_none(plan: Plan) -> None:
    """At the crossing, the condition of Briot and Arakelian holds, with the terms of the appendix."""
    assert len(plan.crossings) % 2 == 1
    at = [plan.coordinates.index(name) if name in plan.coordinates else None for name in NAMES]
    columns = plan.columns()
    for crossing in plan.crossings:
        q, v, a = (x[0] for x in plan.motion(np.array([crossing.t])))
        sample = int(np.argmin(np.abs(plan.t - crossing.t)))
        q_tree = np.array([columns[name][sample] if k is None else q[k] for name, k in zip(NAMES, at, strict=True)])
        z = [k for k, place in enumerate(at) if place is None]
        planned = [k for k, place in enumerate(at) if place is not None]
        for _ in range(20):
            J = FIVE_BAR.J(q_tree)
            q_tree[z] -= np.linalg.solve(J[:, z], FIVE_BAR.phi(q_tree))
        assert abs(FIVE_BAR.s(q_tree)) < 1e-6  # the distal links are in line
        J, v_tree, a_tree = FIVE_BAR.J(q_tree), np.zeros(4), np.zeros(4)
        v_tree[planned], a_tree[planned] = v, a
        v_tree[z] = -np.linalg.solve(J[:, z], J[:, planned] @ v)
        a_tree[z] = -np.linalg.solve(J[:, z], J[:, planned] @ a + FIVE_BAR.J_dot(q_tree, v_tree) @ v_tree)
        force = FIVE_BAR.D_tree(q_tree) @ a_tree + FIVE_BAR.C_tree(q_tree, v_tree) @ v_tree + FIVE_BAR.h_tree(q_tree)
        free = np.linalg.svd(np.vstack([J, E.T]))[2][-1]  # moves no motor and keeps the loop closed
        assert np.abs(np.vstack([J, E.T]) @ free).max() < 1e-6
        assert abs(free @ force) < 1e-3 * np.abs(force).max()
        assert crossing.unbalanced < 1e-3


def slider_driven() -> Mechanism:
    """Return the slider-crank without gravity, driven by its slider, its crank at 0.5 rad."""
    loop = {"name": "pin", "type": "point_2d", "frame_a": {"link": "rod_link", "xyz": [ROD[0], 0.0, 0.0]},
            "frame_b": "slider_link", "rows_in": "world"}  # fmt: skip
    rod, slider = dead_centre(0.5)
    return Mechanism.from_urdf(
        Path("urdf/slider_crank/slider_crank.urdf"), loops=[loop], independent=["slider"], gravity=[0.0, 0.0, 0.0],
        motors=[{"joint": "slider"}], q_guess={"crank": 0.5, "rod": rod, "slider": slider},
    )  # fmt: skip


def dead_centre(crank: float) -> tuple[float, float]:
    """Return the angle of the rod relative to the crank and the place of the slider, outside."""
    lean = -np.arcsin(CRANK[0] * np.sin(crank) / ROD[0])
    return lean - crank, CRANK[0] * np.cos(crank) + ROD[0] * np.cos(lean)


def inertia(crank: float) -> float:
    """Return the inertia of the slider-crank at the crank, kg m²."""
    (r, crank_mass), (l, rod_mass) = CRANK, ROD
    lean = np.arcsin(r * np.sin(crank) / l)
    turn = r * np.cos(crank) / (l * np.cos(lean))  # of the rod, by the crank
    centre = [-r * np.sin(crank) - l / 2 * np.sin(lean) * turn, r * np.cos(crank) / 2]
    slide = -r * np.sin(crank) - l * np.sin(lean) * turn
    return (crank_mass * (4 * r**2 + 0.02**2) / 12 + rod_mass * np.dot(centre, centre) + SLIDER * slide**2
            + rod_mass * (l**2 + 0.02**2) / 12 * turn**2)  # fmt: skip


def test_a_slider_pushes_its_crank_through_dead_centre_in_the_closed_forms_time() -> None:
    """By symmetry the force is constant: all of it, towards the dead centre on both sides of it."""
    limit, x_0 = 20.0, dead_centre(0.5)[1]

    def slowness(crank: float) -> float:
        work = limit * (dead_centre(crank)[1] - x_0)
        return float(np.sqrt(inertia(crank) / (2 * work)))

    # The crank is 0.5 - s^2 near its start, so that the integrand is smooth.
    exact = 2 * quad(lambda s: 2 * s * slowness(0.5 - s**2), 1e-9, np.sqrt(0.5), epsabs=1e-12, epsrel=1e-12)[0]
    rod, slider = dead_centre(-0.5)
    plan = optimize(slider_driven(), to={"q": {"slider": slider, "crank": -0.5, "rod": rod}},
                    limits={"torque": limit}, cross_singularities=True)  # fmt: skip
    assert abs(plan.t_end / exact - 1) < 1e-5
    assert plan.torque.min() > limit * (1 - 1e-3)
    assert [x.t for x in plan.crossings] == pytest.approx([exact / 2], rel=1e-4)
    require_replay(plan, limit)


def test_ends_of_one_aspect_need_no_crossing() -> None:
    target = {"q": {"theta_1": -1.0, "theta_3": -1.9}}
    one, other = (optimize("five_bar", to=target, limits={"torque": 2.0}, cross_singularities=flag)
                  for flag in (False, True))  # fmt: skip
    assert one.t_end == other.t_end
    assert other.coordinates == ("theta_1", "theta_3")
    assert other.crossings == ()


def test_the_files_of_a_crossing_replay_it(tmp_path: Path, plan: Plan) -> None:
    files = {path.name for path in plan.save(tmp_path)}
    assert files == {"open.scene.toml", "plan.csv", "plan.json"}
    run = simulate(tmp_path / "open.scene.toml")
    assert run.status == "done"
    assert np.abs(run.q_tree[-1] - plan.quantities[-1, :4]).max() < 1e-6
    assert "crosses singular configurations" in str(plan)
    assert plan.to_dict()["crossings"][0]["t"] == plan.crossings[0].t


def test_a_crossing_has_no_tracking_scene(plan: Plan) -> None:
    with pytest.raises(InputError, match=r'plan.scene: tracking control .* take control = "open"'):
        plan.scene("closed")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"limits": {"torque": 3.0, "singularity": 0.1}}, "limits.singularity: not supported with cross_singularities"),
        ({"limits": {"torque": 3.0, "jerk": 1e4}}, "limits.jerk: not supported with cross_singularities"),
        ({"minimize": {"time": 1.0, "jerk": 1e-6}}, "minimize.jerk: not supported with cross_singularities"),
        ({"path": {"shape": "free"}}, "cross_singularities: a motion along a path"),
    ],
)
def test_crossing_rejects_options_of_regular_motions(keys: dict[str, Any], message: str) -> None:
    keys = {"limits": {"torque": 3.0}} | keys
    with pytest.raises(InputError, match=message):
        optimize("five_bar", to={"q": {"theta_1": -1.0, "theta_3": -1.9}}, cross_singularities=True, **keys)


def test_dependent_coordinates_select_the_branch_of_an_end() -> None:
    target = close(TARGETS[0], -1)
    with pytest.raises(InputError, match="not connected"):
        optimize("five_bar", to={"q": target}, limits={"torque": 3.0})
    start = close(TARGETS[2], -1)
    target = {"theta_1": start["theta_1"] + 0.1, "theta_3": start["theta_3"] + 0.1}
    plan = optimize("five_bar", start={"q": start}, to={"q": target}, limits={"torque": 3.0})
    assert np.abs(plan.quantities[0, :4] - list(start.values())).max() < 1e-9
    require_replay(plan, 3.0)
