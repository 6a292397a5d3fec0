"""Model a mechanism of the x-y plane with Exudyn's planar bodies, three coordinates each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.frames import Frame
from scripts.experiments.benchmark.peers.exudyn_steps import Steps
from scripts.experiments.benchmark.peers.stepping import start_of
from scripts.experiments.benchmark.work import Work

__all__ = ["Plane", "in_plane"]

PARALLEL = 1e-12  # sine of the largest angle between axes that count as parallel


def in_plane(work: Work) -> bool:
    """Whether all hinges are about z, and slides, loops and gravity lie in the x-y plane."""
    mechanism, tree = work.mechanism, work.mechanism.tree
    pin.forwardKinematics(tree.model, tree.data, start_of(work)[0])
    for k in range(1, tree.model.njoints):
        axis, turns = tree.axis(k)
        along = tree.data.oMi[k].rotation @ axis
        if np.abs(np.delete(along, 2) if turns else along[2:]).max() > PARALLEL:
            return False
    loops_are = all(loop.type == "point_2d" and tuple(loop.axis_a) == (0, 0, 1) for loop in mechanism.spec.loop)
    return loops_are and bool(tree.model.gravity.linear[2] == 0)


class Plane(Steps):
    """A work's mechanism at its start, with body frames in the centres of mass, parallel to the world's."""

    def __init__(self, work: Work) -> None:
        super().__init__(work)
        tree = work.mechanism.tree
        model, data = tree.model, tree.data
        q_tree, v_tree = start_of(work)
        pin.forwardKinematics(model, data, q_tree, v_tree)
        self._q = tree.to_coordinates(q_tree)
        self._v = v_tree.copy()
        self._placements = [pin.SE3(placement) for placement in data.oMi]
        self._centers = [np.zeros(3)]
        self._bodies = [self.mbs.AddObject(self.items.ObjectGround())]
        self._nodes: list[Any] = []
        for k in range(1, model.njoints):
            self._body(self._placements[k], data.v[k], model.inertias[k], model.gravity.linear)
        self._axes = [self._joint(k) for k in range(1, model.njoints)]
        self._close()
        self._push()
        self.assemble()

    def state(self) -> tuple[Array, Array]:
        """Return q_tree and v_tree."""
        q_tree, v_tree, output = self._q.copy(), self._v.copy(), self.exudyn.OutputVariableType
        at, rate = (
            [np.zeros(3), *(np.array(self.mbs.GetNodeOutput(node, kind)) for node in self._nodes)]
            for kind in (output.Coordinates, output.Coordinates_t)
        )
        model = self.mechanism.tree.model
        for k in range(1, model.njoints):
            parent, j = int(model.parents[k]), model.joints[k].idx_v
            axis, turns = self._axes[k - 1]
            if turns:
                q_tree[j] += axis[2] * (at[k][2] - at[parent][2])
                v_tree[j] = axis[2] * (rate[k][2] - rate[parent][2])
                continue
            (here, speed), (there, carried) = (self._point(body, k, at, rate) for body in (k, parent))
            along = _turned(at[parent][2]) @ axis[:2]
            q_tree[j] += along @ (here - there)
            v_tree[j] = along @ (speed - carried)
        return q_tree, v_tree

    def _body(self, place: pin.SE3, velocity: pin.Motion, inertia: pin.Inertia, gravity: Array) -> None:
        center = place.act(inertia.lever)
        moving = place.rotation @ (velocity.linear + np.cross(velocity.angular, inertia.lever))
        spin, moments = place.rotation @ velocity.angular, place.rotation @ inertia.inertia @ place.rotation.T
        node = self.mbs.AddNode(
            self.items.NodeRigidBody2D(
                referenceCoordinates=[*center[:2], 0.0], initialVelocities=[*moving[:2], spin[2]]
            )
        )
        body = self.mbs.AddObject(
            self.items.ObjectRigidBody2D(mass=inertia.mass, inertia=moments[2, 2], nodeNumber=node)
        )
        marker = self.mbs.AddMarker(self.items.MarkerBodyMass(bodyNumber=body))
        self.mbs.AddLoad(self.items.LoadMassProportional(markerNumber=marker, loadVector=list(gravity)))
        self._centers.append(center)
        self._bodies.append(body)
        self._nodes.append(node)

    def _marker(self, body: int, point: Array) -> Any:
        """Mark a point of a body by where it is at the start."""
        local = [*(point - self._centers[body])[:2], 0.0]
        return self.mbs.AddMarker(self.items.MarkerBodyRigid(bodyNumber=self._bodies[body], localPosition=local))

    def _joint(self, k: int) -> tuple[Array, bool]:
        """Add a joint; return its axis in the world at the start, and whether it turns."""
        axis, turns = self.mechanism.tree.axis(k)
        along, point = self._placements[k].rotation @ axis, self._placements[k].translation
        markers = [self._marker(body, point) for body in (int(self.mechanism.tree.model.parents[k]), k)]
        if turns:
            self.mbs.AddObject(self.items.ObjectJointRevolute2D(markerNumbers=markers))
        else:
            normal = [-along[1], along[0], 0.0]
            self.mbs.AddObject(
                self.items.ObjectJointPrismatic2D(markerNumbers=markers, axisMarker0=list(along), normalMarker1=normal)
            )
        return along, turns

    def _close(self) -> None:
        for loop in self.mechanism.spec.loop:
            markers = self._ends([loop.frame_a, loop.frame_b], f"loop {loop.name!r}")
            self.mbs.AddObject(self.items.ObjectJointRevolute2D(markerNumbers=markers))

    def _push(self) -> None:
        """Add springs between frames, and constant forces on hinges."""
        for spring in self.mechanism.spec.spring:
            if spring.frame_a is not None and spring.frame_b is not None:
                self.mbs.AddObject(
                    self.items.ObjectConnectorSpringDamper(
                        markerNumbers=self._ends([spring.frame_a, spring.frame_b], "spring"),
                        referenceLength=spring.rest_length or 0.0,
                        stiffness=spring.stiffness,
                        damping=spring.damping,
                    )
                )
        model = self.mechanism.tree.model
        for k in range(1, model.njoints):
            force = float(self.mechanism.springs.constant[model.joints[k].idx_v]) * self._axes[k - 1][0][2]
            parent = int(model.parents[k])
            for body, sign in ((k, 1), (parent, -1)):
                if force and body:
                    marker = self._marker(body, self._centers[body])
                    load = self.items.LoadTorqueVector(markerNumber=marker, loadVector=[0.0, 0.0, sign * force])
                    self.mbs.AddLoad(load)

    def _ends(self, named: Sequence[Any], where: str) -> list[Any]:
        frames = [self.mechanism.frames.find(frame, where) for frame in named]
        return [self._marker(frame.joint, self._world(frame)) for frame in frames]

    def _world(self, frame: Frame) -> Array:
        return frame.translation if frame.joint == 0 else self._placements[frame.joint].act(frame.translation)

    def _point(self, body: int, k: int, at: list[Array], rate: list[Array]) -> tuple[Array, Array]:
        """Return position and velocity of the point of a body that was the origin of joint k at the start."""
        arm = _turned(at[body][2]) @ (self._placements[k].translation - self._centers[body])[:2]
        place = self._centers[body][:2] + at[body][:2] + arm
        return place, rate[body][:2] + rate[body][2] * np.array([-arm[1], arm[0]])


def _turned(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
