"""Impacts in loops while other joints are at stops or at rest: random mechanisms that failed once."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities

FOLDER = "tests/sensitivity/loops"
HEIGHT = "link.la1.com.z"


def finite_difference(name: str, overrides: dict[str, Any], h: float = 1e-4) -> np.ndarray:
    """Derivative of the last state with respect to the height of a link's centre, by extrapolated differences."""
    urdf = ElementTree.parse(f"{FOLDER}/{name}/{name}.urdf")
    origin = urdf.find("link[@name='la1']/inertial/origin")
    assert origin is not None
    z = float(origin.attrib["xyz"].split()[2])

    def end(by: float) -> np.ndarray:
        run = simulate(f"{FOLDER}/{name}", {**overrides, HEIGHT: z + by})
        assert run.status == "done"
        return np.concatenate([run.q_tree[-1], run.v_tree[-1]])

    fine, coarse = ((end(x) - end(-x)) / (2 * x) for x in (h, 2 * h))
    return (4 * fine - coarse) / 3


def ends(result: Sensitivities) -> np.ndarray:
    assert result.run.status == "done", result.run.message
    return np.concatenate([result.q_tree[-1, :, 0], result.v_tree[-1, :, 0]])


@pytest.mark.parametrize("rtol", [1e-8, 1e-9, 1e-12])
def test_bounces_of_a_joint_while_another_joint_is_at_its_stop(rtol: float) -> None:
    """A joint loses its remaining speed at its stop while the loops move on, and S follows.

    The differences resolve bounces until these are neglected. At 1e-8 runs have another order of events.
    """
    overrides = {"solver.rtol": rtol, "solver.method": "Radau"}
    result = ends(sensitivities(f"{FOLDER}/two_stops", [HEIGHT], overrides))
    expected = finite_difference("two_stops", {**overrides, "solver.rtol": 1e-12})
    assert np.abs(result - expected).max() <= 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("rtol", [1e-8, 1e-9, 1e-10, 1e-11, 1e-12])
def test_an_inelastic_impact_that_releases_the_joint_at_once(rtol: float) -> None:
    """Rounding may bring the joint to its stop again at the same instant, which belongs to the same impact."""
    overrides = {"solver.rtol": rtol}
    result = ends(sensitivities(f"{FOLDER}/inelastic", [HEIGHT], overrides))
    expected = finite_difference("inelastic", {"solver.rtol": 1e-12}, 1e-5)
    assert np.abs(result - expected).max() <= 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-9, 1e-10])
@pytest.mark.parametrize("more", [[], ["link.la1.mass", "link.la2.mass", "link.lb1.mass"]])
def test_rates_of_joints_at_rest_have_zero_derivatives(rtol: float, more: list[str]) -> None:
    names = ["spring.1.rest_length", *more]
    result = sensitivities(f"{FOLDER}/friction_at_a_stop", names, {"solver.rtol": rtol})
    assert result.run.status == "done"
    assert np.abs(result.run.v_tree[-1]).max() < 1e-12
    assert np.abs(result.v_tree[-1]).max() < 1e-12


@pytest.mark.parametrize("rtol", [1.217382727739662e-08, 1.8464249428955427e-08, 3e-8])
@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_a_joint_that_leaves_its_stop_without_speed(rtol: float, formulation: str) -> None:
    """Rounding makes it touch and leave again at the same instant, without speed, so this is not an event."""
    overrides = {"solver.rtol": rtol, "formulation": formulation}
    name = "initial.q_dot.j0_1"
    scene, start = f"{FOLDER}/left_smoothly", 0.4079220041557603
    result = sensitivities(scene, [name], overrides)
    tight = {"solver.rtol": 1e-12, "formulation": formulation}
    above, below = (simulate(scene, {**tight, name: start + h}) for h in (1e-5, -1e-5))
    expected = np.concatenate([above.q_tree[-1] - below.q_tree[-1], above.v_tree[-1] - below.v_tree[-1]]) / 2e-5
    assert np.abs(ends(result) - expected).max() <= 1e-5 * np.abs(expected).max()
