"""Runs as MCAP files: what another reader and another program's kinematics find in them."""

from __future__ import annotations

import builtins
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yourdfpy
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import ckc_pin
from ckc_pin.errors import InputError
from ckc_pin.formats.mcap import write_mcap
from tests.contract.helpers.command import ckc


def read(path: Path) -> dict[str, list[Any]]:
    """Return the messages of each topic, with the time of each in ns."""
    topics: dict[str, list[Any]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, at, raw in reader.messages():
            topics.setdefault(connection.topic, []).append((at, reader.deserialize(raw, connection.msgtype)))
    return topics


@pytest.mark.parametrize("scene", ["five_bar/tracking", "three_rrr", "bricard"])
def test_frames_are_those_of_the_urdf_at_the_joint_states(scene: str, tmp_path: Path) -> None:
    """Kinematics of yourdfpy, from nothing but the messages."""
    run = ckc_pin.simulate(scene, {"t_end": 0.1, "solver.output_dt": 0.05})
    topics = read(write_mcap(run, tmp_path / "run.mcap"))
    ((_, description),) = topics["/robot_description"]
    robot = yourdfpy.URDF.load(StringIO(description.data), load_meshes=False, build_scene_graph=True)
    assert [at for at, _ in topics["/joint_states"]] == [round(1e9 * t) for t in run.t]
    for (_, state), (_, frames) in zip(topics["/joint_states"], topics["/tf"], strict=True):
        robot.update_cfg(dict(zip(state.name, state.position, strict=True)))
        for transform in frames.transforms:
            assert transform.header.frame_id == "world"
            exact = robot.get_transform(transform.child_frame_id)
            place, turn = transform.transform.translation, transform.transform.rotation
            np.testing.assert_allclose([place.x, place.y, place.z], exact[:3, 3], atol=1e-12)
            np.testing.assert_allclose(rotation(turn.x, turn.y, turn.z, turn.w), exact[:3, :3], atol=1e-12)


def rotation(x: float, y: float, z: float, w: float) -> Any:
    """Return the matrix of a unit quaternion, by Euler and Rodrigues."""
    axis = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * axis + 2 * axis @ axis


def test_joint_states_and_wrenches_are_the_quantities_of_the_run(tmp_path: Path) -> None:
    run = ckc_pin.simulate("two_ur5", {"t_end": 0.1, "solver.output_dt": 0.05})
    topics = read(write_mcap(run, tmp_path / "run.mcap"))
    names = [name for name in run.mechanism.coordinates if not name.startswith("load_root.")]
    for k, (_, state) in enumerate(topics["/joint_states"]):
        assert state.name == names
        for name, position, velocity, effort in zip(names, state.position, state.velocity, state.effort, strict=True):
            assert (position, velocity) == (run[name][k], run[f"v.{name}"][k])
            assert effort == (run[f"tau.{name}"][k] if name in run.actuated else 0.0)
    for k, (_, frames) in enumerate(topics["/tf"]):
        (load,) = (x.transform.translation for x in frames.transforms if x.child_frame_id == "load_bar")
        assert [load.x, load.y, load.z] == [run[f"load_root.{axis}"][k] for axis in "xyz"]
    joint = "right_elbow_joint"
    for k, (_, message) in enumerate(topics[f"/joint_wrenches/{joint}"]):
        force, moment = message.wrench.force, message.wrench.torque
        numbers = force.x, force.y, force.z, moment.x, moment.y, moment.z
        assert list(numbers) == [run[f"joint.{joint}.{part}"][k] for part in ("fx", "fy", "fz", "mx", "my", "mz")]


def test_the_command_writes_the_file_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "new" / "swing.mcap"
    result = ckc("run", "five_bar/swing", "--set", "t_end=0.1", "--mcap", str(path))
    assert result.code == 0, result.err
    assert str(path) in result.out
    assert len(read(path)["/tf"]) == 11
    assert [x.name for x in path.parent.iterdir()] == ["swing.mcap"]


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def refuse(name: str, *arguments: Any, **options: Any) -> Any:
        if name.startswith("rosbags"):
            raise ModuleNotFoundError(name)
        return original(name, *arguments, **options)

    run = ckc_pin.simulate("five_bar/swing", {"t_end": 0.1})
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"writing MCAP files needs rosbags: pip install ckc_pin\[bags\]"):
        write_mcap(run, tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())
