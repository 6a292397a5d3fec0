"""What a run's controller wanted, rebuilt from the scene and the texts that the run carries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert
from ckc_pin.control.desired import Desired
from ckc_pin.control.point_path import make_desired
from ckc_pin.control.spec import ControllerSpec, SetPointSpec, TorquesSpec
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.run.run import Run

__all__ = ["DesiredPath", "Poses", "desired_along", "desired_poses"]


@dataclass(frozen=True)
class DesiredPath:
    """q_d along a run.

    Attributes
    ----------
    kind : "set_point" or "tracking"
    q, q_dot : (m, d) arrays
        At the run's output instants, in the order of `independent`.
    """

    kind: str
    q: Array
    q_dot: Array


def desired_along(run: Run) -> DesiredPath | None:
    """Return q_d and its rate at the run's output instants, or None where the scene has no controller that wants any.

    Raises
    ------
    InputError
        The run's own scene does not say what was wanted.
    """
    if "controller" not in run.scene:
        return None
    spec: ControllerSpec = convert(run.scene["controller"], ControllerSpec, run.scene_name)  # type: ignore[arg-type]
    if isinstance(spec, TorquesSpec):
        return None
    if isinstance(spec, SetPointSpec):
        q_d = run.mechanism.vector(spec.q_d, run.independent, f"{run.scene_name}: controller.q_d")
        return DesiredPath("set_point", np.tile(q_d, (len(run.t), 1)), np.zeros((len(run.t), len(q_d))))
    sources = Sources(run.scene_name, None, run.texts)
    desired: Desired = make_desired(spec.desired, run.mechanism, sources, float(run.t[-1]))
    sampled = np.array([desired(float(t))[:2] for t in run.t])
    return DesiredPath("tracking", sampled[:, 0], sampled[:, 1])


@dataclass(frozen=True)
class Poses:
    """Where the mechanism should have been, at some output instants of a run.

    Attributes
    ----------
    q_tree : (m, nq) array
        Configurations of the tree, Pinocchio's q; where there is none, the last one before.
    exists : (m,) array of bool
        Whether the mechanism can have what is desired, on the branch of the run.
    """

    q_tree: Array
    exists: BoolArray


def desired_poses(run: Run, rows: IntArray) -> Poses | None:
    """Return sigma(q_d) at output instants of a run, or None where its scene has no controller."""
    wanted = desired_along(run)
    if wanted is None:
        return None
    mechanism = run.mechanism
    at = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[rows[0]]))
    poses, exists = [], []
    for q_d in wanted.q[rows]:
        found = sigma(mechanism, q_d, at)
        exists.append(found.verdict == "converged")
        at = found.at if exists[-1] else at
        poses.append(at.q_tree)
    return Poses(np.array(poses), np.array(exists))
