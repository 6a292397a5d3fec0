"""The command `ckc import`: files and output, refused input, and published robots if they are available."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from tests.contract.helpers.bad import Bad, expect
from tests.contract.helpers.command import ckc

ROBOTS = Path(__file__).resolve().parents[2].parent / "shared" / "robots"

FOUR_BAR = """<mujoco model="linkage"><compiler angle="radian"/><worldbody>
<body name="crank"><joint name="a" axis="0 1 0" range="-2 2"/><geom type="box" size=".1 .1 .1"/>
  <body name="rod" pos="1 0 .5"><joint name="b" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/></body></body>
<body name="rocker" pos="2 0 -1"><joint name="c" axis="0 1 0" armature="0.1"/><geom type="box" size=".1 .1 .1"/></body>
</worldbody><equality><connect name="elbow" body1="rod" body2="rocker" anchor="1 0 -.5"/></equality></mujoco>
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "linkage.xml").write_text(FOUR_BAR, encoding="utf-8")
    return tmp_path


# --- files and output -----------------------------------------------------------------------------------------------


def test_imported_mechanism_passes_check(folder: Path) -> None:
    done = ckc("import", "linkage.xml")
    assert (done.code, done.err) == (0, "")
    for line in ("written: linkage/mechanism.toml", "written: linkage/linkage.urdf", "guessed: ranges are hard stops"):
        assert line in done.out
    text = (folder / "linkage" / "mechanism.toml").read_text(encoding="utf-8")
    assert text.startswith("# Imported from linkage.xml, a MuJoCo model.")
    assert '[[joint]]\nname = "a"\nstops = true\n' in text
    assert '[[joint]]\nname = "c"\narmature = 0.1\n' in text
    check = ckc("check", "linkage", "--json").json
    assert (check["n"], check["rows"], check["rank"], check["d"]) == (3, 3, 2, 1)


def test_json_has_files_notes_and_check(folder: Path) -> None:
    result = ckc("import", "linkage.xml", "--out", "there/deep", "--json").json
    assert set(result) == {"status", "format", "written", "warnings", "left_out", "guessed", "check"}
    assert result["format"] == "linkage.xml, a MuJoCo model"
    assert result["written"] == [
        f"there/deep/{file}" for file in ("mechanism.toml", "linkage.urdf", "default.scene.toml")
    ]
    assert result["left_out"] == []
    assert result["guessed"] == ["ranges are hard stops without rebound; in MuJoCo they are soft: a"]
    check = ckc("check", "there/deep", "--json").json
    assert result["check"] == {"status": "done", **check}


def test_robot_that_cannot_be_assembled_is_written(folder: Path) -> None:
    far = FOUR_BAR.replace("<connect", "<weld").replace('anchor="1 0 -.5"', 'relpose="9 0 0 1 0 0 0"')
    (folder / "far.xml").write_text(far, encoding="utf-8")
    result = ckc("import", "far.xml", "--json")
    assert result.code == 0
    assert result.json["check"]["status"] == "error"
    assert "not closed: nearest miss" in result.json["check"]["message"]
    assert "not closed" in ckc("import", "far.xml", "--out", "again").out
    assert (folder / "far" / "mechanism.toml").is_file()


def test_existing_files_are_kept_without_overwrite(folder: Path) -> None:
    ckc("import", "linkage.xml")
    file = folder / "linkage" / "mechanism.toml"
    file.write_text("mine", encoding="utf-8")
    refused = ckc("import", "linkage.xml")
    assert refused.code == 2
    files = ("mechanism.toml", "linkage.urdf", "default.scene.toml")
    assert f"{', '.join(f'linkage/{name}' for name in files)}: there already" in refused.err
    assert "--overwrite" in refused.err
    assert file.read_text(encoding="utf-8") == "mine"
    assert ckc("import", "linkage.xml", "--overwrite").code == 0
    assert file.read_text(encoding="utf-8").startswith("# Imported")


NAMES = [
    'a "quoted" name',
    "back\\slash",
    "with.dot",
    "名前",
    "new&#10;line",
    "tab&#9;bed",
    "x = 1 # no comment",
    "del\x7f",
]


@pytest.mark.parametrize("name", NAMES)
def test_any_name_is_written_as_valid_toml_and_urdf(folder: Path, name: str) -> None:
    """Names are untrusted input: quotes, control characters and TOML syntax in them must be escaped."""
    quoted = name.replace('"', "&quot;")
    text = FOUR_BAR.replace('name="a"', f'name="{quoted}" ref="0.2" armature="0.1"').replace(
        'name="elbow"', f'name="{quoted}"'
    )
    text = text.replace("</mujoco>", f'<actuator><motor joint="{quoted}"/></actuator></mujoco>')
    text = text.replace('model="linkage"', f'model="{quoted}"')
    (folder / "odd.xml").write_text(text, encoding="utf-8")
    assert ckc("import", "odd.xml", "--out", "odd").code == 0
    meant = name.replace("&#10;", "\n").replace("&#9;", "\t")
    content: dict[str, Any] = tomllib.loads((folder / "odd" / "mechanism.toml").read_text(encoding="utf-8"))
    assert content["actuated"] == [meant]
    assert content["q_guess"] == {meant: 0.2}
    assert [loop["name"] for loop in content["loop"]] == [meant]
    assert meant in ckc("check", "odd", "--json").json["coordinates"]


def test_file_with_a_generic_name_takes_the_name_of_its_folder(folder: Path) -> None:
    (folder / "my robot").mkdir()
    (folder / "my robot" / "robot.xml").write_text(FOUR_BAR, encoding="utf-8")
    assert ckc("import", "my robot/robot.xml", "--json").json["written"][0] == "my_robot/mechanism.toml"


# --- refused input ----------------------------------------------------------------------------------------------


def mjcf(body: str = "", rest: str = "", file: str = "m.xml") -> dict[str, str]:
    return {file: f"<mujoco><worldbody>{body}</worldbody>{rest}</mujoco>"}


def urdf(content: str, **others: str) -> dict[str, str]:
    links = '<link name="base"/><link name="arm"/><joint name="j" type="revolute"><parent link="base"/>'
    return {
        "r.urdf": f'<robot name="r">{links}<child link="arm"/><axis xyz="0 0 1"/></joint>{content}</robot>',
        **{name.replace("_", "."): text for name, text in others.items()},
    }


BODY = "<body name='b'><joint name='j'/><geom size='.1'/></body>"
FREE_BELOW = "<body><body name='c'><freejoint/><geom size='.1'/></body></body>"
MESH, MESH_ASSET = "<body><joint/><geom type='mesh' mesh='m'/></body>", "<asset><mesh file='m.stl'/></asset>"
FINE = "<asset><mesh builtin='sphere' params='1000000'/></asset>"
CABLE = "<equality><weld body1='B_last'/></equality>"
BAD_MODEL = "<mujoco><worldbody><body pos='0 up'/></worldbody></mujoco>"
SUBMODEL = "<asset><model file='n.xml'/></asset>"
BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><mujoco>&b;</mujoco>'
X, R = ["import", "m.xml"], ["import", "r.urdf"]
LOOP = '<loop name="l" type="{}"><predecessor link="{}"/><successor link="base"/>{}</loop>'
GEAR = '<coupling name="g"><predecessor link="{}"/><successor link="base"/>{}</coupling>'

CASES = [
    Bad("no file", ["import", "nowhere.xml"], ["nowhere.xml: no such robot file"]),
    Bad("a folder", ["import", "d"], ["d: a folder"], files={"d/x": ""}),
    Bad("not XML", X, ["m.xml: malformed XML"], files={"m.xml": "solid"}),
    Bad("not text", X, ["m.xml", "not UTF-8"], files={"m.xml": b"\xff\xfe\x00"}),
    Bad("an entity bomb", X, ["document type declaration (x) is not accepted"], files={"m.xml": BOMB}),
    Bad("deep XML", X, ["nested more than 300 deep"], files={"m.xml": "<body>" * 1000 + "</body>" * 1000}),
    Bad("another XML", X, ["root element is <svg>", "<robot> (URDF) or <sdf>"], files={"m.xml": "<svg/>"}),
    Bad(
        "another YAML", ["import", "x.yaml"], ["have to be a robot.yaml or a loop_closures.yaml"], files={"x.yaml": ""}
    ),
    Bad(
        "a yaml alone",
        ["import", "robot.yaml"],
        ["expected one URDF", "got none"],
        files={"robot.yaml": ""},
    ),
    Bad("a folder that cannot be made", [*X, "--out", "m.xml/x"], ["m.xml/x: cannot be written"], files=mjcf(BODY)),
    # MJCF: refused by MuJoCo's compiler, with the name of the element
    Bad("global coordinates", X, ["<compiler>", "coordinate"], files=mjcf("", "<compiler coordinate='global'/>")),
    Bad("unknown unit", X, ["<compiler>", "'gon'"], files=mjcf("", "<compiler angle='gon'/>")),
    Bad("bad sequence", X, ["euler sequence"], files=mjcf("<body euler='1 2 3'/>", "<compiler eulerseq='xyq'/>")),
    Bad("unknown class", X, ["<joint> 'j'", "class name 'k'"], files=mjcf("<body><joint name='j' class='k'/></body>")),
    Bad("class without name", X, ["<default>", "empty class"], files=mjcf("", "<default><default/></default>")),
    Bad("unknown joint type", X, ["<joint>", "'screw'"], files=mjcf("<body><joint type='screw'/></body>")),
    Bad("unknown element", X, ["<jiont> 'j'", "unrecognized"], files=mjcf("<body><jiont name='j'/></body>")),
    Bad("two of one name", X, ["<joint> 'j'"], files=mjcf("<body><joint name='j'/><joint name='j'/></body>")),
    Bad("two bodies of one name", X, ["<body> 'b'", "repeated"], files=mjcf(BODY + "<body name='b'/>")),
    Bad("a word for a number", X, ["pos='0 0 up'", "bad format"], files=mjcf("<body pos='0 0 up'/>")),
    Bad("not a number", X, ["<body> 'b'", "pos='0 0 nan'"], files=mjcf("<body name='b' pos='0 0 nan'/>")),
    Bad("a number too large", X, ["stiffness='1e200'"], files=mjcf("<body><joint stiffness='1e200'/></body>")),
    Bad("too few numbers", X, ["quat='1 0'", "enough data"], files=mjcf("<body quat='1 0'/>")),
    Bad("no rotation", X, ["quat='0 0 0 0'", "zero"], files=mjcf("<body quat='0 0 0 0'/>")),
    Bad("no axis", X, ["<joint> 'j'", "axis"], files=mjcf("<body><joint name='j' axis='0 0 0'/></body>")),
    Bad("no size", X, ["<geom> 'g'", "size"], files=mjcf("<body><geom name='g' type='box'/></body>")),
    Bad("negative size", X, ["size='-1'", "positive"], files=mjcf("<body><geom size='-1'/></body>")),
    Bad("no mass", X, ["<body> 'b'", "mass and inertia"], files=mjcf("<body name='b'><joint/></body>")),
    Bad("a free joint below", X, ["<body> 'c'", "free joint"], files=mjcf(FREE_BELOW)),
    Bad("no such body", X, ["body1='q'", "there are b"], files=mjcf(BODY, "<equality><weld body1='q'/></equality>")),
    Bad("no such site", X, ["site1='q'"], files=mjcf(BODY, "<equality><weld site1='q' site2='q'/></equality>")),
    Bad("nothing to connect", X, ["<connect>", "body1"], files=mjcf(BODY, "<equality><connect/></equality>")),
    Bad("no anchor", X, ["<connect>", "anchor"], files=mjcf(BODY, "<equality><connect body1='b'/></equality>")),
    Bad("no such joint", X, ["'q'", "there are j"], files=mjcf(BODY, "<equality><joint joint1='q'/></equality>")),
    Bad("a motor on nothing", X, ["'q'", "there are j"], files=mjcf(BODY, "<actuator><motor joint='q'/></actuator>")),
    Bad("neither true nor false", X, ["active='yes'"], files=mjcf(BODY, "<equality><weld active='yes'/></equality>")),
    Bad("bad solid", X, ["<mesh> 'm'", "m.stl"], files=mjcf(MESH, MESH_ASSET) | {"m.stl": "version of a pointer"}),
    Bad("a cable", X, ["'B_last'", "not read: <composite>"], files=mjcf("<composite/>" + BODY, CABLE)),
    # MJCF: refused before MuJoCo reads it
    Bad("an include from outside", X, ["file='../../../x'", "repository"], files=mjcf("<include file='../../../x'/>")),
    Bad("an include of itself", X, ["'m.xml' is included twice"], files=mjcf("<include file='m.xml'/>")),
    Bad("an include of nothing", X, ["n.xml: no such MuJoCo model"], files=mjcf("<include file='n.xml'/>")),
    Bad("a model from outside", X, ["file='../../../x'"], files=mjcf("", "<asset><model file='../../../x'/></asset>")),
    Bad("a model of itself", X, ["cannot contain itself"], files=mjcf("", "<asset><model file='m.xml'/></asset>")),
    Bad(
        "a bad model",
        X,
        ["n.xml: <body>", "'0 up'"],
        files=mjcf("", SUBMODEL) | mjcf("<body pos='0 up'/>", "", "n.xml"),
    ),
    Bad("too many", X, ["1000000 bodies", "1000 and"], files=mjcf(f"<replicate count='1000000'>{BODY}</replicate>")),
    Bad(
        "a fine mesh",
        X,
        ["params='1000000'"],
        files=mjcf("", FINE),
    ),
    # URDF
    Bad("an unknown property", R, ["xacro cannot expand it", "'x'"], files=urdf('<link name="${x}"/>')),
    Bad("two roots", R, ["roots found: 'base', 'lost'"], files=urdf('<link name="lost"/>')),
    Bad(
        "unknown loop",
        R,
        ["unsupported type 'screw'", "one of revolute"],
        files=urdf(LOOP.format("screw", "arm", "")),
    ),
    Bad("loop from nothing", R, ["predecessor 'x' is not a link"], files=urdf(LOOP.format("revolute", "x", ""))),
    Bad(
        "loop about nothing",
        R,
        ["a direction"],
        files=urdf(LOOP.format("revolute", "arm", '<axis xyz="0 0 0"/>')),
    ),
    Bad("loop about a word", R, ["xyz='up'"], files=urdf(LOOP.format("revolute", "arm", '<axis xyz="up"/>'))),
    Bad("coupling from nothing", R, ["coupling 'g': predecessor 'x' is not a link"], files=urdf(GEAR.format("x", ""))),
    Bad("coupling by nothing", R, ["coupling 'g': expected <ratio> with a number"], files=urdf(GEAR.format("arm", ""))),
    Bad(
        "neither independent nor not",
        R,
        ["independent='maybe'"],
        files=urdf(
            '<link name="i"/><joint name="k" '
            'type="revolute" independent="maybe"><parent link="arm"/><child link="i"/></joint>'
        ),
    ),
    # robot.yaml
    Bad("broken YAML", R, ["robot.yaml: malformed YAML"], files=urdf("", robot_yaml="a: [b")),
    Bad("YAML without a table", R, ["robot.yaml: expected a table"], files=urdf("", robot_yaml="- a")),
    Bad("YAML aliases", R, ["anchors and aliases"], files=urdf("", robot_yaml="type: &a [3d]\nname_mot: *a")),
    Bad(
        "YAML objects",
        R,
        ["robot.yaml: malformed YAML"],
        files=urdf("", robot_yaml="type: !!python/object:os.system x"),
    ),
    Bad("large YAML", R, ["more than 65536"], files=urdf("", robot_yaml="#" * 70000)),
    Bad("deep YAML", R, ["nested more than 20 deep"], files=urdf("", robot_yaml="[" * 60000)),
    Bad("deep YAML on a line", R, ["nested more than 20 deep"], files=urdf("", robot_yaml="- " * 30000)),
    Bad("a loop of one frame", R, ["robot.yaml", "closed_loop"], files=urdf("", robot_yaml="closed_loop: [[base]]")),
    Bad(
        "loop to nothing",
        R,
        ["no link or joint 'arn'; did you mean arm?"],
        files=urdf("", robot_yaml="closed_loop: [[base, arn]]"),
    ),
    Bad("unknown loop type", R, ["type '5d'"], files=urdf("", robot_yaml="closed_loop: [[base, arm]]\ntype: [5d]")),
    Bad(
        "a type too many",
        R,
        ["1 entries but joint_type has 0"],
        files=urdf("", robot_yaml="joint_name: [j]"),
    ),
    Bad(
        "unknown joint to stand for",
        R,
        ["joint_type 'BALL' of j"],
        files=urdf("", robot_yaml="joint_name: [j]\njoint_type: [BALL]"),
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_bad_file_is_refused(case: Bad, bar: Path) -> None:
    expect(case, bar)


def test_robot_yaml_needs_pyyaml(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in urdf("", robot_yaml="name_mot: [j]").items():
        (folder / name).write_text(text, encoding="utf-8")
    monkeypatch.setitem(sys.modules, "yaml", None)
    refused = ckc("import", "r.urdf")
    assert refused.code == 2
    assert "robot.yaml: reading it needs PyYAML" in refused.err


# --- scenes and import in memory --------------------------------------------------------------------------------------

KEYS = '<keyframe><key qpos="0.1 -0.2 0.1"/><key name="a/b" qpos="-0.3 0 0.2"/></keyframe></mujoco>'


def test_imported_folder_can_be_run(folder: Path) -> None:
    ckc("import", "linkage.xml")
    outcome = ckc("run", "linkage", "--json").json
    assert (outcome["status"], outcome["t"]) == ("done", 1.0)


def test_key_frames_are_the_guess_and_scenes(folder: Path) -> None:
    """The first key frame is where assembly starts, each other one is a scene that starts there."""
    (folder / "keys.xml").write_text(FOUR_BAR.replace("</mujoco>", KEYS), encoding="utf-8")
    imported = ckc("import", "keys.xml", "--json").json
    written = imported["written"]
    assert any("key frame 'a/b' starts where the loops close" in note for note in imported["guessed"])
    assert written[2:] == ["keys/default.scene.toml", "keys/a_b.scene.toml"]
    content: dict[str, Any] = tomllib.loads((folder / "keys" / "mechanism.toml").read_text(encoding="utf-8"))
    assert content["q_guess"] == {"a": 0.1, "b": -0.2, "c": 0.1}
    scene: dict[str, Any] = tomllib.loads((folder / "keys" / "a_b.scene.toml").read_text(encoding="utf-8"))
    q = scene["initial"]["q"]
    turns = np.cumsum([0.0, q["a"], q["b"]])[1:]  # of the crank and of the rod; the rocker's tip is at 1 in its z
    crank = np.array([np.cos(turns[0]) + 0.5 * np.sin(turns[0]), 0.5 * np.cos(turns[0]) - np.sin(turns[0])])
    rod = np.array([np.cos(turns[1]) - 0.5 * np.sin(turns[1]), -0.5 * np.cos(turns[1]) - np.sin(turns[1])])
    rocker = np.array([2 + np.sin(q["c"]), -1 + np.cos(q["c"])])
    assert np.abs(crank + rod - rocker).max() < 1e-9
    assert np.abs([q["a"] + 0.3, q["b"], q["c"] - 0.2]).max() < 0.7
    assert ckc("run", "keys/a_b", "--json").json["status"] == "done"


def test_key_frame_of_another_model_is_left_out(folder: Path) -> None:
    keys = KEYS.replace("0.1 -0.2 0.1", "0.1 -0.2 0.1 7")
    (folder / "keys.xml").write_text(FOUR_BAR.replace("</mujoco>", keys), encoding="utf-8")
    result = ckc("import", "keys.xml", "--json").json
    assert any("key frames are left out" in note for note in result["guessed"])
    assert result["check"]["d"] == 1


def test_foreign_file_is_used_without_import(folder: Path) -> None:
    """The notes are on stderr, and the results are those of the imported mechanism. Nothing is written."""
    ckc("import", "linkage.xml")
    checked = ckc("check", "linkage.xml", "--json")
    assert checked.json == ckc("check", "linkage", "--json").json
    assert checked.err.startswith("note: linkage.xml is imported as linkage.xml, a MuJoCo model\n  guessed: ranges are")
    run, same = (ckc("run", what, "--json").json for what in ("linkage.xml", "linkage"))
    assert run["q_tree"] == same["q_tree"]
    with pytest.warns(UserWarning, match="is imported as"):
        mechanism = ckc_pin.load("linkage.xml")
    assert mechanism.coordinates == ("a", "b", "c")
    with pytest.warns(UserWarning, match="is imported as"):
        finished = ckc_pin.simulate("linkage.xml", {"t_end": 0.1})
    assert finished.status == "done"
    with pytest.warns(UserWarning, match="is imported as"):
        scene = ckc_pin.Scene(ckc_pin.load(folder / "linkage.xml"), t_end=0.1)
    assert ckc_pin.simulate(scene).status == "done"
    assert sorted(path.name for path in folder.iterdir()) == ["linkage", "linkage.xml"]
    refused = ckc("check", "nowhere.xml")
    assert (refused.code, "nowhere.xml" in refused.err) == (2, True)


def test_repair_is_offered_and_done(folder: Path) -> None:
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="-0.5" ixy="0" ixz="0" iyz="0"/></inertial>'
    for name, text in urdf("").items():
        (folder / name).write_text(
            text.replace('<link name="arm"/>', f'<link name="arm">{body}</link>'), encoding="utf-8"
        )
    refused = ckc("import", "r.urdf")
    assert (refused.code, "--repair" in refused.err, (folder / "r").exists()) == (2, True, False)
    repaired = ckc("import", "r.urdf", "--repair")
    assert repaired.code == 0
    assert "guessed: repaired: principal moments of link arm" in repaired.out


# --- published robots ---------------------------------------------------------------------------------------------

# coordinates, rows, rank and freedoms: those of the motors and of rods that spin about their own axes
PUBLISHED = {
    "example-parallel-robots/5bar_linkage_iso3d/robot.yaml": (5, 3, 3, 2),
    "example-parallel-robots/cassie_like/robot.urdf": (19, 12, 12, 5 + 2),
    "example-parallel-robots/robot_delta/robot.yaml": (14, 18, 9, 2 + 3),
    "example-parallel-robots/talos_like/robot.yaml": (13, 6, 6, 6 + 1),
    "generalized_rbda/four_bar.urdf": (3, 5, 2, 1),
    "generalized_rbda/six_bar.urdf": (5, 5, 2, 3),
}


@pytest.mark.skipif(not ROBOTS.is_dir(), reason="the folder of published robots is not beside the project")
@pytest.mark.parametrize("file", PUBLISHED)
def test_published_robots_are_imported(file: str, folder: Path) -> None:
    check = ckc("import", str(ROBOTS / file), "--out", "robot", "--json").json["check"]
    assert check["status"] == "done", check
    assert (check["n"], check["rows"], check["rank"], check["d"]) == PUBLISHED[file]
