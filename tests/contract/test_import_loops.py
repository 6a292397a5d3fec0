"""Import of robots whose joints form loops: dialects of URDF, and the choice of the joint at which a loop is cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import MechanismError
from ckc_pin.formats.importing import Draft, read
from tests.conftest import assert_close
from tests.contract.test_import_urdf import has_note

BODY = (
    '<inertial><origin xyz="0.5 0.1 0"/><mass value="1.5"/>'
    '<inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0.002" ixz="0" iyz="0"/></inertial>'
)


def joint(name: str, parent: str, child: str, x: float, inner: str = "", kind: str = "continuous") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="0 0 1"/>{inner}</joint>'


LINKS = '<link name="w"/>' + "".join(f'<link name="{name}">{BODY}</link>' for name in "abc")
JOINTS = joint("j1", "w", "a", 0.0) + joint("j2", "a", "b", 1.0) + joint("j3", "w", "c", 1.5)

UPRIGHT = JOINTS.replace('<origin xyz="1.5 0 0"/>', '<origin xyz="1.7 0 0" rpy="0 0 1.5707963267948966"/>')


def imported(folder: Path, content: str, attributes: str = "", **files: str) -> Draft:
    path = folder / "thing.urdf"
    path.write_text(f'<robot name="thing" {attributes}>{content}</robot>', encoding="utf-8")
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text, encoding="utf-8")
    return read(path)


def tips_apart(q: dict[str, float]) -> float:
    """Distance of the tips of b and c, from trigonometry: links of 1 m, pins at 0 and 1.5 m on the x axis."""
    one, two, three = q["j1"], q["j1"] + q["j2"], q["j3"]
    b = np.array([np.cos(one) + np.cos(two), np.sin(one) + np.sin(two)])
    return float(np.linalg.norm(b - [1.5 + np.cos(three), np.sin(three)]))


ENDS = '<link1 link="b" xyz="1 0 0" rpy="0 0 0.3"/><{} link="c" xyz="1 0 0" rpy="0 0 0"/>'
CONSTRAINT = (
    '<constraint name="k" type="{}"><parent link="b"/><parent_origin xyz="1 0 0"/><parent_axis xyz="0 0 1"/>'
    '<child link="c"/><child_origin xyz="1 0 0" rpy="{} 0 0"/><child_axis xyz="{}"/></constraint>'
)
BALL = (
    '<drake:ball_constraint><drake:ball_constraint_body_A name="b"/><drake:ball_constraint_body_B name="c"/>'
    '<drake:ball_constraint_p_AP value="1 0 0"/><drake:ball_constraint_p_BQ value="1 0 0"/></drake:ball_constraint>'
)
DIALECTS = {  # with the type of the loop and its rows
    "loop_joint": (
        f'<loop_joint name="k" type="continuous"><axis xyz="0 0 2"/>{ENDS.format("link2")}</loop_joint>', "hinge", 5,
    ),
    "both called link1": (f'<loop_joint name="k" type="spherical">{ENDS.format("link1")}</loop_joint>', "point", 3),
    "constraint": (CONSTRAINT.format("revolute", "0", "0 0 1"), "hinge", 5),
    "constraint with turned axes": (CONSTRAINT.format("revolute", "1.5707963267948966", "0 1 0"), "hinge", 5),
    "drake": (BALL, "point", 3),
    "loop": (
        '<loop name="k" type="continuous"><predecessor link="b"><origin xyz="1 0 0"/></predecessor>'
        '<successor link="c"><origin xyz="1 0 0"/></successor><axis xyz="0 0 1"/></loop>', "hinge", 5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_close_the_same_loop(dialect: str, tmp_path: Path) -> None:
    content, kind, rows = DIALECTS[dialect]
    draft = imported(tmp_path, LINKS + JOINTS + content)
    ((loop, _),) = draft.loops
    assert loop.type == kind
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.closure.rows, mechanism.rank, mechanism.d) == (3, rows, 2, 1)
    assert tips_apart(dict(zip(mechanism.coordinates, mechanism.q_tree, strict=True))) < 1e-9
    assert "a URDF with <" in draft.origin
    assert not draft.left_out


def test_loop_closures_yaml_gives_hinges_at_zero_and_motors(tmp_path: Path) -> None:
    """b and c meet at (1.5, 0.5, 0) at zero: pins on both are placed there, in the axes of the links."""
    joints = JOINTS.replace('<origin xyz="1.5 0 0"/>', '<origin xyz="1.5 0 0" rpy="0 0 1.5707963267948966"/>')
    closure = "closures: [{link_a: b, link_b: c, point: [1.5, 0.5, 0], axis: [0, 0, -1]}]\nindependent: [j3]\nfar: 1"
    draft = imported(tmp_path, LINKS + joints, loop_closures__yaml=closure)
    ((loop, _),) = draft.loops
    assert_close(loop.frame_a.xyz, [0.5, 0.5, 0.0], 1e-12)
    assert_close(loop.frame_b.xyz, [0.5, 0.0, 0.0], 1e-12)
    assert (loop.type, draft.actuated) == ("hinge", ["j3"])
    assert has_note(draft.left_out, "unsupported key 'far'")
    assert draft.build_mechanism().d == 1
    assert read(tmp_path / "loop_closures.yaml").loops == draft.loops


GAZEBO = """<gazebo><joint name="j4" type="revolute"><parent>c</parent><child>b</child>
<pose>.7 .6 0 0 0 1.5707963267948966</pose><axis><xyz>0 0 1</xyz>{}</axis></joint></gazebo>"""


def test_gazebo_joint_closes_the_loop_at_zero(tmp_path: Path) -> None:
    """The pin is at (1.7, 0.6) at zero: in b, which begins at (1, 0), and in c, which stands upright at (1.7, 0)."""
    draft = imported(tmp_path, LINKS + UPRIGHT + GAZEBO.format(""))
    ((loop, _),) = draft.loops
    assert (loop.name, loop.type) == ("j4", "hinge")
    assert_close(loop.frame_a.xyz, [0.6, 0.0, 0.0], 1e-15)
    assert_close(loop.frame_b.xyz, [0.7, 0.6, 0.0], 1e-15)
    assert_close(loop.frame_b.rpy, [0.0, 0.0, np.pi / 2], 1e-14)
    mechanism = draft.build_mechanism()
    assert (mechanism.rank, mechanism.d) == (2, 1)


def test_gazebo_links_are_read_with_their_poses(tmp_path: Path) -> None:
    """Link c of the four-bar in Gazebo's format, with both of its joints."""
    inertia = "<ixx>0.01</ixx><iyy>0.1</iyy><izz>0.1</izz><ixy>0.002</ixy>"
    inertial = f"<inertial><pose>0.5 0.1 0 0 0 0</pose><mass>1.5</mass><inertia>{inertia}</inertia></inertial>"
    c = f'<link name="c"><pose>1.7 0 0 0 0 1.5707963267948966</pose>{inertial}</link>'
    hinge = '<joint name="j3" type="revolute"><parent>w</parent><child>c</child><axis><xyz>0 0 1</xyz></axis></joint>'
    (tmp_path / "plain").mkdir()
    plain = imported(tmp_path / "plain", LINKS + UPRIGHT + GAZEBO.format("")).build_mechanism()
    links = LINKS.replace(f'<link name="c">{BODY}</link>', f"<gazebo>{c}{hinge}</gazebo>")
    draft = imported(tmp_path, links + UPRIGHT[: UPRIGHT.index('<joint name="j3"')] + GAZEBO.format(""))
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.rank, mechanism.d) == (3, 2, 1)
    assert draft.origin == "thing.urdf, a URDF with <gazebo><link> and <gazebo><joint>"
    D = [ckc_pin.terms(x, x.tree.named(x.q_tree)).D for x in (mechanism, plain)]
    assert_close(D[0], D[1], 1e-12, relative=True)


def test_gazebo_plugins_are_read(tmp_path: Path) -> None:
    mimic = (
        '<gazebo><plugin filename="libroboticsgroup_gazebo_mimic_joint_plugin.so" name="m"><joint>j1</joint>'
        "<mimicJoint>j3</mimicJoint><multiplier>-2</multiplier><offset>0.25</offset></plugin></gazebo>"
    )
    weld = (
        '<gazebo><plugin filename="gz-sim-detachable-joint-system" name="gz::sim::systems::DetachableJoint">'
        "<parent_link>b</parent_link><child_model>self</child_model><child_link>{}</child_link></plugin></gazebo>"
    )
    spring = (
        '<gazebo reference="j2"><springStiffness>3</springStiffness><springReference>0.5</springReference></gazebo>'
    )
    draft = imported(tmp_path, LINKS + JOINTS + mimic + weld.format("c") + spring)
    ((loop, _),) = draft.loops
    ((stiff, _),) = draft.springs
    assert (loop.type, stiff.joint, stiff.stiffness, stiff.rest) == ("weld", "j2", 3.0, 0.5)
    assert '<mimic joint="j1" multiplier="-2.0" offset="0.25" />' in draft.urdf_text()
    other = imported(tmp_path, LINKS + JOINTS + weld.format("elsewhere"))
    assert not other.loops
    assert has_note(other.warnings, "DetachableJoint", "'elsewhere'", "6 freedoms more")


def test_elements_that_are_not_read_are_named_with_their_count(tmp_path: Path) -> None:
    extra = (
        '<sensor/><sensor/><closure joint="j1"/><gazebo reference="a"><mu1>1</mu1></gazebo><gazebo><plugin/></gazebo>'
    )
    joints = JOINTS.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><calibration rising="0"/>')
    draft = imported(tmp_path, LINKS.replace(BODY, BODY + "<collision/>") + joints + extra)
    assert set(draft.left_out) == {
        *("2 <sensor>", "1 <mu1> of <gazebo>", "1 <plugin> of <gazebo>"),
        *("3 <collision> of <link>", "3 <calibration> of <joint>"),
    }
    assert has_note(draft.warnings, "1 <closure>", "up to 6 freedoms more")
    plain = imported(tmp_path, LINKS + JOINTS + "<sensor/>")
    assert has_note(plain.guessed, "no loops, because no element that was read declares one")
    assert not has_note(draft.guessed, "declares none")


def test_namespace_and_implicit_world_are_read(tmp_path: Path) -> None:
    lost = JOINTS.replace('parent link="w"', 'parent link="world"')
    draft = imported(tmp_path, LINKS.replace('<link name="w"/>', "") + lost, 'xmlns="http://drake.mit.edu"')
    assert has_note(draft.guessed, 'the link "world" is added')
    assert draft.build_mechanism().d == 3


# --- the choice of the cut -----------------------------------------------------------------------------------------

DAMPED = '<dynamics damping="0.3"/>'
LIMITED = '<limit lower="-1" upper="1.5" effort="3" velocity="2"/>'


def four_bar(folder: Path, damped: str) -> Draft:
    """Return a four-bar of which the joints in `damped` have damping; j4 connects the tips of b and c."""
    (folder / damped).mkdir(exist_ok=True)
    places = {"j1": ("w", "a", 0.0), "j2": ("a", "b", 1.0), "j3": ("w", "c", 1.5), "j4": ("b", "d", 1.0)}
    joints = "".join(joint(name, *ends, DAMPED if name in damped else "") for name, ends in places.items())
    tip = '<joint name="tip" type="fixed"><parent link="c"/><child link="d"/><origin xyz="1 0 0"/></joint>'
    return imported(folder / damped, f'{LINKS}<link name="d"/>{joints}{tip}')


@pytest.mark.parametrize("free", ["j1", "j2", "j3", "j4"])
def test_loop_is_cut_at_the_joint_without_properties(free: str, tmp_path: Path) -> None:
    draft = four_bar(tmp_path, "".join(name for name in ("j1", "j2", "j3", "j4") if name != free))
    ((loop, _),) = draft.loops
    assert (loop.name, loop.type) == (free, "hinge")
    assert has_note(draft.guessed, "close loops and are cut there", free)
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.rank, mechanism.d) == (3, 2, 1)
    assert np.count_nonzero(mechanism.springs.joint_damping) == 3


def inertia(draft: Draft, q: str, value: float) -> tuple[float, float]:
    """Return D and h of eq. 6 in one coordinate."""
    draft.independent, draft.actuated, draft.gravity = [q], [q], (0.0, -9.81, 0.0)
    guess = {"j1": 1.2, "j2": -0.8, "j3": 2.1, "j4": 0.6}
    draft.q_guess = {name: guess[name] for name in guess if draft.robot.find(f"joint[@name='{name}']") is not None}
    at = ckc_pin.terms(draft.build_mechanism(), {q: value}, {q: 0.0})
    return float(at.D[0, 0]), float(at.h[0])


def test_inertia_does_not_depend_on_the_cut(tmp_path: Path) -> None:
    """Joints are reversed, links get other frames, and loops other frames; the mechanism is the same."""
    reference = inertia(imported(tmp_path, LINKS + JOINTS + DIALECTS["loop"][0]), "j1", 1.1)
    cuts = {cut: inertia(four_bar(tmp_path, damped), "j1", 1.1) for cut, damped in
            (("j2", "j1j3j4"), ("j3", "j1j2j4"), ("j4", "j1j2j3"), ("none", "j1j2j3j4"))}  # fmt: skip
    for cut in cuts.values():
        assert_close(np.array(cut) / reference, [1.0, 1.0], 1e-10)
    by_j3 = [inertia(four_bar(tmp_path, damped), "j3", 2.0) for damped in ("j2j3j4", "j1j2j3")]
    assert_close(np.array(by_j3[0]) / by_j3[1], [1.0, 1.0], 1e-10)


def test_joint_without_an_alternative_stays_with_a_weld(tmp_path: Path) -> None:
    ranges = UPRIGHT.replace("continuous", "revolute").replace('<axis xyz="0 0 1"/>', f'<axis xyz="0 0 1"/>{LIMITED}')
    closing = GAZEBO.format("<limit><lower>-1</lower><upper>1.5</upper></limit>")
    draft = imported(tmp_path, LINKS + ranges + closing)
    ((loop, _),) = draft.loops
    assert loop.type == "weld"
    assert has_note(draft.guessed, "links without mass", loop.name)
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.rank, mechanism.d) == (4, 3, 1)
    lower, upper = mechanism.tree.limits()
    assert (list(lower), list(upper)) == ([-1.0] * 4, [1.5] * 4)


def test_second_parent_is_cut_into_a_loop(tmp_path: Path) -> None:
    draft = imported(tmp_path, LINKS + JOINTS + joint("j4", "c", "b", 1.0))
    ((loop, _),) = draft.loops
    assert (loop.name, loop.frame_b) == ("j4", "b")
    assert has_note(draft.guessed, "close loops and are cut there", "j4")
    assert draft.build_mechanism().d == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (joint("j4", "b", "b", 0.0), "connects link 'b' with itself"),
        (DIALECTS["loop_joint"][0].replace('link="c"', 'link="b"'), "connects link 'b' with itself"),
        (DIALECTS["constraint"][0] + BALL, "both connect links 'b' and 'c'"),
        (DIALECTS["loop_joint"][0].replace("continuous", "wobbly"), "loop_joint 'k': unsupported type 'wobbly'"),
        (DIALECTS["loop_joint"][0].replace("<link2", "<link3"), "expected <link1> and <link2>"),
        (BALL.replace('name="c"', 'name="x"'), "body_B 'x' is not a link"),
        (GAZEBO.format("").replace("revolute", "wobbly"), "<gazebo> joint 'j4': unsupported type 'wobbly'"),
        (GAZEBO.format("").replace("<parent>c", "<parent>x"), "parent 'x' is not a link"),
        (GAZEBO.format("").replace("<xyz>0 0 1", "<xyz>0 0 0"), "<axis>: expected a direction"),
        (joint("j1", "w", "c", 0.0), "two <joint> elements are called 'j1'"),
        (
            joint("ground", "b", "world", 0.0) + DIALECTS["loop"][0].replace('link="b"', 'link="world"'),
            "link 'world' is carried by a joint; rename it",
        ),
        ('<link name="lost"/>', "links are not connected; roots found: 'w', 'lost'"),
    ],
)  # fmt: skip
def test_impossible_loops_are_refused(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises((MechanismError, ckc_pin.InputError)) as refused:
        imported(tmp_path, LINKS + JOINTS + content)
    assert message in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "thing.urdf"))


# --- motors --------------------------------------------------------------------------------------------------------


def transmission(kind: str, *ends: str) -> str:
    return (
        f'<transmission name="t"><type>transmission_interface/{kind}Transmission</type>{"".join(ends)}</transmission>'
    )


def end(tag: str, name: str, reduction: float) -> str:
    return f'<{tag} name="{name}"><mechanicalReduction>{reduction}</mechanicalReduction></{tag}>'


def test_transmissions_and_command_interfaces_are_motors(tmp_path: Path) -> None:
    control = "<ros2_control><joint name='{}'><command_interface name='effort'/></joint></ros2_control>"
    content = transmission("Simple", '<joint name="j3"/>', end("actuator", "m", 50)) + control.format("j3")
    draft = imported(tmp_path, LINKS + JOINTS + DIALECTS["loop"][0] + content + control.format("j1"))
    assert [(m.name, m.joint, m.ratio) for m, _ in draft.motors] == [("j3", "j3", 50.0), ("j1", "j1", 1.0)]
    assert draft.build_mechanism().independent[0] in ("j1", "j3")


def test_ros2_control_declares_mimics_and_efforts_limit_motors(tmp_path: Path) -> None:
    params = '<param name="mimic">j1</param><param name="multiplier">-3</param>'
    control = f'<ros2_control><joint name="j3"><command_interface name="position"/>{params}</joint></ros2_control>'
    limited = JOINTS.replace(
        'name="j1" type="continuous">', 'name="j1" type="continuous"><limit effort="20" velocity="1"/>'
    )
    motor = transmission("Simple", '<joint name="j1"/>', end("actuator", "m", -50))
    draft = imported(tmp_path, LINKS + limited + control + motor)
    assert [(m.joint, m.ratio, m.torque_limit) for m, _ in draft.motors] == [("j1", -50.0, 0.4)]
    assert '<mimic joint="j1" multiplier="-3.0" offset="0.0" />' in draft.urdf_text()
    assert draft.build_mechanism().d == 2


def test_motors_of_a_differential_turn_as_ros_control_says(tmp_path: Path) -> None:
    """The formulas of ros_control: n_1 (m_1 q_1 + m_2 q_2) and so on, with n = 7, 11 and m = 3, 5."""
    joints, actuators = (
        [end("joint", "j1", 3), end("joint", "j2", 5)],
        [end("actuator", "x", 7), end("actuator", "y", 11)],
    )
    expected = {
        "Differential": [[7 * 3, 7 * 5], [11 * 3, -11 * 5]],
        "FourBarLinkage": [[7 * 3, 0], [11, 11 * 5]],
    }
    for kind, rows in expected.items():
        draft = imported(tmp_path, LINKS + JOINTS + transmission(kind, *joints, *actuators))
        weights = [[motor.joints.get(name, 0.0) for name in ("j1", "j2")] for motor, _ in draft.motors]
        assert_close(weights, rows, 0.0)
        assert [motor.name for motor, _ in draft.motors] == ["x", "y"]
    odd = imported(tmp_path, LINKS + JOINTS + transmission("Wobbly", *joints, *actuators))
    assert [motor.joint for motor, _ in odd.motors] == ["j1", "j2"]
    assert has_note(odd.left_out, "transmission t", "unsupported")


# --- repair --------------------------------------------------------------------------------------------------------


def test_impossible_inertia_is_refused_or_repaired_on_request(tmp_path: Path) -> None:
    path = tmp_path / "thing.urdf"
    bad = LINKS.replace('izz="0.1"', 'izz="-0.02"', 1)
    path.write_text(f"<robot>{bad}{JOINTS}</robot>", encoding="utf-8")
    with pytest.raises(MechanismError, match=r"link 'a'.* -0.02, .*--repair"):
        read(path)
    draft = read(path, repair=True)
    assert has_note(draft.guessed, "repaired: principal moments of link a")
    inertia = draft.build_mechanism().tree.model.inertias[1].inertia
    declared = np.array([[0.01, 0.002, 0.0], [0.002, 0.1, 0.0], [0.0, 0.0, -0.02]])
    assert 2 * np.linalg.eigvalsh(inertia).max() <= np.trace(inertia) * (1 + 1e-12)
    # No other possible tensor with these axes is nearer: compare with a grid of second moments of mass.
    _, axes = np.linalg.eigh(declared)
    grid = np.linspace(0.0, 0.12, 25)
    nearest = min(
        float(np.linalg.norm(axes @ np.diag([y + z, x + z, x + y]) @ axes.T - declared))
        for x in grid for y in grid for z in grid
    )  # fmt: skip
    assert np.linalg.norm(inertia - declared) <= nearest + 1e-12


def test_swapped_limits_are_refused_or_repaired_on_request(tmp_path: Path) -> None:
    path = tmp_path / "thing.urdf"
    swapped = joint("j9", "c", "d", 1.0, '<limit lower="2" upper="-1" effort="1" velocity="1"/>', "revolute")
    path.write_text(f'<robot>{LINKS}<link name="d"/>{JOINTS}{swapped}</robot>', encoding="utf-8")
    with pytest.raises(MechanismError, match=r"lower limit 2 is above the upper one -1; .*--repair"):
        read(path)
    draft = read(path, repair=True)
    assert has_note(draft.guessed, "repaired: the limits of joint j9")
    lower, upper = draft.build_mechanism().tree.limits()
    assert (lower[-1], upper[-1]) == (-1.0, 2.0)
