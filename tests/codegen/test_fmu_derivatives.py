"""Directional derivatives of FMUs against differences of the FMU's own values and against linear models."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from ckc_pin import Scene, linearize, load_scene, simulate
from ckc_pin.base.arrays import Array
from ckc_pin.scene.parts import load_scene_mechanism
from tests.codegen.fmu_instance import Instance, write_fmu
from tests.codegen.test_export_c import make_mechanism

# Central differences are extrapolated to the sixth order.
MAX_DIFFERENCE = 1e-9  # relative to the largest derivative of a quantity by any input or state, and its value
ROUNDING = 1e-9  # of differences of quantities that are constant
EXACT = 1e-9  # relative: against the linear model, at a state of a run with this tolerance
# Scene, version of FMI, time of the compared state of a run (s), step of differences. The step is shorter where another
# row would become the one with the largest residual.
CASES = {
    "five_bar": ("five_bar/swing", "2.0", 0.3, 3e-3),
    "five_bar_spf": ("five_bar/swing", "3.0", 0.3, 3e-4),
    "delta": ("delta", "3.0", 0.3, 3e-3),
    "andrews": ("andrews", "2.0", 0.005, 3e-3),
    "flyball": ("flyball", "2.0", 0.3, 3e-3),
    "five_bar_at_stop": ("five_bar/friction", "3.0", 0.1, 3e-3),
}


def scene_of(name: str) -> Scene:
    overrides = {"solver.rtol": 1e-11, "t_end": CASES[name][2], "controller": None, "friction_smoothing": None}
    if name == "five_bar_at_stop":  # theta_1 rests on its stop
        frictionless = {f"joint.theta_{k}.friction": 0.0 for k in (1, 2, 3, 4)}
        overrides |= {"parameters": {**frictionless, "gravity": [-9.81, 0.0, 0.0]}, "formulation": "reduced"}
        overrides |= {"initial": {"q": {"theta_1": -1.45, "theta_3": -1.5}, "q_dot": {"theta_3": 0.5}}}
    elif name == "five_bar_spf":
        overrides |= {"formulation": "spf", "epsilon": 0.1}
    else:
        overrides |= {"formulation": "reduced"}
    return load_scene(CASES[name][0], overrides)


class Evaluation(Instance):
    """Model exchange of a scene's FMU at states and inputs."""

    def __init__(self, folder: Path, scene: Scene, fmi: str) -> None:
        super().__init__(write_fmu(scene, folder, fmi), "ModelExchange")
        self.knowns = [*self.states, *self.inputs]

    def values(self, point: Array) -> Array:
        """Return all outputs at the states and inputs."""
        states, inputs = np.split(point, [len(self.states)])
        self.set_states(states)
        self.set(dict(zip(self.inputs, inputs.tolist(), strict=True)))
        return self.get(self.outputs)

    def jacobian(self, point: Array) -> Array:
        """Return the derivatives of all outputs by all states and inputs."""
        self.values(point)
        return self.derivatives(self.outputs, self.knowns)

    def point(self, values: Callable[[str], float]) -> Array:
        return np.array([values(name) for name in self.knowns])


@pytest.fixture(scope="module")
def evaluation_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Evaluation]:
    @cache
    def evaluation(name: str) -> Evaluation:
        return Evaluation(tmp_path_factory.mktemp("fmu"), scene_of(name), CASES[name][1])

    return evaluation


@pytest.mark.parametrize("name", CASES)
def test_directional_derivatives_are_limits_of_differences(
    name: str, evaluation_of: Callable[[str], Evaluation]
) -> None:
    """The point is off the constraint manifold where the states allow it, and motors are not at their limits."""
    evaluation, random = evaluation_of(name), np.random.default_rng(0)
    run = simulate(scene_of(name))
    point = evaluation.point(lambda x: float(run[x][-1]) if x in evaluation.states else random.uniform(-0.2, 0.2))
    if name.endswith("spf"):
        point[: len(evaluation.states)] += random.uniform(-1e-3, 1e-3, len(evaluation.states))

    def difference(k: int, step: float) -> Array:
        shift = step * np.eye(len(point))[k]
        return (evaluation.values(point + shift) - evaluation.values(point - shift)) / (2 * step)

    def limit(k: int) -> Array:
        coarse, middle, fine = (difference(k, CASES[name][3] / 2**i) for i in range(3))
        return (64 * fine - 20 * middle + coarse) / 45

    actual = evaluation.jacobian(point)
    expected = np.transpose([limit(k) for k in range(len(point))])
    for row, (ours, theirs) in enumerate(zip(actual, expected, strict=True)):
        scale = np.abs(theirs).max() + np.abs(evaluation.values(point)[row]) + ROUNDING / MAX_DIFFERENCE
        assert np.abs(ours - theirs).max() <= MAX_DIFFERENCE * scale, evaluation.outputs[row]


@pytest.mark.parametrize("name", ["five_bar", "delta", "andrews"])
def test_directional_derivatives_are_those_of_the_linear_model(
    name: str, evaluation_of: Callable[[str], Evaluation]
) -> None:
    scene, evaluation = scene_of(name), evaluation_of(name)
    model, run = linearize(scene, scene.spec.t_end), simulate(scene)
    point = evaluation.point(lambda x: float(run[x][-1]) if x in evaluation.states else 0.0)
    jacobian = evaluation.jacobian(point)
    free = set(load_scene_mechanism(scene).tree.free_coordinates)
    columns = [*model.states, *(f"tau.{x}" if not x.startswith("tau.") else x for x in model.inputs)]
    rows = [f"a.{x}" for x in model.states[: len(model.states) // 2]]
    expected = {
        **dict(zip(rows, np.hstack([model.A, model.B])[len(rows) :], strict=True)),
        **{x: y for x, y in zip(model.outputs, np.hstack([model.C, model.D]), strict=True) if x not in free},
    }
    assert len(expected) > len(rows)
    place = [evaluation.knowns.index(x) for x in columns]
    for output, theirs in expected.items():
        ours = jacobian[evaluation.outputs.index(output)][place]
        assert np.abs(ours - theirs).max() <= EXACT * max(1.0, np.abs(theirs).max()), output


def test_directional_derivatives_by_parameters_are_refused(evaluation_of: Callable[[str], Evaluation]) -> None:
    evaluation = evaluation_of("five_bar_spf")
    mass = next(name for name in evaluation.reference if name.startswith("link."))
    with pytest.raises(FMICallException):
        evaluation.derivatives(["theta_2"], [mass])
    assert evaluation.messages[-1] == "directional derivatives are by inputs and states"


def test_torque_beyond_its_limit_changes_nothing(tmp_path: Path) -> None:
    motor = '\n[[motor]]\nname = "theta_1"\njoint = "theta_1"\ntorque_limit = 1.0\n'
    make_mechanism(tmp_path, 'actuated = ["theta_1", "theta_3"]', "", motor)
    scene = scene_of("five_bar").with_overrides({"mechanism": str(tmp_path)})
    evaluation = Evaluation(tmp_path / "fmu", scene, "2.0")
    run = simulate(scene)
    for torque, expected in ((0.5, True), (1.5, False)):
        names = {"tau.theta_1": torque}
        point = evaluation.point(
            lambda x, names=names: names.get(x, float(run[x][-1]) if x in evaluation.states else 0)
        )
        by_torque = evaluation.jacobian(point)[:, evaluation.knowns.index("tau.theta_1")]
        assert by_torque.any() == expected
