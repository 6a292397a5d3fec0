"""An imported robot and MuJoCo's model of the same file, set to the same states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from ckc_pin.formats.importing import Draft, read
from ckc_pin.mechanism.joints import Joints
from ckc_pin.mechanism.springs import Springs

ROOT = ("x", "y", "z", "rx", "ry", "rz")


class Twin:
    """The imported `draft` and MuJoCo's `model` of one file, without armature of tendons, which is not imported."""

    def __init__(self, path: Path) -> None:
        self.draft: Draft = read(path)
        self.tree, self.frames, _ = self.draft.build_tree()
        self.joints = Joints(self.tree, [spec for spec, _ in self.draft.joints])
        self.model: Any = mujoco.MjModel.from_xml_path(str(path))
        self.model.tendon_armature[:] = 0.0
        self.data: Any = mujoco.MjData(self.model)

    def labels(self, joint: int) -> list[str]:
        name = self.model.joint(joint).name
        return {0: [f"{name}.{axis}" for axis in ROOT], 1: [f"{name}_{axis}" for axis in "xyz"]}.get(
            int(self.model.jnt_type[joint]), [name]
        )

    def put(self, values: Any, v: Any) -> tuple[Any, Any]:
        """Set a state by coordinates; return Pinocchio's q and the map from Pinocchio's velocities to MuJoCo's."""
        named = dict(zip(self.tree.coordinates, values, strict=True))
        column = {label: k for k, label in enumerate(self.tree.coordinates)}
        to = np.zeros((self.model.nv, self.tree.n))
        for joint in range(self.model.njnt):
            labels = self.labels(joint)
            x = np.array([named[label] for label in labels])
            at, dof = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint]
            columns = [column[label] for label in labels]
            if len(x) == 1:
                self.data.qpos[at] = x[0]
                to[dof, columns] = 1.0
            elif len(x) == 3:  # rotations about x, y, z in this order; MuJoCo's velocity is in the body's axes
                r_x, r_y, r_z = (pin.exp3(angle * axis) for angle, axis in zip(x, np.eye(3), strict=True))
                self.data.qpos[at : at + 4] = quaternion(r_x @ r_y @ r_z)
                to[dof : dof + 3, columns] = np.column_stack(
                    [(r_y @ r_z).T @ np.eye(3)[0], r_z.T @ np.eye(3)[1], np.eye(3)[2]]
                )
            else:  # MuJoCo's linear velocity is in the world's axes, Pinocchio's in the body's
                self.data.qpos[at : at + 7] = [*x[:3], *quaternion(pin.exp3(x[3:]))]
                to[dof : dof + 3, columns[:3]] = pin.exp3(x[3:])
                to[dof + 3 : dof + 6, columns[3:]] = np.eye(3)
        self.data.qvel[:] = to @ v
        mujoco.mj_forward(self.model, self.data)
        return self.tree.from_coordinates(values), to

    def mass_matrices(self, q_tree: Any, to: Any) -> tuple[Any, Any]:
        """Return Pinocchio's mass matrix and MuJoCo's."""
        D = pin.crba(self.tree.model, self.tree.data, q_tree)
        M = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, M)
        return np.triu(D) + np.triu(D, 1).T, to.T @ M @ to

    def passive_forces(self, q_tree: Any, v: Any, to: Any) -> tuple[Any, Any]:
        """Return the forces of springs and dampers: the imported mechanism's and MuJoCo's."""
        ours = Springs(self.tree, self.frames, [spec for spec, _ in self.draft.springs])
        return ours.elastic_force(q_tree) + ours.damping_force(q_tree, v), to.T @ self.data.qfrc_passive

    def pose(self, frame: Any) -> pin.SE3:
        """Return the world pose of an imported frame in the state set last."""
        local = self.frames.find(frame, "test")
        return self.tree.data.oMi[local.joint] * pin.SE3(local.rotation, local.translation)

    def bodies(self, q_tree: Any) -> dict[str, tuple[list[Any], list[Any]]]:
        """Return mass, centre of mass and inertia in the world's axes of each body: imported and MuJoCo's."""
        pin.forwardKinematics(self.tree.model, self.tree.data, q_tree)
        bodies = {}
        for body in range(1, self.model.nbody):
            name = self.model.body(body).name
            inertial = self.draft.robot.find(f"link[@name='{name}']/inertial")
            assert inertial is not None, name
            link = self.pose(name)
            centre = [float(x) for x in inertial.find("origin").get("xyz").split()]
            xx, yy, zz, xy, xz, yz = (
                float(inertial.find("inertia").get(key)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            )
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            axes = self.data.ximat[body].reshape(3, 3)
            bodies[name] = (
                [
                    float(inertial.find("mass").get("value")),
                    link.act(np.array(centre)),
                    link.rotation @ inertia @ link.rotation.T,
                ],
                [
                    self.model.body_mass[body],
                    self.data.xipos[body],
                    axes @ np.diag(self.model.body_inertia[body]) @ axes.T,
                ],
            )
        return bodies

    def residuals(self, q_tree: Any) -> dict[str, float]:
        """Return the distance and angle between the frames of each loop, and the residual of each coupling."""
        pin.forwardKinematics(self.tree.model, self.tree.data, q_tree)
        residuals = {}
        for loop, _ in self.draft.loops:
            a, b = self.pose(loop.frame_a), self.pose(loop.frame_b)
            distance = float(np.linalg.norm(a.translation - b.translation))
            residuals[loop.name] = abs(distance - (loop.length or 0.0))
            if loop.type == "weld":
                residuals[f"{loop.name}, rotation"] = float(np.linalg.norm(pin.log3(a.rotation.T @ b.rotation)))
        named = dict(zip(self.tree.coordinates, self.tree.to_coordinates(q_tree), strict=True))
        for coupling, _ in self.draft.couplings:
            if coupling.joints:
                first = next(iter(coupling.joints.values()))
                residual = sum(x * named[joint] for joint, x in coupling.joints.items()) - coupling.offset
                name = coupling.name or next(iter(coupling.joints))
                residuals[name] = abs(residual / first)
            else:
                powers = coupling.polynomial or [0.0, coupling.ratio]
                residual = (
                    named[coupling.joint] - coupling.offset - np.polynomial.Polynomial(powers)(named[coupling.other])
                )
                residuals[f"{coupling.joint} by {coupling.other}"] = abs(residual)
        return residuals

    def mujoco_residuals(self) -> dict[str, float]:
        """Return the same from the residuals of MuJoCo's constraint rows."""
        residuals: dict[str, float] = {}
        rows = self.data.efc_pos[: self.data.ne]
        owner = self.data.efc_id[: self.data.ne]
        for k in range(self.model.neq):
            values, name, kind = rows[owner == k], self.model.eq(k).name, int(self.model.eq_type[k])
            if len(values) in (3, 6):
                residuals[name] = float(np.linalg.norm(values[:3]))
            if len(values) == 6:  # the vector part of a quaternion
                residuals[f"{name}, rotation"] = 2 * float(np.arcsin(min(1.0, np.linalg.norm(values[3:]))))
            elif kind == mujoco.mjtEq.mjEQ_JOINT:
                joints = [self.model.eq_obj1id[k], self.model.eq_obj2id[k]]
                residuals[" by ".join(self.model.joint(j).name for j in joints if j >= 0)] = abs(float(values[0]))
            elif len(values) == 1:  # of a tendon; divided by the coefficient of its first joint, if it has joints
                first = self.model.tendon_adr[self.model.eq_obj1id[k]]
                residuals[name] = abs(float(values[0])) / (self.model.wrap_prm[first] or 1.0)
        return residuals


def quaternion(rotation: Any) -> list[float]:
    """Return (w, x, y, z) of a rotation matrix."""
    x, y, z, w = pin.Quaternion(rotation).coeffs()
    return [w, x, y, z]
