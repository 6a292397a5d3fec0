"""Mechanisms and references for tests of set-point control: chains of point masses, and the appendix's five-bar."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ckc_pin import Mechanism
from ckc_pin.base.sources import Sources
from ckc_pin.control import SetPoint
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.scene.initial import Start, find_start
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from tests.analytic.five_bar import FIVE_BAR, Array

G = 9.81
NEAR_START = {"initial.at": None, "initial.q": {"theta_1": 0.3, "theta_3": 0.5}}  # half a radian from q_d


class CertifyArguments(NamedTuple):
    """Arguments of `certify`."""

    mechanism: Mechanism
    controller: SetPoint
    start: Start


def load_arguments(overrides: Mapping[str, Any] | None = None) -> CertifyArguments:
    """Load the five-bar's set-point scene with overrides by dotted key."""
    loaded = load_scene("five_bar/set_point", overrides)
    mechanism = load_scene_mechanism(loaded)
    controller = build_scene_controller(loaded, mechanism)
    assert isinstance(controller, SetPoint)
    return CertifyArguments(mechanism, controller, find_start(mechanism, loaded))


def pendulum(links: int) -> Mechanism:
    """Return a chain of point masses of 1 kg on massless rods of 1 m, angles from +x, gravity along -y."""
    parts, parent, x = ['<link name="base"/>'], "base", 0.0
    for k in range(1, links + 1):
        parts.append(
            f'<link name="rod{k}"><inertial><origin xyz="1 0 0"/><mass value="1"/>'
            '<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="q{k}" type="continuous"><parent link="{parent}"/><child link="rod{k}"/>'
            f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
        parent, x = f"rod{k}", 1.0
    spec = MechanismSpec(name="pendulum", urdf="p.urdf", gravity=(0.0, -G, 0.0))
    urdf = f'<robot name="p">{"".join(parts)}</robot>'
    return assemble_mechanism(spec, Sources("pendulum", None, {"p.urdf": urdf}))


def at_rest(mechanism: Mechanism, q: list[float]) -> Start:
    solution = sigma(mechanism, np.array(q))
    assert solution.verdict == "converged"
    return Start(solution.at, np.zeros(mechanism.d), np.zeros(mechanism.closure.rows))


def five_bar_U(controller: SetPoint, q: Array) -> float:
    """Return V_L at rest by the numpy five-bar."""
    q_d = controller.q_d
    h_d, V_d = FIVE_BAR.h(FIVE_BAR.sigma(q_d)), FIVE_BAR.potential_energy(FIVE_BAR.sigma(q_d))
    e = q - q_d
    return float(FIVE_BAR.potential_energy(FIVE_BAR.sigma(q)) - V_d - e @ h_d + e @ controller.K_P @ e / 2)


def five_bar_gradient(q: Array, step: float, branch: int = 1) -> Array:
    """Return dh/dq by fourth-order central differences of the numpy five-bar's h."""
    h = [[FIVE_BAR.h(FIVE_BAR.sigma(q + k * step * e, branch)) for k in (1, -1, 2, -2)] for e in np.eye(2)]
    return np.array([(8 * (a - b) - (c - d)) / (12 * step) for a, b, c, d in h]).T


def five_bar_border(s: float, count: int) -> Array:
    """Return points (theta_1, theta_3) with |s| = s: the elbows are 2 l2 sin(gamma/2) apart, s = sin gamma."""
    l, points = FIVE_BAR.l, []
    for gamma in (np.arcsin(s), np.pi - np.arcsin(s)):
        distance = 2 * l[1] * np.sin(gamma / 2)
        for theta_1 in np.linspace(-np.pi, np.pi, count, endpoint=False):
            x, y = l[0] * np.cos(theta_1) - FIVE_BAR.base, l[0] * np.sin(theta_1)
            r = np.hypot(x, y)
            cosine = (l[2] ** 2 + r**2 - distance**2) / (2 * l[2] * r)
            if abs(cosine) <= 1:
                points += [[theta_1, np.arctan2(y, x) + sign * np.arccos(cosine)] for sign in (1, -1)]
    return np.array(points)
