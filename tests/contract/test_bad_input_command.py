"""Invalid names, options and settings on the command line: exit code 2 and one message with the valid choices."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.helpers.bad import STOPPED, Bad, expect

SHIPPED = ("shipped: ", "five_bar, five_bar_as_printed", "or give the path of a")
SCENES = "it has default, friction, set_point, swing, tracking"
TERMS = ("terms", "five_bar", "--q")
EMPTY = {"empty/readme.txt": ""}


def _set(*overrides: str) -> tuple[str, ...]:
    return ("run", "bar/swing.scene.toml", *(word for override in overrides for word in ("--set", override)))


CASES = [
    # the command itself
    Bad(
        "unknown command",
        ["rnu"],
        [
            "No such command 'rnu'",
            "check, explore, terms, compile, run, inverse, linearize, sensitivities, sweep, excite, identify, "
            "calibrate, optimize, plot,",
        ],
    ),
    Bad("unknown option", ["check", "five_bar", "--jsn"], ["ckc check", "--jsn", "--json", "See ckc check --help"]),
    Bad("missing argument", ["check"], ["ckc check: Missing argument 'MECHANISM|SCENE'", "--help"]),
    Bad("too many arguments", ["check", "five_bar", "again"], ["unexpected extra argument", "again"]),
    Bad("no state", ["terms", "five_bar"], ["Missing option '--q'"]),
    Bad("option without value", ["run", "five_bar", "--set"], ["--set", "requires an argument"]),
    # names
    Bad("unknown mechanism", ["check", "fivebar"], ["no mechanism 'fivebar'", *SHIPPED]),
    Bad("unknown mechanism for terms", ["terms", "fivebar", "--q", "{}"], ["no mechanism 'fivebar'", *SHIPPED]),
    Bad("unknown mechanism of a scene", ["run", "fivebar/swing"], ["no mechanism 'fivebar'", *SHIPPED]),
    Bad("unknown scene", ["run", "five_bar/trackng"], ["five_bar has no scene 'trackng'", SCENES]),
    Bad("unknown scene to check", ["check", "five_bar/trackng"], ["five_bar has no scene 'trackng'", SCENES]),
    Bad("a way out of the library", ["run", "five_bar/../five_bar/swing"], ["has no scene '../five_bar/swing'"]),
    Bad("a name of control characters", ["check", "five\nbar\0"], [r"no mechanism 'five\nbar\x00'"]),
    Bad("a name like markup", ["check", "[red]"], ["no mechanism '[red]'"]),
    Bad("missing scene file", ["run", "nowhere/x.scene.toml"], ["nowhere/x.scene.toml: no such scene"]),
    Bad("missing mechanism file", ["check", "nowhere.toml"], ["nowhere.toml: no such mechanism file"]),
    Bad("folder without mechanism", ["check", "empty"], ["empty/mechanism.toml: no such"], files=EMPTY),
    Bad(
        "folder without scene",
        ["run", "empty"],
        ["empty: it contains no scene, *.scene.toml"],
        files=EMPTY,
    ),
    Bad(
        "folder without default scene",
        ["run", "own"],
        ["own: no default.scene.toml", "name one of its scenes: a.scene.toml, b.scene.toml"],
        files={"own/a.scene.toml": "", "own/b.scene.toml": ""},
    ),
    Bad(
        "folder as scene file",
        ["run", "own.scene.toml"],
        ["own.scene.toml: it contains no scene, "],
        files={"own.scene.toml/x": ""},
    ),
    Bad(
        "URDF as scene",
        ["run", "bar/odd.toml"],
        ["malformed TOML", "line 1", "named in a mechanism.toml"],
        files={"bar/odd.toml": '<robot name="r"><link name="a"/></robot>'},
    ),
    Bad(
        "scene as mechanism",
        [*TERMS[:1], "bar/swing.scene.toml", "--q", "{}"],
        ["swing.scene.toml: a scene; expected a mechanism"],
    ),
    Bad("a name that no file can have", ["check", "\0.toml"], [r"'\x00.toml'", "not a valid file name"]),
    Bad("a name too long for a file", ["check", "x" * 5000 + ".toml"], ["xx.toml: cannot be read: File name too"]),
    # exciting motions
    Bad(
        "period of zero",
        ["excite", "five_bar", "--period", "0"],
        ["excite: period: expected a number of seconds above"],
    ),
    Bad("no calibration", ["calibrate", "none.calibrate.toml"], ["none.calibrate.toml: no such calibration"]),
    Bad("no identification", ["identify", "none.identify.toml"], ["none.identify.toml: no such identification"]),
    Bad("no parameters", ["excite", "five_bar", "--parameters", ","], ["excite: parameters: nothing to identify"]),
    Bad("no rate", ["excite", "five_bar", "--rate", "0"], ["--rate 0: expected a number above zero"]),
    Bad(
        "unknown limit",
        ["excite", "five_bar", "--limit", "v.x=1"],
        ["excite: limits: nothing is called 'v.x'; there are"],
    ),
    Bad("limit without value", ["excite", "five_bar", "--limit", "v.theta_1"], ["--limit v.theta_1: write KEY=VALUE"]),
    # the state of terms
    Bad("state that is not JSON", [*TERMS, "theta_1=1"], ["--q theta_1=1: not JSON", "--q '{\"theta_1\": 0.4}'"]),
    Bad("state without end", [*TERMS, "[" * 100_000], ["--q [[", "not JSON"]),
    Bad("state that is a list", [*TERMS, "[1, 2]"], ["--q [1, 2]: not a table", "e.g. --q"]),
    Bad("state with a word", [*TERMS, '{"theta_1": "a"}'], ['--q: theta_1 = "a": expected a finite number']),
    Bad("state with NaN", [*TERMS, '{"theta_1": NaN}'], ["--q: theta_1 = NaN: expected a finite number"]),
    Bad("state with true", [*TERMS, '{"theta_1": true}'], ["theta_1 = true: expected a finite number"]),
    Bad("state with a huge number", [*TERMS, '{"theta_1": 1%s}' % ("0" * 400)], ["expected a finite number"]),
    Bad("state with unknown coordinate", [*TERMS, '{"theta_9": 1}'], ["'theta_9'", "theta_1, theta_3"]),
    Bad("state with a missing coordinate", [*TERMS, '{"theta_1": 1}'], ["theta_3 missing", "theta_1, theta_3"]),
    Bad(
        "state with some dependent coordinates",
        [*TERMS, '{"theta_1": 1, "theta_2": 1, "theta_3": 1}'],
        ["expected the independent coordinates (theta_1, theta_3) or all coordinates", "'theta_2'"],
    ),
    Bad("state out of reach", [*TERMS, '{"theta_1": 3.1, "theta_3": 0}'], ["theta_1 = 3.1, theta_3 = 0", "reach"]),
    Bad("rates that are not JSON", [*TERMS, "{}", "--v", "fast"], ["--v fast: not JSON"]),
    Bad(
        "rate of an unknown coordinate",
        [*TERMS, '{"theta_1": -1.2, "theta_3": -1.9}', "--v", '{"omega": 1}'],
        ["v: ", "'omega'", "theta_1, theta_3"],
    ),
    # --set
    Bad("setting without value", _set("formulation"), ["--set formulation: write KEY=VALUE, e.g. solver.rtol=1e-10"]),
    Bad("setting without key", _set("=3"), ["--set =3: write KEY=VALUE"]),
    Bad("setting with half a key", _set("solver.=3"), ["--set solver.=3: write KEY=VALUE"]),
    Bad("setting under a value", _set("formulation.kind=3"), ["formulation.kind: formulation is a value, not a table"]),
    Bad("setting under a nested value", _set("solver.rtol.x.y=3"), ["solver.rtol is a value, not a table"]),
    Bad("setting an unknown key", _set("solver.rtoll=1e-8"), ["solver: unknown key 'rtoll'", "valid: method,", "rtol"]),
    Bad("setting an unknown table", _set("slover.rtol=1e-8"), ["unknown key 'slover'", "valid: mechanism,", "solver"]),
    Bad("setting a table to a number", _set("solver=3"), ["solver = 3: expected a table, got an integer"]),
    # --out, and runs that are none
    Bad("folder for results that is a file", ["run", "five_bar/swing", "--out", "bar/mechanism.toml"], ["--out bar/"]),
    Bad("folder for results below a file", ["run", "five_bar/swing", "--out", "bar/mechanism.toml/x"], ["--out bar/"]),
    Bad("figures of nothing", ["plot", "nowhere"], ["nowhere: no such run file"]),
    Bad("figures of another file", ["plot", "bar/mechanism.toml"], ["bar/mechanism.toml: not a run file, or damaged"]),
    Bad("playback of nothing", ["play", "nowhere"], ["nowhere: no such run file"]),
    Bad("playback that stands still", ["play", "nowhere", "--speed", "0"], ["--speed", "0"]),
    # known only from the numbers: both elbows at one place, the distal links free to turn
    Bad(
        "singular state",
        [*TERMS, '{"theta_1": 0.9938649815584397, "theta_3": 2.1477276720313534}'],
        ["theta_1 = 0.993865, theta_3 = 2.14773 is singular"],
        code=STOPPED,
    ),
    Bad(
        "singular start",
        _set("initial.q={theta_1=0.9938649815584397, theta_3=2.1477276720313534}"),
        [
            "singular: theta_1, theta_3 do not determine theta_2, theta_4",
            "start elsewhere",
            "for example theta_3, theta_4",
        ],
        code=STOPPED,
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_invalid_command_lines_are_rejected(case: Bad, bar: Path) -> None:
    expect(case, bar)
