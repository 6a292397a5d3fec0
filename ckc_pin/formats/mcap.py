"""A run as an MCAP file: joint states, frames of links, wrenches of joints, and the URDF, as messages of ROS 2.

Foxglove, PlotJuggler and the tools of rosbag2 read it. Times are those of the run, from zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import temporary_folder, write_atomic
from ckc_pin.errors import InputError
from ckc_pin.formats.urdf.writer import to_urdf
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run

__all__ = ["write_mcap"]

WORLD = "world"
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")


def write_mcap(run: Run, path: str | Path) -> Path:
    """Write a run as an MCAP file, a message of each topic for each output instant; return its path.

    - ``/joint_states``: position, velocity, and the motors' force on each joint that is one coordinate.
    - ``/tf``: placements of all links in the world.
    - ``/joint_wrenches/JOINT``: the wrench that the joint transmits, at its origin in world axes. Instants at which J
      has lost rank have no message.
    - ``/robot_description``: the URDF of the tree, once.

    Raises
    ------
    InputError
        rosbags is not installed, or the file cannot be written.
    """
    path = Path(path)
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"{path}: writing MCAP files needs rosbags: pip install ckc_pin[bags]") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    with temporary_folder() as folder:
        bag = folder / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for topic, kind, nanoseconds, message in _messages(run, store.types):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], nanoseconds, bytes(store.serialize_cdr(message, kind)))
        (written,) = bag.glob("*.mcap")
        write_atomic(path, written.read_bytes())
    return path


def _messages(run: Run, types: dict[str, Any]) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, time in ns and message, by time."""
    mechanism = run.mechanism
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    text, _ = to_urdf(mechanism)
    yield "/robot_description", "std_msgs/msg/String", 0, types["std_msgs/msg/String"](text)
    joints, wrenches, placements = _single_joints(mechanism), _wrenches(run), _link_placements(mechanism)
    names = [mechanism.coordinates[k] for k in joints]
    force = run.tau @ mechanism.motors.transmission
    for k, t in enumerate(run.t.tolist()):
        nanoseconds = round(1e9 * t)
        at = header(time(*divmod(nanoseconds, 1_000_000_000)), WORLD)
        q, v = run.q_tree[k], run.v_tree[k]
        state = types["sensor_msgs/msg/JointState"](at, names, q[joints], v[joints], force[k, joints])
        yield "/joint_states", "sensor_msgs/msg/JointState", nanoseconds, state
        transforms = [
            types["geometry_msgs/msg/TransformStamped"](
                at, link, types["geometry_msgs/msg/Transform"](vector(*place[:3]), quaternion(*place[3:]))
            )
            for link, place in placements(mechanism.tree.from_coordinates(q))
        ]
        yield "/tf", "tf2_msgs/msg/TFMessage", nanoseconds, types["tf2_msgs/msg/TFMessage"](transforms)
        for joint, wrench in wrenches.items():
            if np.isfinite(wrench[k]).all():
                parts = types["geometry_msgs/msg/Wrench"](vector(*wrench[k, :3]), vector(*wrench[k, 3:]))
                stamped = types["geometry_msgs/msg/WrenchStamped"](at, parts)
                yield f"/joint_wrenches/{joint}", "geometry_msgs/msg/WrenchStamped", nanoseconds, stamped


def _single_joints(mechanism: Mechanism) -> Array:
    """Return the coordinates whose joint has one freedom."""
    return np.array([k for k, name in enumerate(mechanism.coordinates) if name not in mechanism.tree.free_coordinates])


def _wrenches(run: Run) -> dict[str, Array]:
    """Return the wrench of each joint along a run, (m, 6) arrays by name."""
    joints = [name.removesuffix(".fx") for name in run.quantities if name.startswith("joint.") and name.endswith(".fx")]
    return {joint.removeprefix("joint."): np.array([run[f"{joint}.{part}"] for part in WRENCH]).T for joint in joints}


def _link_placements(mechanism: Mechanism) -> Callable[[Array], Iterator[tuple[str, list[float]]]]:
    """Return a function that yields the name of each link with its position and quaternion (x, y, z, w)."""
    tree = mechanism.tree
    links = [frame for frame in tree.model.frames if frame.type == pin.FrameType.BODY]

    def placements(q_tree: Array) -> Iterator[tuple[str, list[float]]]:
        pin.forwardKinematics(tree.model, tree.data, q_tree)
        for link in links:
            yield link.name, pin.SE3ToXYZQUAT(tree.data.oMi[link.parentJoint] * link.placement).tolist()

    return placements
