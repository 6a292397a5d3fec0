"""Mechanisms made by rule: a name and a number give the texts of a mechanism's files, for as many links as wanted."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from ckc_pin.base.sources import Sources

__all__ = ["GENERATORS", "MAX_N", "GeneratorSpec", "generate"]

GENERATORS = ("n_four_bar",)
MAX_N = 160  # n = 2 N + 1 coordinates, and memory grows with n^3: 2.2 GB


class GeneratorSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A scene's ``mechanism = {generator = "n_four_bar", N = 40}``; the bound holds before anything is made.

    Attributes
    ----------
    generator
        N unit squares in a row that share their verticals.
        ``generator = "n_four_bar"``
    N
        How many.
        ``N = 40``
    """

    generator: Literal["n_four_bar"]
    N: Annotated[int, msgspec.Meta(ge=1, le=MAX_N)] = 4


def generate(spec: GeneratorSpec) -> tuple[str, Sources]:
    """Return the text of the mechanism file and the sources that hold the URDF it names.

    Parameters
    ----------
    spec : GeneratorSpec
        ``n_four_bar``: N unit squares in a row that share their verticals. N + 1 rods stand on ground
        pins one metre apart, N bars lie on top; all are uniform, 1 m and 1 kg. ``theta_k`` is rod k's
        angle from +x, ``psi_k`` the angle of bar k against rod k - 1, on whose top it is pinned.
    """
    N = spec.N
    rods = [_link(f"rod_{k}", z=0.0, colour="blue") for k in range(N + 1)]
    bars = [_link(f"bar_{k}", z=0.05, colour="orange") for k in range(1, N + 1)]
    feet = [_joint(f"theta_{k}", "ground", f"rod_{k}", x=k) for k in range(N + 1)]
    tops = [_joint(f"psi_{k}", f"rod_{k - 1}", f"bar_{k}", x=1) for k in range(1, N + 1)]
    urdf = _URDF.format(length=N + 0.2, middle=N / 2, parts="\n".join(rods + bars + feet + tops))
    guess = [f"theta_{k} = {_UP}" for k in range(N + 1)] + [f"psi_{k} = -{_UP}" for k in range(1, N + 1)]
    loops = [_LOOP.format(k=k) for k in range(1, N + 1)]
    text = _MECHANISM.format(N=N, most=MAX_N, guess="\n".join(guess), loops="\n".join(loops))
    return text, Sources(f"{spec.generator}, N = {N}", None, {"n_four_bar.urdf": urdf})


_UP = "1.5707963267948966"

_MECHANISM = """\
# N-four-bar: unit squares in a row that share their verticals, any number N of them up to {most}; here N = {N}.
name = "n_four_bar"
urdf = "n_four_bar.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["theta_0"]

# Rods upright, bars level.
[q_guess]
{guess}

{loops}
# The first top pin.
[[point]]
name = "B0"
frame = {{link = "rod_0", xyz = [1.0, 0.0, 0.0]}}
"""

_LOOP = """\
[[loop]]
name = "pin_{k}"
type = "point_2d"
frame_a = {{link = "bar_{k}", xyz = [1.0, 0.0, 0.0]}}
frame_b = {{link = "rod_{k}", xyz = [1.0, 0.0, 0.0]}}
rows_in = "world"
"""

_URDF = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- Uniform rods of 1 m and 1 kg: izz = 1/12 kg m^2; 40 mm square, the bars drawn in front of the rods. -->
<robot name="n_four_bar">
  <material name="steel"><color rgba="0.35 0.37 0.40 1"/></material>
  <material name="blue"><color rgba="0.12 0.30 0.60 1"/></material>
  <material name="orange"><color rgba="0.95 0.55 0.15 1"/></material>
  <link name="ground">
    <visual>
      <origin xyz="{middle} 0 -0.04"/>
      <geometry><box size="{length} 0.06 0.02"/></geometry>
      <material name="steel"/>
    </visual>
  </link>
{parts}
</robot>
"""

_PIN = """\
    <visual>
      <origin xyz="{x} 0 {z}"/>
      <geometry><cylinder radius="0.03" length="0.05"/></geometry>
      <material name="{colour}"/>
    </visual>"""


def _link(name: str, z: float, colour: str) -> str:
    pins = "\n".join(_PIN.format(x=x, z=z, colour=colour) for x in (0, 1))
    return f"""\
  <link name="{name}">
    <inertial>
      <origin xyz="0.5 0 0"/>
      <mass value="1"/>
      <inertia ixx="{0.04**2 / 6!r}" iyy="{1 / 12!r}" izz="{1 / 12!r}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual>
      <origin xyz="0.5 0 {z}"/>
      <geometry><box size="1 0.04 0.04"/></geometry>
      <material name="{colour}"/>
    </visual>
{pins}
  </link>"""


def _joint(name: str, parent: str, child: str, x: int) -> str:
    return f"""\
  <joint name="{name}" type="continuous">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{x} 0 0"/>
    <axis xyz="0 0 1"/>
  </joint>"""
