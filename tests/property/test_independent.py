"""Independent coordinates that a mechanism chooses itself: motors, then those nearest the root; stable."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from ckc_pin import Mechanism, load
from ckc_pin.base.sources import Sources
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism.spec import JointSpec, LoopType, MechanismSpec
from tests.property.mechanisms import closed_mechanism
from tests.property.strategies import TYPES

MAX_SLOPE = 40.0  # entries of rho; a random choice has up to 1e3


def rebuilt(mechanism: Mechanism, **keys: object) -> Mechanism:
    spec: MechanismSpec = msgspec.structs.replace(mechanism.spec, **keys)
    return assemble_mechanism(spec, mechanism.sources)


def moved_guess(mechanism: Mechanism, size: float, seed: int) -> dict[str, float]:
    random, numbers = np.random.default_rng(seed), mechanism.tree.to_coordinates(mechanism.q_tree)
    return {
        name: float(x + size * random.uniform(-1, 1)) for name, x in zip(mechanism.coordinates, numbers, strict=True)
    }


@pytest.mark.parametrize("kind", TYPES)
def test_choice_does_not_change_with_small_changes_of_the_guess(kind: LoopType) -> None:
    for seed in range(4):
        mechanism = closed_mechanism(kind, seed, free=False).mechanism
        assert np.abs(mechanism.assembled.rho / mechanism.tree.step_scale[:, None]).max() < MAX_SLOPE
        for size in (1e-6, 1e-3, 1e-2):
            other = rebuilt(mechanism, q_guess=moved_guess(mechanism, size, seed))
            assert other.independent == mechanism.independent


@pytest.mark.parametrize("name", ["five_bar", "four_bar", "delta", "three_rrr", "slider_crank", "n_four_bar"])
def test_motors_come_first_with_and_without_stops(name: str) -> None:
    mechanism = load(name)
    limited = 'type="revolute"><limit lower="-7" upper="7" effort="1" velocity="1"/>'
    texts = {file: text.replace('type="continuous">', limited) for file, text in mechanism.sources.texts.items()}
    mechanism.sources = Sources(name, None, texts)
    angles = [x for x, unit in zip(mechanism.coordinates, mechanism.tree.units(), strict=True) if unit == "rad"]
    stops = [JointSpec(name=x, stops=True) for x in angles if x not in mechanism.tree.free_coordinates]
    for seed, joint in enumerate(([], [], stops)):
        guess = moved_guess(mechanism, 0.02 * (seed > 0), seed)
        other = rebuilt(mechanism, independent=None, actuated=list(mechanism.actuated), q_guess=guess, joint=joint)
        assert other.independent == mechanism.actuated


def test_joints_nearest_the_root_come_first_without_motors() -> None:
    """Of a chain of three links with its tip on the ground, the first joint; of mimic joints, the master."""
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="l{{0}}"><inertial><mass value="1"/>{inertia}</inertial></link>'
    joint = """<joint name="{0}" type="continuous"><parent link="{1}"/><child link="l{0}"/><origin xyz="{2} 0 0"/>
      <axis xyz="0 0 1"/></joint>"""
    chain = link.format("c") + joint.format("c", "base", 0)
    chain += link.format("b") + joint.format("b", "lc", 1) + link.format("a") + joint.format("a", "lb", 1)
    loop = {"name": "tip", "type": "point_2d", "frame_a": {"link": "la", "xyz": [1, 0, 0]},
            "frame_b": {"link": "base", "xyz": [1.5, 0, 0]}}  # fmt: skip
    guess = {"c": 1.0, "b": -1.2, "a": -1.5}
    mechanism = Mechanism.from_urdf(f'<robot name="r"><link name="base"/>{chain}</robot>', loops=[loop], q_guess=guess)
    assert mechanism.independent == ("c",)
    fingers = "".join(link.format(x) + joint.format(x, "base", 0) for x in "ab")
    for ratio in (0.1, 1.0, -10.0):
        coupling = {"joint": "a", "other": "b", "ratio": ratio}
        gripper = Mechanism.from_urdf(f'<robot name="r"><link name="base"/>{fingers}</robot>', couplings=[coupling])
        assert gripper.independent == ("b",)
