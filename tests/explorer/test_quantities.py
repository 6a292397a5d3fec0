"""Live quantities against closed forms, finite differences, and the equilibrium of each body."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import ckc_pin
from ckc_pin import InputError, Mechanism
from ckc_pin.analysis.singularities import search_singular
from ckc_pin.explorer.forces import compute_pose_forces
from ckc_pin.explorer.paths import EXPLORED, SHOWN
from ckc_pin.explorer.quantities import QUANTITIES, Quantities
from ckc_pin.explorer.quantity import PoseState
from ckc_pin.explorer.shapes import TRACE_LENGTH, compute_ellipsoids
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.library import library, shipped
from ckc_pin.view.commands import SceneState
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.conftest import assert_close

STEP = 1e-5  # rad or m, of central differences
PENDULUM = """<robot name="pendulum"><link name="base"/>
  <link name="rod"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint>
</robot>"""


def poses_of_five_bar(count: int) -> list[Array]:
    """Return closed configurations of the five-bar on both branches, from its closed form."""
    random = np.random.default_rng(5)
    return [FIVE_BAR.sigma(np.array([1.7, 1.4]) + random.uniform(-0.3, 0.3, 2), 1 - 2 * (k % 2)) for k in range(count)]


def number(text: str) -> float:
    return float(text.split(" ")[0])


def show(mechanism: Mechanism, *names: str) -> Quantities:
    quantities = Quantities(mechanism)
    for name in names:
        quantities.show(name, True)
    return quantities


def moved(mechanism: Mechanism, scale: float = 0.1):
    """Return a closed configuration away from home."""
    q = mechanism.independent_part(mechanism.q_tree)
    solution = sigma(mechanism, q + scale * np.random.default_rng(2).uniform(-1.0, 1.0, mechanism.d))
    assert solution.verdict == "converged"
    return solution.at


# --- what is computed ----------------------------------------------------------------------------


def test_hidden_quantities_are_not_computed(monkeypatch) -> None:
    mechanism, calls = ckc_pin.load("five_bar"), []
    for kind in QUANTITIES:
        original = kind.evaluate
        monkeypatch.setattr(kind, "evaluate", lambda self, *args, f=original: calls.append(self.name) or f(self, *args))
    quantities, at = Quantities(mechanism), mechanism.kinematics(mechanism.q_tree)
    before = set(vars(at))
    shown = quantities.evaluate(at)
    assert (shown.lines, shown.margins, shown.commands, calls) == ({}, {}, [], [])
    for kind in QUANTITIES:
        quantities.show(kind.name, True)
        lines = quantities.evaluate(mechanism.kinematics(mechanism.q_tree)).lines
        assert list(lines) == calls == [kind.name]
        quantities.show(kind.name, False)
        calls.clear()
    assert set(vars(at)) == before
    quantities.show("centre_of_mass", True)
    quantities.evaluate(at)
    assert set(vars(at)) == before  # neither phi nor J nor rho


@pytest.mark.parametrize("name", [name for name in shipped() if name != "n_four_bar"])
def test_every_mechanism_shows_what_it_has_and_says_what_it_has_not(name: str) -> None:
    mechanism = ckc_pin.load(name)
    quantities = Quantities(mechanism)
    for info in quantities.infos():
        if info.unavailable:
            with pytest.raises(InputError, match=r"has no|without|constrain|have no meaning"):
                quantities.show(info.name, True)
        elif info.name != "nearest_singular":
            quantities.show(info.name, True)
    shown = quantities.evaluate(mechanism.assembled)
    assert list(shown.lines) == quantities.visible_names
    for lines in shown.lines.values():
        assert all(len(line) == 2 and all(isinstance(text, str) for text in line) for line in lines)
        assert not any("nan" in text for _, text in lines)
    assert [info.name for info in quantities.infos() if info.on] == quantities.visible_names


def test_mechanism_without_loops_says_why() -> None:
    quantities = Quantities(Mechanism.from_urdf(PENDULUM))
    reasons = {info.name: info.unavailable for info in quantities.infos() if info.unavailable}
    assert set(reasons) == {"conditioning", "nearest_singular", "ellipsoids", "traces", "loop_frames"}
    with pytest.raises(InputError, match="did you mean"):
        quantities.show("conditionin", True)


def test_quantity_that_does_not_exist_at_a_pose_says_why() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = show(mechanism, "ellipsoids", "centre_of_mass")
    stretched = mechanism.kinematics(np.array([0.0, 0.0, 0.0, 0.0]))  # all links in line
    lines = quantities.evaluate(stretched).lines
    assert lines["ellipsoids"][0][0] == "not here"
    assert "phi_z is singular" in lines["ellipsoids"][0][1]
    assert lines["centre_of_mass"][0][0] == "x"


@pytest.mark.parametrize("name", ["five_bar", "delta", "bricard"])
def test_singular_poses_give_texts_and_finite_drawings(name: str) -> None:
    mechanism = ckc_pin.load(name)
    names = [info.name for info in Quantities(mechanism).infos() if not info.unavailable]
    quantities = show(mechanism, *(name for name in names if name != "nearest_singular"))
    points = search_singular(mechanism, 6)
    assert points
    for point in points:
        shown = quantities.evaluate(point.at)
        texts = [text for lines in shown.lines.values() for line in lines for text in line]
        assert any("singular here" in text for text in texts)
        assert not any("nan" in text or "e+1" in text for text in texts)
        assert all(np.isfinite(command["matrix"]).all() for command in shown.commands if "matrix" in command)


# --- conditioning and motors ---------------------------------------------------------------------


def test_margins_are_relative_singular_values_of_the_closed_form() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = show(mechanism, "conditioning")
    home = FIVE_BAR.J(mechanism.q_tree)
    for q_tree in poses_of_five_bar(4):
        margins = quantities.evaluate(mechanism.kinematics(q_tree)).margins
        for name, columns in (("sigma_min(phi_z)", [1, 3]), ("sigma_min(J)", [0, 1, 2, 3])):
            theirs = [np.linalg.svd(J[:, columns])[1][-1] / np.linalg.norm(J) for J in (FIVE_BAR.J(q_tree), home)]
            assert_close(margins[name], theirs, 1e-12)


def test_two_arms_with_one_load_have_six_internal_torques() -> None:
    mechanism = ckc_pin.load("two_ur5")
    lines = dict(show(mechanism, "motors").evaluate(moved(mechanism, 0.02)).lines["motors"])
    assert lines["internal torques"].startswith("6, of ")
    assert set(lines["internal torques"].removeprefix("6, of ").split(", ")) == set(mechanism.actuated)
    assert lines["idle here"] == "none"
    assert dict(show(ckc_pin.load("five_bar"), "motors").evaluate(ckc_pin.load("five_bar").assembled).lines["motors"]) \
        == {"internal torques": "none", "idle here": "none"}  # fmt: skip


def test_motor_at_the_dead_point_of_its_rocker_is_idle() -> None:
    text = (library() / "four_bar/four_bar.urdf").read_text()
    keys = {
        key: value for key, value in ckc_pin.load("four_bar").spec.to_dict().items() if key in ("q_guess", "gravity")
    }
    loops = ckc_pin.load("four_bar").spec.loop
    mechanism = Mechanism.from_urdf(text, loops=loops, independent=["crank"], actuated=["rocker"], **keys)
    crank, coupler, rocker, ground = 0.5, 1.2, 0.75, 1.1
    reach = crank + coupler  # crank and coupler in line: the rocker reverses
    angle = np.arccos((ground**2 + reach**2 - rocker**2) / (2 * ground * reach))
    dead = sigma(mechanism, np.array([angle]))
    assert dead.verdict == "converged"
    motors = show(mechanism, "motors")
    lines = dict(motors.evaluate(dead.at).lines["motors"])
    assert lines["idle here"] == "rocker"
    assert lines["freedoms without a motor"] == "1, along crank"
    assert dict(motors.evaluate(mechanism.assembled).lines["motors"])["idle here"] == "none"


def test_distance_to_the_nearest_singular_configuration_of_five_bar() -> None:
    """The branch ends where the distal links are in line: the elbows are l_2 + l_4 apart."""
    mechanism, l = ckc_pin.load("five_bar"), FIVE_BAR.l
    q = np.array([1.7, 1.4])
    at = mechanism.kinematics(FIVE_BAR.sigma(q))
    updates = []
    quantities = Quantities(mechanism, on_update=lambda: updates.append(1))
    quantities.show("nearest_singular", True)
    assert quantities.evaluate(at).lines["nearest_singular"] == [["distance", "computing"]]
    deadline = time.monotonic() + 60
    while not updates and time.monotonic() < deadline:
        time.sleep(0.02)
    (_, text), (_, place) = quantities.evaluate(at).lines["nearest_singular"]
    assert text.endswith("rad (fold)")

    def distance(theta_1: float) -> float:
        """Return the distance to the nearest theta_3 for which the elbows are l_2 + l_4 apart."""
        x, y = l[0] * np.cos(theta_1) - FIVE_BAR.base, l[0] * np.sin(theta_1)
        r = np.hypot(x, y)
        cosine = (r**2 + l[2] ** 2 - (l[1] + l[3]) ** 2) / (2 * r * l[2])
        if abs(cosine) > 1:
            return np.inf
        theta_3 = np.arctan2(y, x) + np.arccos(cosine) * np.array([1, -1])
        gaps = np.angle(np.exp(1j * (theta_3 - q[1])))
        return float(np.hypot(theta_1 - q[0], np.abs(gaps).min()))

    grid = np.linspace(q[0] - 2, q[0] + 2, 2001)
    best = grid[int(np.argmin([distance(x) for x in grid]))]
    theirs = minimize_scalar(distance, bounds=(best - 0.003, best + 0.003), method="bounded", options={"xatol": 1e-9})
    assert_close(number(text), theirs.fun, 5.1e-5)  # four digits are shown
    assert place.startswith(f"theta_1 = {theirs.x:.3g}"[:14])
    stale = quantities.evaluate(mechanism.kinematics(FIVE_BAR.sigma(q + 0.1))).lines["nearest_singular"]
    assert stale[0][1].endswith("s ago")
    quantities.show("nearest_singular", False)


def test_long_search_is_given_up_when_it_is_hidden() -> None:
    mechanism = ckc_pin.load("stewart")  # its search takes many seconds
    quantities, others = show(mechanism, "nearest_singular"), set(threading.enumerate())
    quantities.evaluate(mechanism.assembled)
    (thread,) = set(threading.enumerate()) - others
    time.sleep(0.5)
    assert thread.is_alive()
    quantities.show("nearest_singular", False)
    thread.join(30)
    assert not thread.is_alive()


# --- holding torques and forces ------------------------------------------------------------------


def test_holding_torques_are_the_gradient_of_the_energy_along_the_manifold() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = show(mechanism, "holding_torques")
    for k, q_tree in enumerate(poses_of_five_bar(6)):
        branch, q = 1 - 2 * (k % 2), q_tree[Q]
        gradient = [
            (FIVE_BAR.potential_energy(FIVE_BAR.sigma(q + e, branch)) -
             FIVE_BAR.potential_energy(FIVE_BAR.sigma(q - e, branch))) / (2 * STEP)
            for e in STEP * np.eye(2)
        ]  # fmt: skip
        state = PoseState(mechanism, quantities.actuation, mechanism.kinematics(q_tree))
        assert_close(state.static_forces.tau, gradient, 1e-8)
        assert_close(state.static_forces.tau, FIVE_BAR.h(q_tree), 1e-12)
        lines = dict(quantities.evaluate(mechanism.kinematics(q_tree)).lines["holding_torques"])
        assert_close([number(lines["h of theta_1"]), number(lines["motor theta_3"])], gradient, 1e-3)
        assert "not held" not in lines


def test_moment_of_pendulum_without_motor_remains() -> None:
    mechanism = Mechanism.from_urdf(PENDULUM, actuated=[])
    angle = 0.3
    lines = dict(show(mechanism, "holding_torques").evaluate(mechanism.kinematics(np.array([angle])))
                 .lines["holding_torques"])  # fmt: skip
    moment = -2 * 9.81 * 0.5 * np.cos(angle)  # a positive turn about y lowers the rod
    assert_close(number(lines["h of hinge"]), moment, 1e-3)
    assert_close(number(lines["remains along hinge"]), moment, 1e-3)
    assert "no motors" in lines["not held"]


def test_motor_with_limit_holds_what_it_can() -> None:
    motors = [{"joint": "hinge", "torque_limit": 5.0}]
    mechanism = Mechanism.from_urdf(PENDULUM, motors=motors)
    lines = dict(show(mechanism, "holding_torques").evaluate(mechanism.assembled).lines["holding_torques"])
    assert_close(number(lines["motor hinge"]), -5.0, 0.0)
    assert_close(number(lines["remains along hinge"]), 5.0 - 2 * 9.81 * 0.5, 1e-3)
    assert "within the torque limits" in lines["not held"]


def test_forces_of_five_bar_are_those_of_the_closed_form_at_rest_and_in_motion() -> None:
    mechanism = ckc_pin.load("five_bar")
    random = np.random.default_rng(0)
    actuation = Quantities(mechanism).actuation
    for q_tree in poses_of_five_bar(5):
        at = mechanism.kinematics(q_tree)
        _, forces = FIVE_BAR.acceleration_and_multipliers(q_tree, np.zeros(4), FIVE_BAR.h(q_tree))
        loops, _, _ = compute_pose_forces(PoseState(mechanism, actuation, at))
        assert_close(loops["elbow"], [*forces, 0, 0, 0, 0], 1e-10)
        v_tree, tau = FIVE_BAR.rho(q_tree) @ random.uniform(-2, 2, 2), random.uniform(-3, 3, 2)
        _, forces = FIVE_BAR.acceleration_and_multipliers(q_tree, v_tree, tau)
        loops, _, _ = compute_pose_forces(PoseState(mechanism, actuation, at, v_tree, tau))
        assert_close(loops["elbow"], [*forces, 0, 0, 0, 0], 1e-9)


@pytest.mark.parametrize("name", ["five_bar", "slider_crank", "delta", "stewart", "two_ur5", "bricard"])
def test_forces_at_rest_balance_each_body(name: str) -> None:
    """Forces and moments about the world's origin: own joint, joints on the body, loops, weight."""
    mechanism = ckc_pin.load(name)
    model, at = mechanism.tree.model, moved(mechanism, 0.02)
    loops, joints, _ = compute_pose_forces(PoseState(mechanism, Quantities(mechanism).actuation, at))
    rotation, origin = at.pose.rotation, at.pose.translation
    total = np.zeros((model.njoints, 6))

    def add(body: int, force: Array, moment: Array, at_point: Array) -> None:
        total[body] += np.concatenate([force, moment + np.cross(at_point, force)])

    for joint in range(1, model.njoints):
        inertia = model.inertias[joint]
        weight = inertia.mass * np.array(mechanism.spec.gravity)
        add(joint, weight, np.zeros(3), origin[joint] + rotation[joint] @ inertia.lever)
        if model.names[joint] in joints:
            wrench = joints[model.names[joint]]
            add(joint, wrench[:3], wrench[3:], origin[joint])
            add(model.parents[joint], -wrench[:3], -wrench[3:], origin[joint])
    for loop in mechanism.spec.loop:
        a, b = (mechanism.frames.find(end, loop.name) for end in (loop.frame_a, loop.frame_b))
        wrench, point = loops[loop.name], origin[a.joint] + rotation[a.joint] @ a.translation
        add(a.joint, wrench[:3], wrench[3:], point)
        add(b.joint, -wrench[:3], -wrench[3:], point)
    weight = sum(inertia.mass for inertia in model.inertias) * 9.81
    assert weight > 1.0
    assert_close(total[1:], 0.0, 1e-9 * weight)
    assert_close(
        total[0, :3], sum(i.mass for i in list(model.inertias)[1:]) * np.array(mechanism.spec.gravity), 1e-9 * weight
    )


def test_arrow_of_a_loop_points_along_its_force_at_its_scale() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = show(mechanism, "forces")
    q_tree = poses_of_five_bar(1)[0]
    shown = quantities.evaluate(mechanism.kinematics(q_tree))
    matrix = next(np.reshape(c["matrix"], (4, 4)).T for c in shown.commands if c["path"].endswith("loop:elbow"))
    _, force = FIVE_BAR.acceleration_and_multipliers(q_tree, np.zeros(4), FIVE_BAR.h(q_tree))
    text = dict(shown.lines["forces"])["long arrows"]
    length = 0.35 * mechanism.size * np.linalg.norm(force) / number(text)
    assert_close(matrix[:2, 2], length * force / np.linalg.norm(force), 1e-9)
    tip = FIVE_BAR.l[0] * np.exp(1j * q_tree[0]) + FIVE_BAR.l[1] * np.exp(1j * (q_tree[0] + q_tree[1]))
    assert_close(matrix[:2, 3], [tip.real, tip.imag], 1e-9)


# --- shapes --------------------------------------------------------------------------------------


def test_ellipsoid_of_five_bar_is_that_of_the_closed_form() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = show(mechanism, "ellipsoids")

    def tip(q: Array, branch: int) -> Array:
        a = FIVE_BAR.sigma(q, branch)
        z = FIVE_BAR.l[0] * np.exp(1j * a[0]) + FIVE_BAR.l[1] * np.exp(1j * (a[0] + a[1]))
        return np.array([z.real, z.imag, 0.0])

    for k, q_tree in enumerate(poses_of_five_bar(4)):
        branch, q = 1 - 2 * (k % 2), q_tree[Q]
        jacobian = np.column_stack([(tip(q + e, branch) - tip(q - e, branch)) / (2 * STEP) for e in STEP * np.eye(2)])
        shown = quantities.evaluate(mechanism.kinematics(q_tree))
        lines = dict(shown.lines["ellipsoids"])
        matrix = np.reshape(shown.commands[0]["matrix"], (4, 4)).T
        drawn = matrix[:3, :3] / number(lines["drawn at"])
        limit = 2.0 * mechanism.size / number(lines["drawn at"])
        axes, sizes, _ = np.linalg.svd(jacobian)
        assert_close(
            (drawn @ drawn.T)[:2, :2],
            (axes[:, :2] * np.minimum(sizes, limit) ** 2 @ axes[:, :2].T)[:2, :2],
            3e-3 * sizes[0] ** 2,
        )
        assert_close([float(x.split(" ")[0]) for x in lines["tip"].split(", ")], [*sizes, 0.0], 1e-3 * sizes[0])
        assert_close(matrix[:3, 3], tip(q, branch), 1e-12)
        assert np.linalg.det(drawn) > 0
        assert np.linalg.norm(matrix[:3, 2]) > 1e-3  # the flat direction has a thickness


@pytest.mark.parametrize("name", ["delta", "stewart", "two_ur5", "slider_crank", "bricard"])
def test_ellipsoids_are_differences_along_the_manifold(name: str) -> None:
    mechanism = ckc_pin.load(name)
    at = moved(mechanism, 0.02)
    q, columns = mechanism.independent_part(at.q_tree), []
    for e in STEP * np.eye(mechanism.d):
        after, before = (mechanism.point_positions(sigma(mechanism, q + s * e, at).at.q_tree) for s in (1, -1))
        columns.append({point: (after[point] - before[point]) / (2 * STEP) for point in after})
    for point, matrix in compute_ellipsoids(mechanism, at).items():
        theirs = np.column_stack([column[point] for column in columns])
        if len(mechanism.actuated) == mechanism.d:
            rates = mechanism.motors.transmission @ at.rho
            theirs = theirs @ np.linalg.inv(rates)
        assert_close(matrix, theirs, 1e-7 * max(1.0, np.abs(theirs).max()))


def test_trace_is_bounded_and_cleared_when_it_is_switched_off() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities, scene = show(mechanism, "traces"), SceneState()
    angles = np.linspace(0, 40 * np.pi, 3 * TRACE_LENGTH)
    for a in angles:
        at = mechanism.kinematics(
            mechanism.q_tree + a * np.eye(4)[0]
        )  # closed or not: the tip is a point of the left chain
        for command in quantities.evaluate(at).commands:
            scene.apply(command)
    lines = scene.messages()
    assert len(lines) == TRACE_LENGTH // 100
    assert sum(map(len, lines)) < 40 * TRACE_LENGTH
    quantities.evaluate(at)
    assert quantities.evaluate(at).commands == []  # a point that stands still adds nothing
    for command in quantities.show("traces", False):
        scene.apply(command)
    assert scene.messages() == []
    quantities.show("traces", True)
    assert quantities.evaluate(at).commands == []


def test_centre_of_mass_is_that_of_the_closed_form() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = show(mechanism, "centre_of_mass")
    l, c, m = FIVE_BAR.l, FIVE_BAR.c, FIVE_BAR.m
    for q_tree in poses_of_five_bar(3):
        moment = 0.0
        for base, (i, j) in zip((0.0, FIVE_BAR.base), ((0, 1), (2, 3)), strict=True):
            first, second = np.exp(1j * q_tree[i]), np.exp(1j * (q_tree[i] + q_tree[j]))
            moment += m[i] * (base + c[i] * first) + m[j] * (base + l[i] * first + c[j] * second)
        centre = moment / sum(m)
        shown = quantities.evaluate(mechanism.kinematics(q_tree))
        assert_close(np.reshape(shown.commands[0]["matrix"], (4, 4)).T[:3, 3], [centre.real, centre.imag, 0], 1e-12)
        lines = dict(shown.lines["centre_of_mass"])
        assert_close(number(lines["moving mass"]), sum(m), 1e-3)
        assert_close(number(lines["x"]), centre.real, 1e-3)


def test_loop_frames_move_with_the_bodies_and_open_loops_get_a_rod() -> None:
    mechanism = ckc_pin.load("five_bar")
    quantities = Quantities(mechanism)
    drawn = quantities.show("loop_frames", True)
    assert len(drawn) == 2
    assert all(command["path"].startswith(f"{EXPLORED}/joint:") for command in drawn)
    assert quantities.evaluate(mechanism.assembled).commands == []
    q_tree = mechanism.q_tree + 0.1 * np.eye(4)[0]
    shown = quantities.evaluate(mechanism.kinematics(q_tree))
    ends = []
    for k in (0, 2):
        z = FIVE_BAR.l[k] * np.exp(1j * q_tree[k]) + FIVE_BAR.l[k + 1] * np.exp(1j * (q_tree[k] + q_tree[k + 1]))
        ends.append(np.array([z.real + (FIVE_BAR.base if k else 0.0), z.imag, 0.0]))
    rod = next(np.reshape(c["matrix"], (4, 4)).T for c in shown.commands if c["path"].endswith("/way"))
    assert_close(rod[:3, 3], ends[1], 1e-12)  # from frame B
    assert_close(rod[:3, 2], ends[0] - ends[1], 1e-12)  # to frame A
    assert shown.lines["loop_frames"] == [["loop elbow", f"open by {np.linalg.norm(ends[0] - ends[1]):.4g} m"]]
    again = quantities.evaluate(mechanism.kinematics(q_tree))
    assert {command["type"] for command in again.commands} == {"set_transform"}
    assert quantities.evaluate(mechanism.assembled).commands == [{"type": "delete", "path": f"{SHOWN}/loop_frames"}]
    removed = {command["path"] for command in quantities.show("loop_frames", False)}
    assert {command["path"] for command in drawn} <= removed
