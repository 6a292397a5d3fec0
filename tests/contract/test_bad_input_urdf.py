"""URDFs as untrusted input: values that urdfdom and Pinocchio accept silently are refused with their name."""

from __future__ import annotations

from pathlib import Path

import pytest

from ckc_pin import load, terms
from tests.contract.helpers.bad import Bad, expect

CHECK = ("check", "bar")
NAMED = "five_bar.urdf: "
ONE = {"bar/mechanism.toml": 'name = "one"\nurdf = "five_bar.urdf"\n'}

PENDULUM = """<robot name="p"><link name="a"/><link name="b"><inertial><origin xyz="1 0 0"/><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" type="continuous">
<parent link="a"/><child link="b"/><origin xyz="0 0 0"/><axis xyz="0 0 1"/></joint></robot>"""


def _complete_urdf(what: str, urdf: str | bytes, *says: str) -> Bad:
    return Bad(what, CHECK, [NAMED, *says], files={**ONE, "bar/five_bar.urdf": urdf})


def _pendulum(what: str, old: str, new: str, *says: str) -> Bad:
    assert old in PENDULUM
    return _complete_urdf(what, PENDULUM.replace(old, new, 1), *says)


def _joint(what: str, inside: str, *says: str) -> Bad:
    """A pendulum with something more in its joint."""
    return _pendulum(what, "</joint>", f"{inside}</joint>", "joint 'j'", *says)


def _more(what: str, elements: str, *says: str) -> Bad:
    """A pendulum with more links and joints."""
    return _pendulum(what, "</robot>", f"{elements}</robot>", *says)


def _turns(name: str, parent: str, child: str) -> str:
    return f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/></joint>'


XML = [
    _complete_urdf("malformed", "<robot><link></robot>", "malformed XML: mismatched tag: line 1"),
    _complete_urdf("empty", "", "malformed XML: no element found"),
    Bad("binary", CHECK, ["bar/five_bar.urdf: not a", "not UTF-8"], files={"bar/five_bar.urdf": b"\x00\xff"}),
    _complete_urdf("a control character", '<robot name="\1"/>', "malformed XML"),
    _complete_urdf("a document type", '<!DOCTYPE robot><robot name="a"/>', "document type declaration (robot)"),
    _complete_urdf(
        "a billion laughs",
        '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]><robot name="&c;"/>',
        "document type declaration (x)",
    ),
    _complete_urdf(
        "another file", '<!DOCTYPE x SYSTEM "file:///etc/hostname"><robot name="a"/>', "document type declaration"
    ),
    _complete_urdf("an unknown entity", '<robot name="&x;"/>', "malformed XML: undefined entity"),
    _complete_urdf(
        "nested without end", "<robot>" + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>", "nested more than"
    ),
    _complete_urdf("two documents", "<robot/><robot/>", "malformed XML: junk after document element"),
    _complete_urdf("another root", "<mujoco/>", "expected the root element <robot> of a URDF, got <mujoco>"),
]

TREE = [
    _complete_urdf("nothing in it", '<robot name="a"/>', "no <link>"),
    _complete_urdf("a link without name", "<robot><link/></robot>", "a <link> has no name"),
    _more("two links of one name", '<link name="a"/>', "two <link> elements are called 'a'"),
    _more("two joints of one name", f'<link name="c"/>{_turns("j", "b", "c")}', "two <joint> elements are called 'j'"),
    _more("two roots", '<link name="c"/>', "a URDF is a tree with one root link; roots found: 'a', 'c'"),
    _more("two parents", f'<link name="c"/>{_turns("k", "c", "b")}', "link 'b' has two parents: joints 'j' and 'k'"),
    _more("a circle", _turns("k", "b", "a"), "roots found: none: the joints form a circle"),
    _more(
        "a circle beside the tree",
        f'<link name="c"/><link name="d"/>{_turns("k", "c", "d")}{_turns("l", "d", "c")}',
        "links in a circle, not below 'a': c, d",
    ),
    _pendulum("unknown parent", 'parent link="a"', 'parent link="x"', "its parent link 'x' does not exist", "a, b"),
    _pendulum("unknown child", 'child link="b"', 'child link="x"', "its child link 'x' does not exist", "a, b"),
    _pendulum("no parent", '<parent link="a"/>', "", "joint 'j' has no <parent>"),
    _pendulum("a parent without name", '<parent link="a"/>', "<parent/>", "its <parent> names no link"),
]

JOINTS = [
    _pendulum("no joint type", ' type="continuous"', "", "joint 'j': it has no type; valid: revolute, continuous"),
    _pendulum("unknown joint type", "continuous", "ball", "type 'ball' is not supported; valid: revolute, continuous"),
    _pendulum("planar joint", "continuous", "planar", "type 'planar' is not supported; valid: revolute"),
    _pendulum("zero axis", "0 0 1", "0 0 0", "joint 'j': its axis is zero"),
    _pendulum("almost zero axis", "0 0 1", "0 0 1e-200", "joint 'j': its axis is zero"),
    _pendulum("axis with nan", "0 0 1", "0 nan 1", "joint 'j', <axis>: xyz='0 nan 1' is not 3 finite numbers"),
    _pendulum("axis of two numbers", "0 0 1", "0 1", "xyz='0 1' is not 3 finite numbers"),
    _pendulum("axis without numbers", ' xyz="0 0 1"', "", "joint 'j', <axis> has no xyz"),
    _pendulum("origin with a word", 'xyz="0 0 0"', 'xyz="0 0 up"', "<origin>: xyz='0 0 up' is not 3 finite numbers"),
    _pendulum("origin with commas", 'xyz="0 0 0"', 'xyz="0,0,0"', "xyz='0,0,0' is not 3 finite numbers"),
    _pendulum("a number only Python reads", 'xyz="0 0 0"', 'xyz="0 0 1_0"', "xyz='0 0 1_0' is not 3 finite"),
    _pendulum("a number too large", 'xyz="0 0 0"', 'xyz="0 0 1e999"', "xyz='0 0 1e999' is not 3 finite"),
    _complete_urdf(
        "limits reversed",
        PENDULUM.replace("continuous", "revolute").replace("</joint>", '<limit lower="1" upper="-1"/></joint>'),
        "joint 'j': its lower limit 1 is above the upper one -1",
    ),
    _joint("effort in words", '<limit effort="much"/>', "<limit>: effort='much' is not a finite number"),
    _joint("negative damping", '<dynamics damping="-1"/>', "negative damping -1"),
    _joint("negative friction", '<dynamics friction="-1"/>', "negative friction -1"),
    _joint("friction of nan", '<dynamics friction="nan"/>', "<dynamics>: friction='nan' is not a finite number"),
    _joint("mimic of nothing", "<mimic/>", "its <mimic> names no joint"),
    _joint("mimic by nan", '<mimic joint="j" multiplier="nan"/>', "multiplier='nan' is not a finite number"),
]

BODIES = [
    _pendulum("negative mass", 'mass value="1"', 'mass value="-1"', "link 'b': negative mass -1 kg"),
    _pendulum("mass of nan", 'mass value="1"', 'mass value="nan"', "link 'b', <mass>: value='nan' is not a finite"),
    _pendulum("infinite mass", 'mass value="1"', 'mass value="inf"', "value='inf' is not a finite number"),
    _pendulum("mass in words", 'mass value="1"', 'mass value="heavy"', "value='heavy' is not a finite number"),
    _pendulum("mass without value", '<mass value="1"/>', "<mass/>", "link 'b', <mass> has no value"),
    _pendulum("inertial without mass", '<mass value="1"/>', "", "link 'b', <inertial> has no <mass>"),
    _pendulum("half an inertia", 'iyy="1"', "", "link 'b', <inertia> has no iyy"),
    _pendulum("negative inertia", 'iyy="1"', 'iyy="-1"', "link 'b': its inertia has a negative principal moment, -1"),
    _pendulum("indefinite inertia", 'ixy="0"', 'ixy="2"', "its inertia has a negative principal moment, -1"),
    _pendulum("inertia of nan", 'izz="1"', 'izz="nan"', "link 'b', <inertia>: izz='nan' is not a finite number"),
    _pendulum("centre in words", 'xyz="1 0 0"', 'xyz="a 0 0"', "link 'b', <origin>: xyz='a 0 0' is not 3 finite"),
]


INERTIAL = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
TWICE = [
    _joint(f"two {element.split()[0][1:]}", element, f": 2 <{element.split()[0][1:]}> elements; a URDF has one at most")
    for element in ('<origin xyz="1 0 0"/>', '<parent link="b"/>', '<child link="a"/>', '<axis xyz="1 0 0"/>')
]
TWICE += [
    _joint(f"two {element.split()[0][1:]}", 2 * element, f": 2 <{element.split()[0][1:]}> elements; a URDF has one at")
    for element in ('<limit effort="1"/>', '<dynamics damping="1"/>', '<mimic joint="k"/>')
]
TWICE += [
    _pendulum(
        "two inertial", "</inertial>", f"</inertial>{INERTIAL}", "link 'b': 2 <inertial> elements; a URDF has one"
    ),
    _pendulum("two mass", "<mass", '<mass value="2"/><mass', "link 'b', <inertial>: 2 <mass> elements; a URDF has one"),
    _pendulum("two inertia", "<inertia ", "<inertia/><inertia ", "link 'b', <inertial>: 2 <inertia> elements; a URDF"),
    _pendulum(
        "two centres", "<origin", "<origin/><origin", "link 'b', <inertial>: 2 <origin> elements; a URDF has one"
    ),
    _joint(
        "three axes", '<axis xyz="1 0 0"/><axis xyz="0 1 0"/>', ": 3 <axis> elements; a URDF has one at most in <joi"
    ),
]


@pytest.mark.parametrize("case", [*XML, *TREE, *JOINTS, *BODIES, *TWICE], ids=lambda case: case.what)
def test_bad_urdf(case: Bad, bar: Path, capfd: pytest.CaptureFixture[str]) -> None:
    expect(case, bar)
    assert capfd.readouterr() == ("", ""), "urdfdom writes to the file descriptors themselves"


HARMLESS = {
    "a byte order mark": "\ufeff" + PENDULUM,
    "another encoding's name": '<?xml version="1.0" encoding="utf-16"?>' + PENDULUM,
    "a picture of nonsense": PENDULUM.replace(
        '<link name="a"/>', '<link name="a"><visual><geometry><box size="a b"/></geometry></visual></link>'
    ),
    "several pictures": PENDULUM.replace(
        '<link name="a"/>', f'<link name="a">{2 * "<visual><origin/><origin/></visual><collision/>"}</link>'
    ),
    "elements of other programs": PENDULUM.replace(
        "</joint>", "<hardwareInterface/><hardwareInterface/><safety_controller/></joint>"
    ),
    "a colour of nonsense": PENDULUM.replace('name="p">', 'name="p"><material name="m"><color rgba="x"/></material>'),
    "dynamics that say nothing": PENDULUM.replace("</joint>", "<dynamics/></joint>"),
    "a robot without name": PENDULUM.replace(' name="p"', ""),
    "a link called world, a joint called universe": PENDULUM.replace('"a"', '"world"').replace('"j"', '"universe"'),
    "a link and a joint of one name": PENDULUM.replace('"j"', '"b"'),
}


@pytest.mark.parametrize("what", HARMLESS)
def test_elements_irrelevant_to_dynamics_are_accepted(what: str, bar: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """All the same pendulum: m = 1 kg at 1 m, 1 kg m^2 about its centre of mass."""
    (bar / "mechanism.toml").write_text(ONE["bar/mechanism.toml"], encoding="utf-8")
    (bar / "five_bar.urdf").write_text(HARMLESS[what], encoding="utf-8")
    mechanism = load(bar)
    assert terms(mechanism, {mechanism.coordinates[0]: 0.3}).D[0, 0] == pytest.approx(2.0, rel=1e-14)
    assert capfd.readouterr() == ("", "")
