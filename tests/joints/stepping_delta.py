"""Moreau's time-stepping scheme for a delta on its stops, with Pinocchio's terms and nothing of the package.

Each step integrates the momentum over h. It then projects the velocity, in the metric of D', onto those that keep the
loops closed and leave every reached stop with at least `restitution` times the speed of approach.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import nnls

from tests.analytic.five_bar import Array

Limits = tuple[float, float]


class SteppingDelta:
    """A folder's delta, released from rest."""

    def __init__(self, folder: Path, stops: dict[str, Limits], restitution: float) -> None:
        file = tomllib.loads((folder / "mechanism.toml").read_text())
        self.model = model = pin.buildModelFromUrdf(str(folder / file["urdf"]))
        model.gravity.linear = np.array(file["gravity"])
        self.restitution = restitution
        self.balls = [
            tuple(self._add(loop["name"], loop[side]) for side in ("frame_a", "frame_b")) for loop in file["loop"]
        ]
        self.data = model.createData()
        joints = [model.joints[model.getJointId(name)] for name in stops]
        self.arms_q, self.arms = [joint.idx_q for joint in joints], [joint.idx_v for joint in joints]
        self.rest = [k for k in range(model.nv) if k not in self.arms]
        self.lower, self.upper = np.array(list(stops.values())).T
        self.guess = file["q_guess"]

    def _add(self, name: str, place: dict[str, Any]) -> int:
        link = self.model.frames[self.model.getFrameId(place["link"])]
        at = link.placement * pin.SE3(np.eye(3), np.array(place["xyz"]))
        return int(
            self.model.addFrame(pin.Frame(f"{name} {place['link']}", link.parentJoint, at, pin.FrameType.OP_FRAME))
        )

    def start(self, arms: Array) -> Array:
        """Return the closed configuration at given angles of the arms, from the file's guess."""
        v = np.zeros(self.model.nv)
        for name, value in self.guess.items():
            first = self.model.joints[self.model.getJointId(name)].idx_v
            for axis, x in value.items() if isinstance(value, dict) else [("x", value)]:
                v[first + "xyz".index(axis)] = x
        v[self.arms] = arms
        return self.closed(pin.integrate(self.model, pin.neutral(self.model), v))

    def closed(self, q: Array) -> Array:
        """Close the loops by Newton's method without moving the arms."""
        for _ in range(30):
            phi, J = self.closure(q)
            if np.abs(phi).max() < 1e-13:
                return q
            step = np.zeros(self.model.nv)
            step[self.rest] = np.linalg.solve(J[:, self.rest], -phi)
            q = pin.integrate(self.model, q, step)
        raise AssertionError("the delta does not close")

    def closure(self, q: Array) -> tuple[Array, Array]:
        """Return the balls' distances from their sockets, (18,), and the Jacobian."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        phi, J = [], []
        for a, b in self.balls:
            phi.append(self.data.oMf[a].translation - self.data.oMf[b].translation)
            at = (pin.getFrameJacobian(self.model, self.data, k, pin.LOCAL_WORLD_ALIGNED)[:3] for k in (a, b))
            J.append(next(at) - next(at))
        return np.concatenate(phi), np.concatenate(J)

    def run(self, arms: Array, duration: float, steps: int, seen: int) -> Array:
        """Return the arms' angles after their release at `seen` equidistant instants, (seen, 3)."""
        h, q, v, angles = duration / steps, self.start(arms), np.zeros(self.model.nv), []
        for step in range(1, steps + 1):
            middle = pin.integrate(self.model, q, 0.5 * h * v)
            v = self.stepped(middle, v, h)
            q = self.closed(pin.integrate(self.model, middle, 0.5 * h * v))
            if step % (steps // seen) == 0:
                angles.append(q[self.arms_q])
        return np.array(angles)

    def stepped(self, q: Array, v: Array, h: float) -> Array:
        """Return the velocity after a step with midpoint q."""
        D = np.array(pin.crba(self.model, self.data, q))
        D = np.triu(D) + np.triu(D, 1).T
        bias = pin.nonLinearEffects(self.model, self.data, q, v)
        _, J = self.closure(q)
        rho = np.zeros((self.model.nv, len(self.arms)))
        rho[self.arms] = np.eye(len(self.arms))
        rho[self.rest] = np.linalg.solve(J[:, self.rest], -J[:, self.arms])
        inertia = rho.T @ D @ rho
        free = np.linalg.solve(inertia, rho.T @ (D @ v - h * bias))
        angles, before = q[self.arms_q], v[self.arms]
        side = np.where(angles >= self.upper, 1.0, np.where(angles <= self.lower, -1.0, 0.0))
        at = np.flatnonzero(side)
        if len(at):
            # impulses x >= 0 of free + inertia^-1 G x, after which the arms leave the stops with at least `after`
            G = -np.eye(len(self.arms))[:, at] * side[at]
            after = self.restitution * np.maximum(side[at] * before[at], 0.0)
            root = np.linalg.cholesky(np.linalg.inv(inertia))
            free = free + np.linalg.solve(inertia, G @ _solve_complementarity(root.T @ G, G.T @ free - after))
        return np.asarray(rho @ free)


def _solve_complementarity(root: Array, gap: Array) -> Array:
    """Return x >= 0 with root^T root x + gap >= 0 and one of them zero, for each x."""
    target = np.linalg.lstsq(root.T, -gap, rcond=None)[0]
    return np.asarray(nnls(root, target)[0])
