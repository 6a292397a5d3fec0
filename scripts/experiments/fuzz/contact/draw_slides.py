"""Stacks, trees and racks of prismatic joints, with stops, friction and couplings; some racks are jammed."""

from __future__ import annotations

import numpy as np

from scripts.experiments.fuzz.contact.cases import RTOL, Case, choose_restitutions, mass_ratio
from scripts.experiments.fuzz.contact.stops import Contact
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.mechanism_files import toml_value

__all__ = ["draw_racks", "draw_stack", "draw_tree"]

G = 9.81


def _urdf(axes: Array, masses: Array, parents: list[int]) -> str:
    parts = ['  <link name="base"/>']
    for k, (axis, mass, parent) in enumerate(zip(axes, masses, parents, strict=True)):
        above = "base" if parent < 0 else f"b{parent}"
        words = " ".join(repr(float(x)) for x in axis)
        parts.append(
            f'  <link name="b{k}"><inertial><origin xyz="0 0 0"/><mass value="{float(mass)!r}"/>'
            '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>\n'
            f'  <joint name="x{k}" type="prismatic"><parent link="{above}"/><child link="b{k}"/>'
            f'<axis xyz="{words}"/></joint>'
        )
    return '<robot name="slides">\n' + "\n".join(parts) + "\n</robot>\n"


def _case(
    seed: int,
    random: np.random.Generator,
    kind: str,
    urdf: str,
    gravity: Array,
    contacts: dict[str, Contact],
    q: Array,
    v: Array,
    tables: str = "",
    jammed: bool = False,
) -> Case:
    names = [f"x{k}" for k in range(len(q))]
    mechanism = f'name = "slides"\nurdf = "slides.urdf"\ngravity = {gravity.tolist()}\n{tables}'
    overrides = {
        "t_end": float(random.uniform(0.3, 1.0)),
        "solver.rtol": RTOL,
        "initial": {"q": dict(zip(names, q.tolist(), strict=True)), "q_dot": dict(zip(names, v.tolist(), strict=True))},
    }
    return Case(
        seed, kind, {"mechanism.toml": mechanism, "slides.urdf": urdf}, contacts, overrides, linear=True, jammed=jammed
    )


def _start(random: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Draw gaps to the lower stops, some of them closed, and rates, some of them zero."""
    closed = random.random(count) < random.choice([0.0, 0.3, 0.8])
    rests = random.random(count) < random.choice([0.2, 0.8])
    q = np.where(closed, 0.0, random.choice([random.uniform(0.01, 0.5, count), np.full(count, 0.25)]))
    return q, np.where(rests, 0.0, random.choice([random.normal(size=count), -np.ones(count)]))


def _contacts(random: np.random.Generator, q: Array, weight: float) -> dict[str, Contact]:
    e = choose_restitutions(random, len(q))
    has_friction = random.random() < 0.4
    contacts = {}
    for k in range(len(q)):
        lower = 0.0 if random.random() < 0.9 else -np.inf
        upper = (
            float(q[k] + random.choice([0.0, random.uniform(0.01, 0.4)], p=[0.1, 0.9]))
            if random.random() < 0.3
            else np.inf
        )
        if upper <= lower:
            upper = np.inf
        friction = float(weight * 10 ** random.uniform(-2, 0.5)) if has_friction and random.random() < 0.6 else 0.0
        contacts[f"x{k}"] = Contact(friction, lower, upper, e[k])
    return contacts


def draw_stack(seed: int, random: np.random.Generator) -> Case:
    """Draw a stack of bodies on a vertical line; each rests on the stop of the body below."""
    count = int(random.integers(1, 6))
    masses = mass_ratio(random, count)
    gravity = np.array([0.0, 0.0, -G]) * float(random.choice([0.0, 1.0, 1.0, 0.1]))
    q, v = _start(random, count)
    contacts = _contacts(random, q, float(G * masses.min()))
    axes = np.tile([0.0, 0.0, 1.0], (count, 1))
    return _case(seed, random, "stack", _urdf(axes, masses, list(range(-1, count - 1))), gravity, contacts, q, v)


def draw_tree(seed: int, random: np.random.Generator) -> Case:
    """Draw a tree of prismatic joints in random directions; an impact at one stop changes all rates."""
    count = int(random.integers(2, 6))
    masses = mass_ratio(random, count)
    parents = [int(random.integers(-1, k)) for k in range(count)]
    axes = random.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    for k in range(count):  # no more than three independent directions in a row
        chain, above = [k], parents[k]
        while above >= 0:
            chain.append(above)
            above = parents[above]
        if len(chain) > 3:
            parents[k] = -1
    gravity = random.normal(size=3) * float(random.choice([0.0, 4.0]))
    q, v = _start(random, count)
    contacts = _contacts(random, q, float(max(np.linalg.norm(gravity), 1.0) * masses.min()))
    return _case(seed, random, "tree of slides", _urdf(axes, masses, parents), gravity, contacts, q, v)


def draw_racks(seed: int, random: np.random.Generator) -> Case:
    """Draw coupled prismatic joints, some with redundant couplings; a third of the cases is jammed by two stops."""
    jammed = random.random() < 0.35
    count = int(random.integers(2, 5))
    masses = mass_ratio(random, count)
    axes = np.tile([1.0, 0.0, 0.0], (count, 1))
    parents = [-1] * count if random.random() < 0.6 else list(range(-1, count - 1))
    geared = count if jammed else int(random.integers(2, count + 1))
    ratios = np.r_[1.0, random.choice([-1.0, 1.0, random.uniform(-2, 2)], geared - 1)]
    if jammed:
        ratios[1] = -abs(ratios[1]) or -1.0
    q, v = _start(random, count)
    q[:geared] = 0.0 if jammed else q[0] * ratios
    couplings = [(k, 0, ratios[k]) for k in range(1, geared)]
    if random.random() < 0.4:
        one, other = (geared - 1, geared - 2) if geared > 2 else (1, 0)
        couplings.append((one, other, ratios[one] / ratios[other]))
    tables = "".join(
        "[[coupling]]\n" + "".join(f"{key} = {toml_value(value)}\n" for key, value in table.items())
        for table in ({"joint": f"x{k}", "other": f"x{of}", "ratio": float(r)} for k, of, r in couplings)
    )
    free = ["x0", *(f"x{k}" for k in range(geared, count))]
    tables = f"independent = {toml_value(free)}\n{tables}"
    if jammed and not v[0]:
        v[0] = random.choice([-1.0, 1.0])
    v[:geared] = v[0] * ratios
    e = choose_restitutions(random, count)
    contacts = {}
    for k in range(count):
        lower, upper = (0.0, np.inf) if jammed else (q[k] - random.uniform(0, 0.3), q[k] + random.uniform(0, 0.3))
        has_friction = not jammed and random.random() < 0.2
        contacts[f"x{k}"] = Contact(
            float(masses.min() * random.uniform(0, 10)) if has_friction else 0.0, float(lower), float(upper), e[k]
        )
    case = _case(
        seed, random, "jammed racks" if jammed else "racks", _urdf(axes, masses, parents),
        np.array([random.choice([0.0, -G]), 0.0, 0.0]), contacts, q, v, tables, jammed,
    )  # fmt: skip
    start = case.overrides["initial"]
    case.overrides["initial"] = {
        key: {name: x for name, x in table.items() if name in free} for key, table in start.items()
    }
    return case
