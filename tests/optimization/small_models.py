"""Mechanisms whose optimal motions have closed forms."""

from __future__ import annotations

from typing import Any

from ckc_pin import Mechanism

MASS = 2.0  # kg, of the slider and of the pendulum
LENGTH = 0.4  # m, of the pendulum
GRAVITY = 9.81


def slider(*, damping: float = 0.0, friction: float = 0.0, **motor: Any) -> Mechanism:
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
        urdf, gravity=[0, 0, -GRAVITY], motors=[{"joint": "rail", **motor}], joints=joints, q_guess={"rail": 0.0}
    )


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
