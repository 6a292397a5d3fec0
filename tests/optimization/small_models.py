"""Mechanisms whose optimal motions have closed forms, and the check of a plan's replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from ckc_pin import Mechanism, Plan

MASS = 2.0  # kg, of the slider and of the pendulum
LENGTH = 0.4  # m, of the pendulum
GRAVITY = 9.81
REPLAY, CLOSURE = 1e-6, 1e-10  # of replays: rad, rad/s, m, m/s; largest |phi| of plans


def slider(
    *, damping: float = 0.0, friction: float = 0.0, springs: Sequence[dict[str, Any]] = (), **motor: Any
) -> Mechanism:
    """Return a mass on a horizontal rail: a double integrator."""
    urdf = f"""
    <robot name="slider">
      <link name="base"/>
      <link name="cart">
        <inertial><mass value="{MASS}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
      </link>
      <joint name="rail" type="prismatic">
        <parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
        <limit lower="-10" upper="10" effort="100" velocity="100"/>
      </joint>
    </robot>"""
    joints = [{"name": "rail", "damping": damping, "friction": friction}] if damping or friction else []
    return Mechanism.from_urdf(
        urdf, gravity=[0, 0, -GRAVITY], motors=[{"joint": "rail", **motor}], joints=joints, springs=springs,
        q_guess={"rail": 0.0},
    )  # fmt: skip


def table(**motor: Any) -> Mechanism:
    """Return a bead on two crossed rails, along x and y."""
    inertial = '<inertial><mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    urdf = f"""
    <robot name="table">
      <link name="base"/>
      <link name="beam">{inertial.format(1e-9)}</link>
      <link name="bead">{inertial.format(MASS)}</link>
      <joint name="x" type="prismatic">
        <parent link="base"/><child link="beam"/><axis xyz="1 0 0"/>
        <limit lower="-1" upper="1" effort="100" velocity="100"/>
      </joint>
      <joint name="y" type="prismatic">
        <parent link="beam"/><child link="bead"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="100" velocity="100"/>
      </joint>
    </robot>"""
    return Mechanism.from_urdf(
        urdf, gravity=[0, -GRAVITY, 0], motors=[{"joint": "x", **motor}, {"joint": "y", **motor}],
        points=[{"name": "bead", "frame": "bead"}], q_guess={"x": 0.0, "y": 0.0},
    )  # fmt: skip


def pendulum(**motor: Any) -> Mechanism:
    """Return a point mass on a massless rod; the angle is 0 where it hangs."""
    urdf = f"""
    <robot name="pendulum">
      <link name="base"/>
      <link name="rod">
        <inertial>
          <origin xyz="0 {-LENGTH} 0"/><mass value="{MASS}"/>
          <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/>
        </inertial>
      </link>
      <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint>
    </robot>"""
    return Mechanism.from_urdf(urdf, gravity=[0, -GRAVITY, 0], motors=[{"joint": "hinge", **motor}])


def pendulum_duration(angle: float, torque: float) -> float:
    """Return the smallest time in which the pendulum turns from rest to rest, s.

    The torque is M up to an angle and -M after it, which follows from the energy at both ends.
    """
    inertia, weight = MASS * LENGTH**2 + 1e-9, MASS * GRAVITY * LENGTH

    def square(q: float, switch: float) -> float:
        work = torque * q if q < switch else torque * (2 * switch - q)
        return float(2 * (work - weight * (1 - np.cos(q))) / inertia)

    switch = brentq(lambda c: square(angle, c), angle / 2, angle)
    # Substitutions x = q^(1/2) at the start and (angle - q)^(1/2) at the end remove the singularities.
    first = quad(lambda x: 2 * x / np.sqrt(square(x**2, switch)), 0, np.sqrt(switch), epsabs=1e-12)[0]
    second = quad(lambda x: 2 * x / np.sqrt(square(angle - x**2, switch)), 0, np.sqrt(angle - switch), epsabs=1e-12)[0]
    return float(first + second)


def require_replay(plan: Plan, limit: float) -> None:
    """Require that a replay ends where the plan does, that its loops are closed, and its torques within the limit."""
    assert plan.replay.error < REPLAY
    assert plan.replay.closure < CLOSURE
    assert plan.replay.max_tau <= limit * (1 + 1e-9)
