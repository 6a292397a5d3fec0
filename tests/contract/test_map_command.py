"""`ckc map`: JSON, figures, and one message with exit code 2 for a mechanism that cannot be mapped."""

import numpy as np
import pytest

import ckc_pin
from tests.contract.helpers.command import ckc

KEYS = {
    "mechanism", "space", "point", "axes", "held", "measure", "branches", "more_branches", "loci", "desired", "seconds",
    "notes",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def maps():
    """Compute each map once. Several tests print it."""
    compute, done = ckc_pin.singularity_map, {}

    def look_up(mechanism, progress, **options):
        key = (mechanism, repr(options))
        if key not in done:
            done[key] = compute(mechanism, progress=progress, **options)
        return done[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ckc_pin, "singularity_map", look_up)
        yield


def test_json_and_figures_are_written(tmp_path):
    result = ckc("map", "four_bar", "--cells", "16", "--out", str(tmp_path / "new"), "--json")
    assert result.code == 0
    assert set(result.json) >= KEYS
    assert [branch["reached"] for branch in result.json["branches"]] == [1.0, 1.0]  # its crank turns
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["map_joint.png", "map_joint.svg"]
    place = ckc("map", "four_bar", "--cells", "16", "--space", "cartesian", "--out", str(tmp_path))
    assert place.code == 0
    assert (tmp_path / "map_cartesian.png").stat().st_size > 10_000
    assert "place of coupler" in place.out


def test_terminal_output_has_loci_and_desired_trajectory(tmp_path):
    result = ckc("map", "five_bar", "--cells", "16", "--scene", "set_point", "--out", str(tmp_path))
    assert result.code == 0
    assert result.err == ""  # no progress in a pipe
    assert "0.993864982" in result.out
    assert f"{np.pi - 0.993864982:.9f}" in result.out
    assert "type 2, closed" in result.out
    assert "desired, five_bar/set_point" in result.out
    assert (tmp_path / "map_joint.svg").read_text(encoding="utf-8").startswith("<?xml")


NO_LOOP = """name = "arm"
urdf = "arm.urdf"
"""
ARM = """<robot name="arm"><link name="base"/><link name="a"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint></robot>"""
LOCKED = NO_LOOP + '[[loop]]\nname = "bolt"\ntype = "weld"\nframe_a = "a"\nframe_b = "base"\n'


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        (LOCKED, (), "d = 0"),
        (NO_LOOP, (), "without loops"),
        (NO_LOOP, ("--space", "cartesian"), "without loops"),
    ],
)
def test_mechanism_without_freedoms_or_loops_is_refused(tmp_path, text, options, says):
    (tmp_path / "arm.urdf").write_text(ARM, encoding="utf-8")
    (tmp_path / "mechanism.toml").write_text(text, encoding="utf-8")
    result = ckc("map", str(tmp_path / "mechanism.toml"), *options, "--json")
    assert result.code == 2
    assert result.json["status"] == "error"
    assert says in result.json["message"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["delta", "--sections", "4"], "--sections goes with --space cartesian"),
        (["delta", "--space", "cartesian", "--sections", "4", "--scene", "circle"], "and without --scene"),
        (["delta", "--space", "cartesian", "--sections", "99"], "sections = 99: expected 2 to 24"),
        (["five_bar", "--space", "cartesian", "--sections", "4"], "map two coordinates instead"),
    ],
)
def test_invalid_sections_are_refused(words, says):
    result = ckc("map", *words)
    assert (result.code, result.out) == (2, "")
    assert says in result.err


def test_unknown_point_is_refused():
    result = ckc("map", "n_four_bar", "--space", "cartesian", "--point", "nowhere")
    assert result.code == 2
    assert result.out == ""
    assert result.err.count("\n") == 1


def test_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    result = ckc("map", "five_bar", "--out", str(tmp_path / "file"))
    assert result.code == 2
    assert "no folder that can be written to" in result.err


def test_distances_of_a_section_are_said_to_be_within_it():
    """Of three freedoms two are axes, and the motion is not in the section; of two freedoms none is fixed."""
    section = ckc("map", "three_rrr", "--cells", "16", "--scene", "circle")
    assert "within section (rad)" in section.out
    assert "over the axes only, within this section (a_3 = 3.514)." in " ".join(section.out.split())
    assert "nearest singular phi_z in all of q: 0.166347 rad, type 2, at t =" in " ".join(section.out.split())
    whole = ckc("map", "five_bar", "--cells", "16", "--scene", "set_point")
    assert "distance (rad)" in whole.out
    assert "section" not in whole.out
    assert "in all of q: 0.939215 rad, type 2, at t = 0.00000 s from desired" in " ".join(whole.out.split())
    for words, within in (("three_rrr", "circle"), True), (("five_bar", "set_point"), False):
        name, scene = words
        assert ckc("map", name, "--cells", "16", "--scene", scene, "--json").json["desired"]["within_section"] is within
