"""`ckc import` of SDFormat: frames, models and joints, compared with Drake's own parser of SDFormat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ScrewJoint, UniversalJoint

from ckc_pin import InputError, MechanismError
from ckc_pin.base.arrays import Array
from ckc_pin.formats.importing import Draft, read
from tests.conftest import assert_close
from tests.contract.test_import_urdf import has_note


def imported(folder: Path, content: str, **files: str) -> Draft:
    (folder / "thing.sdf").write_text(content, encoding="utf-8")
    for name, text in files.items():
        path = folder / name.replace("__", ".").replace("_in_", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return read(folder / "thing.sdf")


# --- random models -------------------------------------------------------------------------------------------------

KINDS = ("revolute", "prismatic", "ball", "universal", "screw", "continuous", "fixed")


class Random:
    """Random elements of SDFormat."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def numbers(self, count: int, size: float = 1.0) -> str:
        return " ".join(repr(float(x)) for x in self.random.uniform(-size, size, count))

    def pose(self, relative_to: str = "") -> str:
        """A pose in one of the three formats of rotations."""
        attribute = f'relative_to="{relative_to}"' if relative_to else ""
        kind = self.random.integers(3)
        if kind == 0:
            return f"<pose {attribute}>{self.numbers(6)}</pose>"
        if kind == 1:
            return f'<pose {attribute} degrees="true">{self.numbers(3)} {self.numbers(3, 180.0)}</pose>'
        x, y, z, w = map(float, (q := self.random.normal(size=4)) / np.linalg.norm(q))
        return f'<pose {attribute} rotation_format="quat_xyzw">{self.numbers(3)} {x} {y} {z} {w}</pose>'

    def link(self, name: str, pose: str) -> str:
        """A link with a positive definite inertia of a body of three rods."""
        a, b, c = self.random.uniform(0.1, 0.5, 3)
        keys = {"ixx": b + c, "iyy": a + c, "izz": a + b, "ixy": 0.02, "ixz": -0.01, "iyz": 0.015}
        inertia = "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in keys.items())
        mass = f"<mass>{float(self.random.uniform(0.5, 2.0))!r}</mass>"
        return f'<link name="{name}">{pose}<inertial>{self.pose()}{mass}<inertia>{inertia}</inertia></inertial></link>'

    def joint(self, name: str, kind: str, parent: str, child: str, frames: list[str]) -> str:
        place = "" if self.random.random() < 0.4 else self.pose(self.pick(["", *frames]))
        axes = ""
        if kind in ("revolute", "prismatic", "screw", "continuous"):
            expressed = self.pick(["", *(f'expressed_in="{frame}"' for frame in frames)])
            pitch = "<screw_thread_pitch>0.7</screw_thread_pitch>" if kind == "screw" else ""
            axes = f"<axis><xyz {expressed}>{self.numbers(3)}</xyz></axis>{pitch}"
        elif kind == "universal":
            one = self.random.normal(size=3)
            other = np.cross(one, self.random.normal(size=3))
            axes = "".join(
                f"<{tag}><xyz>{' '.join(repr(float(x)) for x in axis)}</xyz></{tag}>"
                for tag, axis in (("axis", one), ("axis2", other))
            )
        ends = f"<parent>{parent}</parent><child>{child}</child>"
        return f'<joint name="{name}" type="{kind}">{ends}{place}{axes}</joint>'

    def pick(self, choices: list[str]) -> str:
        return choices[self.random.integers(len(choices))]

    def model(self, kinds: list[str], nested: str = "", root: str = "fixed") -> str:
        """A tree of links whose poses, joints and frames are relative to each other."""
        frames = ["__model__"]
        inner = nested
        for k, kind in enumerate(kinds):
            name = f"l{k}"
            relative = self.pick(["", *frames])
            inner += self.link(name, self.pose(relative))
            if k == 0:
                inner += "" if root == "free" else self.joint("base", "fixed", "world", name, [])
            else:
                inner += self.joint(f"j{k}", kind, self.pick([f"l{i}" for i in range(k)]), name, frames)
                frames.append(f"j{k}")
            inner += f'<frame name="f{k}" attached_to="{name}">{self.pose(self.pick(["", *frames]))}</frame>'
            frames += [name, f"f{k}"]
        return f'<model name="m">{inner}{self.pose()}</model>'


def sdf(content: str, version: str = "1.9") -> str:
    return f'<?xml version="1.0"?><sdf version="{version}">{content}</sdf>'


class Both:
    """A model read by us and by Drake.

    Our coordinates are hinges and slides in a row. Drake has one joint for a ball, a universal joint and a screw.
    """

    def __init__(self, folder: Path, text: str) -> None:
        self.draft = imported(folder, text)
        self.mechanism = self.draft.build_mechanism()
        self.plant = MultibodyPlant(0.0)
        Parser(self.plant).AddModelsFromString(text, "sdf")
        self.plant.mutable_gravity_field().set_gravity_vector(self.draft.gravity)
        self.plant.Finalize()
        self.context = self.plant.CreateDefaultContext()

    def set(self, values: dict[str, float]) -> Array:
        """Put Drake's joints to our coordinates, and return d(our rates)/d(Drake's), shape (n, nv)."""
        labels = list(self.mechanism.coordinates)
        rates = np.zeros((len(labels), self.plant.num_velocities()))
        for index in self.plant.GetJointIndices():
            joint = self.plant.get_joint(index)
            instance = self.plant.GetModelInstanceName(joint.model_instance())
            # Drake counts a joint of the outer model to the child's model.
            name = joint.name() if joint.name() == "tie" else "::".join([*instance.split("::")[1:], joint.name()])
            first = joint.velocity_start()
            parts = [label for label in labels if label == name or label.startswith(f"{name}_")]
            at = np.array([values[part] for part in parts])
            positions = self.plant.GetPositions(self.context)
            if isinstance(joint, UniversalJoint):
                joint.set_angles(self.context, at)
            elif joint.num_velocities() == 3:
                x, y, z = np.eye(3)
                one, two, three = (
                    pin.AngleAxis(angle, axis).matrix() for angle, axis in zip(at, (x, y, z), strict=True)
                )
                joint.set_angles(self.context, RollPitchYaw(RotationMatrix(one @ two @ three)).vector())
                turning = np.column_stack([x, one @ y, one @ two @ z])
                rows = [labels.index(part) for part in parts]
                rates[np.ix_(rows, range(first, first + 3))] = np.linalg.inv(turning)
                continue
            elif joint.num_velocities() == 1:
                positions[joint.position_start()] = at[0]
                self.plant.SetPositions(self.context, positions)
            elif joint.num_velocities() == 6:
                continue
            for k, part in enumerate(parts):
                rates[labels.index(part), first + (0 if isinstance(joint, ScrewJoint) else k)] = 1.0
            if isinstance(joint, ScrewJoint):
                rates[labels.index(parts[1]), first] = joint.screw_pitch() / (2 * np.pi)
        return rates

    def assert_same(self, seed: int) -> None:
        """Compare mass matrix and gravity at a random configuration."""
        random = np.random.default_rng(seed)
        tree = self.mechanism.tree
        values = {label: float(random.uniform(-1.0, 1.0)) for label in self.mechanism.coordinates}
        for label in self.mechanism.coordinates:
            if label.endswith("_slide"):
                values[label] = 0.7 / (2 * np.pi) * values[label.removesuffix("_slide") + "_turn"]
        rates = self.set(values)
        q = tree.neutral() if self.mechanism.q_tree is None else self.mechanism.q_tree.copy()
        moving = [k for k, label in enumerate(self.mechanism.coordinates) if not label.startswith("root.")]
        for k in moving:
            q[tree.q_index[k]] = values[self.mechanism.coordinates[k]]
        inertia = pin.crba(tree.model, tree.model.createData(), q)
        inertia = np.triu(inertia) + np.triu(inertia, 1).T
        gravity = pin.computeGeneralizedGravity(tree.model, tree.model.createData(), q)
        ours = rates.T @ inertia @ rates
        theirs = self.plant.CalcMassMatrix(self.context)
        used = np.flatnonzero(np.abs(rates).sum(axis=0))
        assert len(used) >= 1
        assert_close(ours[np.ix_(used, used)], theirs[np.ix_(used, used)], 1e-12 * max(1.0, abs(theirs).max()))
        expected = -self.plant.CalcGravityGeneralizedForces(self.context)
        assert_close((rates.T @ gravity)[used], expected[used], 1e-12 * max(1.0, abs(expected).max()))
        assert_close(float(sum(i.mass for i in tree.model.inertias)), self.plant.CalcTotalMass(self.context), 1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_random_models_equal_drake(seed: int, tmp_path: Path) -> None:
    random = Random(seed)
    kinds = ["", *(KINDS[k] for k in random.random.permutation(len(KINDS)))]
    both = Both(tmp_path, sdf(random.model(kinds, root="free" if seed % 3 == 0 else "fixed")))
    for k in range(3):
        both.assert_same(k)


@pytest.mark.parametrize("seed", range(4))
def test_nested_models_equal_drake(seed: int, tmp_path: Path) -> None:
    """An inner model is placed by one of its frames, and joined to the outer one by a joint of the outer one."""
    random = Random(100 + seed)
    inner = random.model(["", "revolute", "prismatic"], root="free")
    placed = inner.replace('<model name="m">', '<model name="in" placement_frame="f1" canonical_link="l1">')
    outer = random.model(["", "revolute", "universal"], nested=placed)
    link = random.joint("tie", "revolute", "l2", "in::f2", ["in", "in::l0"])
    both = Both(tmp_path, sdf(f"{outer.removesuffix('</model>')}{link}</model>"))
    for k in range(3):
        both.assert_same(k)


# --- joints and loops ----------------------------------------------------------------------------------------------

INERTIAL = "<inertial><mass>1</mass><inertia><ixx>.1</ixx><iyy>.1</iyy><izz>.1</izz></inertia></inertial>"


def link(name: str, pose: str = "0 0 0 0 0 0", inner: str = INERTIAL) -> str:
    return f'<link name="{name}"><pose>{pose}</pose>{inner}</link>'


def joint(name: str, parent: str, child: str, inner: str = "", kind: str = "revolute", axis: str = "0 1 0") -> str:
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f'<joint name="{name}" type="{kind}">{ends}<axis><xyz>{axis}</xyz>{inner}</axis></joint>'


FOUR_BAR = (
    link("a") + link("b", "0 0 0.3 0 0.4 0") + link("c", "0.5 0 0 0 0 0")
    + joint("j1", "world", "a") + joint("j2", "a", "b") + joint("j3", "world", "c")
)  # fmt: skip
CLOSING = joint("j4", "c", "b").replace("<axis>", "<pose>0.4 0 0 0 0 0</pose><axis>")


def model(content: str, attributes: str = "") -> str:
    return sdf(f'<model name="m" {attributes}>{content}</model>')


def test_link_with_two_parents_is_a_loop(tmp_path: Path) -> None:
    """The pin is at b's tip, (0.4 cos 0.4, 0.3 - 0.4 sin 0.4) in the world, and c begins at (0.5, 0)."""
    draft = imported(tmp_path, model(FOUR_BAR + CLOSING))
    ((loop, _),) = draft.loops
    assert (loop.name, loop.type, loop.frame_b.link) == ("j4", "hinge", "b")
    assert_close(loop.frame_a.xyz, [0.4 * np.cos(0.4) - 0.5, 0.0, 0.3 - 0.4 * np.sin(0.4)], 1e-15)
    mechanism = draft.build_mechanism()
    assert (mechanism.rank, mechanism.d) == (2, 1)
    assert_close(mechanism.q_tree, np.zeros(3), 1e-12)  # the file's poses close the loop


def test_attached_links_are_a_weld_as_they_are_drawn(tmp_path: Path) -> None:
    """Gazebo's DetachableJoint attaches c's tip, a link of its own, to b: a four-bar whose bars b and c are one."""
    tip = link("tip", "0.4 0 0.1 0 0 0") + joint("j4", "c", "tip")
    plugin = """<plugin filename="gz-sim-detachable-joint-system" name="gz::sim::systems::DetachableJoint">
    <parent_link>b</parent_link><child_model>m</child_model><child_link>tip</child_link></plugin>"""
    draft = imported(tmp_path, model(FOUR_BAR + tip + plugin))
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.rank, mechanism.d) == (4, 3, 1)
    assert_close(mechanism.q_tree, np.zeros(4), 1e-12)
    renamed = imported(tmp_path, model(FOUR_BAR + tip + plugin.replace("m</child_model>", "spawned_m</child_model>")))
    assert renamed.build_mechanism().d == 1
    lost = imported(tmp_path, model(FOUR_BAR + tip + plugin.replace("tip</child_link>", "nothing</child_link>")))
    assert has_note(lost.warnings, "DetachableJoint of 'b' and 'nothing' is left out", "6 freedoms more")


def test_a_link_and_a_joint_of_one_name_are_both_read(tmp_path: Path) -> None:
    """Old files have such names. Others that refer to the name mean the link."""
    content = link("a") + link("pin", "0 0 0.3 0 0 0") + joint("j1", "world", "a") + joint("pin", "a", "pin")
    draft = imported(tmp_path, model(content + link("b", "0 0 0.5 0 0 0") + joint("j2", "pin", "b")))
    assert draft.build_mechanism().coordinates == ("j1", "pin", "j2")


def test_comments_and_empty_lines_above_the_declaration_are_ignored(tmp_path: Path) -> None:
    content = "<!-- a line -- and\nanother -->" + link("a") + joint("j1", "world", "a")
    text = model(content)
    assert text.startswith("<?xml")
    assert imported(tmp_path, "\n\n" + text).build_mechanism().d == 1


def test_properties_of_an_axis_are_read(tmp_path: Path) -> None:
    limit = "<limit><lower>-1e16</lower><upper>0.7</upper><effort>-1</effort></limit>"
    dynamics = (
        "<dynamics><damping>0.4</damping><friction>0.2</friction><spring_stiffness>3</spring_stiffness>"
        "<spring_reference>0.1</spring_reference></dynamics>"
    )
    mimic = '<mimic joint="j1"><multiplier>2</multiplier><offset>0.3</offset><reference>0.1</reference></mimic>'
    content = link("a") + link("b", "1 0 0 0 0 0") + joint("j1", "world", "a", limit + dynamics)
    draft = imported(tmp_path, model(content + joint("j2", "a", "b", mimic)))
    mechanism = draft.build_mechanism()
    assert mechanism.tree.limits()[0][0] == -np.inf
    assert mechanism.tree.limits()[1][0] == 0.7
    assert (mechanism.springs.joint_damping[0], mechanism.joints.friction[0]) == (0.4, 0.2)
    assert (mechanism.springs.joint_stiffness[0], mechanism.springs.joint_rest[0]) == (3.0, 0.1)
    assert mechanism.d == 1
    assert_close(mechanism.q_tree[1], 2 * (mechanism.q_tree[0] - 0.1) + 0.3, 1e-12)
    lost = imported(tmp_path, model(content + joint("j2", "a", "b", mimic.replace("j1", "j9"))))
    assert has_note(lost.warnings, "mimic of joint j2", "'j9'", "1 freedom more")


@pytest.mark.parametrize(
    ("version", "flag"), [("1.4", ""), ("1.6", "<use_parent_model_frame>1</use_parent_model_frame>")]
)
def test_axis_may_be_in_the_frame_of_the_model(version: str, flag: str, tmp_path: Path) -> None:
    """The model's y axis is the world's -x axis, because the model is turned by 90 degrees about z."""
    turned = "<pose>0 0 0 0 0 1.5707963267948966</pose>"
    content = turned + link("a", "0 0 0 0.3 0.4 0.5") + joint("j", "world", "a", flag)
    mechanism = imported(tmp_path, sdf(f'<model name="m">{content}</model>', version)).build_mechanism()
    placement, jacobian = mechanism.tree.kinematics(mechanism.tree.neutral())
    assert_close(jacobian[3:, 0], [-1.0, 0.0, 0.0], 1e-12)
    assert_close(placement[1, 9:], [0.0, 0.0, 0.0], 1e-12)


@pytest.mark.parametrize(
    ("kind", "missing", "axes"),
    [("revolute2", "axis2", ("1 0 0", "0 0 1")), ("universal", "axis axis2", ("1 0 0", "0 1 0"))],
)
def test_missing_axes_are_those_of_gazebo_and_said(
    kind: str, missing: str, axes: tuple[str, str], tmp_path: Path
) -> None:
    """Gazebo reads <axis2> of `revolute2` with SDFormat's direction. ODE's universal joint turns about x and y."""
    one, two = (f"<{tag}><xyz>{xyz}</xyz></{tag}>" for tag, xyz in zip(("axis", "axis2"), axes, strict=True))
    written = link("a", "0 0 0 0.3 0.4 0.5") + joint("j", "world", "a", kind=kind, axis=axes[0])
    complete = imported(tmp_path, model(written.replace(one, one + two)))
    assert not has_note(complete.guessed, "Gazebo's default")
    draft = imported(tmp_path, model(written.replace(one, "" if "axis axis2" in missing else one)))
    for tag, xyz in zip(("axis", "axis2"), axes, strict=True):
        note = f"<{tag}> of {kind} joints is Gazebo's default, {xyz}: j"
        assert has_note(draft.guessed, note) == (tag in missing.split())
    assert draft.urdf_text() == complete.urdf_text()


def test_gearbox_turns_the_child_against_the_parent(tmp_path: Path) -> None:
    """SDFormat: theta of the child = -ratio * theta of the parent, from the reference body."""
    gear = (
        '<joint name="gear" type="gearbox"><parent>rotor</parent><child>arm</child><gearbox_ratio>0.25</gearbox_ratio>'
        "<gearbox_reference_body>base</gearbox_reference_body><axis><xyz>0 1 0</xyz></axis>"
        "<axis2><xyz>0 {} 0</xyz></axis2></joint>"
    )
    for sign in (1, -1):
        content = link("base") + link("rotor") + link("arm") + joint("fix", "world", "base", kind="fixed")
        content += joint("in", "base", "rotor", axis="0 -1 0") + joint("out", "base", "arm")
        mechanism = imported(tmp_path, model(content + gear.format(sign))).build_mechanism()
        assert mechanism.d == 1
        ((coupling, comment),) = read(tmp_path / "thing.sdf").couplings
        assert (coupling.joint, coupling.other, coupling.ratio, comment) == ("out", "in", 0.25 * sign, "gearbox gear")
    lost = imported(tmp_path, model(content + gear.replace(">base<", ">world<").format(1)))
    assert has_note(lost.warnings, "gearbox gear", "1 freedom more")


def test_models_of_a_world_and_included_ones_are_read(tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    inner = link("upper") + link("lower", "0 0 1 0 0 0") + joint("elbow", "upper", "lower")
    arm = sdf(f'<model name="arm">{inner}</model>')
    include = "<include><uri>model://arm</uri><name>left</name><pose>0 2 0 0 0 0</pose></include>"
    hold = '<joint name="hold" type="fixed"><parent>world</parent><child>left::upper</child></joint>'
    ground = f'<model name="ground"><static>true</static>{link("slab")}</model>'
    world = f'<world name="w"><gravity>0 -1 -2</gravity>{ground}{include}{hold}</world>'
    draft = imported(tmp_path, sdf(world), models_in_arm_in_model__sdf=arm)
    assert draft.gravity == (0.0, -1.0, -2.0)
    mechanism = draft.build_mechanism()
    assert mechanism.coordinates == ("left::elbow",)
    placement, _ = mechanism.tree.kinematics(mechanism.tree.neutral())
    assert_close(placement[1, 9:], [0.0, 2.0, 1.0], 1e-15)


def test_a_model_that_nothing_holds_is_free_at_its_pose(tmp_path: Path) -> None:
    content = "<pose>1 2 3 0 0 1.5</pose>" + link("a", "0 0 1 0 0 0") + link("b") + joint("j", "a", "b")
    draft = imported(tmp_path, model(content))
    assert has_note(draft.guessed, "a is free, with the coordinates root.x to root.rz")
    assert_close([draft.q_guess[f"root.{x}"] for x in ("x", "y", "z", "rz")], [1.0, 2.0, 4.0, 1.5], 1e-12)
    assert draft.build_mechanism().d == 7


def test_masses_that_the_file_does_not_give_are_one_and_said(tmp_path: Path) -> None:
    draft = imported(tmp_path, model(link("a", inner="") + joint("j", "world", "a")))
    assert has_note(draft.guessed, "SDFormat's default, 1 kg", ": a")
    assert float(draft.robot.find("link[@name='a']/inertial/mass").get("value")) == 1.0


def test_elements_that_are_not_read_are_named(tmp_path: Path) -> None:
    inner = INERTIAL + "<collision name='c'/><sensor name='s'/>"
    content = link("a", inner=inner) + joint("j", "world", "a") + "<plugin name='p' filename='x'/>"
    draft = imported(tmp_path, model(content + "<drake:distance_constraint/>"))
    assert set(draft.left_out) == {"1 <collision> of <link>", "1 <sensor> of <link>", "1 <plugin> of <model>"}
    assert has_note(draft.warnings, "1 <drake:distance_constraint> of <model>", "freedoms")


REFUSED = {
    "broken XML": ("<sdf><model", "malformed XML"),
    "no model": (sdf(""), "no <model>"),
    "no version": (sdf("", "new"), "expected a version"),
    "a word": (model(link("a", "0 0 up 0 0 0")), "'0 0 up 0 0 0' is not 6 finite numbers"),
    "no quaternion": (
        model('<link name="a"><pose rotation_format="quat_xyzw">0 0 0 0 0 0 0</pose></link>'), "no rotation",
    ),
    "an unknown frame": (model('<link name="a"><pose relative_to="x"/></link>'), "there is no frame 'x'"),
    "a cycle of poses": (
        model('<link name="a"><pose relative_to="b"/></link><link name="b"><pose relative_to="a"/></link>'), "a cycle",
    ),
    "a cycle of frames": (
        model('<frame name="f" attached_to="g"/><frame name="g" attached_to="f"/>' + link("a") + joint("j", "f", "a")),
        "attached to itself",
    ),
    "two of one name": (model(link("a") + link("a")), "two frames are called 'm::a'"),
    "a joint to nothing": (model(link("a") + joint("j", "world", "x")), "there is no frame 'x'"),
    "a joint with itself": (model(link("a") + joint("j", "a", "a")), "with itself"),
    "two joints on one pair": (model(FOUR_BAR + joint("again", "a", "b")), "both connect links 'a' and 'b'"),
    "no child": (model(link("a") + '<joint name="j" type="fixed"><parent>a</parent></joint>'), "has no <child>"),
    "no axis": (
        model(link("a") + '<joint name="j" type="screw"><parent>world</parent><child>a</child></joint>'), "no <axis>",
    ),
    "a zero axis": (model(link("a") + joint("j", "world", "a", axis="0 0 0")), "expected a direction"),
    "an unknown type": (model(link("a") + joint("j", "world", "a", kind="wobbly")), "unsupported type 'wobbly'"),
    "an unknown include": (model("<include><uri>model://nothing</uri></include>"), "no such file"),
    "an include of itself": (model("<include><uri>thing.sdf</uri></include>"), "cannot include itself"),
    "a far include": (model("<include><uri>../../../../etc/x.sdf</uri></include>"), "no such file"),
    "a negative mass": (model(link("a", inner=INERTIAL.replace(">1<", ">-1<"))), "negative mass"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_bad_files_are_refused(what: str, tmp_path: Path) -> None:
    text, message = REFUSED[what]
    with pytest.raises((InputError, MechanismError)) as refused:
        imported(tmp_path, text)
    assert message in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "thing.sdf"))
