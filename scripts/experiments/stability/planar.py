"""Files of five-bars with any lengths, masses and springs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from scripts.experiments.mechanism_files import PlanarLink, planar_chain, urdf_robot

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
    """A five-bar in chain numbering (1, 2 left, 3, 4 right, proximal first); the defaults are the paper's, `five_bar`.

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
        links = [
            PlanarLink(f"theta_{k + 1}", f"link_{k + 1}", l, c, m, (I / 100, I, I))
            for k, (l, c, m, I) in enumerate(zip(self.l, self.c, self.m, self.I, strict=True))
        ]
        elements = [
            '  <link name="base"/>',
            *planar_chain(0.0, links[:2], "left_end", "tip_left", "continuous"),
            *planar_chain(self.base, links[2:], "right_end", "tip_right", "continuous"),
        ]
        (folder / "five_bar.urdf").write_text(urdf_robot("five_bar", elements), encoding="utf-8")
        (folder / "mechanism.toml").write_text(_MECHANISM.format(g=self.g) + self._springs(), encoding="utf-8")

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
