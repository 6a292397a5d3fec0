"""`ckc import` of xacro files, which are expanded by the package `xacro`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ckc_pin import InputError
from ckc_pin.formats.importing import Draft, read

XMLNS = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
LEG = f"""<robot {XMLNS}><xacro:macro name="leg" params="name length:=1">
<link name="${{name}}"/><joint name="${{name}}_hip" type="continuous"><parent link="base"/><child link="${{name}}"/>
<origin xyz="${{length * cos(pi)}} 0 0"/></joint></xacro:macro></robot>"""
ROBOT = f"""<robot name="r" {XMLNS}><xacro:arg name="size" default="0.5"/><link name="base"/>
<xacro:include filename="$(find parts)/leg.xacro"/>
<xacro:leg name="left"/><xacro:leg name="right" length="$(arg size)"/></robot>"""


def expanded(folder: Path, text: str, name: str = "walker.urdf.xacro") -> Draft:
    (folder / ".git").mkdir(exist_ok=True)
    (folder / "parts").mkdir(exist_ok=True)
    (folder / "parts" / "leg.xacro").write_text(LEG, encoding="utf-8")
    (folder / "robots").mkdir(exist_ok=True)
    path = folder / "robots" / name
    path.write_text(text, encoding="utf-8")
    return read(path)


def test_macros_arguments_and_packages_are_expanded(tmp_path: Path) -> None:
    draft = expanded(tmp_path, ROBOT)
    assert (draft.name, draft.origin) == ("walker", "walker.urdf.xacro, a URDF, expanded by xacro")
    places = {joint.get("name"): joint.find("origin").get("xyz") for joint in draft.robot.iterfind("joint")}
    assert places == {"left_hip": "-1.0 0.0 0.0", "right_hip": "-0.5 0.0 0.0"}


def test_package_is_found_by_the_name_in_its_manifest(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "package.xml").write_text("<package><name> the_parts </name></package>", encoding="utf-8")
    draft = expanded(tmp_path, ROBOT.replace("$(find parts)", "$(find the_parts)"))
    assert draft.robot.find("joint[@name='left_hip']") is not None


def test_properties_may_begin_with_an_underscore(tmp_path: Path) -> None:
    text = ROBOT.replace('<link name="base"/>', '<xacro:property name="_long" value="0.25"/><link name="base"/>')
    draft = expanded(tmp_path, text.replace("$(arg size)", "${2 * _long}"))
    assert draft.robot.find("joint[@name='right_hip']/origin").get("xyz") == "-0.5 0.0 0.0"


def test_xacro_may_expand_to_another_format(tmp_path: Path) -> None:
    text = f'<sdf version="1.9" {XMLNS}><model name="m"><link name="a"/></model></sdf>'
    assert expanded(tmp_path, text, "thing.sdf.xacro").origin == "thing.sdf.xacro, an SDFormat file, expanded by xacro"


@pytest.mark.parametrize(
    "expression",
    [
        "().__class__",
        "(lambda: ().__class__)()",
        "[x for x in ().__class__.__mro__]",
        "(x for x in ()).gi_frame.f_back",
        "'a'.format(1)",
        "__import__('os')",
    ],
)
def test_expressions_that_reach_into_python_are_refused(expression: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not accepted"):
        expanded(tmp_path, ROBOT.replace('default="0.5"', f'default="${{{expression}}}"'))


def test_missing_package_macro_and_file_are_named(tmp_path: Path) -> None:
    for old, new, message in (
        ("$(find parts)", "$(find wheels)", "no package 'wheels'"),
        ("xacro:leg name", "xacro:arm name", "xacro cannot expand it: .*arm"),
        ("/leg.xacro", "/arm.xacro", "xacro cannot expand it: .*arm.xacro"),
        ("</robot>", "", "xacro cannot expand it"),
    ):
        with pytest.raises(InputError, match=message):
            expanded(tmp_path, ROBOT.replace(old, new))


def test_missing_arguments_are_named_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a template of ERB"):
        expanded(tmp_path, ROBOT.replace("0.5", "<%= size %>"))
    with pytest.raises(
        InputError, match=r"argument size.*; it has no default, .* `xacro walker.urdf.xacro ARGUMENT:=VALUE"
    ):
        expanded(tmp_path, ROBOT.replace('<xacro:arg name="size" default="0.5"/>', ""))


def test_missing_xacro_is_named_with_the_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(InputError, match=r"pip install 'ckc_pin\[xacro\]'.*xacro FILE > robot.urdf"):
        expanded(tmp_path, ROBOT)
