"""Through impacts in loops next to joints that touch or rest: drawn at random, kept because they once went wrong."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities

FOLDER = "tests/sensitivity/loops"
HEIGHT = "link.la1.com.z"


def differentiated(name: str, overrides: dict[str, Any], h: float = 1e-4) -> np.ndarray:
    """Of the last state, by the height of a link's centre: differences of runs, extrapolated once."""
    urdf = ElementTree.parse(f"{FOLDER}/{name}/{name}.urdf")
    origin = urdf.find("link[@name='la1']/inertial/origin")
    assert origin is not None
    z = float(origin.attrib["xyz"].split()[2])

    def end(by: float) -> np.ndarray:
        run = simulate(f"{FOLDER}/{name}", {**overrides, HEIGHT: z + by})
        assert run.status == "done"
        return np.concatenate([run.q_tree[-1], run.v_tree[-1]])

    near, far = ((end(x) - end(-x)) / (2 * x) for x in (h, 2 * h))
    return (4 * near - far) / 3


def ends(found: Sensitivities) -> np.ndarray:
    assert found.run.status == "done", found.run.message
    return np.concatenate([found.q_tree[-1, :, 0], found.v_tree[-1, :, 0]])


@pytest.mark.parametrize("rtol", [1e-8, 1e-9, 1e-12])
def test_bounces_of_a_joint_while_another_touches(rtol: float) -> None:
    """What holds a joint takes the rest of its speed, and the loops go on: changes follow them there.

    The differences know bounces to where they are taken to be over. Those of runs at 1e-8 meet another order of events.
    """
    overrides = {"solver.rtol": rtol, "solver.method": "Radau"}
    found = ends(sensitivities(f"{FOLDER}/two_stops", [HEIGHT], overrides))
    wanted = differentiated("two_stops", {**overrides, "solver.rtol": 1e-12})
    assert np.abs(found - wanted).max() <= 1e-3 * np.abs(wanted).max()


@pytest.mark.parametrize("rtol", [1e-8, 1e-9, 1e-10, 1e-11, 1e-12])
def test_an_inelastic_impact_that_a_joint_leaves_at_once(rtol: float) -> None:
    """By rounding it may be at its stop once more at that instant, and rests there: that is when it was thrown."""
    overrides = {"solver.rtol": rtol}
    found = ends(sensitivities(f"{FOLDER}/inelastic", [HEIGHT], overrides))
    wanted = differentiated("inelastic", {"solver.rtol": 1e-12}, 1e-5)
    assert np.abs(found - wanted).max() <= 1e-5 * np.abs(wanted).max()


@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-9, 1e-10])
@pytest.mark.parametrize("more", [[], ["link.la1.mass", "link.la2.mass", "link.lb1.mass"]])
def test_what_has_come_to_rest_rests_with_every_parameter(rtol: float, more: list[str]) -> None:
    names = ["spring.1.rest_length", *more]
    found = sensitivities(f"{FOLDER}/friction_at_a_stop", names, {"solver.rtol": rtol})
    assert found.run.status == "done"
    assert np.abs(found.run.v_tree[-1]).max() < 1e-12
    assert np.abs(found.v_tree[-1]).max() < 1e-12


@pytest.mark.parametrize("rtol", [1.217382727739662e-08, 1.8464249428955427e-08, 3e-8])
@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_a_stop_that_a_joint_leaves_smoothly(rtol: float, formulation: str) -> None:
    """By rounding it touches and leaves again at that instant, without a speed: that has no time of its own."""
    overrides = {"solver.rtol": rtol, "formulation": formulation}
    name = "initial.q_dot.j0_1"
    scene, start = f"{FOLDER}/left_smoothly", 0.4079220041557603
    found = sensitivities(scene, [name], overrides)
    tight = {"solver.rtol": 1e-12, "formulation": formulation}
    ahead, behind = (simulate(scene, {**tight, name: start + h}) for h in (1e-5, -1e-5))
    wanted = np.concatenate([ahead.q_tree[-1] - behind.q_tree[-1], ahead.v_tree[-1] - behind.v_tree[-1]]) / 2e-5
    assert np.abs(ends(found) - wanted).max() <= 1e-5 * np.abs(wanted).max()
