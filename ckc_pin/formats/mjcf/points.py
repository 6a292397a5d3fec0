"""MuJoCo's sites that nothing is fastened to: points to report and to trace."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from ckc_pin.formats.draft import frame
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.tree import MjcfTree
from ckc_pin.mechanism.spec import PointSpec

__all__ = ["free_sites"]


def free_sites(compiled: Compiled, tree: MjcfTree) -> list[tuple[PointSpec, str]]:
    """Return a point for each site with a name that no equality, tendon or actuator is on."""
    used, points = set(_used(compiled)), []
    for site in range(compiled.model.nsite):
        name = compiled.name("site", site)
        if name and site not in used:
            placed = tree.site(site)
            at = frame(placed.link, pin.SE3(np.eye(3), placed.pose.translation))
            points.append((PointSpec(name=name, frame=at), ""))
    return points


def _used(compiled: Compiled) -> Iterator[int]:
    model, mujoco = compiled.model, compiled.mujoco
    for k in range(model.neq):
        if int(model.eq_objtype[k]) == mujoco.mjtObj.mjOBJ_SITE:
            yield from (int(model.eq_obj1id[k]), int(model.eq_obj2id[k]))
    for k in range(model.nwrap):
        if int(model.wrap_type[k]) == mujoco.mjtWrap.mjWRAP_SITE:
            yield int(model.wrap_objid[k])
        elif int(model.wrap_type[k]) in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER):
            yield int(model.wrap_prm[k])  # the side on which a tendon goes round
    for k in range(model.nactuator):
        if int(model.actuator_trntype[k]) in (mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK):
            yield from (int(site) for site in model.actuator_trnid[k])
