"""A mechanism's terms as CasADi functions, for optimal control, identification or code generation by the user."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.codegen.acceleration import ConstrainedInertia
from ckc_pin.codegen.arguments import argument_names, present, values
from ckc_pin.codegen.expressions import term_expressions
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers

__all__ = ["Symbolic", "symbolic"]

FUNCTIONS = ("phi", "J", "J_dot_v", "D_tree", "potential", "bias_tree", "damping", "kinetic", "q_dot", "v_dot")


@dataclass(frozen=True, repr=False)
class Symbolic(HasSummary):
    """CasADi functions of a mechanism; SI units, vectors in the order of `coordinates`.

    Arguments of the functions:

    - q: Pinocchio's q', nq numbers. A free root's rotation is a quaternion x, y, z, w of unit length.
    - v: v', n numbers. A free root's are its twist in its own axes.
    - u: u', n generalized forces.
    - p: the numbers named by `parameters`.

    Attributes
    ----------
    coordinates, independent : tuple of str
    parameters : tuple of str
        Names of the masses, centres, inertias, offsets, lengths, stiffnesses and gravity that are not zero, as
        parameters are named elsewhere. A body's numbers, ``link.link_2.mass``, are those of all links that its joint
        moves, in the joint's frame.
    values : (k,) array
        The mechanism's values of the parameters.
    q_tree : (nq,) array
        The assembled configuration.
    phi, J : casadi.Function
        Of (q, p): (rows) and (rows, n).
    J_dot_v : casadi.Function
        Of (q, v, p): (rows).
    D_tree, potential : casadi.Function
        Of (q, p): (n, n); and J, the potential energy of gravity, springs and constant forces.
    bias_tree, damping, kinetic : casadi.Function
        Of (q, v, p): C' v' + h' less the forces of springs, (n); the forces of dampers, (n); J.
    q_dot : casadi.Function
        Of (q, v): the rate of q, (nq).
    v_dot : casadi.Function
        Of (q, v, u, p): eq. 1's acceleration, (n), on and off the constraint manifold, where J has full rank.
    """

    coordinates: tuple[str, ...]
    independent: tuple[str, ...]
    parameters: tuple[str, ...]
    values: Array
    q_tree: Array
    phi: Any
    J: Any
    J_dot_v: Any
    D_tree: Any
    potential: Any
    bias_tree: Any
    damping: Any
    kinetic: Any
    q_dot: Any
    v_dot: Any

    def summary(self) -> Summary:
        """One-screen summary."""
        functions = [str(getattr(self, name)) for name in FUNCTIONS]
        rows: list[Row] = [
            ("coordinates", self.coordinates),
            ("independent q", self.independent),
            ("parameters", self.parameters),
            *zip(FUNCTIONS, functions, strict=True),
        ]
        return Summary(f"CasADi functions of {len(self.coordinates)} coordinates", rows)


def symbolic(mechanism: Mechanism | str | Path) -> Symbolic:
    """Return a mechanism's terms as CasADi functions.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
        A mechanism, its shipped name or its folder.

    Raises
    ------
    InputError
        CasADi is not installed, or the mechanism is unknown.

    >>> five_bar = symbolic("five_bar")
    >>> five_bar.v_dot(five_bar.q_tree, np.zeros(4), np.zeros(4), five_bar.values).shape
    (4, 1)
    """
    mechanism = as_mechanism(mechanism, "symbolic")
    try:
        import casadi as cs
    except ModuleNotFoundError as error:
        raise InputError("symbolic needs CasADi, which is not installed: pip install ckc_pin[symbolic]") from error
    terms, mechanism_numbers = term_expressions(mechanism), model_numbers(mechanism)
    q, v, p = terms.configuration.q, terms.v, terms.arguments.vector
    u = cs.SX.sym("u", mechanism.n)
    v_dot, _ = ConstrainedInertia(terms).acceleration(u, np.zeros(mechanism.closure.rows))

    def function(name: str, result: Any, **arguments: Any) -> Any:
        value = cs.densify(terms.configuration.as_function_of_q(result))
        return cs.Function(name, list(arguments.values()), [value], list(arguments), [name])

    return Symbolic(
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        parameters=tuple(argument_names(mechanism, present(mechanism_numbers))),
        values=values(mechanism_numbers, present(mechanism_numbers)),
        q_tree=np.array(mechanism.q_tree),
        phi=function("phi", terms.rows.phi, q=q, p=p),
        J=function("J", terms.rows.J, q=q, p=p),
        J_dot_v=function("J_dot_v", terms.rows.J_dot_v, q=q, v=v, p=p),
        D_tree=function("D_tree", terms.D_tree, q=q, p=p),
        potential=function("potential", terms.potential, q=q, p=p),
        bias_tree=function("bias_tree", terms.bias_tree, q=q, v=v, p=p),
        damping=function("damping", terms.damping, q=q, v=v, p=p),
        kinetic=function("kinetic", terms.kinetic, q=q, v=v, p=p),
        q_dot=function("q_dot", terms.q_dot, q=q, v=v),
        v_dot=function("v_dot", v_dot, q=q, v=v, u=u, p=p),
    )
