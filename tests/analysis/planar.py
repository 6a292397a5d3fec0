"""Planar linkages for tests: chains of revolute joints about z with links along +x, whose tips are joined."""

from __future__ import annotations

from collections.abc import Sequence

from ckc_pin.base.sources import Sources
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.spec import LoopSpec, LoopType, MechanismSpec, PointSpec

INERTIA = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'


def linkage(
    chains: Sequence[tuple[float, Sequence[float]]],
    guess: Sequence[float],
    independent: Sequence[str],
    loop: LoopType = "point_2d",
) -> Mechanism:
    """Return a linkage with joints a1, a2, ..., b1, ...

    Parameters
    ----------
    chains : sequence of (float, sequence of float)
        Start on the x axis and lengths of the links of each chain, m.
    guess : sequence of float
        Angles at which assembly starts, rad.
    independent : sequence of str
    loop : str
        Type of the loops that join each tip to the first chain's tip, which is the point "tip".
    """
    links, joints, names = ['<link name="base"/>'], [], []
    for letter, (start, lengths) in zip("abc", chains, strict=False):
        parent, x = "base", start
        for k, length in enumerate([*lengths, None], 1):
            child = f"{letter}_link_{k}" if length is not None else f"{letter}_tip"
            kind, axis = ("revolute", '<axis xyz="0 0 1"/>') if length is not None else ("fixed", "")
            limit = '<limit lower="-100" upper="100" effort="1" velocity="1"/>' if length is not None else ""
            links.append(f'<link name="{child}">{INERTIA if length is not None else ""}</link>')
            name = f"{letter}{k}" if length is not None else f"{letter}_end"
            joints.append(
                f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
                f'<origin xyz="{x} 0 0"/>{axis}{limit}</joint>'
            )
            names += [name] if length is not None else []
            parent, x = child, length or 0.0
    urdf = f'<robot name="linkage">{"".join(links + joints)}</robot>'
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
