"""Mechanisms with parts at rest on moving links: trusses on a carrier, and grippers closed on their stops."""

from __future__ import annotations

import numpy as np

from scripts.experiments.fuzz.contact.cases import Case, choose_restitutions
from scripts.experiments.fuzz.contact.stops import Contact
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.mechanism_files import format_numbers, toml_value

__all__ = ["draw_gripper", "draw_truss"]


def _link(name: str, com: Array, mass: float, moment: float) -> str:
    return (
        f'  <link name="{name}"><inertial><origin xyz="{format_numbers(com)}"/><mass value="{mass!r}"/>'
        f'<inertia ixx="{moment!r}" iyy="{moment!r}" izz="{moment!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def _joint(name: str, kind: str, parent: str, child: str, xyz: Array, rpy: Array, axis: Array) -> str:
    return (
        f'  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{format_numbers(xyz)}" rpy="{format_numbers(rpy)}"/><axis xyz="{format_numbers(axis)}"/></joint>'
    )


def draw_truss(seed: int, random: np.random.Generator) -> Case:
    """Draw a truss: two bars that form a triangle with a spinning link, so that their pins cannot move."""
    while True:
        a, b, c = random.uniform(0.4, 1, 3)
        if max(a, b, c) < 0.95 * (a + b + c - max(a, b, c)):
            break
    at_a, at_b = np.arccos((a * a + c * c - b * b) / (2 * a * c)), np.arccos((b * b + c * c - a * a) / (2 * b * c))
    angles = {"x": float(at_a), "y": float(np.pi - at_b)}
    zero, z = np.zeros(3), np.array([0.0, 0.0, 1.0])
    bar = np.r_[random.uniform(-0.3, 0.3, 2), 0.1]
    ratio = 10 ** random.uniform(0, random.choice([0.0, 4.0]))
    parts = [
        '  <link name="base"/>',
        _link("carrier", np.array([0.1, 0.2, 0.0]), float(ratio), 1e-2),
        '  <link name="table"/>',
        _link("A", bar, 1.0, 1e-2),
        _link("B", bar, 1.0, 1e-2),
        _joint("c", "continuous", "base", "carrier", zero, zero, np.array([0.0, 1.0, 0.0])),
        _joint("f", "fixed", "carrier", "table", np.array([0.2, 0.1, -0.3]), random.uniform(-1, 1, 3), z),
        _joint("x", "continuous", "table", "A", zero, zero, z),
        _joint("y", "continuous", "table", "B", np.array([c, 0.0, 0.0]), zero, z),
    ]
    kind = str(random.choice(["hinge", "point", "cylindrical"]))
    mechanism = (
        f'name = "truss"\nurdf = "truss.urdf"\ngravity = {toml_value(random.normal(size=3) * 5)}\n[q_guess]\n'
        + "".join(f"{key} = {value!r}\n" for key, value in angles.items())
        + f'[[loop]]\nname = "tip"\ntype = "{kind}"\n'
        f'frame_a = {{link = "A", xyz = {toml_value([float(a), 0.0, 0.0])}}}\n'
        f'frame_b = {{link = "B", xyz = {toml_value([float(b), 0.0, 0.0])}}}\n'
    )
    contacts = {}
    for (name, angle), e in zip(angles.items(), choose_restitutions(random, 2), strict=True):
        friction = float(random.uniform(0.01, 1)) if random.random() < 0.6 else 0.0
        if friction == 0.0 or random.random() < 0.4:
            lower, upper = random.permutation([0.0, random.uniform(0.1, 1.0)])
            contacts[name] = Contact(friction, angle - float(lower), angle + float(upper), e)
        else:
            contacts[name] = Contact(friction)
    if random.random() < 0.3:
        contacts["c"] = Contact(float(random.uniform(0.01, 0.3)))
    overrides = {
        "t_end": 1.0, "solver.rtol": float(10 ** random.uniform(-11, -3)),
        "initial": {"at": "assembled", "q_dot": {"c": float(random.uniform(1, 4))}},
    }  # fmt: skip
    files = {"mechanism.toml": mechanism, "truss.urdf": '<robot name="truss">\n' + "\n".join(parts) + "\n</robot>\n"}
    return Case(seed, "trusses", files, contacts, overrides, quiet=frozenset("xy"), compares_steps="c" not in contacts)


def draw_gripper(seed: int, random: np.random.Generator) -> Case:
    """Draw fingers at rest on their stops, at the end of a moving arm.

    The fingers stay at rest for one of two reasons. Either they are coupled, have equal masses and are arranged around
    one point, so that their inertial forces cancel. Or a closing force exceeds the inertial forces many times.
    """
    count = int(random.choice([2, 2, 3]))
    pressed = random.random() < 0.5
    coupled = not pressed or random.random() < 0.7
    moved = int(random.integers(1, 4))
    parts, parent = ['  <link name="base"/>'], "base"
    zero = np.zeros(3)
    for k in range(moved):
        mass = float(10 ** random.uniform(-0.5, 0.7))
        parts.append(_link(f"arm{k}", random.uniform(-0.1, 0.1, 3), mass, 0.02 * mass))
        axis = random.normal(size=3)
        xyz = random.uniform(-0.4, 0.4, 3) if k else zero
        parts.append(
            _joint(f"a{k}", "continuous", parent, f"arm{k}", xyz, random.uniform(-3, 3, 3), axis / np.linalg.norm(axis))
        )
        parent = f"arm{k}"
    mass, at = float(10 ** random.uniform(-2.5, -0.5)), np.array([0.0, 0.0, 0.06])
    names = [f"f{k}" for k in range(count)]
    # an axis of 1 points to closed: the finger rests on its upper stop
    flips = random.choice([1.0, 1.0, -1.0], count)
    for k, name in enumerate(names):
        turn, axis = np.array([0.0, 0.0, 2 * np.pi * k / count]), np.array([0.0, flips[k], 0.0])
        parts.append(_link(f"finger{k}", zero, mass, 1e-4 * mass))
        parts.append(_joint(name, "prismatic", parent, f"finger{k}", at, turn, axis))
    mechanism = f'name = "gripper"\nurdf = "gripper.urdf"\ngravity = {toml_value(random.normal(size=3) * 6)}\n'
    independent = [f"a{k}" for k in range(moved)] + (names[:1] if coupled else names)
    mechanism += f"independent = {toml_value(independent)}\n"
    couplings = [(k, 0) for k in range(1, count)] if coupled else []
    if len(couplings) == 2 and random.random() < 0.4:
        couplings.append((2, 1))  # redundant
    for k, of in couplings:
        ratio = float(flips[k] * flips[of])
        mechanism += f'[[coupling]]\njoint = "{names[k]}"\nother = "{names[of]}"\nratio = {ratio}\n'
    if pressed:
        for k in range(count) if not coupled or random.random() < 0.5 else range(1):
            force = float(-flips[k] * mass * random.uniform(400, 4000))
            mechanism += f'[[force]]\njoint = "{names[k]}"\nvalue = {force!r}\n'
    e = choose_restitutions(random, count)
    opens = float(random.choice([-1, 1])) if not pressed else 1.0  # without a closing force also at rest when open
    stopped = [k for k in range(count) if not coupled or random.random() < 0.8] or [0]
    contacts = {}
    for k in range(count):
        limits = (-np.inf, np.inf)
        if k in stopped:
            limits = (0.0, 0.04) if opens * flips[k] > 0 else (-0.04, 0.0)
        friction = float(mass * random.uniform(0.1, 10)) if random.random() < 0.2 else 0.0
        if k in stopped or friction:
            contacts[names[k]] = Contact(friction, *limits, e[k])
    rates = {f"a{k}": float(random.normal() * 2) for k in range(moved)}
    overrides = {
        "t_end": 0.5, "solver.rtol": float(10 ** random.uniform(-11, -4)),
        "initial": {"q": dict.fromkeys(independent, 0.0), "q_dot": {**dict.fromkeys(independent, 0.0), **rates}},
    }  # fmt: skip
    files = {
        "mechanism.toml": mechanism,
        "gripper.urdf": '<robot name="gripper">\n' + "\n".join(parts) + "\n</robot>\n",
    }
    return Case(seed, "grippers", files, contacts, overrides, quiet=frozenset(names), quiet_after=1e-3)
