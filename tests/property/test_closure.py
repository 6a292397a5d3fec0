"""Every loop type: phi as docs/reference/mechanism.md says, J its derivative, J_dot that of J. Off the manifold."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from ckc_pin.mechanism.closure import ClosureBuilder
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.spec import CouplingSpec, FrameSpec, LoopSpec, LoopType
from ckc_pin.mechanism.tree import Tree
from ckc_pin.mechanism.urdf import TreeText, merge
from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.property.strategies import TYPES, loops, seeds
from tests.property.worlds import Numbers, Placement, World, compose, random_world, rotation, slope


class Closed:
    """The program's view of a world with some loops."""

    def __init__(self, world: World, *specs: LoopSpec | CouplingSpec) -> None:
        texts = [
            TreeText(world.urdf(prefix), f"{prefix}.urdf", prefix, "free" if free else "fixed", xyz=xyz, rpy=rpy)
            for (prefix, (xyz, rpy)), free in zip(world.stands.items(), (False, world.free), strict=True)
        ]
        self.tree = Tree(pin.buildModelFromXML(ElementTree.tostring(merge(texts).root, encoding="unicode")))
        builder = ClosureBuilder(self.tree, Frames(self.tree.model))
        for spec in specs:
            builder.add_loop(spec) if isinstance(spec, LoopSpec) else builder.add_coupling(spec)
        self.closure = builder.build()

    def vector(self, values: Numbers) -> Array:
        return np.array([values[name] for name in self.tree.coordinates])

    def at(self, q: Numbers) -> Kinematics:
        everything = np.arange(self.tree.n)
        split = Partition(everything[:0], everything)
        return Kinematics(self.tree, self.closure, split, self.tree.from_coordinates(self.vector(q)))


def placed(world: World, q: Numbers, frame: str | FrameSpec) -> Placement:
    if isinstance(frame, str):
        return world.placement(frame, q)
    return compose(world.placement(frame.link, q), (rotation(np.array(frame.rpy)), np.array(frame.xyz)))


def table(loop: LoopSpec, A: Placement, B: Placement) -> Array:
    """phi as docs/reference/mechanism.md's table has it."""
    (R_A, p_A), (R_B, p_B) = A, B
    resolve = R_A.T if loop.rows_in == "a" else np.eye(3)
    r = resolve @ (p_A - p_B)
    a, b = (np.array(axis) / np.linalg.norm(axis) for axis in (loop.axis_a, loop.axis_b))
    e1, e2 = right_handed(a)
    b = R_A.T @ R_B @ b  # in frame A, like a, e1 and e2
    log = Rotation.from_matrix(R_A.T @ R_B).as_rotvec()
    rows: dict[str, Any] = {
        "point": lambda: r,
        "point_2d": lambda: [e1 @ r, e2 @ r],
        "hinge": lambda: [*r, e1 @ b, e2 @ b],
        "cylindrical": lambda: [e1 @ r, e2 @ r, e1 @ b, e2 @ b],
        "universal": lambda: [*r, a @ b],
        "prismatic": lambda: [e1 @ r, e2 @ r, *log],
        "weld": lambda: [*r, *log],
        "distance": lambda: [(r @ r - loop.length**2) / (2 * loop.length)],
    }
    return np.array(rows[loop.type]())


def right_handed(a: Array) -> tuple[Array, Array]:
    """e1, e2 of a right-handed (e1, e2, a)."""
    axes = np.eye(3)
    for k in range(3):
        if np.array_equal(a, axes[k]):
            return axes[(k + 1) % 3], axes[(k + 2) % 3]
    e1 = np.cross(a, axes[np.argmin(np.abs(a))])
    return e1 / np.linalg.norm(e1), np.cross(a, e1 / np.linalg.norm(e1))


def rounding_of_log(loop: LoopSpec, A: Placement, B: Placement) -> float:
    """Rounding error of the log of the relative rotation, where there is one: it grows towards half a turn."""
    if loop.type not in ("weld", "prismatic"):
        return 0.0
    return 1e-14 / max(np.pi - Rotation.from_matrix(A[0].T @ B[0]).magnitude(), 1e-14)


def half_turn_away(loop: LoopSpec, A: Placement, B: Placement) -> bool:
    """Whether the log of the relative rotation, where there is one, is far from its cut at half a turn."""
    return loop.type not in ("weld", "prismatic") or Rotation.from_matrix(A[0].T @ B[0]).magnitude() < 2.9


every_type = pytest.mark.parametrize("kind", TYPES)


@every_type
@given(seed=seeds, data=st.data())
def test_phi_of_each_loop_type_matches_the_definition(kind: LoopType, seed: int, data: st.DataObject) -> None:
    world, loop = random_world(seed), data.draw(loops(kind))
    q = world.configuration()
    A, B = placed(world, q, loop.frame_a), placed(world, q, loop.frame_b)
    assert_close(Closed(world, loop).at(q).phi, table(loop, A, B), 1e-12 + rounding_of_log(loop, A, B))


@every_type
@given(seed=seeds, data=st.data())
def test_J_is_the_derivative_of_phi(kind: LoopType, seed: int, data: st.DataObject) -> None:
    """phi_dot = J v along any velocity, by differences of the table."""
    world, loop = random_world(seed), data.draw(loops(kind))
    q, v = world.configuration(), world.velocity()
    assume(half_turn_away(loop, placed(world, q, loop.frame_a), placed(world, q, loop.frame_b)))

    def phi(t: float) -> Array:
        moved = world.moved(q, v, t)
        return table(loop, placed(world, moved, loop.frame_a), placed(world, moved, loop.frame_b))

    closed = Closed(world, loop)
    assert_close(closed.at(q).J @ closed.vector(v), slope(phi), 1e-9)


@every_type
@given(seed=seeds, data=st.data())
def test_J_dot_is_the_derivative_of_J(kind: LoopType, seed: int, data: st.DataObject) -> None:
    world, loop = random_world(seed), data.draw(loops(kind))
    q, v = world.configuration(), world.velocity()
    assume(half_turn_away(loop, placed(world, q, loop.frame_a), placed(world, q, loop.frame_b)))
    closed = Closed(world, loop)
    J_dot = slope(lambda t: closed.at(world.moved(q, v, t)).J)
    assert_close(closed.at(q).J_dot(closed.vector(v)), J_dot, 1e-9)


@given(seed=seeds, ratio=st.floats(-3, 3), offset=st.floats(-1, 1), prismatic=st.booleans())
def test_a_coupling_is_affine(seed: int, ratio: float, offset: float, prismatic: bool) -> None:
    world = random_world(seed)
    joint, other = ("a_j2" if prismatic else "a_j3"), "b_j4"
    closed = Closed(world, CouplingSpec(joint=joint, other=other, ratio=ratio, offset=offset))
    q, v = world.configuration(), world.velocity()
    at = closed.at(q)
    assert_close(at.phi, [q[joint] - ratio * q[other] - offset], 1e-14)
    assert_close(at.J @ closed.vector(v), [v[joint] - ratio * v[other]], 1e-13)
    assert_close(at.J_dot(closed.vector(v)), 0, 0)


@given(seed=seeds)
def test_nonlinear_couplings(seed: int) -> None:
    """Sums of joints, a polynomial, and SciPy's quintic spline, with the second derivative of its ends beyond them."""
    world = random_world(seed)
    q, v = world.configuration(), world.velocity()
    x = np.array([-1.0, -0.6, -0.3, 0.1, 0.4, 0.7, 1.1, 1.5])
    spline = make_interp_spline(x, np.exp(x), 5)

    def curve(at: float) -> float:
        end = float(np.clip(at, x[0], x[-1]))
        return float(spline(end) + spline(end, 1) * (at - end) + spline(end, 2) * (at - end) ** 2 / 2)

    specs = [
        CouplingSpec(joints={"a_j1": 0.5, "b_j4": -2.0, "b_j3": 0.25}, offset=0.3),
        CouplingSpec(joint="a_j4", other="b_j1", polynomial=[1.0, -0.5, 0.0, 2.0], offset=-0.2),
        CouplingSpec(joint="a_j3", other="b_j3", table=list(zip(x.tolist(), np.exp(x).tolist(), strict=True))),
    ]
    closed = Closed(world, *specs)

    def phi(q: Numbers) -> Array:
        b = q["b_j1"]
        return np.array(
            [
                0.5 * q["a_j1"] - 2.0 * q["b_j4"] + 0.25 * q["b_j3"] - 0.3,
                q["a_j4"] - (1.0 - 0.5 * b + 2.0 * b**3) + 0.2,
                q["a_j3"] - curve(q["b_j3"]),
            ]
        )

    at = closed.at(q)
    assert_close(at.phi, phi(q), 1e-12)
    assert_close(at.J @ closed.vector(v), slope(lambda t: phi(world.moved(q, v, t))), 1e-9)
    J_dot = slope(lambda t: closed.at(world.moved(q, v, t)).J)
    assert_close(at.J_dot(closed.vector(v)), J_dot, 1e-9)


@given(seed=seeds, data=st.data())
def test_rows_follow_the_order_of_the_loops(seed: int, data: st.DataObject) -> None:
    """Loops of all types and a coupling at once: grouping rows by primitive must not show."""
    world = random_world(seed)
    specs = [data.draw(loops(kind)) for kind in data.draw(st.permutations(TYPES))]
    named = [LoopSpec(**{f: getattr(s, f) for f in s.__struct_fields__} | {"name": s.type}) for s in specs]
    coupling = CouplingSpec(joint="b_j1", other="a_j1", ratio=2.0)
    closed, q, v = Closed(world, *named, coupling), world.configuration(), world.velocity()
    at = closed.at(q)
    alone = [Closed(world, spec).at(q) for spec in (*named, coupling)]
    loops_of_rows = [spec.name for spec, k in zip(named, alone[:-1], strict=True) for _ in k.phi]
    assert [name for name, _ in closed.closure.names] == [*loops_of_rows, "b_j1~a_j1"]
    assert_close(at.phi, np.concatenate([k.phi for k in alone]), 1e-14)
    assert_close(at.J, np.vstack([k.J for k in alone]), 1e-13)
    assert_close(at.J_dot(closed.vector(v)), np.vstack([k.J_dot(closed.vector(v)) for k in alone]), 1e-12)


@given(seed=seeds, turn=st.floats(0, 0.2) | st.floats(0, np.pi - 1e-6))
def test_weld_rows_are_the_rotation_vector(seed: int, turn: float) -> None:
    """The log up to its cut at half a turn, and its derivatives through the series for small angles."""
    world = random_world(seed)
    q, v, axis = world.configuration(), world.velocity(), world.random.normal(size=3)
    axis /= np.linalg.norm(axis)
    (R_A, _), (R_B, _) = world.placement("a_3", q), world.placement("b_3", q)
    inside = R_B.T @ R_A @ Rotation.from_rotvec(turn * axis).as_matrix()
    x, y, z = Rotation.from_matrix(inside).as_euler("xyz").tolist()
    loop = LoopSpec(name="loop", type="weld", frame_a="a_3", frame_b=FrameSpec(link="b_3", rpy=(x, y, z)))
    closed = Closed(world, loop)
    at, v_tree = closed.at(q), closed.vector(v)
    assert_close(at.phi[3:], turn * axis, 1e-9)  # near half a turn Pinocchio's log has some 11 digits
    if turn < 2.9:
        assert_close(at.J @ v_tree, slope(lambda t: closed.at(world.moved(q, v, t)).phi), 1e-10)
        assert_close(at.J_dot(v_tree), slope(lambda t: closed.at(world.moved(q, v, t)).J), 1e-10)
