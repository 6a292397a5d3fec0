"""Random mechanisms: a loop's frames are put where a random configuration closes it, so each assembles exactly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scripts.experiments.fuzz.build import Builder
from scripts.experiments.fuzz.spatial import Array, rotation
from scripts.experiments.mechanism_files import closing_frame

__all__ = ["RandomMechanism", "random_mechanism"]

ROWS = {"point": 3, "hinge": 5, "cylindrical": 4, "universal": 4, "prismatic": 5, "weld": 6, "distance": 1}
FLAT_ROWS = {"point_2d": 2, "point": 2, "hinge": 2, "cylindrical": 2, "distance": 1}
SCENE = 'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\n\n[initial]\nat = "assembled"\n'


@dataclass(frozen=True)
class RandomMechanism:
    """The texts of a mechanism's files and what kind it is."""

    kind: str
    texts: dict[str, str]

    def write(self, folder: Path) -> Path:
        """Write the files to a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in {**self.texts, "default.scene.toml": SCENE}.items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder


def random_mechanism(seed: int) -> RandomMechanism:
    """A mechanism from a seed."""
    random = np.random.default_rng([seed, 1])
    kind = str(random.choice(["planar", "planar loops", "spatial", "spatial loops", "floating", "platform"]))
    builder = Builder(random, kind.replace(" ", "_"), free=kind in ("floating", "platform"))
    if random.random() < 0.2:
        builder.scale = float(10 ** random.uniform(-2, 2))
    builder.stands = np.array([builder.vector(0.5), random.uniform(-3, 3, 3)]) * (random.random() < 0.7)
    down = random.normal(size=3)
    builder.gravity = 9.81 * down / np.linalg.norm(down) * (random.random() < 0.9)
    if random.random() < 0.5:
        builder.gravity = builder.gravity * builder.scale
    if builder.free:
        for label, x in zip(("x", "y", "z", "rx", "ry", "rz"), random.uniform(-1, 1, 6).tolist(), strict=True):
            builder.guess[f"root.{label}"] = x * (builder.scale if "r" not in label else 1.0)
    flat = None
    if kind.startswith("planar") or (kind == "floating" and random.random() < 0.5):
        flat = rotation(random.normal(size=(1, 3)))[0][2] if random.random() < 0.7 else np.array([0.0, 0.0, 1.0])
    freedoms = int(random.choice([1, 1, 2, 3] if "loops" not in kind else [1, 2]))
    if kind == "platform":
        _platform(builder)
    elif kind.endswith("loops"):
        _two_loops(builder, flat, freedoms)
    else:
        _one_loop(builder, flat, freedoms)
    _springs(builder)
    return RandomMechanism(f"{kind}{'' if flat is None or kind.startswith('planar') else ' planar'}", builder.texts())


def _chain(builder: Builder, name: str, count: int, flat: Array | None, parent: str = "base") -> list[str]:
    """Links one after the other."""
    random, links = builder.random, [parent]
    for k in range(count):
        slides = random.random() < 0.12
        axis = (
            builder.vector(1.0, flat if slides else None) if flat is None or slides else flat * random.choice([-1, 1])
        )
        axis = axis / np.linalg.norm(axis) * random.choice([1.0, 1.0, -1.0, 2.5])
        at = builder.vector(0.7, flat) if k or name != "a" else np.zeros(3)
        joint = "prismatic" if slides else str(random.choice(["continuous", "continuous", "revolute"]))
        links.append(builder.joint(f"{name}{k + 1}", joint, links[-1], at, axis, flat))
    return links[1:]


def _close(builder: Builder, kind: str, a: str, b: str, flat: Array | None, name: str = "loop") -> None:
    """A loop between two links, which the guess closes."""
    random = builder.random
    placement_a, placement_b = builder.placement(a), builder.placement(b)
    inside = builder.turns[a].T @ builder.vector(0.6, flat)
    axis = random.normal(size=3) if flat is None else builder.turns[a].T @ flat
    across = np.cross(axis, random.normal(size=3))
    across /= np.linalg.norm(across)
    length = float(builder.scale * random.uniform(0.2, 0.8))
    offset = np.zeros(3)
    if kind == "distance":
        offset = length * across
    elif kind in ("cylindrical", "prismatic"):  # a prismatic loop draws a number too, so that seeds stay the same
        offset = axis / np.linalg.norm(axis) * builder.scale * random.uniform(-0.2, 0.2)
        offset = offset if kind == "cylindrical" else np.zeros(3)
    xyz, rpy = closing_frame(placement_a, placement_b, inside + offset)
    loop: dict[str, Any] = {
        "name": name,
        "type": kind,
        "frame_a": {"link": a, "xyz": inside},
        "frame_b": {"link": b, "xyz": xyz, "rpy": rpy},
    }
    if kind == "distance":
        loop["length"] = length
    else:
        loop["axis_a"] = axis
        loop["axis_b"] = across if kind == "universal" else axis
    if kind in ("point", "hinge", "universal", "weld") and random.random() < 0.5:
        loop["rows_in"] = "world"
    builder.loops.append(loop)


def _one_loop(builder: Builder, flat: Array | None, freedoms: int) -> None:
    random = builder.random
    rows = ROWS if flat is None else FLAT_ROWS
    kind = str(random.choice(list(rows)))
    coupled = random.random() < 0.15
    n = rows[kind] + freedoms + coupled
    first = int(random.integers((n + 1) // 2, n + 1))
    a = _chain(builder, "a", first, flat)
    b = _chain(builder, "b", n - first, flat) or ["base"]
    _close(builder, kind, a[-1], b[-1], flat)
    if random.random() < 0.15:
        again = dict(builder.loops[0], name="again")
        builder.loops.append(again)
    if coupled:
        one, other = random.choice([part.name for part in builder.parts], 2, replace=False).tolist()
        ratio = float(random.uniform(-1.5, 1.5))
        offset = builder.guess[one] - ratio * builder.guess[other]
        builder.couplings.append({"joint": one, "other": other, "ratio": ratio, "offset": offset})


def _two_loops(builder: Builder, flat: Array | None, freedoms: int) -> None:
    """A trunk with two branches that close on it, or on the ground."""
    random = builder.random
    rows = ROWS if flat is None else FLAT_ROWS
    kinds = random.choice(["point", "point_2d", "hinge"] if flat is not None else ["point", "distance", "universal"], 2)
    n = sum(rows[str(kind)] for kind in kinds) + freedoms
    trunk = _chain(builder, "a", (n + 1) // 2, flat)
    second = (n - len(trunk)) // 2
    for name, count, kind in zip("bc", (second, n - len(trunk) - second), kinds, strict=True):
        links = _chain(builder, name, count, flat) or ["base"]
        at = trunk[-1] if name == "b" else trunk[int(random.integers(len(trunk) // 2, len(trunk)))]
        _close(builder, str(kind), at, links[-1], flat, f"loop_{name}")


def _platform(builder: Builder) -> None:
    """A free plate tied to the world by rods and points, or by legs whose joints tell where it is."""
    random = builder.random
    partly = [["distance"] * 5, ["distance"] * 4, ["point", "distance"], ["hinge"], ["universal"], ["point"]]
    legged = [["weld"], ["weld", "distance"], ["point"] * 3, ["hinge", "universal"], ["point", "hinge"]]
    whole = random.random() < 0.7
    kinds = legged[int(random.integers(len(legged)))] if whole else partly[int(random.integers(len(partly)))]
    rows = sum(ROWS[kind] for kind in kinds)
    joints = max(0, rows - 6) + int(random.integers(1, 3)) if whole else int(random.integers(0, 3))
    share = np.diff([0, *sorted(random.integers(0, joints + 1, len(kinds) - 1).tolist()), joints])
    for k, (kind, count) in enumerate(zip(kinds, share, strict=True)):
        leg = _chain(builder, "abcdef"[k], int(count), None) or ["base"]
        _close(builder, kind, leg[-1], "world", None, f"loop_{k}")


def _springs(builder: Builder) -> None:
    random = builder.random
    for _ in range(int(random.choice([0, 0, 0, 1, 2]))):
        stiffness = float(10 ** random.uniform(0, 3))
        damping = float(10 ** random.uniform(-2, 1)) if random.random() < 0.5 else 0.0
        part = builder.parts[int(random.integers(len(builder.parts)))] if builder.parts else None
        if part is not None and random.random() < 0.5:
            taken = {spring.get("joint") for spring in builder.springs}
            unit = builder.scale**2 if part.kind != "prismatic" else 1.0
            rest = float(random.uniform(-1, 1) * (builder.scale if part.kind == "prismatic" else 1.0))
            if part.name not in taken:
                builder.springs.append(
                    {
                        "joint": part.name,
                        "rest": rest,
                        "stiffness": 0.1 * stiffness * unit,
                        "damping": 0.1 * damping * unit,
                    }
                )
        else:
            link = f"{part.name}_link" if part is not None else "base"
            builder.springs.append({
                "frame_a": "world", "frame_b": {"link": link, "xyz": builder.vector(0.4)},
                "rest_length": float(random.uniform(0, 0.5) * builder.scale),
                "stiffness": stiffness, "damping": damping,
            })  # fmt: skip
