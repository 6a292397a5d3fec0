"""The explorer's session: movements, history, branches, parameters, open loops, runs and saving, without a browser."""

from __future__ import annotations

import time
from collections import deque

import msgspec
import numpy as np
import pytest

import ckc_pin
from ckc_pin.explorer.messages import (
    CopyText,
    Drag,
    GoTo,
    Home,
    ListBranches,
    Move,
    Pause,
    Redo,
    Release,
    ResetParameters,
    Save,
    SelectBranch,
    SetMotor,
    SetParameter,
    Show,
    ShowMap,
    StartRun,
    StopRun,
    Undo,
)
from ckc_pin.explorer.opening import Opened, open_explored
from ckc_pin.explorer.session import Session
from ckc_pin.kinematics.assembly import open_loops
from ckc_pin.kinematics.loading import read_spec
from ckc_pin.kinematics.sigma import assembly_branches, sigma
from ckc_pin.mechanism.library import MECHANISM_FILE, read_mechanism_texts
from ckc_pin.view.commands import SceneState
from tests.analytic.five_bar import FIVE_BAR
from tests.analytic.test_point import tip
from tests.conftest import assert_close

PATIENCE = 60.0  # s


def as_open(opened, path):
    """Return a mechanism with its loops open, as if they could not be closed from the guess."""
    text, sources = read_mechanism_texts(path)
    sources.texts[MECHANISM_FILE] = text
    mechanism = opened.mechanism
    guess = mechanism.tree.named(mechanism.tree.to_coordinates(mechanism.q_tree))
    as_tree, with_loops = open_loops(read_spec(text, sources.name), sources, guess)
    return Opened(opened.name, as_tree, as_tree.assembled, with_open_loops=with_loops, problem="made open for the test")


class Desk:
    """A session whose requests are handled at once, and its messages to the pages."""

    def __init__(self, what, folder=None):
        self.posted = deque()
        self.sent = []
        self.session = Session(open_explored(what), self.sent.append, self.posted.append, folder)

    def ask(self, *requests):
        for request in requests:
            self.session.handle(request)
        self.go_on()

    def go_on(self):
        for _ in range(1000):
            self.session.advance()
            self.session.send_frame()
            assert self.report("pose")["closure"] <= 1e-10 or self.session.opened.problem
            if not self.session.is_active:
                return
        raise AssertionError("the movement does not end")

    def until(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline
            while self.posted:
                self.posted.popleft()()
            self.session.advance()
            self.session.send_frame()
            time.sleep(0.01)

    def reports(self, kind):
        """All reports of a kind, in their order."""
        return [
            command["content"]
            for sent in self.sent
            for command in sent.get("commands", [sent])
            if command["type"] == "report" and command["path"] == kind
        ]

    def report(self, kind):
        return self.reports(kind)[-1]

    @property
    def values(self):
        return self.report("pose")["values"]

    def refused(self, request):
        """Handle a request and return the notice that refuses it."""
        count = len(self.reports("notice"))
        self.ask(request)
        notices = self.reports("notice")
        assert len(notices) == count + 1
        assert notices[-1]["is_error"]
        return notices[-1]["text"]


@pytest.fixture
def open_desk():
    desks = []

    def open_one(*arguments):
        desks.append(Desk(*arguments))
        return desks[-1]

    yield open_one
    for desk in desks:
        desk.session.close()


def test_slider_moves_one_coordinate_and_undo_returns(open_desk):
    desk = open_desk("five_bar")
    start = desk.values
    desk.ask(Move("theta_1", -1.2), Release())
    assert desk.values["theta_1"] == -1.2
    assert desk.values["theta_3"] == start["theta_3"]
    desk.ask(Move("theta_3", -1.9), Release())
    assert desk.report("pose")["can_undo"]
    desk.ask(Undo())
    assert desk.values["theta_3"] == start["theta_3"]
    assert desk.values["theta_1"] == -1.2
    desk.ask(Undo())
    assert desk.values == start
    assert not desk.report("pose")["can_undo"]
    desk.ask(Redo(), Redo())
    assert desk.values["theta_3"] == -1.9
    desk.ask(Home())
    assert desk.values == start


def test_drag_brings_the_tip_to_the_mouse(open_desk):
    desk = open_desk("five_bar")
    mechanism = desk.session.mechanism
    frame = mechanism.points["tip"]
    q = mechanism.independent_part(mechanism.q_tree) + np.array([0.3, -0.1])
    target = tip(FIVE_BAR, q)
    body = mechanism.tree.model.names[frame.joint]
    desk.ask(Drag(body, frame.translation.tolist(), [target.real, target.imag, 3.0], [0.0, 0.0, 1.0]))
    desk.ask(Release())
    reached = tip(FIVE_BAR, [desk.values["theta_1"], desk.values["theta_3"]])
    assert abs(reached - target) < 1e-8


def test_slider_ends_with_its_reason(open_desk):
    desk = open_desk("five_bar")
    desk.ask(Move("theta_1", 3.0), Release())
    pose = desk.report("pose")
    assert (pose["end"], pose["ended"]) == ("phi_z is singular there", "theta_1")
    desk.ask(Move("theta_1", -1.4), Release())
    assert desk.report("pose")["end"] == ""


def test_click_in_the_map_goes_to_q(open_desk):
    desk = open_desk("five_bar")
    desk.ask(GoTo({"theta_1": -1.0, "theta_3": -2.0}))
    assert (desk.values["theta_1"], desk.values["theta_3"]) == (-1.0, -2.0)


def test_branches_are_those_of_the_command_and_can_be_selected(open_desk):
    desk = open_desk("five_bar")
    desk.ask(Move("theta_1", -1.2), Release(), ListBranches())
    desk.until(lambda: desk.report("branch_list")["branches"])
    branches = desk.report("branch_list")["branches"]
    mechanism = ckc_pin.load("five_bar")
    at = sigma(mechanism, np.array([-1.2, desk.values["theta_3"]])).at
    expected = assembly_branches(mechanism, at)
    assert len(branches) == len(expected) == 2
    desk.ask(SelectBranch(1))
    selected = mechanism.tree.from_coordinates(np.array([desk.values[name] for name in mechanism.coordinates]))
    gap = selected - expected[1].q_tree
    assert_close((gap + np.pi) % (2 * np.pi) - np.pi, 0.0 * gap, 1e-9)
    assert desk.report("branch_list")["current"] == 1
    desk.ask(Undo())
    assert desk.report("branch_list")["branches"] == []
    assert "out of date" in desk.refused(SelectBranch(1))


def test_length_slider_equals_check_with_the_parameter(open_desk):
    desk = open_desk("five_bar")
    infos = {info["name"]: info for info in desk.report("setup")["parameters"]}
    name = "joint.theta_2.xyz.x"
    value = infos[name]["value"] * 1.1
    desk.ask(SetParameter(name, value))
    expected = ckc_pin.check("five_bar", {name: value})
    assert_close(
        [desk.values[name] for name in expected.coordinates],
        ckc_pin.load("five_bar", {name: value}).tree.to_coordinates(ckc_pin.load("five_bar", {name: value}).q_tree),
        1e-9,
    )
    assert "not closed" in desk.refused(SetParameter(name, 20.0))
    desk.ask(ResetParameters())
    desk.ask(Undo())
    present = {info["name"]: info["value"] for info in desk.report("setup")["parameters"]}
    assert present[name] == pytest.approx(value, rel=1e-15)


def test_unassembled_mechanism_is_shown_open_and_closes_when_it_can(open_desk, tmp_path):
    mechanism = ckc_pin.load("five_bar")
    path = mechanism.save(tmp_path / "apart")
    text = path.read_text()
    wrong = text.replace('frame_b = "tip_right"', 'frame_b = {link = "link_4", xyz = [9.0, 0.0, 0.0]}')
    assert wrong != text
    path.write_text(wrong)
    desk = open_desk(path)
    setup = desk.report("setup")
    assert setup["warnings"][0].startswith(str(path))
    assert "not closed" in setup["warnings"][0]
    assert len(setup["coordinates"]) == 4
    assert desk.report("pose")["closure"] > 1.0
    desk.ask(Move("theta_2", 0.5), Release())
    assert desk.values["theta_2"] == 0.5
    assert "closed" in desk.refused(StartRun())


def test_open_loops_close_where_the_user_brings_them_together(open_desk, tmp_path):
    """A four-bar whose guess is so far away that it does not lead to a closed configuration, then one that does."""
    path = ckc_pin.load("four_bar").save(tmp_path / "apart")
    desk = open_desk(path)
    desk.session._open(as_open(desk.session.opened, path))
    closed = desk.session.opened.with_open_loops.assembled.q_tree
    assert desk.report("setup")["warnings"][0] == "made open for the test"
    name = desk.session.mechanism.coordinates[0]
    desk.ask(Move(name, desk.values[name] + 0.01), Release())
    assert not desk.session.opened.problem
    assert desk.report("pose")["closure"] <= 1e-10
    assert "closed now" in desk.report("notice")["text"]
    assert np.abs(desk.session.at.q_tree - closed).max() < 0.1


def test_undo_keeps_gestures_between_two_uses_of_one_slider(open_desk):
    desk = open_desk("five_bar")
    name, value = "joint.theta_2.xyz.x", 0.2794
    desk.ask(SetParameter(name, 1.01 * value), SetParameter(name, 1.02 * value))
    desk.ask(Move("theta_1", -1.3), Release(), SetParameter(name, 1.03 * value))
    desk.ask(Undo())
    assert desk.values["theta_1"] == -1.3
    present = {info["name"]: info["value"] for info in desk.report("setup")["parameters"]}
    assert present[name] == pytest.approx(1.02 * value, rel=1e-15)
    desk.ask(Undo(), Undo())
    assert not desk.report("pose")["can_undo"]


def test_mechanism_without_freedoms_says_so(open_desk):
    links = "".join(
        f'<link name="{name}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link>"
        for name in ("a", "b")
    )
    truss = ckc_pin.Mechanism.from_urdf(
        f"""<robot name="truss"><link name="base"/>{links}
        <joint name="left" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
        <joint name="right" type="continuous"><parent link="base"/><child link="b"/><origin xyz="1 0 0"/>
        <axis xyz="0 0 1"/></joint></robot>""",
        loops=[{"name": "top", "type": "point_2d", "frame_a": {"link": "a", "xyz": [1, 0, 0]},
                "frame_b": {"link": "b", "xyz": [1, 0, 0]}}],
        q_guess={"left": 1.0, "right": 2.1},
    )  # fmt: skip
    desk = open_desk(truss)
    assert any("no freedom" in warning for warning in desk.report("setup")["warnings"])
    desk.ask(Move("left", 0.0))
    assert "no freedom" in desk.report("pose")["end"]


def test_free_run_equals_the_command_to_the_bit(open_desk, tmp_path):
    desk = open_desk("five_bar", tmp_path)
    desk.ask(Move("theta_1", -1.2), Release(), StartRun(rtol=1e-8))
    desk.until(lambda: desk.report("run")["t"] > 0.2)
    desk.ask(Pause(), StopRun(), Save("run", "swing"))
    desk.until(lambda: desk.reports("notice"))
    assert not desk.report("notice")["is_error"], desk.report("notice")
    saved = ckc_pin.Run.load(tmp_path / "swing")
    again = ckc_pin.simulate(tmp_path / "swing" / "swing.scene.toml")
    assert np.array_equal(saved.q_tree, again.q_tree)
    assert saved.scene["solver"]["rtol"] == 1e-8
    assert_close(saved.q_tree[-1], list(desk.values.values()), 1e-5)


def test_push_moves_a_run_and_other_requests_wait(open_desk):
    desk = open_desk("five_bar/set_point")
    desk.ask(StartRun(mode="free"))
    desk.ask(Drag("theta_1", [0.3, 0.0, 0.0], [2.0, 0.5, 0.0]))
    start = desk.values["theta_1"]
    desk.until(lambda: desk.report("run")["t"] > 0.3)
    assert desk.values["theta_1"] > start
    assert "stop the run first" in desk.refused(Move("theta_1", 0.0))
    assert "stop the run first" in desk.refused(Undo())
    desk.ask(SetMotor("theta_1", 1.0), Release(), StopRun())
    assert "start one first" in desk.refused(Pause())


def test_wrong_names_are_refused_with_the_choices(open_desk, tmp_path):
    desk = open_desk("five_bar", tmp_path)
    assert "theta_1" in desk.refused(Move("theta_9", 0.0))
    assert "theta_1" in desk.refused(GoTo({"theta_9": 0.0}))
    assert "link_9" in desk.refused(Drag("link_9", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
    assert "there are" in desk.refused(Show("colours", True))
    assert "no run" in desk.refused(Save("run"))


def test_saved_scene_and_copied_texts_reproduce_the_pose(open_desk, tmp_path):
    desk = open_desk("five_bar/swing", tmp_path)
    desk.ask(Move("theta_1", -1.15), Release(), Save("scene", "mine"), CopyText("q_guess"), CopyText("svg"))
    start = ckc_pin.simulate(tmp_path / "mine.scene.toml", {"t_end": 1e-3}).q_tree[0]
    assert_close(start, list(desk.values.values()), 1e-12)
    texts = desk.reports("text")
    assert texts[0]["text"].startswith("[q_guess]")
    assert texts[1]["text"].startswith("<svg")
    assert texts[1]["file_name"] == "five_bar.svg"


def test_quantities_are_computed_while_they_are_shown(open_desk):
    desk = open_desk("five_bar")
    desk.ask(Show("conditioning", False), Show("loop_frames", False))
    assert desk.report("pose")["quantities"] == {}
    desk.ask(Show("conditioning", True))
    margins = desk.report("pose")["margins"]
    value, reference = margins["sigma_min(phi_z)"]
    assert value == reference == pytest.approx(desk.session.at.margin(), rel=1e-12)
    desk.ask(Show("conditioning", False))
    assert desk.report("pose")["margins"] == {}


def test_drawings_of_quantities_survive_another_parameter_value() -> None:
    desk, objects = Desk("five_bar"), []
    desk.ask(Show(quantity="centre_of_mass", on=True), Show(quantity="traces", on=True))
    desk.ask(Move(coordinate="theta_1", value=-1.2))
    for values in ({}, {"link.link_1.mass": 0.4}):
        desk.ask(*(SetParameter(name=name, value=value) for name, value in values.items()))
        scene = SceneState()
        for command in desk.sent:
            scene.apply(command)
        drawn = {message["path"] for message in map(msgspec.msgpack.decode, scene.messages())
                 if message["type"] == "set_object"}  # fmt: skip
        objects.append(drawn)
    before, after = objects
    assert {path for path in before if "/traces/" in path}  # of the mechanism with the old values
    assert after == {path for path in before if "/traces/" not in path}
    assert sum("/loop:elbow:" in path for path in after) == 2
    assert any("/centre_of_mass/" in path for path in after)


def test_map_after_another_parameter_value_begins_at_the_closed_pose(monkeypatch) -> None:
    desk, requested = Desk("five_bar"), []
    monkeypatch.setattr(desk.session.map_panel, "request", lambda mechanism, at: requested.append((mechanism, at)))
    desk.ask(ShowMap(), SetParameter(name="joint.theta_2.xyz.x", value=0.26))
    assert len(requested) == 2
    for mechanism, at in requested:
        assert np.abs(mechanism.kinematics(at.q_tree).phi).max() <= 1e-10
