"""MuJoCo's tendons: a line between two sites with stiffness or damping is a spring; the others are named."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.formats.draft import frame, number
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.tree import MjcfTree
from ckc_pin.mechanism.spec import SpringSpec

__all__ = ["Tendon", "Tendons"]


@dataclass(frozen=True)
class Tendon:
    """A tendon's way.

    Attributes
    ----------
    number : int
        MuJoCo's.
    name : str
    ends : (int, int) tuple, or None
        The sites of a straight line between two.
    joints : list of (int, float)
        Of a fixed tendon, its joints and their coefficients.
    """

    number: int
    name: str
    ends: tuple[int, int] | None
    joints: list[tuple[int, float]]


class Tendons:
    """The tendons of a model.

    Attributes
    ----------
    all : list of Tendon
    """

    def __init__(self, compiled: Compiled) -> None:
        self.compiled = compiled
        self.all = [self._read(k) for k in range(compiled.model.ntendon)]

    @property
    def used_joints(self) -> set[int]:
        """Joints that fixed tendons name."""
        return {joint for tendon in self.all for joint, _ in tendon.joints}

    def springs(self, tree: MjcfTree) -> tuple[list[tuple[SpringSpec, str]], list[str]]:
        """Return springs between frames, and what of the tendons is none."""
        model, springs, left_out = self.compiled.model, [], []
        for tendon in self.all:
            k = tendon.number
            shortest, longest = (float(x) for x in model.tendon_lengthspring[k])
            stiffness, damping = float(model.tendon_stiffness[k]), float(model.tendon_damping[k])
            more = {
                "a limit": model.tendon_limited[k],
                "dry friction": model.tendon_frictionloss[k],
                "armature": model.tendon_armature[k],
                "stiffness or damping of higher order": np.any(model.tendon_stiffnesspoly[k])
                or np.any(model.tendon_dampingpoly[k]),
            }
            acts = bool(stiffness or damping)
            if acts and (tendon.ends is None or (stiffness and shortest != longest)):
                more["stiffness or damping"] = True
            elif acts and tendon.ends is not None:
                a, b = (tree.site(site) for site in tendon.ends)
                ends = [frame(end.link, pin.SE3(np.eye(3), end.pose.translation)) for end in (a, b)]
                spec = SpringSpec(
                    frame_a=ends[0],
                    frame_b=ends[1],
                    rest_length=number(longest) if stiffness else 0.0,
                    stiffness=stiffness,
                    damping=damping,
                )
                springs.append((spec, f"tendon {tendon.name}".rstrip()))
            said = [what for what, value in more.items() if value]
            if said:
                left_out.append(f"{' and '.join(said)} of tendon {tendon.name or k}")
        return springs, left_out

    def _read(self, k: int) -> Tendon:
        model, wraps = self.compiled.model, self.compiled.mujoco.mjtWrap
        first = int(model.tendon_adr[k])
        over = [(int(model.wrap_type[w]), w) for w in range(first, first + int(model.tendon_num[k]))]
        sites = [int(model.wrap_objid[w]) for kind, w in over if kind == wraps.mjWRAP_SITE]
        turned = [w for kind, w in over if kind == wraps.mjWRAP_JOINT]
        joints = [(int(model.wrap_objid[w]), float(model.wrap_prm[w])) for w in turned]
        ends = (sites[0], sites[1]) if len(over) == len(sites) == 2 else None
        return Tendon(k, self.compiled.name("tendon", k), ends, joints)
