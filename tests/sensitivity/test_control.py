"""Sensitivities with controllers against extrapolated differences: gains, targets, limits, samples, functions."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, simulate
from ckc_pin.mechanism.parameters import values_of, with_components
from ckc_pin.sensitivity.sensitivities import sensitivities
from tests.sensitivity.four_bar import TIGHT

TOLERANCE = 1e-8  # relative to the largest


def agree(scene: str, values: dict[str, float], overrides: dict[str, Any]) -> None:
    """Compare joint coordinates, rates, u and tau; `values` are those of the parameters."""
    result = sensitivities(scene, list(values), overrides)
    assert result.run.status == "done"
    run = result.run
    free = run.mechanism.tree.free_coordinates
    joints = [k for k, name in enumerate(run.coordinates) if name not in free]
    parts = {
        "q": (result.q_tree[:, joints], lambda x: x.q_tree[:, joints]),
        "v": (result.v_tree[:, joints], lambda x: x.v_tree[:, joints]),
        "u": (result.u, lambda x: x.u),
        "tau": (result.tau, lambda x: x.tau),
    }
    for k, (name, value) in enumerate(values.items()):
        h = 1e-2 * max(1.0, abs(value))
        runs = [[simulate(scene, {**overrides, name: value + x}) for x in (h / s, -h / s)] for s in (1, 2, 4)]
        for part, (ours, read) in parts.items():
            if part == "tau" and len(run.actuated) > len(run.independent):  # motors that share u
                assert np.isnan(ours).all()
                continue
            one, two, four = (
                (read(more) - read(less)) / (2 * h / s) for (more, less), s in zip(runs, (1, 2, 4), strict=True)
            )
            expected = (16 * (4 * four - two) - (4 * two - one)) / 45
            assert np.abs(expected).max() > 1e-6, name  # it matters
            assert np.abs(ours[:, :, k] - expected).max() <= TOLERANCE * np.abs(expected).max(), name


@pytest.mark.parametrize(
    ("terms", "formulation", "each"),
    [("pinocchio", "dae", False), ("pinocchio", "reduced", True), ("generated", "dae", True)],
)
def test_gains_of_tracking(terms: str, formulation: str, each: bool) -> None:
    """As one number, or by coordinate."""
    gains = {"controller.Lambda": 1.0, "controller.K_D": 10.0}
    spec = ckc_pin.load_scene("five_bar/tracking").spec.controller
    assert (spec.Lambda, spec.K_D) == tuple(gains.values())
    overrides = {**TIGHT, "formulation": formulation, "t_end": 0.3, "solver.output_dt": 0.1, "solver.terms": terms}
    if each:
        overrides |= {name: {"theta_1": gain, "theta_3": gain} for name, gain in gains.items()}
        gains = {"controller.Lambda.theta_3": 1.0, "controller.K_D.theta_1": 10.0}
    agree("five_bar/tracking", gains, overrides)


@pytest.mark.parametrize("terms", ["pinocchio", "generated"])
def test_target_of_a_set_point(terms: str) -> None:
    """The compensated gravity depends on the target."""
    q_d = dict(ckc_pin.load_scene("five_bar/set_point").spec.controller.q_d)
    overrides = {**TIGHT, "formulation": "reduced", "t_end": 0.3, "solver.output_dt": 0.1, "solver.terms": terms}
    agree("five_bar/set_point", {f"controller.q_d.{name}": value for name, value in q_d.items()}, overrides)


@pytest.mark.parametrize("scene", ["delta/circle", "stewart/wave", "two_ur5/lift"])
def test_tracking_with_a_free_root(scene: str) -> None:
    ready = ckc_pin.load_scene(scene)
    name = ckc_pin.load(scene.split("/")[0]).independent[1]
    start = (ready.spec.initial.q_dot or {}).get(name, 0.0)
    overrides = {**TIGHT, "formulation": "reduced", "t_end": 0.1, "solver.output_dt": 0.05, "solver.terms": "pinocchio"}
    gain = float(ready.spec.controller.K_D)
    agree(scene, {f"initial.q_dot.{name}": start, "controller.K_D": gain}, overrides)


REDUNDANT = """
[[motor]]
joint = "theta_1"
{limit}
[[motor]]
joint = "theta_2"
torque_limit = 0.5
[[motor]]
joint = "theta_3"
{limit}
"""


def with_three_motors(folder: Path, limit: str = "") -> str:
    shutil.copytree("urdf/five_bar", folder)
    path = folder / "mechanism.toml"
    text = path.read_text(encoding="utf-8").replace('actuated = ["theta_1", "theta_3"]\n', "")
    path.write_text(text + REDUNDANT.format(limit=limit), encoding="utf-8")
    return str(folder / "set_point.scene.toml")


def test_a_torque_limit_that_other_motors_compensate(tmp_path: Path) -> None:
    """The other motors give the rest of u, so the motion does not depend on the limit."""
    names = ["motor.theta_2.torque_limit", "motor.theta_2.ratio", "controller.K_P"]
    result = sensitivities(with_three_motors(tmp_path / "x"), names, {"t_end": 0.3, "solver.output_dt": 0.05})
    assert np.abs(result.run.tau[:, 1]).max() == 0.5
    assert not result.q_tree[:, :, :2].any()
    assert not result.u[:, :, :2].any()
    assert np.abs(result.q_tree[-1, :, 2]).max() > 1e-3


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_redundant_motors_that_cannot_give_u_stop_the_run(method: str, formulation: str, tmp_path: Path) -> None:
    overrides = {"t_end": 0.3, "solver.method": method, "formulation": formulation}
    result = sensitivities(with_three_motors(tmp_path / "x", "torque_limit = 1.0"), ["gravity.y"], overrides)
    assert result.run.status == "stopped"
    assert "motors at their torque limits cannot produce u together" in result.run.message


def test_lengths_are_rejected_if_a_point_follows_a_path(tmp_path: Path) -> None:
    """Even with a model, q_d depends on the mechanism's lengths."""
    shutil.copytree("urdf/five_bar", tmp_path / "x")
    scene = tmp_path / "x" / "tracking.scene.toml"
    x, y, _ = simulate("five_bar/swing", {"t_end": 1e-3}).points["tip"][0]
    text = (
        scene.read_text(encoding="utf-8").partition("[controller]")[0].replace('at = "equilibrium"', 'at = "assembled"')
    )
    scene.write_text(
        text + '[controller]\ntype = "tracking"\nLambda = 1.0\nK_D = 10.0\nmodel = "mechanism.toml"\n'
        f'[controller.desired]\npoint = "tip"\nline = {{ start = [{x}, {y}, 0.0], end = [{x}, {y + 0.01}, 0.0], '
        "frequency = 1.0 }\n",
        encoding="utf-8",
    )
    with pytest.raises(InputError, match=r"joint\.theta_2\.xyz\.x: .* q_d depends on the mechanism's lengths"):
        sensitivities(str(scene), ["joint.theta_2.xyz.x"])


# --- sampled ---------------------------------------------------------------------------------------

CLOCK = {"controller.sample_time": 0.01, "controller.delay": 0.013}
OF_SET_POINT = {"controller.K_P": 10.0, "controller.K_V": 1.0, "initial.q_dot.theta_1": 0.0, "gravity.y": -9.81}


@pytest.mark.parametrize(
    ("formulation", "terms"),
    [("dae", "pinocchio"), ("reduced", "pinocchio"), ("spf", "pinocchio"), ("dae", "generated")],
)
def test_sampled_controllers(formulation: str, terms: str) -> None:
    """Output and derivatives are held between samples, with a delay longer than a period."""
    settings = {**TIGHT, **CLOCK, "formulation": formulation, "solver.terms": terms}
    agree("five_bar/set_point", OF_SET_POINT, {**settings, "t_end": 0.1, "solver.output_dt": 0.025})
    names = {"initial.q_dot.theta_1": 0.0} | ({"controller.Lambda": 1.0} if terms == "pinocchio" else {})
    quick = {"controller.sample_time": 1e-3, "controller.delay": 1.3e-3, "t_end": 0.1, "solver.output_dt": 0.025}
    agree("five_bar/tracking", names, {**settings, **quick})


def test_sampled_torques_beyond_their_limit() -> None:
    """A torque at its limit has zero derivatives until a sample brings it back."""
    limited = {"controller.torque_limit": 2.0, "controller.sample_time": 0.01}
    overrides = {**TIGHT, **limited, "formulation": "reduced", "t_end": 0.5, "solver.output_dt": 0.1}
    run = simulate("five_bar/set_point", overrides)
    assert np.abs(run.tau).max() == 2.0 > np.abs(run.tau[-1]).max()
    agree("five_bar/set_point", OF_SET_POINT, overrides)


# --- caller's controller -----------------------------------------------------------------------------


class Spring:
    """A nonlinear law of independent and dependent coordinates, rates and time."""

    def u(self, t: float, terms: ckc_pin.Terms) -> list[float]:
        q, v = terms.q_tree, terms.v_tree
        return [-3.0 * np.sin(q[0] + 1.0) - 0.2 * v[1] + np.sin(t), -2.0 * q[2] ** 3 - 0.3 * v[2] * np.cos(q[3])]


@pytest.mark.parametrize(
    ("formulation", "sampled"), [("dae", False), ("reduced", False), ("spf", False), ("dae", True)]
)
def test_a_callers_controller(formulation: str, sampled: bool) -> None:
    overrides = {
        **TIGHT,
        "formulation": formulation,
        "t_end": 0.15,
        "solver.output_dt": 0.05,
        "solver.terms": "pinocchio",
    }
    values = {"link.link_2.mass": 0.1, "joint.theta_2.xyz.x": 0.2794, "gravity.y": -9.81, "initial.q_dot.theta_1": 0.0}
    loaded = ckc_pin.load("five_bar")
    present = with_components(values_of(loaded.spec, loaded.urdf))
    values |= {name: present[name] for name in values if name in present}
    law = ckc_pin.Sampled(Spring(), 0.01) if sampled else Spring()
    # The controller's differences are rounded: error control at TIGHT would take a hundred thousand steps.
    loose = {**overrides, "solver.rtol": 1e-9, "solver.atol": 1e-11}
    result = ckc_pin.sensitivities("five_bar/swing", list(values), loose, controller=law)
    assert result.run.status == "done"
    for k, (name, value) in enumerate(values.items()):
        h = 2e-3 * max(0.3, abs(value))
        runs = [
            [simulate("five_bar/swing", {**overrides, name: value + x}, controller=law) for x in (h / s, -h / s)]
            for s in (1, 2)
        ]
        for part in ("q_tree", "v_tree", "u"):
            one, two = (
                (getattr(more, part) - getattr(less, part)) / (2 * h / s)
                for (more, less), s in zip(runs, (1, 2), strict=True)
            )
            expected = (4 * two - one) / 3
            assert np.abs(getattr(result, part)[:, :, k] - expected).max() <= 1e-7 * np.abs(expected).max(), (
                name,
                part,
            )


def test_a_callers_controller_that_reads_terms_is_rejected() -> None:
    """Terms depend on masses, but not on the start."""

    def compensated(t: float, terms: ckc_pin.Terms) -> np.ndarray:
        return terms.h - 2.0 * terms.q_dot

    overrides = {**TIGHT, "t_end": 0.2}
    with pytest.raises(InputError, match=r"link\.link_2\.mass: the controller reads terms whose parameter dependence"):
        ckc_pin.sensitivities("five_bar/swing", ["link.link_2.mass"], overrides, controller=compensated)
    name = "initial.q_dot.theta_3"
    result = ckc_pin.sensitivities("five_bar/swing", [name], overrides, controller=compensated)
    one, two = (
        simulate("five_bar/swing", {**overrides, name: x}, controller=compensated).q_tree for x in (1e-4, -1e-4)
    )
    assert np.abs(result.q_tree[:, :, 0] - (one - two) / 2e-4).max() <= 1e-6 * np.abs(one - two).max() / 2e-4


def test_a_callers_controller_must_give_u() -> None:
    class Motors:
        def tau(self, t: float, terms: ckc_pin.Terms) -> list[float]:
            return [0.0, 0.0]

    with pytest.raises(InputError, match="Motors gives tau, whose derivatives are unknown"):
        ckc_pin.sensitivities("five_bar/swing", ["gravity.y"], controller=Motors())  # type: ignore[arg-type]
