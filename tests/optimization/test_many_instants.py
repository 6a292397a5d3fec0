"""CasADi functions evaluated at many instants at a time are those that CasADi evaluates."""

from __future__ import annotations

from typing import Any

import casadi as cs
import numpy as np
import pytest

import ckc_pin
from ckc_pin.optimization.many_instants import InstantsFunction
from ckc_pin.optimization.reduced import ReducedDynamics


def every_operation() -> Any:
    """Return a function with every operation that terms may contain."""
    x, y = cs.SX.sym("x", 3), cs.SX.sym("y", 2)
    a, b, c = x[0], x[1], y[0]
    values = [
        a + b, a - c, a * b, a / (2 + b * b), -a, a * a, 2 * a, 1 / (3 + c), cs.sqrt(1 + a * a), cs.sin(a), cs.cos(b),
        cs.tan(c), cs.atan2(a, b), cs.fabs(c), a < b, a <= c, cs.eq(a, b), cs.ne(a, b), cs.logic_not(a < b),
        cs.logic_and(a < b, b < c), cs.logic_or(a < b, b < c), cs.if_else(a < b, c, y[1]), cs.fmin(a, b), cs.fmax(b, c),
        (2 + a) ** x[2], cs.SX(7.0), a,
    ]  # fmt: skip
    return cs.Function("every", [x, y], [cs.vertcat(*values), cs.densify(cs.SX(2, 2)), cs.SX(0, 3)])


@pytest.mark.parametrize("count", [1, 15, 16, 17, 100])
def test_operations_are_those_of_casadi(count: int) -> None:
    function, random = every_operation(), np.random.default_rng(count)
    x, y = random.uniform(-1, 1, (count, 3)), random.uniform(-1, 1, (count, 2))
    x.setflags(write=False)
    many = InstantsFunction(function)(x, y)
    assert [result.shape for result in many] == [(count, 27, 1), (count, 2, 2), (count, 0, 3)]
    for k in range(count):
        for ours, exact in zip(many, function(x[k], y[k]), strict=True):
            np.testing.assert_allclose(ours[k], exact.full(), rtol=1e-15, atol=0)


def test_terms_of_a_mechanism_have_casadis_digits() -> None:
    dynamics, random = ReducedDynamics(ckc_pin.load("delta")), np.random.default_rng(1)
    for of_instants in (dynamics._closure, dynamics._rates, dynamics._passive, dynamics._first, dynamics._second):
        function = of_instants.function
        columns = [random.uniform(-1, 1, (19, function.numel_in(k))) for k in range(function.n_in())]
        many = of_instants(*columns)
        for k in range(19):
            exact = function(*(x[k] for x in columns))
            for ours, value in zip(many, exact if isinstance(exact, tuple) else [exact], strict=True):
                np.testing.assert_array_equal(ours[k], value.full())


def test_an_unknown_operation_is_named() -> None:
    x = cs.SX.sym("x")
    with pytest.raises(ValueError, match=r"operations: CasADi's .* is not supported"):
        InstantsFunction(cs.Function("f", [x], [cs.erf(x)]))
