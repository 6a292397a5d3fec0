"""A program for the benchmark: a MuJoCo of any version, which closes loops by soft constraints, with fixed steps."""

import json
import sys
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from timing import fixed_step, print_motion, read_inertia, say

SETTINGS = ("RK4, solref 4 dt", "RK4, solref 2 dt", "implicitfast, solref 2 dt")
COARSEST_S = 2e-2  # step at the tolerance 1e-2
STIFFEST_SOLIMP = [0.9999, 0.9999, 0.001, 0.5, 2.0]  # of constraints; the manual's limit of solref is 2 dt
DISABLED = ("AUTORESET", "CONTACT", "SENSOR")  # AUTORESET would restart a run that diverged
PAIRS = {"point": 1, "point_2d": 1, "hinge": 2, "weld": 3}  # pairs of coincident points by type of loop


def text(numbers: Any) -> str:
    """Return numbers as an attribute."""
    return " ".join(repr(float(x)) for x in np.ravel(numbers))


def quaternion(rotation: Any) -> Any:
    """Return the quaternion w, x, y, z of a rotation matrix."""
    w_x_y_z = np.zeros(4)
    mujoco.mju_mat2Quat(w_x_y_z, np.ravel(rotation))
    return w_x_y_z


def matrix(w_x_y_z: Any) -> Any:
    """Return the rotation matrix of a quaternion w, x, y, z."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array(w_x_y_z))
    return rotation.reshape(3, 3)


def build_model(problem: dict[str, Any]) -> Any:
    """Return a problem as a model."""
    root = ElementTree.Element("mujoco")
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="false", inertiagrouprange="6 6")
    ElementTree.SubElement(root, "option", gravity=text(problem["gravity"]))
    bodies, on_joints, at = [ElementTree.SubElement(root, "worldbody")], problem["joints"], 0
    for body in problem["bodies"]:
        pose = {"pos": text(body["translation"]), "quat": text(quaternion(body["rotation"]))}
        added = ElementTree.SubElement(bodies[body["parent"]], "body", pose)
        mass, inertia = read_inertia(body)
        full = text(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        ElementTree.SubElement(added, "inertial", pos=text(body["center"]), mass=text(mass), fullinertia=full)
        if body["joint"] == "free":
            ElementTree.SubElement(added, "freejoint")
        else:
            numbers = {"armature": "armature", "damping": "damping", "stiffness": "stiffness", "springref": "rest"}
            ElementTree.SubElement(
                added, "joint", type="hinge" if body["joint"] == "revolute" else "slide", axis=text(body["axis"]),
                **{name: text(on_joints[key][at]) for name, key in numbers.items()},
            )  # fmt: skip
        at += 6 if body["joint"] == "free" else 1
        bodies.append(added)
    equality, tendons = ElementTree.SubElement(root, "equality"), ElementTree.SubElement(root, "tendon")
    pairs, sites = iter(problem["pairs"]), 0

    def add_sites(ends: Any) -> list[str]:
        nonlocal sites
        names = []
        for body, pose in ends:
            sites += 1
            ElementTree.SubElement(bodies[body], "site", name=f"s{sites}", **pose)
            names.append(f"s{sites}")
        return names

    for loop in problem["loops"]:
        points = [next(pairs) for _ in range(PAIRS[loop["type"]])]
        if loop["type"] == "weld":
            poses = [
                {"pos": text(loop[end]["translation"]), "quat": text(quaternion(loop[end]["rotation"]))} for end in "ab"
            ]
            names = add_sites(zip((loop["a"]["body"], loop["b"]["body"]), poses, strict=True))
            ElementTree.SubElement(equality, "weld", site1=names[0], site2=names[1])
            continue
        for pair in points:
            names = add_sites((pair[end]["body"], {"pos": text(pair[end]["point"])}) for end in "ab")
            ElementTree.SubElement(equality, "connect", site1=names[0], site2=names[1])
    for spring in problem["springs"]:
        names = add_sites((spring[end]["body"], {"pos": text(spring[end]["point"])}) for end in "ab")
        numbers = {"stiffness": "stiffness", "springlength": "rest_length", "damping": "damping"}
        tendon = ElementTree.SubElement(tendons, "spatial", {name: text(spring[key]) for name, key in numbers.items()})
        for name in names:
            ElementTree.SubElement(tendon, "site", site=name)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    for feature in DISABLED:
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{feature}", 0)
    if mujoco.__version__ == "4.0.0":  # its Hessian is wrong with a sparse constraint Jacobian
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return model


def configure(model: Any, setting: str, dt: float) -> None:
    """Set integrator, step and stiffness of the constraints."""
    integrator, stiffness = setting.split(", ")
    model.opt.timestep = dt
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.eq_solref[:] = [float(stiffness.split()[1]) * dt, 1.0]
    model.eq_solimp[:] = STIFFEST_SOLIMP


def set_start(problem: dict[str, Any], model: Any, data: Any) -> None:
    """Set the start."""
    mujoco.mj_resetData(model, data)
    q, v, qpos, qvel = iter(problem["q"]), iter(problem["v"]), list[float](), list[float]()
    for body in problem["bodies"]:
        if body["joint"] != "free":
            qpos.append(next(q))
            qvel.append(next(v))
            continue
        placed, position = np.array(body["rotation"]), [next(q) for _ in range(3)]
        x, y, z, w = (next(q) for _ in range(4))
        rotation = placed @ matrix([w, x, y, z])
        qpos += [*(placed @ position + body["translation"]), *quaternion(rotation)]
        qvel += [*(rotation @ [next(v) for _ in range(3)]), *(next(v) for _ in range(3))]
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, problem["joints"]["force"]


def read_state(problem: dict[str, Any], data: Any) -> tuple[list[float], list[float]]:
    """Return q and v."""
    qpos, qvel, q, v = iter(data.qpos.tolist()), iter(data.qvel.tolist()), list[float](), list[float]()
    for body in problem["bodies"]:
        if body["joint"] != "free":
            q.append(next(qpos))
            v.append(next(qvel))
            continue
        back, position = np.array(body["rotation"]).T, np.array([next(qpos) for _ in range(3)])
        rotation = matrix([next(qpos) for _ in range(4)])
        w, x, y, z = quaternion(back @ rotation).tolist()
        q += [*(back @ (position - body["translation"])).tolist(), x, y, z, w]
        v += [*(rotation.T @ [next(qvel) for _ in range(3)]).tolist(), *(next(qvel) for _ in range(3))]
    return q, v


def read_acceleration(problem: dict[str, Any], data: Any) -> list[float]:
    """Return v_dot; linear parts of free bodies are turned into the body's axes, which turn."""
    at, rates, v = 0, np.array(data.qacc), read_state(problem, data)[1]
    for k, body in enumerate(problem["bodies"]):
        if body["joint"] == "free":
            rotation = data.xmat[k + 1].reshape(3, 3)
            linear, angular = v[at : at + 3], v[at + 3 : at + 6]
            rates[at : at + 3] = rotation.T @ rates[at : at + 3] - np.cross(angular, linear)
        at += 6 if body["joint"] == "free" else 1
    return rates.tolist()


def main() -> None:
    """Answer one problem."""
    problem = json.load(sys.stdin)
    version = mujoco.__version__
    say(name=f"MuJoCo {version.split('.')[0]}", version=version, packaged=True, settings=SETTINGS)
    if problem["pairs"] is None:
        return say(unsupported="loops that are no points, hinges or welds are not set up in it")
    if not problem["bodies"]:
        return say(unsupported="there are no bodies")
    mujoco.set_mju_user_warning(lambda _: None)  # by default it writes them to a file in the current folder
    try:
        model = build_model(problem)
    except ValueError as error:
        return say(unsupported=" ".join(str(error).split()))
    data = mujoco.MjData(model)
    set_start(problem, model, data)
    if not problem["instants"]:
        configure(model, SETTINGS[0], 1e-4)
        mujoco.mj_forward(model, data)
        return say(acceleration=read_acceleration(problem, data))
    dt = fixed_step(problem, COARSEST_S)[1]
    configure(model, problem["setting"], dt)

    def advance(t: float) -> None:
        mujoco.mj_step(model, data, nstep=round((t - data.time) / dt))

    steps = round(problem["t_end"] / dt)
    print_motion(
        problem, lambda: set_start(problem, model, data), advance, lambda: read_state(problem, data), lambda: steps
    )
    return None


if __name__ == "__main__":
    main()
