"""Planar linkages for tests: chains of revolute joints about z with links along +x, whose tips are joined."""

from __future__ import annotations

from collections.abc import Sequence

from ckc_pin.base.sources import Sources
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.spec import LoopSpec, LoopType, MechanismSpec, PointSpec
from scripts.experiments.mechanism_files import PlanarLink, planar_chain, urdf_robot


def linkage(
    chains: Sequence[tuple[float, Sequence[float]]],
    guess: Sequence[float],
    independent: Sequence[str],
    loop: LoopType = "point_2d",
) -> Mechanism:
    """Return a linkage of chains whose tips are joined to the first chain's, which is the point "tip".

    Parameters
    ----------
    chains : sequence of (float, sequence of float)
        Where each chain starts on the x axis, and the lengths of its links, m. Joints are a1, a2, ..., b1, ...
    guess : sequence of float
        Angles at which assembly starts, rad, in the order of the joints.
    independent : sequence of str
    loop : LoopType
    """
    elements, names = ['  <link name="base"/>'], []
    for letter, (start, lengths) in zip("abc", chains, strict=False):
        links = [
            PlanarLink(f"{letter}{k}", f"{letter}_link_{k}", length, 0.0, 1.0, (0.01, 0.01, 0.01))
            for k, length in enumerate(lengths, 1)
        ]
        elements += planar_chain(start, links, f"{letter}_end", f"{letter}_tip", "revolute")
        names += [link.joint for link in links]
    urdf = urdf_robot("linkage", elements)
    spec = MechanismSpec(
        name="linkage",
        urdf="linkage.urdf",
        gravity=(0.0, -9.81, 0.0),
        independent=list(independent),
        q_guess=dict(zip(names, guess, strict=True)),
        loop=[
            LoopSpec(name=f"loop_{letter}", type=loop, frame_a="a_tip", frame_b=f"{letter}_tip", rows_in="world")
            for letter in "bc"[: len(chains) - 1]
        ],
        point=[PointSpec(name="tip", frame="a_tip")],
    )
    return assemble_mechanism(spec, Sources("linkage", None, {"linkage.urdf": urdf}))
