"""Mechanism files and URDFs with something wrong in them: exit 2, one message, nothing from urdfdom beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from ckc_pin import InputError, load
from tests.contract.helpers.bad import Bad, expect

CHECK = ("check", "bar")
NAMED = "bar/mechanism.toml: "
LINKS = "there are base, link_1, link_2, link_3, link_4, tip_left, tip_right"
COORDINATES = "there are theta_1, theta_2, theta_3, theta_4"
INDEPENDENT = '["theta_1", "theta_3"]'
FINITE = "expected a finite number"


def _edit(what: str, old: str, new: str, *says: str) -> Bad:
    """Whatever is wrong in the file, the message begins with the file."""
    return Bad(what, CHECK, (f"error: {NAMED}", *says), {"mechanism.toml": (old, new)})


def _add(what: str, entry: str, *says: str) -> Bad:
    return _edit(what, "[[point]]", f"{entry}\n[[point]]", *says)


def _motor(what: str, entry: str, *says: str) -> Bad:
    return _edit(what, f"actuated = {INDEPENDENT}", f"[[motor]]\n{entry}\n", *says)


def _file(what: str, content: str | bytes, *says: str) -> Bad:
    return Bad(what, CHECK, says, files={"bar/mechanism.toml": content})


def _named(what: str, content: str, *says: str) -> Bad:
    return _file(what, f'name = "o"\n{content}\n', *says)


def _coupling(more: str = "") -> str:
    return f'[[coupling]]\njoint = "theta_1"\nother = "theta_3"\n{more}'


FILES = [
    _file("malformed", "name = \n", f"{NAMED}malformed TOML", "line 1"),
    _file("empty", "", f"{NAMED}the key 'name' is missing"),
    _file("binary", b"\x00\xff\xfe", f"{NAMED}not a mechanism file, not UTF-8 text (byte 1)"),
    _file("nested without end", f"x = {'[' * 100_000}", "malformed TOML: nested too deeply"),
    _file("a number of 5000 digits", f"name = 1{'0' * 5000}", "malformed TOML"),
    _file("17 MiB", b"#" * (17 * 2**20), f"{NAMED}larger than 16 MiB"),
    _file("a URDF", "<robot/>", "malformed TOML", "this is XML: a URDF is named in a mechanism.toml"),
    _file("a name that is empty", 'name = ""', "name = '': expected a string that is not empty"),
    _file("a name that is a number", "name = 3", "name = 3: expected a string, got an integer"),
    _edit("an unknown key", "gravity", "gravty", f"{NAMED}unknown key 'gravty'; valid: name, urdf, tree, gravity"),
    _named("no urdf", "", f'{NAMED}give either urdf = "FILE" or [[tree]] entries'),
    _named("urdf and tree", 'urdf = "a"\n[[tree]]\nfile = "b"', "give either urdf"),
    _named("a missing urdf", 'urdf = "nope.urdf"', "bar/nope.urdf: no such"),
    _named("a folder for a urdf", 'urdf = "."', "bar: a folder or a device, not a"),
    _named("a device for a urdf", 'urdf = "/dev/zero"', "/dev/zero: a folder or a device, not a"),
    _named("a urdf of no possible name", 'urdf = "a\\u0000b"', "not a valid file name"),
    _named("an unknown package", 'urdf = "package://nope/x.urdf"', "no package 'nope' is installed"),
    _named(
        "gravity of two numbers", "gravity = [0.0, 1.0]", "gravity = [0.0, 1.0]: expected a list of 3, got a list of 2"
    ),
    _named("gravity of one number", "gravity = 9.81", "gravity = 9.81: expected a list, got a number"),
    _named("gravity with nan", 'urdf = "five_bar.urdf"\ngravity = [0.0, nan, 0.0]', f"gravity[1] = nan: {FINITE}"),
    _named("tree root", '[[tree]]\nfile = "five_bar.urdf"\nroot = "loose"', "tree[0].root = 'loose'; valid: 'fixed'"),
    _named("tree parent", '[[tree]]\nfile = "five_bar.urdf"\nparent = "floor"', "five_bar.urdf: its parent 'floor' is"),
    _named(
        "two trees of the same names",
        '[[tree]]\nfile = "five_bar.urdf"\n[[tree]]\nfile = "five_bar.urdf"',
        "five_bar.urdf: link 'base' is already in an earlier tree; give this [[tree]] a prefix",
    ),
]

LOOPS = [
    _edit("loop key", "rows_in", "row_in", "loop[0]: unknown key 'row_in'; valid: name, type, frame_a", "rows_in"),
    _edit("loop type", "point_2d", "point2d", "loop[0].type = 'point2d'; valid: 'cylindrical', 'distance', 'hinge'"),
    _edit("no loop type", 'type = "point_2d"', "", "loop[0]: the key 'type' is missing; valid: 'cylindrical'"),
    _edit("rows_in", 'in = "world"', 'in = "b"', "loop[0].rows_in = 'b'; valid: 'a', 'world'"),
    _edit("loop frame", '"tip_left"', '"tip"', "loop 'elbow', frame_a: no link 'tip'", LINKS),
    _edit("loop joint frame", '"tip_left"', '"joint:tip"', "loop 'elbow', frame_a: no joint 'tip'", "theta_1"),
    _edit("loop frame table", '"tip_left"', '{link = "tip"}', "loop 'elbow', frame_a: no link 'tip'", LINKS),
    _edit("loop frame key", '"tip_left"', '{lnk = "tip"}', "loop[0].frame_a: unknown key 'lnk'; valid: link, xyz, rpy"),
    _edit("loop frame number", '"tip_left"', "3", "loop[0].frame_a = 3: expected a string or a table"),
    _edit("loop frame at nan", '"tip_left"', '{link = "base", xyz = [0.0, nan, 0.0]}', f"xyz[1] = nan: {FINITE}"),
    _edit("loop on one body", '"tip_left"', '"link_4"', "loop 'elbow': frames A and B belong to the same rigid body"),
    _add(
        "two loops of one name",
        '[[loop]]\nname = "elbow"\ntype = "point"\nframe_a = "base"\nframe_b = "link_2"',
        "loop 'elbow': two loops have this name",
    ),
    _edit("zero loop axis", "rows_in", "axis_a = [0.0, 0.0, 0.0]\nrows_in", "loop 'elbow', axis_a", "not all zero"),
    _edit("length of a point", "rows_in", "length = 1.0\nrows_in", "'point_2d' has no key length"),
    _edit("distance without length", '"point_2d"', '"distance"', "loop 'elbow': type 'distance' needs the key length"),
    _edit("length zero", "rows_in", "length = 0.0\nrows_in", "loop[0].length = 0.0: expected a number greater than 0"),
    _edit(
        "a loop that cannot close",
        '"tip_right"',
        '{link = "tip_right", xyz = [5.0, 0.0, 0.0]}',
        f"{NAMED}not closed: nearest miss 3.02 m at loop elbow",
        "[q_guess]",
    ),
    _add("coupling of nothing", '[[coupling]]\njoint = "theta_1"\nother = "x"\nratio = 1.0', "'x'", COORDINATES),
    _add("coupling to itself", '[[coupling]]\njoint = "theta_1"\nother = "theta_1"\nratio = 1.0', "to itself"),
    _add("coupling without ratio", _coupling(), "coupling 'theta_1~theta_3': give one of ratio, polynomial and table"),
    _add("coupling with two curves", _coupling("ratio = 1.0\npolynomial = [0.0, 1.0]"), "got ratio and polynomial"),
    _add("coupling of one joint", '[[coupling]]\njoint = "theta_1"\nratio = 1.0', "give joint and other, or joints"),
    _add("coupling of two forms", _coupling("joints = {theta_1 = 1.0}"), "give either joints, or joint and other"),
    _add(
        "coupling of zeros", "[[coupling]]\njoints = {theta_1 = 0.0}", "coupling 'theta_1': all coefficients are zero"
    ),
    _add("coupling of unknowns", "[[coupling]]\njoints = {x = 1.0}", "'x'", COORDINATES),
    _add("a table that turns back", _coupling("table = [[0, 0], [2, 1], [1, 2]]"), "but 1 follows 2"),
    _add("a table of two points", _coupling("table = [[0, 0], [2, 1]]"), "expected 3 to 500 points, got 2"),
    _add("a table that is no table", _coupling("table = [[0, 0, 1]]"), "expected a list of 2, got a list of 3"),
    _add("a polynomial of infinities", _coupling("polynomial = [0.0, inf]"), FINITE),
    _add("couplings of one name", 2 * (_coupling('name = "g"\nratio = 1.0') + "\n"), "have the same name 'g'"),
    _add("a coupling named as a loop", _coupling('name = "elbow"\nratio = 1.0'), "have the same name 'elbow'"),
    _add("spring on nothing", "[[spring]]\nstiffness = 1.0", "spring 1: give either joint, or frame_a and frame_b"),
    _add("spring on an unknown joint", '[[spring]]\njoint = "x"\nstiffness = 1.0', "'x'", COORDINATES),
    _add(
        "negative spring",
        '[[spring]]\njoint = "theta_1"\nstiffness = -1.0',
        "stiffness = -1.0: expected a number of at",
    ),
    _add(
        "damper and spring on a joint",
        '[[spring]]\njoint = "theta_1"\ndamping = 1.0\n[[spring]]\njoint = "theta_1"\nstiffness = 1.0',
        "two springs on joint 'theta_1'; give one with their stiffness and damping",
    ),
    _add("force on nothing", '[[force]]\njoint = "x"\nvalue = 1.0', "'x'", COORDINATES),
    _edit("point frame", 'frame = "tip_left"\n', 'frame = "x"\n', "point 'tip': no link 'x'", LINKS),
]


def _joint(what: str, keys: str, *says: str) -> Bad:
    return _add(what, f"[[joint]]\n{keys}", *says)


LIMITED = ('"theta_1" type="continuous">', '"theta_1" type="revolute"><limit lower="0.5" upper="0.5"/>')

JOINTS = [
    _joint(
        "negative armature",
        'name = "theta_1"\narmature = -0.1',
        "joint[0].armature = -0.1: expected a number of at least 0",
    ),
    _joint(
        "negative friction",
        'name = "theta_1"\nfriction = -1.0',
        "joint[0].friction = -1.0: expected a number of at least 0",
    ),
    _joint(
        "negative damping",
        'name = "theta_1"\ndamping = -1.0',
        "joint[0].damping = -1.0: expected a number of at least 0",
    ),
    _joint(
        "friction of nan",
        'name = "theta_1"\nfriction = nan',
        "joint[0].friction = nan: expected a number of at least 0",
    ),
    _joint(
        "restitution above 1",
        'name = "theta_1"\nstops = true\nrestitution = 1.5',
        "joint[0].restitution = 1.5: expected a number of at least 0 and at most 1",
    ),
    _joint(
        "restitution below 0",
        'name = "theta_1"\nstops = true\nrestitution = -0.5',
        "joint[0].restitution = -0.5: expected a number of at least 0 and at most 1",
    ),
    _joint("stops in words", 'name = "theta_1"\nstops = "yes"', "joint[0].stops = 'yes': expected true or false"),
    _joint(
        "stops without limits",
        'name = "theta_1"\nstops = true',
        "joint 'theta_1': stops = true, but its URDF gives no limits",
    ),
    Bad(
        "stops without room",
        CHECK,
        ["joint 'theta_1': stops = true, but both its limits are 0.5"],
        {
            "five_bar.urdf": LIMITED,
            "mechanism.toml": ("[[point]]", '[[joint]]\nname = "theta_1"\nstops = true\n[[point]]'),
        },
    ),
    _joint(
        "restitution without stops",
        'name = "theta_1"\nrestitution = 0.5',
        "joint 'theta_1': a restitution goes with stops = true",
    ),
    _joint(
        "a joint twice",
        'name = "theta_1"\nfriction = 1.0\n[[joint]]\nname = "theta_1"\narmature = 1.0',
        "joint: 'theta_1' is given twice",
    ),
    _joint("an unknown joint", 'name = "x"\nfriction = 1.0', "joint: no joint of one freedom called 'x'", COORDINATES),
    _joint("a fixed joint", 'name = "tip_left_fixed"', "no joint of one freedom called 'tip_left_fixed'", COORDINATES),
    _joint("a joint without name", "friction = 1.0", "joint[0]: the key 'name' is missing"),
    _joint("a joint's unknown key", 'name = "theta_1"\nfricton = 1.0', "unknown key 'fricton'", "mean 'friction'?"),
]

COORDINATE_CHOICES = [
    _edit("unknown independent", INDEPENDENT, '["theta_1", "x"]', "independent: no coordinate 'x'", COORDINATES),
    _edit("too few independent", INDEPENDENT, '["theta_1"]', "independent: 1 coordinates (theta_1)", "d = 2"),
    _edit("too many independent", INDEPENDENT, '["theta_1", "theta_2", "theta_3"]', "3 coordinates", "d = 2", "do"),
    _edit("none independent", INDEPENDENT, "[]", "independent: 0 coordinates (none)", "d = 2"),
    _edit("independent twice", INDEPENDENT, '["theta_1", "theta_1"]', "independent: a coordinate is named twice"),
    _edit("independent as a string", INDEPENDENT, '"theta_1"', "independent = 'theta_1': expected a list"),
    _edit("unknown actuated", f"actuated = {INDEPENDENT}", 'actuated = ["x"]', "actuated: no coordinate 'x'"),
    _edit("actuated twice", f"actuated = {INDEPENDENT}", 'actuated = ["theta_1", "theta_1"]', "actuated: a joint is"),
    _motor("motor on no joint", 'joint = "x"', "motor 'x': no joint of one freedom called 'x'; there are theta_1"),
    _motor("motor on nothing", 'name = "x"', "motor 'x': give either joint, or joints, a table of numbers by joint"),
    _motor(
        "motor on both", 'joint = "theta_1"\njoints = {theta_3 = 1.0}', "motor 'theta_1': give either joint, or joints"
    ),
    _motor("motor without a name", "joints = {theta_1 = 1.0}", "motor 1: give it a joint, or a name and joints"),
    _motor("motors of one name", 'joint = "theta_1"\n[[motor]]\njoint = "theta_1"', "two motors are called 'theta_1'"),
    _motor("motor that turns nothing", 'joint = "theta_1"\nratio = 0', "motor 'theta_1': its gear turns no joint"),
    _motor(
        "negative rotor",
        'joint = "theta_1"\nrotor_inertia = -1.0',
        "rotor_inertia = -1.0: expected a number of at least 0",
    ),
    _motor(
        "limit of nothing", 'joint = "theta_1"\ntorque_limit = 0', "torque_limit = 0: expected a number greater than 0"
    ),
    _motor("endless ratio", 'joint = "theta_1"\nratio = inf', f"motor[0].ratio = inf: {FINITE}"),
    _motor(
        "rotor on two joints beyond numbers",
        'name = "belt"\njoints = {theta_1 = 1.0, theta_3 = 1e200}\nrotor_inertia = 1e-3',
        "motor 'belt': ratio = 1 with rotor_inertia = 0.001 is too large",
    ),
    *(
        _motor(
            f"limits {limits}",
            f'joint = "theta_1"\ntorque_limit = {limits}',
            "motor 'theta_1': torque_limit: expected",
            "a lower limit of at most 0 and an upper one of at least 0",
        )
        for limits in ("[0.5, 3.0]", "[1.0, -1.0]", "[0.0, 0.0]")
    ),
    _motor("limits of three", 'joint = "theta_1"\ntorque_limit = [1, 2, 3]', "motor[0].torque_limit"),
    _motor("limits of words", 'joint = "theta_1"\ntorque_limit = "no"', "torque_limit = 'no': expected"),
    _motor("limits without end", 'joint = "theta_1"\ntorque_limit = [-inf, 1]', FINITE),
    _motor(
        "gear beyond numbers",
        'joint = "theta_1"\nratio = 1e200\nrotor_inertia = 1e-3',
        "motor 'theta_1': ratio = 1e+200 with rotor_inertia = 0.001 is too large",
    ),
    _add("motors in two ways", '[[motor]]\njoint = "theta_1"', "actuated, motor: give one of them"),
    _edit("unknown guess", "theta_4 = -0.248", "theta_5 = 1.0", "q_guess: no coordinate 'theta_5'", COORDINATES),
    _edit("guess of nan", "theta_4 = -0.248", "theta_4 = nan", f"{NAMED}q_guess.theta_4 = nan: {FINITE}"),
    _edit("guess in words", "theta_4 = -0.248", 'theta_4 = "a"', f"{NAMED}q_guess.theta_4 = 'a': expected a number"),
    Bad(
        "independent that cannot parametrise",
        CHECK,
        ["independent: geared cannot parametrise the mechanism", "(phi_z is singular there); loose would do"],
        files={
            # One joint is welded to the world, the second is geared to the first, only the third can turn.
            "bar/mechanism.toml": """
name = "held"
urdf = "p.urdf"
independent = ["geared"]
[[coupling]]
joint = "geared"
other = "welded"
ratio = 1.0
[[loop]]
name = "hold"
type = "weld"
frame_a = "b"
frame_b = "world"
""",
            "bar/p.urdf": """<robot name="p"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="welded" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
<joint name="geared" type="continuous"><parent link="a"/><child link="c"/><axis xyz="0 0 1"/></joint>
<joint name="loose" type="continuous"><parent link="a"/><child link="d"/><axis xyz="0 0 1"/></joint></robot>""",
        },
    ),
]


@pytest.mark.parametrize("case", [*FILES, *LOOPS, *JOINTS, *COORDINATE_CHOICES], ids=lambda case: case.what)
def test_bad_mechanism(case: Bad, bar: Path, capfd: pytest.CaptureFixture[str]) -> None:
    expect(case, bar)
    assert capfd.readouterr() == ("", "")


def test_a_name_too_long_for_a_file_is_no_mechanism() -> None:
    with pytest.raises(InputError, match=r"no mechanism 'xxx.*shipped: andrews"):
        load("x" * 5000)
