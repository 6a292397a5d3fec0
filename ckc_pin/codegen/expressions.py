"""A mechanism's terms as CasADi expressions: eq. 1's tree terms, constraint rows, springs, dampers and energies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.arguments import Arguments, present
from ckc_pin.codegen.bodies import ConfigurationSymbols, MovingBody, cross, dot, forward_kinematics, multiply
from ckc_pin.codegen.branches import AxisRotations
from ckc_pin.codegen.elimination import elimination_order
from ckc_pin.codegen.rows import RowTerms, row_terms
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers

__all__ = ["TermExpressions", "term_expressions"]


@dataclass(frozen=True)
class TermExpressions:
    """Expressions of the terms at a state (q', v') in symbols.

    Attributes
    ----------
    configuration : ConfigurationSymbols
        Pinocchio's q', a free root's quaternion of unit length.
    v : casadi.SX of n
        v'.
    arguments : Arguments
        Masses, centres of mass, inertias, offsets, stiffnesses, lengths, gravity.
    rotations : AxisRotations
        Rotations between branches, whose symbols are numbers of identical branches.
    quaternions : tuple of int
        Where the quaternions of free roots begin in q'.
    q_dot : casadi.SX of nq
        The rate of q' at v'.
    D_tree : casadi.SX, (n, n)
    bias_tree : casadi.SX of n
        C' v' + h' less the forces of springs and constant forces.
    damping : casadi.SX of n
        Forces of dampers.
    rows : RowTerms
    v_dot : casadi.SX of n
        Symbols of dv'/dt in `inverse_dynamics`.
    inverse_dynamics : casadi.SX of n
        D' v_dot + bias_tree by recursion, which is shorter than the sum, as are its derivatives.
    kept : tuple of int
        Independent constraint rows.
    order : tuple of int
        Elimination order of [D', J^T; J, 0]: coordinates, and kept rows from n on.
    kinetic, potential : casadi.SX
        Energies, J. `potential` is of gravity, springs and constant forces.
    points : casadi.SX, casadi.SX
        Positions and velocities of the named points in the world, each a column of 3 per point.
    """

    configuration: ConfigurationSymbols
    v: Any
    arguments: Arguments
    rotations: AxisRotations
    quaternions: tuple[int, ...]
    q_dot: Any
    D_tree: Any
    bias_tree: Any
    damping: Any
    rows: RowTerms
    v_dot: Any
    inverse_dynamics: Any
    kept: tuple[int, ...]
    order: tuple[int, ...]
    kinetic: Any
    potential: Any
    points: tuple[Any, Any]


def term_expressions(
    mechanism: Mechanism, which: Mapping[str, BoolArray] | None = None, root_groups: Sequence[Sequence[int]] = ()
) -> TermExpressions:
    """Derive the expressions of a mechanism's terms.

    Parameters
    ----------
    mechanism : Mechanism
    which : mapping, optional
        Numbers that are arguments (`arguments.present`).
    root_groups : sequence of sequences of int
        Root joints of identical branches, whose expressions get the same structure.
    """
    import casadi as cs

    tree, arguments = mechanism.tree, Arguments(which or present(model_numbers(mechanism)))
    configuration, v = ConfigurationSymbols(tree.nq), cs.SX.sym("v", tree.n)
    q, v_dot, zero = configuration.q, cs.SX.sym("v_dot", tree.n), cs.SX(tree.n, 1)
    rotations = AxisRotations([placement.rotation for placement in tree.model.jointPlacements], root_groups)
    bodies, accelerated = (forward_kinematics(tree, rotations, configuration, v, x, arguments) for x in (zero, v_dot))
    gravity = arguments.column("gravity")
    q_dot = _configuration_rate(mechanism, q, v)
    D_tree, bias, potential = _inertia(mechanism, bodies, gravity, arguments)
    rotor_forces = multiply(_rotors(tree.n, arguments), v_dot)
    inverse_dynamics = _inertia(mechanism, accelerated, gravity, arguments)[1] + rotor_forces
    elastic, damping, stored = _springs(mechanism, bodies, q, v, arguments)
    rows = row_terms(mechanism.closure, bodies, configuration, v, q_dot, tree.q_index.tolist(), arguments)
    kept = mechanism.independent_rows
    return TermExpressions(
        configuration=configuration,
        v=v,
        arguments=arguments,
        rotations=rotations,
        quaternions=tuple(in_q + 3 for in_q, _ in tree.free_roots),
        q_dot=q_dot,
        D_tree=D_tree,
        bias_tree=bias - elastic,
        damping=damping,
        rows=rows,
        v_dot=v_dot,
        inverse_dynamics=inverse_dynamics - elastic,
        kept=tuple(kept),
        order=elimination_order(mechanism, kept),
        kinetic=dot(v, multiply(D_tree, v)) / 2,
        potential=potential + stored,
        points=_points(mechanism, bodies),
    )


def _points(mechanism: Mechanism, bodies: list[MovingBody]) -> tuple[Any, Any]:
    import casadi as cs

    positions, velocities = cs.SX(0, 1), cs.SX(0, 1)
    for place in mechanism.points.values():
        body = bodies[place.joint]
        to_world = body.axes.rotation_to(bodies[0].axes)
        position, velocity, _ = body.point(cs.SX(place.translation))
        positions = cs.vertcat(positions, multiply(to_world, position))
        velocities = cs.vertcat(velocities, multiply(to_world, velocity))
    return positions, velocities


def _inertia(
    mechanism: Mechanism, bodies: list[MovingBody], gravity: Any, arguments: Arguments
) -> tuple[Any, Any, Any]:
    """Return D', the generalized forces of the bodies' accelerations and gravity, and gravity's potential energy.

    Composite-rigid-body algorithm and recursive Newton-Euler algorithm in one pass from the leaves to the root.
    """
    import casadi as cs

    model, n = mechanism.tree.model, mechanism.n
    D, bias, potential = cs.SX(n, n), cs.SX(n, 1), cs.SX(1, 1)
    mass = [cs.SX(1, 1) for _ in bodies]  # of all bodies behind a joint, with their first and second moments
    first = [cs.SX(3, 1) for _ in bodies]  # about the origin of the joint's frame
    second = [cs.SX(3, 3) for _ in bodies]
    force = [cs.SX(3, 1) for _ in bodies]
    torque = [cs.SX(3, 1) for _ in bodies]  # about the same origin
    for k in range(1, model.njoints):
        body, m = bodies[k], arguments.number("mass", k)
        local, I = arguments.column("centre", k), arguments.symmetric("inertia", k)
        I = I + m * (dot(local, local) * cs.SX.eye(3) - multiply(local, local.T))
        mass[k], first[k] = m, multiply(body.R, m * local)
        second[k] = _rotate_symmetric(I, body.R)
        local_gravity = multiply(bodies[0].axes.rotation_to(body.axes), gravity)
        acceleration = body.acceleration - local_gravity
        swept = cross(body.omega, first[k])
        force[k] = cs.sparsify(m * acceleration + cross(body.alpha, first[k]) + cross(body.omega, swept))
        torque[k] = cs.sparsify(
            cross(first[k], acceleration)
            + multiply(second[k], body.alpha)
            + cross(body.omega, multiply(second[k], body.omega))
        )
        potential = potential - dot(local_gravity, m * body.origin + first[k])
    for k in range(model.njoints - 1, 0, -1):
        body, parent = bodies[k], model.parents[k]
        own_columns = body.columns[len(bodies[parent].columns) :]
        for column in own_columns:
            bias[column.index] = dot(column.axis, torque[k] if column.is_rotation else force[k])
            # Force, and torque about the joint's origin, for a unit acceleration of this coordinate.
            unit_force = cross(column.axis, first[k]) if column.is_rotation else mass[k] * column.axis
            unit_torque = multiply(second[k], column.axis) if column.is_rotation else cross(first[k], column.axis)
            for other in body.columns:
                if other.index > column.index:
                    continue
                moment = cross(body.origin - other.origin, unit_force) if other.is_rotation else None
                entry = dot(other.axis, unit_torque + moment) if other.is_rotation else dot(other.axis, unit_force)
                D[other.index, column.index] = D[column.index, other.index] = entry
        if parent:
            d = body.origin - bodies[parent].origin
            force[parent] = force[parent] + force[k]
            torque[parent] = torque[parent] + torque[k] + cross(d, force[k])
            second[parent] = second[parent] + second[k] + _shift_second_moments(d, first[k] + mass[k] / 2 * d)
            first[parent] = first[parent] + first[k] + mass[k] * d
            mass[parent] = mass[parent] + mass[k]
    return cs.sparsify(D + _rotors(n, arguments)), bias, potential


def _rotors(n: int, arguments: Arguments) -> Any:
    """Return what armatures and rotors of motors on several joints add to D', (n, n)."""
    import casadi as cs

    inertia = cs.diag(cs.vertcat(*(arguments.number("armature", k) for k in range(n))))
    for name, index in arguments.places:
        if name == "rotors":
            i, j = index
            inertia[i, j] += arguments.number("rotors", i, j)
            if i != j:
                inertia[j, i] = inertia[i, j]
    return inertia


def _rotate_symmetric(I: Any, R: Any) -> Any:
    """Return R I R^T of a symmetric I. The part of I that is a multiple of the identity is not rotated."""
    import casadi as cs

    common = I[0, 0]
    part = multiply(R, cs.sparsify(I - common * cs.SX.eye(3)))
    return _symmetric_matrix(lambda i, j: dot(part[i, :].T, R[j, :].T) + (common if i == j else 0))


def _shift_second_moments(d: Any, half: Any) -> Any:
    """Return what second moments gain about a point shifted by -d.

    Parameters
    ----------
    d : casadi.SX of 3
    half : casadi.SX of 3
        First moments plus mass d / 2.
    """
    trace = 2 * dot(d, half)
    return _symmetric_matrix(lambda i, j: (trace if i == j else 0) - d[i] * half[j] - half[i] * d[j])


def _symmetric_matrix(entry: Callable[[int, int], Any]) -> Any:
    """Return a symmetric (3, 3) matrix from its lower triangle, so that no entry is computed twice."""
    import casadi as cs

    matrix = cs.SX(3, 3)
    for i in range(3):
        for j in range(i + 1):
            matrix[i, j] = matrix[j, i] = entry(i, j)
    return cs.sparsify(matrix)


def _springs(
    mechanism: Mechanism, bodies: list[MovingBody], q: Any, v: Any, arguments: Arguments
) -> tuple[Any, Any, Any]:
    """Return generalized forces of springs and constant forces, those of dampers, and the stored energy."""
    import casadi as cs

    springs, n = mechanism.springs, mechanism.n
    elastic, damping, stored = cs.SX(n, 1), cs.SX(n, 1), cs.SX(1, 1)
    for k in range(n):
        x = q[int(mechanism.tree.q_index[k])]
        constant_force = arguments.number("constant", k)
        stiffness = arguments.number("joint_stiffness", k)
        extension = x - arguments.number("joint_rest", k)
        elastic[k] = constant_force - stiffness * extension
        stored = stored + stiffness * extension**2 / 2 - constant_force * x
        damping[k] = -arguments.number("joint_damping", k) * v[k]
    ends = [(bodies[joint], arguments.column("end", k)) for k, joint in enumerate(springs.anchors.point_joint)]
    count = len(springs.stiffness)
    for k, ((a, local_a), (b, local_b)) in enumerate(zip(ends[:count], ends[count:], strict=True)):
        position_a, rate_a, _ = a.point(local_a)
        position_b, rate_b, _ = b.point(local_b)
        R = b.axes.rotation_to(a.axes)
        r = position_a - multiply(R, position_b)
        length = cs.sqrt(dot(r, r))
        direction = r / cs.if_else(length > 0, length, 1)  # a spring of length zero has no direction, and no force
        jacobian_a = a.point_jacobian(position_a, local_a, n)
        jacobian = multiply(direction.T, jacobian_a - multiply(R, b.point_jacobian(position_b, local_b, n)))
        stiffness = arguments.number("stiffness", k)
        extension = length - arguments.number("rest_length", k)
        elastic = elastic - stiffness * extension * jacobian.T
        stored = stored + stiffness * extension**2 / 2
        c = arguments.number("damping", k)
        damping = damping - c * dot(direction, rate_a - multiply(R, rate_b)) * jacobian.T
    return elastic, damping, stored


def _configuration_rate(mechanism: Mechanism, q: Any, v: Any) -> Any:
    """Return the rate of Pinocchio's q' at v'."""
    import casadi as cs

    tree = mechanism.tree
    rate = cs.SX(tree.nq, 1)
    for k in range(tree.n):
        rate[int(tree.q_index[k])] = v[k]
    for in_q, in_v in tree.free_roots:
        u, w, spin = q[in_q + 3 : in_q + 6], q[in_q + 6], v[in_v + 3 : in_v + 6]
        translation = v[in_v : in_v + 3]
        rate[in_q : in_q + 3] = translation + 2 * cs.cross(u, cs.cross(u, translation) + w * translation)
        rate[in_q + 3 : in_q + 6] = 0.5 * (w * spin + cs.cross(u, spin))
        rate[in_q + 6] = -0.5 * cs.dot(u, spin)
    return rate
