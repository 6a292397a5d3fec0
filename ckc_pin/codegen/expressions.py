"""A mechanism's terms as CasADi expressions: the tree of eq. 1, its closure, springs, dampers and energy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.angles import Angles
from ckc_pin.codegen.arguments import Arguments, numbers, present
from ckc_pin.codegen.axes import Turns
from ckc_pin.codegen.bodies import MovingBody, bodies, cross, dot, times
from ckc_pin.codegen.order import elimination_order
from ckc_pin.codegen.rows import RowTerms, row_terms
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Expressions", "expressions", "kept_rows"]


@dataclass(frozen=True)
class Expressions:
    """Terms at a state (q', v'), as functions of symbols.

    Attributes
    ----------
    angles : Angles
        Pinocchio's q', a free root's quaternion of unit length.
    v : casadi.SX of n
        v'.
    arguments : Arguments
        Masses, centres of mass, inertias, offsets, stiffnesses, lengths, gravity.
    turns : Turns
        Rotations of axes, whose symbols are numbers of alike branches.
    quaternions : tuple of int
        Where the quaternions of free roots begin in q'.
    q_dot : casadi.SX of nq
        The rate of q' at v'.
    D_tree : casadi.SX, (n, n)
    bias_tree : casadi.SX of n
        C' v' + h' less what springs and constant forces do.
    damping : casadi.SX of n
        What dampers do.
    rows : RowTerms
    v_dot : casadi.SX of n
        dv'/dt, in what is next.
    needed : casadi.SX of n
        D' v_dot and `bias_tree`, by recursion: shorter than the sum, and so are its derivatives.
    kept : tuple of int
        Rows that follow from no others.
    order : tuple of int
        In which [D', J^T; J, 0] of the kept rows is eliminated: coordinates, and rows from n on.
    kinetic, potential : casadi.SX
        Energies, J; of gravity, springs and constant forces.
    """

    angles: Angles
    v: Any
    arguments: Arguments
    turns: Turns
    quaternions: tuple[int, ...]
    q_dot: Any
    D_tree: Any
    bias_tree: Any
    damping: Any
    rows: RowTerms
    v_dot: Any
    needed: Any
    kept: tuple[int, ...]
    order: tuple[int, ...]
    kinetic: Any
    potential: Any


def kept_rows(mechanism: Mechanism) -> list[int]:
    """Return the rows that follow from no others, as the mechanism's rank found them."""
    return [k for k, row in enumerate(mechanism.closure.names) if ".".join(row) not in mechanism.redundant]


def expressions(
    mechanism: Mechanism, which: Mapping[str, BoolArray] | None = None, alike: Sequence[Sequence[int]] = ()
) -> Expressions:
    """Write a mechanism's terms out, of the numbers that are arguments (`arguments.present`).

    In the same way for all branches that are `alike`, each group of them by the joints that they begin with.
    """
    import casadi as cs

    tree, arguments = mechanism.tree, Arguments(which or present(numbers(mechanism)))
    angles, v = Angles(tree.nq), cs.SX.sym("v", tree.n)
    q, v_dot, none = angles.q, cs.SX.sym("v_dot", tree.n), cs.SX(tree.n, 1)
    turns = Turns([placement.rotation for placement in tree.model.jointPlacements], alike)
    found, driven = (bodies(tree, turns, angles, v, x, arguments) for x in (none, v_dot))
    gravity = arguments.column("gravity")
    q_dot = _configuration_rate(mechanism, q, v)
    D_tree, bias, potential = _inertia(mechanism, found, gravity, arguments)
    needed = _inertia(mechanism, driven, gravity, arguments)[1] + times(cs.diag(_armature(tree.n, arguments)), v_dot)
    elastic, damping, stored = _springs(mechanism, found, q, v, arguments)
    rows = row_terms(mechanism.closure, found, angles, v, q_dot, tree.q_index.tolist(), arguments)
    kept = kept_rows(mechanism)
    return Expressions(
        angles=angles,
        v=v,
        arguments=arguments,
        turns=turns,
        quaternions=tuple(at_q + 3 for at_q, _ in tree.free_roots),
        q_dot=q_dot,
        D_tree=D_tree,
        bias_tree=bias - elastic,
        damping=damping,
        rows=rows,
        v_dot=v_dot,
        needed=needed - elastic,
        kept=tuple(kept),
        order=elimination_order(mechanism, kept),
        kinetic=dot(v, times(D_tree, v)) / 2,
        potential=potential + stored,
    )


def _inertia(mechanism: Mechanism, found: list[MovingBody], gravity: Any, arguments: Arguments) -> tuple[Any, Any, Any]:
    """D', C' v' + h' with D' times what bodies accelerate with, and the potential energy of gravity.

    Composite bodies, and what their bias accelerations ask for, from the leaves to the root: a force along each
    coordinate meets what its joint carries.
    """
    import casadi as cs

    model, n = mechanism.tree.model, mechanism.n
    D, bias, potential = cs.SX(n, n), cs.SX(n, 1), cs.SX(1, 1)
    mass = [cs.SX(1, 1) for _ in found]  # of what a joint carries, with its first and second moments about the origin
    first = [cs.SX(3, 1) for _ in found]
    second = [cs.SX(3, 3) for _ in found]
    force = [cs.SX(3, 1) for _ in found]
    torque = [cs.SX(3, 1) for _ in found]  # about the origin of the joint's own frame
    for k in range(1, model.njoints):
        body, m = found[k], arguments.number("mass", k)
        local, I = arguments.column("centre", k), arguments.symmetric("inertia", k)
        I = I + m * (dot(local, local) * cs.SX.eye(3) - times(local, local.T))
        mass[k], first[k] = m, times(body.R, m * local)
        second[k] = _turned(I, body.R)
        falling = times(found[0].axes.into(body.axes), gravity)
        falls = body.acceleration - falling
        swept = cross(body.omega, first[k])
        force[k] = cs.sparsify(m * falls + cross(body.alpha, first[k]) + cross(body.omega, swept))
        torque[k] = cs.sparsify(
            cross(first[k], falls) + times(second[k], body.alpha) + cross(body.omega, times(second[k], body.omega))
        )
        potential = potential - dot(falling, m * body.origin + first[k])
    for k in range(model.njoints - 1, 0, -1):
        body, parent = found[k], model.parents[k]
        own = body.columns[len(found[parent].columns) :]
        for column in own:
            bias[column.at] = dot(column.axis, torque[k] if column.turns else force[k])
            # the force and the torque about the joint's origin that its unit acceleration asks for
            pushed = cross(column.axis, first[k]) if column.turns else mass[k] * column.axis
            turned = times(second[k], column.axis) if column.turns else cross(first[k], column.axis)
            for other in body.columns:
                if other.at > column.at:
                    continue
                arm = cross(body.origin - other.origin, pushed) if other.turns else None
                entry = dot(other.axis, turned + arm) if other.turns else dot(other.axis, pushed)
                D[other.at, column.at] = D[column.at, other.at] = entry
        if parent:
            d = body.origin - found[parent].origin
            force[parent] = force[parent] + force[k]
            torque[parent] = torque[parent] + torque[k] + cross(d, force[k])
            second[parent] = second[parent] + second[k] + _shift(d, first[k] + mass[k] / 2 * d)
            first[parent] = first[parent] + first[k] + mass[k] * d
            mass[parent] = mass[parent] + mass[k]
    return cs.sparsify(D + cs.diag(_armature(n, arguments))), bias, potential


def _armature(n: int, arguments: Arguments) -> Any:
    import casadi as cs

    return cs.vertcat(*(arguments.number("armature", k) for k in range(n)))


def _turned(I: Any, R: Any) -> Any:
    """R I R^T of a symmetric I; what its diagonal has in common need not be turned."""
    import casadi as cs

    common = I[0, 0]
    part = times(R, cs.sparsify(I - common * cs.SX.eye(3)))
    return _mirrored(lambda i, j: dot(part[i, :].T, R[j, :].T) + (common if i == j else 0))


def _shift(d: Any, half: Any) -> Any:
    """What second moments gain about a point that is d back; half: the first ones, and mass d / 2."""
    reach = 2 * dot(d, half)
    return _mirrored(lambda i, j: (reach if i == j else 0) - d[i] * half[j] - half[i] * d[j])


def _mirrored(entry: Callable[[int, int], Any]) -> Any:
    """A symmetric matrix by its lower triangle, so that nothing is computed twice."""
    import casadi as cs

    found = cs.SX(3, 3)
    for i in range(3):
        for j in range(i + 1):
            found[i, j] = found[j, i] = entry(i, j)
    return cs.sparsify(found)


def _springs(
    mechanism: Mechanism, found: list[MovingBody], q: Any, v: Any, arguments: Arguments
) -> tuple[Any, Any, Any]:
    """What springs and constant forces do, what dampers do, and the energy stored."""
    import casadi as cs

    springs, n = mechanism.springs, mechanism.n
    elastic, damping, stored = cs.SX(n, 1), cs.SX(n, 1), cs.SX(1, 1)
    for k in range(n):
        x = q[int(mechanism.tree.q_index[k])]
        pull = arguments.number("constant", k)
        stiffness = arguments.number("joint_stiffness", k)
        stretched = x - arguments.number("joint_rest", k)
        elastic[k] = pull - stiffness * stretched
        stored = stored + stiffness * stretched**2 / 2 - pull * x
        damping[k] = -arguments.number("joint_damping", k) * v[k]
    ends = [(found[joint], arguments.column("end", k)) for k, joint in enumerate(springs.anchors.point_joint)]
    count = len(springs.stiffness)
    for k, ((a, local_a), (b, local_b)) in enumerate(zip(ends[:count], ends[count:], strict=True)):
        at_a, rate_a, _ = a.point(local_a)
        at_b, rate_b, _ = b.point(local_b)
        into = b.axes.into(a.axes)
        r = at_a - times(into, at_b)
        length = cs.sqrt(dot(r, r))
        along = r / cs.if_else(length > 0, length, 1)  # at length zero it pulls nowhere
        jacobian = times(along.T, a.point_jacobian(at_a, local_a, n) - times(into, b.point_jacobian(at_b, local_b, n)))
        stiffness = arguments.number("stiffness", k)
        stretched = length - arguments.number("rest_length", k)
        elastic = elastic - stiffness * stretched * jacobian.T
        stored = stored + stiffness * stretched**2 / 2
        c = arguments.number("damping", k)
        damping = damping - c * dot(along, rate_a - times(into, rate_b)) * jacobian.T
    return elastic, damping, stored


def _configuration_rate(mechanism: Mechanism, q: Any, v: Any) -> Any:
    import casadi as cs

    tree = mechanism.tree
    rate = cs.SX(tree.nq, 1)
    for k in range(tree.n):
        rate[int(tree.q_index[k])] = v[k]
    for at_q, at_v in tree.free_roots:
        u, w, spin = q[at_q + 3 : at_q + 6], q[at_q + 6], v[at_v + 3 : at_v + 6]
        slide = v[at_v : at_v + 3]
        rate[at_q : at_q + 3] = slide + 2 * cs.cross(u, cs.cross(u, slide) + w * slide)
        rate[at_q + 3 : at_q + 6] = 0.5 * (w * spin + cs.cross(u, spin))
        rate[at_q + 6] = -0.5 * cs.dot(u, spin)
    return rate
