"""Five-bars of any lengths, masses and springs, written as the files that a user would write."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

__all__ = ["JointSpring", "LineSpring", "Planar"]

Four = tuple[float, float, float, float]


@dataclass(frozen=True)
class LineSpring:
    """A spring and damper from a point of the ground to the left tip; N/m, N s/m, m."""

    stiffness: float
    damping: float
    rest: float
    x: float
    y: float


@dataclass(frozen=True)
class JointSpring:
    """A spring and damper on theta_1; N m/rad, N m s/rad, rad."""

    stiffness: float
    damping: float
    rest: float


@dataclass(frozen=True)
class Planar:
    """A five-bar in chain numbering (1, 2 left, 3, 4 right, proximal first); as it stands the paper's, `five_bar`.

    Attributes
    ----------
    l, c, m, I : tuple of 4 floats
        Length and distance from pin to centre of mass (m), mass (kg), moment of inertia about the latter (kg m^2).
    base : float
        Between the pins on the ground, m.
    g : float
        Along -y, m/s^2.
    """

    l: Four = (0.2794, 0.3048, 0.2794, 0.3048)
    c: Four = (0.1466, 0.1581, 0.1410, 0.1467)
    m: Four = (0.2451, 0.2611, 0.2352, 0.2611)
    I: Four = (2.770e-3, 3.476e-3, 2.607e-3, 3.476e-3)
    base: float = 0.3048
    g: float = 9.81
    line: LineSpring | None = None
    joint: JointSpring | None = None

    def longer(self, factor: float) -> Planar:
        """Return the same masses on links `factor` times as long."""
        return replace(
            self,
            l=_times(self.l, (factor,) * 4),
            c=_times(self.c, (factor,) * 4),
            I=_times(self.I, (factor**2,) * 4),
            base=self.base * factor,
        )

    def heavier(self, factors: Four) -> Planar:
        """Return the links with masses and inertias multiplied one by one."""
        return replace(self, m=_times(self.m, factors), I=_times(self.I, factors))

    def write(self, folder: Path) -> None:
        """Write `mechanism.toml` and its URDF into a folder."""
        links = "\n".join(_LINK.format(k=k + 1, c=c, m=m, I=I, thin=I / 100) for k, (c, m, I) in enumerate(self._rods))
        l = self.l
        joints = "\n".join(
            _JOINT.format(name=name, kind=kind, parent=parent, child=child, x=x)
            for name, kind, parent, child, x in (
                ("theta_1", "continuous", "base", "link_1", 0.0),
                ("theta_2", "continuous", "link_1", "link_2", l[0]),
                ("theta_3", "continuous", "base", "link_3", self.base),
                ("theta_4", "continuous", "link_3", "link_4", l[2]),
                ("left_end", "fixed", "link_2", "tip_left", l[1]),
                ("right_end", "fixed", "link_4", "tip_right", l[3]),
            )
        )
        (folder / "five_bar.urdf").write_text(_URDF.format(links=links, joints=joints), encoding="utf-8")
        (folder / "mechanism.toml").write_text(_MECHANISM.format(g=self.g) + self._springs(), encoding="utf-8")

    @property
    def _rods(self) -> list[tuple[float, float, float]]:
        return list(zip(self.c, self.m, self.I, strict=True))

    def _springs(self) -> str:
        text = ""
        if self.line is not None:
            s = self.line
            text += (
                f'[[spring]]\nframe_a = {{link = "world", xyz = [{s.x!r}, {s.y!r}, 0.0]}}\nframe_b = "tip_left"\n'
                f"rest_length = {s.rest!r}\nstiffness = {s.stiffness!r}\ndamping = {s.damping!r}\n"
            )
        if self.joint is not None:
            j = self.joint
            text += (
                f'[[spring]]\njoint = "theta_1"\nrest = {j.rest!r}\n'
                f"stiffness = {j.stiffness!r}\ndamping = {j.damping!r}\n"
            )
        return text


def _times(values: Four, factors: Four) -> Four:
    a, b, c, d = (x * f for x, f in zip(values, factors, strict=True))
    return a, b, c, d


_MECHANISM = """\
name = "five_bar"
urdf = "five_bar.urdf"
gravity = [0.0, -{g!r}, 0.0]
independent = ["theta_1", "theta_3"]
actuated = ["theta_1", "theta_3"]

[q_guess]
theta_1 = -1.434
theta_2 = 0.248
theta_3 = -1.707
theta_4 = -0.248

[[loop]]
name = "elbow"
type = "point_2d"
frame_a = "tip_left"
frame_b = "tip_right"
rows_in = "world"
"""

_URDF = """\
<?xml version="1.0" encoding="utf-8"?>
<robot name="five_bar">
  <link name="base"/>
  <link name="tip_left"/>
  <link name="tip_right"/>
{links}
{joints}
</robot>
"""

_LINK = """\
  <link name="link_{k}">
    <inertial>
      <origin xyz="{c!r} 0 0"/>
      <mass value="{m!r}"/>
      <inertia ixx="{thin!r}" iyy="{I!r}" izz="{I!r}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>"""

_JOINT = """\
  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{x!r} 0 0"/>
    <axis xyz="0 0 1"/>
  </joint>"""
