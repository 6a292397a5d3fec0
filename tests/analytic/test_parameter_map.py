"""The parameter map equals what rebuilding a mechanism from changed files gives, in its values and derivatives."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.base.arrays import Array
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.linkage import Linkage
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import ParameterMap
from ckc_pin.mechanism.parameters import values_of, with_components

SHIPPED = ("five_bar", "delta", "slider_crank_spatial", "talos", "flyball")
STEP = 1e-5

FILE = """
name = "all"
independent = ["a"]
gravity = [0.3, -1.0, -9.0]
[[tree]]
file = "all.urdf"
root = "free"
[q_guess]
"root.x" = 0.1
[[coupling]]
joint = "c"
other = "b"
ratio = 0.7
offset = 0.2
[[joint]]
name = "a"
friction = 0.4
armature = 0.2
[[joint]]
name = "b"
stops = true
restitution = 0.3
damping = 0.5
[[spring]]
frame_a = {link = "tool", xyz = [0.1, 0.2, 0.3], rpy = [0.3, 0.2, 0.1]}
frame_b = "world"
stiffness = 3.0
damping = 0.1
rest_length = 0.4
[[spring]]
joint = "a"
stiffness = 2.0
rest = 0.3
damping = 0.2
[[force]]
joint = "b"
value = 1.5
[[motor]]
joint = "a"
ratio = 3.0
rotor_inertia = 0.01
torque_limit = 4.0
[[point]]
name = "tip"
frame = {link = "tool", xyz = [0.0, 0.0, 0.2]}
"""


def link(name: str, mass: float) -> str:
    return f"""<link name="{name}"><inertial><origin xyz="0.1 -0.2 0.3" rpy="0.2 0.4 -0.3"/><mass value="{mass}"/>
    <inertia ixx="1.1" iyy="1.3" izz="1.5" ixy="0.1" ixz="-0.2" iyz="0.05"/></inertial></link>"""


def joint(name: str, parent: str, child: str, kind: str) -> str:
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="0.4 0.1 -0.2" rpy="0.5 -0.3 0.7"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-1" upper="2" effort="1" velocity="1"/></joint>"""


@pytest.fixture
def all_kinds(tmp_path: Path) -> Mechanism:
    """A mechanism that has every kind of parameter except a loop's, with rotated frames behind fixed joints."""
    masses = {"base": 2.0, "one": 1.0, "two": 3.0, "three": 2.0, "tool": 0.5}
    links = "".join(link(name, mass) for name, mass in masses.items())
    joints = joint("a", "base", "one", "revolute") + joint("b", "one", "two", "prismatic")
    joints += joint("c", "two", "three", "revolute") + joint("weld", "two", "tool", "fixed")
    (tmp_path / "all.urdf").write_text(f'<robot name="all">{links}{joints}</robot>')
    (tmp_path / "all.toml").write_text(FILE.replace('independent = ["a"]\n', ""))
    return load(tmp_path / "all.toml")


def linkage_with(mechanism: Mechanism, overrides: dict[str, float]) -> Any:
    """Build the linkage from changed files: XML is edited and Pinocchio builds the tree."""
    linkage: Any = Linkage(mechanism.spec, mechanism.sources, overrides)
    linkage.motors, linkage.urdf = linkage.motors or mechanism.motors, linkage.urdf.root  # as a mechanism has them
    return linkage


def rebuilt(mechanism: Mechanism, name: str, value: float) -> dict[str, Array]:
    return ParameterMap(linkage_with(mechanism, {name: value})).all_numbers


def check(mechanism: Mechanism, names: Iterable[str]) -> int:
    """Compare values and derivatives of the map with rebuilt linkages; return how many numbers depend on parameters."""
    parameters, count = ParameterMap(mechanism), 0
    for name in names:
        value = parameters.value_of(name)
        step = STEP * max(abs(value), 0.1)
        ways = (step, 2 * step) if value == 0 else (step, -step)  # many numbers may not be negative
        try:
            one, other = (rebuilt(mechanism, name, value + h) for h in ways)
        except MechanismError:  # an inertia that cannot be
            assert not parameters.evaluate([name], value + np.array([ways]).T)[1].all(), name
            continue
        slopes = parameters.derivative(name)
        values, is_physical = parameters.evaluate([name], np.array([[value + step]]))
        assert is_physical.all(), name
        count += len(slopes)
        for key, base in parameters.all_numbers.items():
            finite = np.isfinite(base)
            f_0, f_1, f_2 = (x[key][finite] for x in (parameters.all_numbers, one, other))
            difference = (4 * f_1 - f_2 - 3 * f_0 if value == 0 else f_1 - f_2) / (2 * step)
            slope = slopes.get(key, np.zeros_like(base))[finite]
            size = max(1.0, np.abs(difference).max(initial=0.0))
            assert slope == pytest.approx(difference, abs=1e-7 * size), (name, key)
            there = values[key][0] if key in values else base
            assert there[finite] == pytest.approx(f_1, abs=1e-12 * size), (name, key)
    return count


@pytest.mark.parametrize("name", SHIPPED)
def test_map_equals_rebuilt_shipped_mechanisms(name: str) -> None:
    mechanism = load(name)
    names = single_names(mechanism)
    random = np.random.default_rng(5)
    assert check(mechanism, random.permutation(names)[:40]) > 30


def single_names(mechanism: Mechanism) -> list[str]:
    """Return the names of parameters that are one number."""
    values = values_of(mechanism.spec, mechanism.urdf)
    return [name for name in with_components(values) if not isinstance(values.get(name), tuple)]


def test_map_equals_rebuilt_mechanism_with_every_kind_of_parameter(all_kinds: Mechanism) -> None:
    assert check(all_kinds, single_names(all_kinds)) > 150


def test_several_parameters_of_one_body_act_together(all_kinds: Mechanism) -> None:
    """Mass, centre, inertia and placements at once, at random values."""
    names = [
        "link.two.mass", "link.tool.com.x", "link.two.inertia.ixy", "joint.weld.rpy.y", "joint.weld.xyz.z",
        "joint.a.rpy.x", "motor.a.ratio", "motor.a.rotor_inertia", "spring.1.damping", "joint.a.damping",
    ]  # fmt: skip
    random = np.random.default_rng(3)
    start = np.array([ParameterMap(all_kinds).value_of(name) for name in names])
    members = start + random.uniform(0.01, 0.05, (3, len(names)))
    values, is_physical = ParameterMap(all_kinds).evaluate(names, members)
    assert is_physical.all()
    for k, member in enumerate(members):
        linkage = linkage_with(all_kinds, dict(zip(names, member.tolist(), strict=True)))
        for key, there in ParameterMap(linkage).all_numbers.items():
            assert (values[key][k] if key in values else there) == pytest.approx(there, abs=1e-12), key


def test_derivatives_of_all_parameters_equal_those_of_each_alone(all_kinds: Mechanism) -> None:
    """A mass scales its link's inertia, also if entries of the inertia are parameters too."""
    parameters, names = ParameterMap(all_kinds), single_names(all_kinds)
    together = parameters.derivatives(names)
    for name in names:
        alone = parameters.derivative(name)
        assert together[name].keys() == alone.keys(), name
        for key, slope in alone.items():
            assert together[name][key] == pytest.approx(slope, rel=1e-12, abs=1e-14), (name, key)


def test_given_inertia_is_not_scaled_by_a_mass(all_kinds: Mechanism) -> None:
    overrides = {"link.one.mass": 2.0, "link.one.inertia.iyy": 4.0}
    linkage = linkage_with(all_kinds, overrides)
    slopes = ParameterMap(linkage, overrides).derivative("link.one.mass")
    above, below = (linkage_with(all_kinds, {**overrides, "link.one.mass": 2.0 + h}) for h in (STEP, -STEP))
    expected = (above.tree.model.inertias[1].inertia - below.tree.model.inertias[1].inertia) / (2 * STEP)
    assert slopes["inertia"][1] == pytest.approx(expected, abs=1e-8)


def test_members_that_are_not_physical_are_marked(all_kinds: Mechanism) -> None:
    names = ["link.one.mass", "link.one.inertia.ixx", "spring.0.stiffness"]
    members = np.array([[1.0, 1.1, 3.0], [-1.0, 1.1, 3.0], [1.0, -5.0, 3.0], [1.0, 1.1, -1.0], [np.nan, 1.1, 3.0]])
    _, is_physical = ParameterMap(all_kinds).evaluate(names, members)
    assert is_physical.tolist() == [True, False, False, False, False]
