"""Bad gains, targets, trajectories and models: exit 2 and one message, before anything moves."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.helpers.bad import Bad, expect

NAMED = "bar/tracking.scene.toml: "
DESIRED = f"{NAMED}controller.desired"
FINITE = "expected a finite number"
JOINTS = "theta_1, theta_3"
SHAPES = (
    "controller.K_D: expected a number, a table by joint, a list of 2 numbers (the diagonal) or a 2 x 2 matrix "
    f"in the order {JOINTS}"
)
PENDULUM = """<robot name="p"><link name="a"/><link name="b"><inertial><mass value="1"/><origin xyz="1 0 0"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="swing" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"""


def _tracking(*overrides: str) -> tuple[str, ...]:
    return ("run", "bar/tracking.scene.toml", *(w for c in overrides for w in ("--set", f"controller.{c}")))


def _value(change: str, *says: str) -> Bad:
    return Bad(change[:60], _tracking(change), (f"error: {NAMED}", *says))


def _target(change: str, *says: str) -> Bad:
    """Whatever is wrong in a scene, the message begins with its file."""
    scene = "bar/set_point.scene.toml"
    return Bad(change[:60], ("run", scene, "--set", f"controller.{change}"), (f"error: {scene}: ", *says))


def _csv(what: str, content: str | bytes, *says: str) -> Bad:
    return Bad(f"csv: {what}", _tracking('desired={file="way.csv"}'), says, files={"bar/way.csv": content})


def _rows(*cells: str) -> str:
    return "\n".join(["t,theta_1,theta_3", *cells, ""])


def _way(first: int = 0, last: int = 10) -> list[str]:
    return [f"{k},0.1,0.2" for k in range(first, last + 1)]


GAINS = [
    _value("K_D=high", f"{NAMED}controller.K_D = 'high': expected a number, a table or a list, got a string"),
    _value("K_D=nan", f"{NAMED}controller.K_D = nan: {FINITE}"),
    _value("K_D=-1", "K_D is not positive definite: its smallest eigenvalue is -1"),
    _value("K_D=0", "K_D is not positive definite: its smallest eigenvalue is 0"),
    _value("K_D=[1.0, 2.0, 3.0]", f"{SHAPES}, got a list of 3 numbers"),
    _value("K_D=[1.0, [2.0, 3.0]]", f"{SHAPES}, got rows of different lengths"),
    _value("K_D=[]", f"{SHAPES}, got a list of 0 numbers"),
    _value("K_D=[[1.0]]", f"{SHAPES}, got a 1 x 1 matrix"),
    _value("K_D=[[1.0, 0.0], [1.0]]", f"{SHAPES}, got rows of different lengths"),
    _value("K_D=[1.0, -2.0]", "K_D is not positive definite: its smallest eigenvalue is -2"),
    _value('K_D=[[1.0, "a"], [0.0, 1.0]]', "controller.K_D[0][1] = 'a': expected a number"),
    _value("K_D=[[nan, 0.0], [0.0, 1.0]]", f"controller.K_D[0][0] = nan: {FINITE}"),
    _value("K_D=[[1.0, 0.5], [0.0, 1.0]]", "K_D is not symmetric: its entries [0][1] = 0.5 and [1][0] = 0 differ"),
    _value("K_D=[[1.0, 2.0], [2.0, 1.0]]", "K_D is not positive definite: its smallest eigenvalue is -1"),
    _value("K_D=[[1.0, 1.0], [1.0, 1.0]]", "K_D is not positive definite"),
    _value("K_D={theta_1=1.0}", f"controller.K_D: a table needs the joints {JOINTS}; 'theta_3' is missing"),
    _value("K_D={theta_1=1.0, theta_2=1.0}", f"a table needs the joints {JOINTS}; 'theta_2' is none of them"),
    _value('K_D={theta_1=1.0, theta_3="x"}', "controller.K_D.theta_3 = 'x': expected a number"),
    _value("Lambda=0", "Lambda^T K_D is not positive definite", "eq. 18"),
    _value("Lambda=-1", "Lambda^T K_D is not positive definite: its smallest eigenvalue is -10"),
    Bad(
        "Lambda and K_D that do not commute",
        _tracking("Lambda={theta_1=1.0, theta_3=2.0}", "K_D=[[2.0, 1.0], [1.0, 2.0]]"),
        ["Lambda^T K_D is not symmetric: its entries [0][1] = 1 and [1][0] = 2 differ"],
    ),
    _target("K_P=0", "K_P is not positive definite"),
    _target("K_V=-0.1", "K_V is not positive semi-definite: its smallest eigenvalue is -0.1"),
]

CONTROLLER = [
    _value("type=pid", f"{NAMED}controller.type = 'pid'; valid: 'set_point', 'tracking'"),
    _value("K_P=3", "controller: unknown key 'K_P'; valid: type, Lambda, K_D, desired"),
    Bad("no controller but a number", ("run", "bar", "--set", "controller=3"), ["controller = 3: expected a table"]),
    Bad(
        "no type",
        _tracking(),
        [f"{NAMED}controller: the key 'type' is missing; valid: 'set_point', 'tracking'"],
        {"tracking.scene.toml": ('type = "tracking"', "")},
    ),
    Bad("no K_D", _tracking(), ["the key 'K_D' is missing"], {"tracking.scene.toml": ("K_D = 10.0", "")}),
    _value("torque_limit=0", "controller.torque_limit = 0: expected a number greater than 0"),
    _value("torque_limit={theta_2=3.0}", f"controller.torque_limit: no motor 'theta_2'; there are {JOINTS}"),
    _value("torque_limit={theta_1=-3.0}", "controller.torque_limit.theta_1 = -3.0: expected a number greater than 0"),
    _value("torque_limit=[0.5,-1.0]", "controller.torque_limit: expected a lower limit of at most 0 and an upper one"),
    _value("torque_limit.theta_1=[0.5,1.0]", "controller.torque_limit.theta_1: expected a lower limit of at most 0"),
    _value("torque_limit=strong", "controller.torque_limit = 'strong': expected a number, a list or a table"),
    _target("q_d=1", "controller.q_d = 1: expected a table"),
    _target("q_d.theta_7=1", f"controller.q_d: no coordinate 'theta_7' here; there are {JOINTS}"),
    _target("q_d={theta_1=1.0}", f"controller.q_d: theta_3 missing; expected {JOINTS}"),
    _target("q_d.theta_1=nan", f"controller.q_d.theta_1 = nan: {FINITE}"),
    _target("q_d={theta_1=3.1, theta_3=0.0}", "controller.q_d: the target theta_1 = 3.1, theta_3 = 0 is out of reach"),
    Bad(
        "too few actuators",
        _tracking(),
        ["actuated: theta_1 cannot drive every freedom", "theta_3 is driven by none"],
        {"mechanism.toml": ('actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1"]')},
    ),
    _value("model=other.toml", "bar/other.toml: no such mechanism file"),
    Bad(
        "a model with other coordinates",
        _tracking("model=pendulum.toml"),
        ["controller.model: its coordinates are swing, the plant's theta_1, theta_2, theta_3, theta_4"],
        files={"bar/pendulum.toml": 'name = "p"\nurdf = "p.urdf"\n', "bar/p.urdf": PENDULUM},
    ),
]

TRAJECTORY = [
    _value("desired=3", f"{DESIRED} = 3: expected a table"),
    _value("desired.theta_1=3", f"{DESIRED}.theta_1 = 3: expected a table, got an integer"),
    _value("desired.theta_2.offset=1.0", f"{DESIRED}: needs a table for each of {JOINTS}", "'theta_2' is none"),
    _value("desired={theta_1={offset=0.1}}", f"{DESIRED}: needs a table for each of {JOINTS}", "'theta_3' is missing"),
    _value(
        "desired.theta_1.harmnics=[]",
        f"{DESIRED}.theta_1: unknown key 'harmnics'; valid: ",
        "rate, harmonics, waypoints",
    ),
    _value("desired.theta_1.offset=a", f"{DESIRED}.theta_1.offset = 'a': expected a number"),
    _value("desired.theta_1.offset=nan", f"{DESIRED}.theta_1.offset = nan: {FINITE}"),
    _value("desired.theta_1.harmonics=[1.0, 2.0, 3.0]", f"{DESIRED}.theta_1.harmonics[0] = 1.0: expected a list"),
    _value(
        "desired.theta_1.harmonics=[[1.0, 2.0]]", ".harmonics[0] = [1.0, 2.0]: expected a list of 3, got a list of 2"
    ),
    _value("desired.file=way.csv", f"{DESIRED}: either file", f"or a table for each of {JOINTS}"),
    _value("desired={file=3}", f'{DESIRED}: either file = "NAME.csv", alone or with interpolation'),
    _value('desired={file="way.csv"}', "bar/way.csv: no such"),
    _csv("empty", "", "way.csv: it is empty", "columns t, theta_1, theta_3"),
    _csv("other columns", "time,theta_1,theta_3\n", "its header is 'time,theta_1,theta_3'", "t, theta_1, theta_3"),
    _csv("a column twice", "t,theta_1,theta_1\n", "its header is 't,theta_1,theta_1'"),
    _csv(
        "too short",
        _rows(*_way(last=4)),
        "way.csv: 5 rows; without the key interpolation",
        '"linear", "cubic" or "quintic"',
        "needs at least 6",
    ),
    _csv("a word", _rows(*_way(), "11,b,3"), "way.csv, line 13: '11,b,3' is not 3 finite numbers"),
    _csv("a missing cell", _rows(*_way(last=5), "", "6,1"), "way.csv, line 9: '6,1' is not 3 finite numbers"),
    _csv("one number", _rows(*_way(last=5), "6"), "way.csv, line 8: '6' is not 3 finite numbers"),
    _csv("nan", _rows(*_way(last=5), "6,nan,0"), "way.csv, line 8: '6,nan,0' is not 3 finite numbers"),
    _csv("time that steps back", _rows(*_way(), *_way(5, 9)), "line 13: t = 5 after t = 10; t must increase"),
    _csv("a late start", _rows(*_way(1)), "way.csv: starts at t = 1 s; a run starts at 0"),
    _csv("an early end", _rows(*_way(last=8)), "ends at t = 8 s, before the scene's t_end = 9.5 s", "shorten the run"),
    _csv("a picture", b"\x89PNG\r\n\x1a\n", "bar/way.csv: not a", "not UTF-8 text"),
    _csv("an endless cell", _rows("x" * 200_000), "way.csv"),
]


def _motion(table: str, *says: str) -> Bad:
    return Bad(table, _tracking(f"desired.theta_1={{{table}}}"), (f"error: {DESIRED}.theta_1", *says))


def _point(keys: str, *says: str) -> Bad:
    return Bad(f"point: {keys}", _tracking(f'desired={{point="tip", {keys}}}'), (f"error: {DESIRED}", *says))


WAY = "waypoints=[[0.0, 0.0], [1.0, 1.0]]"
LIMITS = "max_rate=2.0, max_acceleration=5.0"
PLACES = "waypoints=[[0.0, [0.15, -0.42, 0.0]], [1.0, [0.16, -0.42, 0.0]]]"

MOTIONS = [
    _motion('rate="fast"', ".rate = 'fast': expected a number, got a string"),
    _motion("rate=inf", f".rate = inf: {FINITE}"),
    _motion("rte=1.0", "unknown key 'rte'", "rate", "did you mean 'rate'?"),
    _motion("waypoints=3", ".waypoints = 3: expected a list, got an integer"),
    _motion("waypoints=[]", ".waypoints: got 0; at least two waypoints are needed"),
    _motion("waypoints=[[0.0, 1.0]]", ".waypoints: got 1; at least two waypoints are needed"),
    _motion("waypoints=[[0.0, 1.0], [1.0]]", ".waypoints[1] = [1.0]: expected a list of 2, got a list of 1"),
    _motion("waypoints=[[0.0, 1.0], [nan, 1.0]]", f".waypoints[1][0] = nan: {FINITE}"),
    _motion(
        "waypoints=[[0.0, 1.0], [2.0, 1.0], [1.0, 1.0]]", ".waypoints[2]: t = 1 after t = 2; the times must increase"
    ),
    _motion("waypoints=[[0.0, 1.0], [0.0, 2.0]]", ".waypoints[1]: t = 0 after t = 0; the times must increase"),
    _motion("waypoints=[[0.0, 1e308], [1e-8, -1e308]]", ".waypoints: the numbers are too large"),
    _motion(f'{WAY}, profile="septic"', ".profile = 'septic'; valid: 'cubic', 'linear', 'quintic', 'trapezoidal'"),
    _motion('profile="linear"', ": profile belongs to waypoints, which are missing"),
    _motion(f'{WAY}, profile="trapezoidal", max_rate=1.0', ": profile =", "max_acceleration is missing"),
    _motion(f'{WAY}, profile="trapezoidal"', "needs max_rate and max_acceleration; max_rate is missing"),
    _motion(f"{WAY}, max_rate=1.0", 'max_rate belongs to profile = "trapezoidal", not to "quintic"'),
    _motion(f'{WAY}, profile="cubic", {LIMITS}', 'max_rate belongs to profile = "trapezoidal", not to "cubic"'),
    _motion("max_rate=1.0", ": max_rate belongs to waypoints, which are missing"),
    _motion(
        f'{WAY}, profile="trapezoidal", max_rate=0.0, max_acceleration=1.0',
        ".max_rate = 0.0: expected a number greater",
    ),
    _motion(
        f'{WAY}, profile="trapezoidal", max_rate=1.25, max_acceleration=5.0',
        ".waypoints: the distance of 1 from t = 0 s to t = 1 s takes at least 1.05 s with max_rate = 1.25 and "
        "max_acceleration = 5; allow more time or raise the limits",
    ),
    _motion(
        f'{WAY}, profile="trapezoidal", max_rate=9.0, max_acceleration=1.0', "takes at least 2 s with max_rate = 9"
    ),
    _point("file='a.csv', line=1", "line = 1: expected a table"),
    _point("interpolation='linear'", "point needs exactly one of file, circle, line and waypoints, got []"),
    _point(f"{PLACES}, interpolation='linear'", "interpolation belongs to file, not to waypoints"),
    _point(f"{PLACES}, profile='trapezoidal', max_rate=1.0", "max_acceleration is missing"),
    _point(f"{PLACES}, max_rate=1.0", 'max_rate belongs to profile = "trapezoidal"'),
    _point(
        f"{PLACES}, profile='trapezoidal', max_rate=0.005, max_acceleration=1.0",
        ".waypoints: the distance of 0.01 from t = 0 s to t = 1 s takes at least 2.005 s",
    ),
    Bad(
        "point: two coordinates",
        _tracking("desired={point='tip', waypoints=[[0.0, [1.0, 0.0]], [1.0, [0.0, 0.0]]]}"),
        ("controller.desired.waypoints[0][1] = [1.0, 0.0]: expected a list of 3",),
    ),
    Bad(
        "another interpolation",
        _tracking('desired={file="way.csv", interpolation="spline"}'),
        (f"{DESIRED}.interpolation = 'spline'; valid: 'cubic', 'linear', 'quintic'",),
        files={"bar/way.csv": _rows(*_way())},
    ),
    Bad(
        "one row",
        _tracking('desired={file="way.csv", interpolation="linear"}'),
        ("way.csv: 1 rows; interpolation needs at least 2",),
        files={"bar/way.csv": _rows(*_way(last=0))},
    ),
]


@pytest.mark.parametrize("case", [*GAINS, *CONTROLLER, *TRAJECTORY, *MOTIONS], ids=lambda case: case.what)
def test_bad_controller(case: Bad, bar: Path) -> None:
    expect(case, bar)
