"""A robot that was imported, beside MuJoCo's own model of the same file: states of one put into the other."""

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
    """`draft` is what `ckc import` made of a file, `model` what MuJoCo makes of it; rotors on tendons do not come."""

    def __init__(self, path: Path) -> None:
        self.draft: Draft = read(path)
        self.tree, self.frames, _ = self.draft.tree()
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
        """Set a state by our coordinates' values; return Pinocchio's q and the map from our velocities to theirs."""
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
            elif len(x) == 3:  # turns about x, y, z, one after another; MuJoCo's velocity is in the body's axes
                r_x, r_y, r_z = (pin.exp3(angle * axis) for angle, axis in zip(x, np.eye(3), strict=True))
                self.data.qpos[at : at + 4] = quaternion(r_x @ r_y @ r_z)
                to[dof : dof + 3, columns] = np.column_stack(
                    [(r_y @ r_z).T @ np.eye(3)[0], r_z.T @ np.eye(3)[1], np.eye(3)[2]]
                )
            else:  # linear velocity in the world's axes there, in the body's here
                self.data.qpos[at : at + 7] = [*x[:3], *quaternion(pin.exp3(x[3:]))]
                to[dof : dof + 3, columns[:3]] = pin.exp3(x[3:])
                to[dof + 3 : dof + 6, columns[3:]] = np.eye(3)
        self.data.qvel[:] = to @ v
        mujoco.mj_forward(self.model, self.data)
        return self.tree.from_coordinates(values), to

    def mass_matrices(self, q_tree: Any, to: Any) -> tuple[Any, Any]:
        """Ours and MuJoCo's."""
        D = pin.crba(self.tree.model, self.tree.data, q_tree)
        M = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, M)
        return np.triu(D) + np.triu(D, 1).T, to.T @ M @ to

    def passive_forces(self, q_tree: Any, v: Any, to: Any) -> tuple[Any, Any]:
        """Of springs and dampers: ours and MuJoCo's."""
        ours = Springs(self.tree, self.frames, [spec for spec, _ in self.draft.springs])
        return ours.elastic_force(q_tree) + ours.damping_force(q_tree, v), to.T @ self.data.qfrc_passive

    def pose(self, frame: Any) -> pin.SE3:
        """A frame of ours in the world, where `put` left it."""
        found = self.frames.find(frame, "test")
        return self.tree.data.oMi[found.joint] * pin.SE3(found.rotation, found.translation)

    def bodies(self, q_tree: Any) -> dict[str, tuple[list[Any], list[Any]]]:
        """Mass, centre of mass and inertia in the world's axes of each body that has mass: ours and MuJoCo's."""
        pin.forwardKinematics(self.tree.model, self.tree.data, q_tree)
        found = {}
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
            found[name] = (
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
        return found

    def misses(self, q_tree: Any) -> dict[str, float]:
        """How far apart the points of each loop are, and how far each coupling is from being met."""
        pin.forwardKinematics(self.tree.model, self.tree.data, q_tree)
        found = {}
        for loop, _ in self.draft.loops:
            a, b = self.pose(loop.frame_a), self.pose(loop.frame_b)
            apart = float(np.linalg.norm(a.translation - b.translation))
            found[loop.name] = abs(apart - (loop.length or 0.0))
            if loop.type == "weld":
                found[f"{loop.name}, turned"] = float(np.linalg.norm(pin.log3(a.rotation.T @ b.rotation)))
        named = dict(zip(self.tree.coordinates, self.tree.to_coordinates(q_tree), strict=True))
        for coupling, _ in self.draft.couplings:
            miss = named[coupling.joint] - coupling.ratio * named[coupling.other] - coupling.offset
            found[f"{coupling.joint} by {coupling.other}" if coupling.ratio else coupling.joint] = abs(miss)
        return found

    def their_misses(self) -> dict[str, float]:
        """The same as MuJoCo computes it: from the residuals of its constraints' rows."""
        found: dict[str, float] = {}
        rows = self.data.efc_pos[: self.data.ne]
        owner = self.data.efc_id[: self.data.ne]
        for k in range(self.model.neq):
            own, name, kind = rows[owner == k], self.model.eq(k).name, int(self.model.eq_type[k])
            if len(own) in (3, 6):
                found[name] = float(np.linalg.norm(own[:3]))
            if len(own) == 6:  # the vector part of a quaternion
                found[f"{name}, turned"] = 2 * float(np.arcsin(min(1.0, np.linalg.norm(own[3:]))))
            elif kind == mujoco.mjtEq.mjEQ_JOINT:
                joints = [self.model.eq_obj1id[k], self.model.eq_obj2id[k]]
                found[" by ".join(self.model.joint(j).name for j in joints if j >= 0)] = abs(float(own[0]))
            elif len(own) == 1:  # of a tendon; where it is over joints, by the first one's coefficient
                first = self.model.tendon_adr[self.model.eq_obj1id[k]]
                found[name] = abs(float(own[0])) / (self.model.wrap_prm[first] or 1.0)
        return found


def quaternion(rotation: Any) -> list[float]:
    """Return w, x, y, z."""
    x, y, z, w = pin.Quaternion(rotation).coeffs()
    return [w, x, y, z]
