"""What MuJoCo makes of machine.xml: bodies and equality constraints at four configurations, to reference.json.

    python make_reference.py        # wherever mujoco (3 or later) is installed; the tests themselves do not need it

A ball joint's three numbers are turns about x, y and z, one after another; a free joint's are position and rotation
vector. The first configuration is the reference pose.
"""

import json
from pathlib import Path

import mujoco
import numpy as np

HERE = Path(__file__).parent


def turns(angles):
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in zip(np.eye(3), angles, strict=True):
        turn, product = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, axis, angle)
        mujoco.mju_mulQuat(product, quaternion, turn)
        quaternion = product
    return quaternion


def matrix(quaternion):
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def configuration(model, random, size):
    """A configuration `size` away from the reference pose, and the numbers of each joint."""
    q, numbers = model.qpos0.copy(), {}
    for joint in range(model.njnt):
        at, name = model.jnt_qposadr[joint], model.joint(joint).name
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            q[at : at + 3] += random.uniform(-size, size, 3)
            turned, vector = np.zeros(4), np.zeros(3)
            mujoco.mju_mulQuat(turned, q[at + 3 : at + 7].copy(), turns(random.uniform(-size, size, 3)))
            q[at + 3 : at + 7] = turned
            mujoco.mju_quat2Vel(vector, turned, 1.0)
            numbers[name] = [*q[at : at + 3], *vector]
        elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            numbers[name] = random.uniform(-size, size, 3).tolist()
            q[at : at + 4] = turns(numbers[name])
        else:
            q[at] += random.uniform(-size, size)
            numbers[name] = [q[at]]
    return q, numbers


def misses(model, data):
    """How far each equality constraint is from being met: metres, radians."""
    found = {}
    for e in range(model.neq):
        name, kind, given = model.eq(e).name, model.eq_type[e], model.eq_data[e]
        one, two = model.eq_obj1id[e], model.eq_obj2id[e]
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            y = data.qpos[model.jnt_qposadr[one]] - model.qpos0[model.jnt_qposadr[one]]
            x = 0.0 if two < 0 else data.qpos[model.jnt_qposadr[two]] - model.qpos0[model.jnt_qposadr[two]]
            found[name] = [float(y - np.polynomial.polynomial.polyval(x, given[:5]))]
            continue
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            found[name] = [float(np.linalg.norm(data.site_xpos[one] - data.site_xpos[two]))]
            continue
        rotations = [data.xmat[k].reshape(3, 3) for k in (one, two)]
        welded = kind == mujoco.mjtEq.mjEQ_WELD
        anchors = (given[3:6], given[0:3]) if welded else (given[0:3], given[3:6])
        points = [data.xpos[k] + r @ p for k, r, p in zip((one, two), rotations, anchors, strict=True)]
        found[name] = [float(np.linalg.norm(points[0] - points[1]))]
        if welded:
            between = (rotations[0] @ matrix(given[6:10])).T @ rotations[1]
            found[name].append(float(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))))
    return found


def main():
    model = mujoco.MjModel.from_xml_path(str(HERE / "machine.xml"))
    data = mujoco.MjData(model)
    random = np.random.default_rng(7)
    poses = []
    for size in (0.0, 0.4, 0.8, 1.2):
        data.qpos[:], numbers = configuration(model, random, size)
        mujoco.mj_forward(model, data)
        bodies = {}
        for b in range(1, model.nbody):
            axes = data.ximat[b].reshape(3, 3)
            bodies[model.body(b).name] = {
                "mass": float(model.body_mass[b]),
                "centre": data.xipos[b].tolist(),
                "inertia": (axes @ np.diag(model.body_inertia[b]) @ axes.T).tolist(),
            }
        poses.append({"joints": numbers, "bodies": bodies, "misses": misses(model, data)})
    content = {"mujoco": mujoco.__version__, "poses": poses}
    (HERE / "reference.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
