"""CasADi functions evaluated at many instants at a time are those that CasADi evaluates."""

from __future__ import annotations

from typing import Any

import casadi as cs
import numpy as np
import pytest

import ckc_pin
from ckc_pin.codegen.arguments import present, values
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.optimization.many_instants import InstantsFunction
from ckc_pin.optimization.motion_functions import MotionExpressions
from ckc_pin.optimization.tape import Tape


def every_operation() -> tuple[list[Any], list[Any]]:
    """Return inputs and outputs of a function with every operation that terms may contain."""
    x, y = cs.SX.sym("x", 3), cs.SX.sym("y", 2)
    a, b, c = x[0], x[1], y[0]
    values = [
        a + b, a - c, a * b, a / (2 + b * b), -a, a * a, 2 * a, 1 / (3 + c), cs.sqrt(1 + a * a), cs.sin(a), cs.cos(b),
        cs.tan(c), cs.atan2(a, b), cs.fabs(c), a < b, a <= c, cs.eq(a, b), cs.ne(a, b), cs.logic_not(a < b),
        cs.logic_and(a < b, b < c), cs.logic_or(a < b, b < c), cs.if_else(a < b, c, y[1]), cs.fmin(a, b), cs.fmax(b, c),
        (2 + a) ** x[2], cs.SX(7.0), a,
    ]  # fmt: skip
    return [x, y], [cs.vertcat(*values), cs.SX(2, 2), cs.SX(0, 3)]


@pytest.mark.parametrize("count", [1, 15, 16, 17, 100])
def test_operations_are_those_of_casadi(count: int) -> None:
    inputs, outputs = every_operation()
    function, random = cs.Function("every", inputs, outputs), np.random.default_rng(count)
    x, y = random.uniform(-1, 1, (count, 3)), random.uniform(-1, 1, (count, 2))
    x.setflags(write=False)
    many = InstantsFunction.of(inputs, outputs)(x, y)
    assert [result.shape for result in many] == [(count, 27, 1), (count, 2, 2), (count, 0, 3)]
    for k in range(count):
        for ours, exact in zip(many, function(x[k], y[k]), strict=True):
            np.testing.assert_allclose(ours[k], exact.full(), rtol=1e-15, atol=0)


def test_operations_on_parameters_are_those_of_casadi() -> None:
    """They are done when the function is made, also if all arguments are parameters."""
    (x, y), outputs = every_operation()
    function, random = cs.Function("every", [x, y], outputs), np.random.default_rng(5)
    at, parameters = random.uniform(-1, 1, (20, 3)), random.uniform(-1, 1, 2)
    of_some = InstantsFunction(Tape.of([x, y], outputs), parameters)(at)
    none = cs.SX.sym("none", 1)
    of_all = InstantsFunction(Tape.of([none, cs.vertcat(x, y)], outputs), np.append(at[0], parameters))(at[:, :1])
    for k in range(len(at)):
        for ours, exact in zip(of_some, function(at[k], parameters), strict=True):
            np.testing.assert_allclose(ours[k], exact.full(), rtol=1e-15, atol=0)
        for ours, exact in zip(of_all, function(at[0], parameters), strict=True):
            np.testing.assert_allclose(ours[k], exact.full(), rtol=1e-15, atol=0)


def test_terms_of_a_mechanism_have_casadis_digits() -> None:
    mechanism, random = ckc_pin.load("delta"), np.random.default_rng(1)
    expressions, numbers = MotionExpressions(mechanism), model_numbers(mechanism)
    parameters = values(numbers, present(numbers))
    for name in ("closure", "rates", "forces", "first", "second"):
        inputs, outputs = expressions.function(name)
        function = cs.Function(name, inputs, outputs, {"cse": True})
        columns = [random.uniform(-1, 1, (19, x.numel())) for x in inputs[:-1]]
        many = InstantsFunction(Tape.of(inputs, outputs), parameters)(*columns)
        for k in range(19):
            exact = function(*(x[k] for x in columns), parameters)
            for ours, value in zip(many, exact if isinstance(exact, tuple) else [exact], strict=True):
                np.testing.assert_array_equal(ours[k], value.full())


def test_an_unknown_operation_is_named() -> None:
    x = cs.SX.sym("x")
    with pytest.raises(ValueError, match=r"operations: CasADi's .* is not supported"):
        InstantsFunction.of([x], [cs.erf(x)])
