"""Read an SDFormat file: models with loops, nested and included models, and frames relative to each other.

Every <link> becomes a link, every <joint> a joint of the graph. Poses are those of the file, at which all joints are
zero. A model that no joint fixes to the world is free.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import parse_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import choose_name, list_names, make_unique, round_number, round_vector
from ckc_pin.formats.repository import find_in_repository
from ckc_pin.formats.robot import Joint, Link, Robot, ball_axes
from ckc_pin.formats.sdf.elements import (
    JOINT_KINDS,
    attach_links,
    parse_pose,
    read_axes,
    read_link,
    read_numbers,
    read_pitch,
)
from ckc_pin.formats.sdf.frames import MODEL_FRAME, WORLD, FrameGraph, join
from ckc_pin.mechanism.spec import CouplingSpec

__all__ = ["read_sdf"]

FULL = "="  # before a name that is complete already
TRUE = ("true", "1")
LATEST = "1.12"  # version of a file that gives none
MAX_DEPTH = 20  # nested and included models
READ = {  # other elements are left out with a note
    "sdf": "world",
    "world": "model include gravity joint frame",
    "include": "uri name pose static placement_frame",
    "model": "link joint frame model include pose static drake:ball_constraint plugin",
    "link": "pose inertial visual",
    "joint": "parent child pose axis axis2 screw_thread_pitch thread_pitch gearbox_ratio gearbox_reference_body",
}
IRRELEVANT = "self_collide light scene physics gui allow_auto_disable enable_wind state spherical_coordinates"
MOTOR_PLUGINS = ("JointController", "JointPositionController", "ApplyJointForce")


def read_sdf(text: str, path: Path) -> Robot:
    """Read an SDFormat file."""
    return _Reader(path).read(parse_xml(text, str(path)))


@dataclass
class _Pending:
    """A joint or constraint whose frames are resolved after all frames are known."""

    element: Element
    scope: str
    version: tuple[int, ...]


@dataclass
class _Reader:
    """What was read of a file so far."""

    path: Path
    frames: FrameGraph = field(default_factory=FrameGraph)
    links: dict[str, Link] = field(default_factory=dict)
    pending: list[_Pending] = field(default_factory=list)
    static: list[str] = field(default_factory=list)
    canonical: dict[str, str] = field(default_factory=dict)
    unread: Counter[str] = field(default_factory=Counter)
    notes: dict[str, list[str]] = field(default_factory=dict)
    actuated: list[tuple[str, str]] = field(default_factory=list)
    prefix: str = ""

    def read(self, root: Element) -> Robot:
        version = _parse_version(root.get("version", LATEST), str(self.path))
        world = root.find("world")
        if world is None:
            world = Element("world")
            world.extend(root)
        else:
            self._count_unread(root)
        self._count_unread(world)
        models = [(element, self.path) for element in world.findall("model")]
        models += [self._open_include(element, self.path) for element in world.findall("include")]
        if not models:
            raise InputError(f"{self.path}: no <model>")
        declared = models[0][0].get("name", "")
        if len(models) == 1 and world.find("joint") is None:
            self.prefix = f"{declared}::"
        for element, path in models:
            self._add_model(element, "", version, path, ())
        for element in world.findall("frame"):
            self._add_frame(element, "")
        self.pending += [_Pending(element, "", version) for element in world.findall("joint")]
        name, origin = choose_name(self.path, declared), f"{self.path.name}, an SDFormat file"
        robot = Robot(name=name, origin=origin, source=str(self.path))
        robot.links = {WORLD: Link(), **{self._short(name): link for name, link in self.links.items()}}
        self._place_frames()
        self._add_joints(robot)
        self._add_roots(robot)
        default = "0 0 -9.8" if root.find("world") is not None else "0 0 -9.81"
        robot.gravity = round_vector(read_numbers(world, "gravity", default, 3, f"{self.path}: <world>"))
        if world.find("gravity") is None:
            robot.guessed.append(f"gravity is {robot.gravity[2]:g} m/s² along z, because the file does not give it")
        robot.guessed += [f"{what}: {list_names(names)}" for what, names in self.notes.items()]
        robot.leave_out(self.unread)
        actuated = dict.fromkeys(self._short(join(*item)) for item in self.actuated)
        robot.actuated = [name for name in actuated if name in robot.axes] or None
        return robot

    def _short(self, name: str) -> str:
        """Return a full name without the file's only model."""
        return name.removeprefix(self.prefix)

    def _count_unread(self, element: Element) -> None:
        tags = f"{READ[element.tag]} {IRRELEVANT}".split()
        self.unread.update(f"<{child.tag}> of <{element.tag}>" for child in element if child.tag not in tags)

    # --- models ------------------------------------------------------------------------------------

    def _open_include(self, element: Element, path: Path, opened: tuple[Path, ...] = ()) -> tuple[Element, Path]:
        """Return the model of an <include>, renamed and placed as the element says, and its file."""
        self._count_unread(element)
        uri = (element.findtext("uri") or "").strip()
        where = f"{path}: <include> {uri!r}"
        file = find_in_repository(uri, path, where, "model.sdf")
        if file in opened:
            raise InputError(f"{where}: a model cannot include itself")
        if len(opened) > MAX_DEPTH:
            raise InputError(f"{where}: models nested more than {MAX_DEPTH} deep are not accepted")
        root = parse_xml(read_text(file, "SDFormat model"), str(file))
        model = root.find("model")
        if model is None:
            raise InputError(f"{where}: {file.name} has no <model>")
        model.set("version", root.get("version", LATEST))
        model.set("name", str(element.findtext("name") or model.get("name", "model")))
        if element.get("merge", "false").lower() in TRUE:
            raise InputError(
                f"{where}: merge is not supported; remove it and write {model.get('name')}::NAME for names inside"
            )
        for tag in ("pose", "static"):
            if (override := element.find(tag)) is not None:
                for old in model.findall(tag):
                    model.remove(old)
                model.append(override)
        if placed := element.findtext("placement_frame"):
            model.set("placement_frame", placed.strip())
        return model, file

    def _add_model(
        self, element: Element, scope: str, version: tuple[int, ...], path: Path, opened: tuple[Path, ...]
    ) -> None:
        where = f"{self.path}: model {element.get('name')!r}"
        version = _parse_version(element.attrib["version"], where) if "version" in element.attrib else version
        if not element.get("name"):
            raise InputError(f"{self.path}: a <model> has no name")
        if len(opened) + scope.count("::") > MAX_DEPTH:
            raise InputError(f"{where}: models nested more than {MAX_DEPTH} deep are not accepted")
        name = join(scope, element.attrib["name"])
        self._count_unread(element)
        model_frame = join(name, MODEL_FRAME)
        outer = f"{FULL}{join(scope, MODEL_FRAME)}" if scope else WORLD
        placed = element.get("placement_frame", "")
        links = [join(name, link.get("name", "")) for link in element.findall("link")]
        pose = element.find("pose")
        self.frames.add(
            model_frame, where, self._target(pose, outer), parse_pose(pose, where), "",
            f"{FULL}{join(name, placed)}" if placed else "",
        )  # fmt: skip
        for link in element.findall("link"):
            self._add_link(link, name)
        for frame in element.findall("frame"):
            self._add_frame(frame, name)
        nested = [(inner, path, opened) for inner in element.findall("model")]
        for include in element.findall("include"):
            inner, file = self._open_include(include, path, (*opened, path.resolve()))
            nested.append((inner, file, (*opened, path.resolve(), file)))
        for inner, file, chain in nested:
            self._add_model(inner, name, version, file, chain)
        canonical = element.get("canonical_link")
        inner_links = [self.canonical[join(name, inner.attrib["name"])] for inner, _, _ in nested]
        self.canonical[name] = next(iter([join(name, canonical)] if canonical else links or inner_links), "")
        self.frames.frames[model_frame].attached_to = f"{FULL}{self.canonical[name]}" if self.canonical[name] else ""
        if (element.findtext("static") or "").strip().lower() in TRUE:
            self.static += [link for link in self.links if link.startswith(f"{name}::")]
        for joint in element.findall("joint"):
            child = (joint.findtext("child") or "").strip()
            joint_name, where_joint = self._joint_frame(name, joint), f"{self.path}: joint {joint.get('name')!r}"
            pose = joint.find("pose")
            relative_to = self._target(pose, child)
            self.frames.add(joint_name, where_joint, relative_to, parse_pose(pose, where_joint), child)
            self.pending.append(_Pending(joint, name, version))
        self.pending += [_Pending(e, name, version) for e in element.findall("drake:ball_constraint")]
        for plugin in element.findall("plugin"):
            kinds = plugin.get("name", "") + plugin.get("filename", "")
            if any(kind in kinds for kind in MOTOR_PLUGINS):
                self.actuated += [(name, (e.text or "").strip()) for e in plugin.findall("joint_name")]
            elif "DetachableJoint" in kinds:
                self.pending.append(_Pending(plugin, name, version))
            else:
                self.unread["<plugin> of <model>"] += 1

    def _add_link(self, element: Element, scope: str) -> None:
        name, where = join(scope, element.get("name", "")), f"{self.path}: link {element.get('name')!r}"
        if not element.get("name"):
            raise MechanismError(f"{self.path}: a <link> has no name")
        pose = element.find("pose")
        default = f"{FULL}{join(scope, MODEL_FRAME)}"
        self.frames.add(name, where, self._target(pose, default), parse_pose(pose, where))
        self.links[name] = read_link(element, where, self.notes)
        self._count_unread(element)

    def _add_frame(self, element: Element, scope: str) -> None:
        where, pose = f"{self.path}: frame {element.get('name')!r}", element.find("pose")
        root = f"{FULL}{join(scope, MODEL_FRAME)}" if scope else WORLD
        attached = element.get("attached_to", "")
        target = self._target(pose, attached or root)
        self.frames.add(join(scope, element.get("name", "")), where, target, parse_pose(pose, where), attached or root)

    def _target(self, pose: Element | None, default: str) -> str:
        """Return the frame of a pose as it is written. `_place_frames` replaces it by its full name."""
        return (pose.get("relative_to") or pose.get("frame") or default) if pose is not None else default

    def _place_frames(self) -> None:
        """Replace the names to which frames refer by full names."""
        for name, frame in self.frames.frames.items():
            scope = name.removesuffix(f"::{MODEL_FRAME}").rpartition("::")[0]
            for key in ("relative_to", "attached_to", "placed"):
                target = getattr(frame, key)
                if target.startswith(FULL):
                    setattr(frame, key, target.removeprefix(FULL))
                elif target and target != WORLD:
                    setattr(frame, key, self.frames.find(target, scope, frame.where))

    # --- joints ------------------------------------------------------------------------------------

    def _add_joints(self, robot: Robot) -> None:
        gearboxes = []
        for pending in self.pending:
            element, scope = pending.element, pending.scope
            if element.tag == "drake:ball_constraint":
                self._add_ball_constraint(robot, element, scope)
                continue
            if element.tag == "plugin":
                self._add_detachable_joint(robot, element, scope)
                continue
            self._count_unread(element)
            if element.get("type") == "gearbox":
                gearboxes.append(pending)
            else:
                robot.add_joint(self._joint(pending))
        for pending in gearboxes:
            where = f"{self.path}: joint {pending.element.get('name')!r}"
            self._add_gearbox(robot, pending, where)
        self._resolve_mimics(robot)

    def _ends(self, element: Element, scope: str, where: str) -> list[str]:
        """Return the full names of the frames <parent> and <child>."""
        ends = []
        for tag in ("parent", "child"):
            name = (element.findtext(tag) or "").strip()
            if not name:
                raise InputError(f"{where}: it has no <{tag}>")
            ends.append(self.frames.find(name, scope, f"{where}, <{tag}>"))
        return ends

    def _joint(self, pending: _Pending) -> Joint:
        element, scope = pending.element, pending.scope
        name, kind = element.get("name", ""), element.get("type", "")
        where = f"{self.path}: joint {name!r}"
        if not name:
            raise InputError(f"{self.path}: a <joint> has no name")
        if kind not in JOINT_KINDS:
            choices = ", ".join((*JOINT_KINDS, "gearbox"))
            raise MechanismError(f"{where}: unsupported type {kind!r}; expected one of {choices}")
        parent, child = self._ends(element, scope, where)
        full_name = self._joint_frame(scope, element)
        if full_name not in self.frames.frames:  # a joint of the world
            pose = element.find("pose")
            target = self.frames.find(self._target(pose, child), scope, where)
            self.frames.add(full_name, where, target, parse_pose(pose, where), child)
        pose = self.frames.pose(full_name)
        links = [self.frames.link_of(end, where) for end in (parent, child)]

        def rotate(axis: Element, direction: Array) -> Array:
            return pose.rotation.T @ self._axes_of(axis, scope, full_name, pending.version, where) @ direction

        poses = [self.frames.pose(link).inverse() * pose for link in links]
        axes = read_axes(element, kind, rotate, where, self.notes)
        joint = Joint.between(
            self._short(join(scope, name)), JOINT_KINDS[kind], [*map(self._short, links)], poses, axes
        )
        return replace(joint, pitch=read_pitch(element, where) if kind == "screw" else 0.0)

    def _joint_frame(self, scope: str, joint: Element) -> str:
        """Return the name of a joint's frame. Old files give a link and a joint one name, which then means the link."""
        name = join(scope, joint.get("name", ""))
        return f"{name} (joint)" if name in self.links else name

    def _axes_of(self, axis: Element, scope: str, joint: str, version: tuple[int, ...], where: str) -> Array:
        """Return the world's rotation of the frame in which an axis is written."""
        xyz = axis.find("xyz")
        expressed_in = "" if xyz is None else xyz.get("expressed_in", "")
        uses_model = (axis.findtext("use_parent_model_frame") or "").strip().lower() in TRUE
        if expressed_in:
            frame = self.frames.find(expressed_in, scope, f"{where}, <xyz>")
        else:
            frame = join(scope, MODEL_FRAME) if scope and (uses_model or version < (1, 5)) else joint
        return np.array(self.frames.pose(frame).rotation)

    def _resolve_mimics(self, robot: Robot) -> None:
        """Give mimics the names of the robot's coordinates; leave out those of joints that do not exist."""
        axes = robot.axes
        for joint in robot.joints.values():
            scope = joint.name.rpartition("::")[0]
            for axis in (axis for axis in joint.axes if axis.mimic is not None):
                master, *line = axis.mimic or ("", 1.0, 0.0)
                name = next((n for n in (join(scope, master), master) if n in axes and n != joint.name), None)
                axis.mimic = (name, line[0], line[1]) if name else None
                if name is None:
                    robot.warnings.append(
                        f"mimic of joint {joint.name} is left out, because {master!r} is not another joint; there is 1 "
                        "freedom more"
                    )

    def _add_ball_constraint(self, robot: Robot, element: Element, scope: str) -> None:
        where = f"{self.path}: <drake:ball_constraint>"
        ends, poses = [], []
        for body, point in (("body_A", "p_AP"), ("body_B", "p_BQ")):
            name = (element.findtext(f"drake:ball_constraint_{body}") or "").strip()
            ends.append(self.frames.link_of(self.frames.find(name, scope, where), where))
            xyz = read_numbers(element, f"drake:ball_constraint_{point}", "0 0 0", 3, where)
            poses.append(pin.SE3(np.eye(3), np.array(xyz)))
        links = [self._short(end) for end in ends]
        name = make_unique("_".join(links), robot.joints)
        robot.add_joint(replace(Joint.between(name, "ball", links, poses, ball_axes()), closes=True))

    def _add_detachable_joint(self, robot: Robot, element: Element, scope: str) -> None:
        """Attach two links. The child is in a model beside this one, or in this one under any name."""
        tags = ("child_model", "parent_link", "child_link")
        model, parent, child = ((element.findtext(tag) or "").strip() for tag in tags)
        beside = join(join(scope.rpartition("::")[0], model), child)
        full = {self._short(name): name for name in (join(scope, parent), join(scope, child), beside)}
        other = next(
            (name for name in (self._short(beside), self._short(join(scope, child))) if name in robot.links), child
        )
        attach_links(robot, self._short(join(scope, parent)), other, lambda name: self.frames.pose(full[name]))

    def _add_gearbox(self, robot: Robot, pending: _Pending, where: str) -> None:
        """Add angle of the child = -ratio * angle of the parent, both relative to the reference body."""
        element, scope = pending.element, pending.scope
        ends = self._ends(element, scope, where)
        reference = (element.findtext("gearbox_reference_body") or "").strip()
        base = self.frames.link_of(self.frames.find(reference, scope, f"{where}, <gearbox_reference_body>"), where)
        ratio = read_numbers(element, "gearbox_ratio", "1", 1, where)[0]
        turns = []
        for end, tag in zip(ends, ("axis", "axis2"), strict=True):
            axis = element.find(tag)
            direction = np.array(read_numbers(axis, "xyz", "0 0 1", 3, f"{where}, <{tag}>"))
            # Axes are written in the joint's frame, which is the child's unless a pose says otherwise.
            full_name = join(scope, element.get("name", ""))
            if axis is not None:
                direction = self._axes_of(axis, scope, full_name, pending.version, where) @ direction
            turns.append(self._turn(robot, self._short(base), self._short(self.frames.link_of(end, where)), direction))
        if None in turns:
            robot.warnings.append(
                f"gearbox {element.get('name')} is left out, because no hinges connect its links with {reference}; "
                "there is 1 freedom more"
            )
            return
        (master, sign), (follower, other_sign) = turns  # type: ignore[misc]
        spec = CouplingSpec(joint=follower, other=master, ratio=round_number(-ratio * sign * other_sign))
        robot.couplings.append((spec, f"gearbox {element.get('name')}"))

    def _turn(self, robot: Robot, base: str, link: str, axis: Array) -> tuple[str, float] | None:
        """Return the hinge between two links, and the sign of its coordinate about a direction of the world."""
        for joint in robot.joints.values():
            if joint.kind == "revolute" and {joint.parent, joint.child} == {base, link}:
                full = next(name for name in self.frames.frames if self._short(name) == joint.name)
                along = float(self.frames.pose(full).rotation @ joint.axes[0].direction @ axis)
                return joint.name, float(np.sign(along)) * (1.0 if joint.parent == base else -1.0)
        return None

    def _add_roots(self, robot: Robot) -> None:
        """Connect models with the world: static ones by fixed joints, others that no joint holds by free joints."""
        for link in dict.fromkeys(self._short(name) for name in self.static):
            self._add_root(robot, link, "fixed")
        heads = [self._short(name) for name in self.canonical.values() if name] + list(robot.links)
        reached = robot.distances(WORLD)
        for link in heads:
            if link not in reached:
                self._add_root(robot, link, "floating")
                reached = robot.distances(WORLD)

    def _add_root(self, robot: Robot, link: str, kind: str) -> None:
        full = next(name for name in self.links if self._short(name) == link)
        pose = self.frames.pose(full)
        if kind == "fixed":
            robot.add_joint(Joint(make_unique(f"{link}_fixed", robot.joints), "fixed", WORLD, link, pose))
        else:
            robot.add_free_root(link, pose)


def _parse_version(text: str, where: str) -> tuple[int, ...]:
    """Return the version of the format, such as (1, 9)."""
    try:
        return tuple(int(word) for word in text.split("."))
    except ValueError:
        raise InputError(f"{where}: <sdf version={text!r}>: expected a version, such as 1.9") from None
