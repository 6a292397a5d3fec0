"""Random mechanisms. Loop frames are placed so that a random configuration closes the loops."""

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
PLANAR_ROWS = {"point_2d": 2, "point": 2, "hinge": 2, "cylindrical": 2, "distance": 1}
SCENE = 'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\n\n[initial]\nat = "assembled"\n'


@dataclass(frozen=True)
class RandomMechanism:
    """The texts of a mechanism's files, and its kind."""

    kind: str
    texts: dict[str, str]

    def write(self, folder: Path) -> Path:
        """Write the files to a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in {**self.texts, "default.scene.toml": SCENE}.items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder


def random_mechanism(seed: int) -> RandomMechanism:
    """Return the random mechanism of a seed."""
    random = np.random.default_rng([seed, 1])
    kind = str(random.choice(["planar", "planar loops", "spatial", "spatial loops", "floating", "platform"]))
    builder = Builder(random, kind.replace(" ", "_"), free=kind in ("floating", "platform"))
    if random.random() < 0.2:
        builder.scale = float(10 ** random.uniform(-2, 2))
    builder.base_pose = np.array([builder.random_vector(0.5), random.uniform(-3, 3, 3)]) * (random.random() < 0.7)
    gravity_direction = random.normal(size=3)
    builder.gravity = 9.81 * gravity_direction / np.linalg.norm(gravity_direction) * (random.random() < 0.9)
    if random.random() < 0.5:
        builder.gravity = builder.gravity * builder.scale
    if builder.free:
        for label, x in zip(("x", "y", "z", "rx", "ry", "rz"), random.uniform(-1, 1, 6).tolist(), strict=True):
            builder.guess[f"root.{label}"] = x * (builder.scale if "r" not in label else 1.0)
    plane_normal = None
    if kind.startswith("planar") or (kind == "floating" and random.random() < 0.5):
        plane_normal = (
            rotation(random.normal(size=(1, 3)))[0][2] if random.random() < 0.7 else np.array([0.0, 0.0, 1.0])
        )
    freedoms = int(random.choice([1, 1, 2, 3] if "loops" not in kind else [1, 2]))
    if kind == "platform":
        _platform(builder)
    elif kind.endswith("loops"):
        _two_loops(builder, plane_normal, freedoms)
    else:
        _one_loop(builder, plane_normal, freedoms)
    _springs(builder)
    return RandomMechanism(
        f"{kind}{'' if plane_normal is None or kind.startswith('planar') else ' planar'}", builder.to_files()
    )


def _chain(builder: Builder, name: str, count: int, plane_normal: Array | None, parent: str = "base") -> list[str]:
    """Add a serial chain of links, and return their names."""
    random, links = builder.random, [parent]
    for k in range(count):
        is_prismatic = random.random() < 0.12
        axis = (
            builder.random_vector(1.0, plane_normal if is_prismatic else None)
            if plane_normal is None or is_prismatic
            else plane_normal * random.choice([-1, 1])
        )
        axis = axis / np.linalg.norm(axis) * random.choice([1.0, 1.0, -1.0, 2.5])
        at = builder.random_vector(0.7, plane_normal) if k or name != "a" else np.zeros(3)
        joint = "prismatic" if is_prismatic else str(random.choice(["continuous", "continuous", "revolute"]))
        links.append(builder.add_joint(f"{name}{k + 1}", joint, links[-1], at, axis, plane_normal))
    return links[1:]


def _close(builder: Builder, kind: str, a: str, b: str, plane_normal: Array | None, name: str = "loop") -> None:
    """Add a loop between two links that is closed at the initial guess."""
    random = builder.random
    placement_a, placement_b = builder.compute_placement(a), builder.compute_placement(b)
    xyz_a = builder.link_axes[a].T @ builder.random_vector(0.6, plane_normal)
    axis = random.normal(size=3) if plane_normal is None else builder.link_axes[a].T @ plane_normal
    normal = np.cross(axis, random.normal(size=3))
    normal /= np.linalg.norm(normal)
    length = float(builder.scale * random.uniform(0.2, 0.8))
    offset = np.zeros(3)
    if kind == "distance":
        offset = length * normal
    elif kind in (
        "cylindrical",
        "prismatic",
    ):  # a prismatic loop also draws a number, so that the mechanisms of seeds stay the same
        offset = axis / np.linalg.norm(axis) * builder.scale * random.uniform(-0.2, 0.2)
        offset = offset if kind == "cylindrical" else np.zeros(3)
    xyz, rpy = closing_frame(placement_a, placement_b, xyz_a + offset)
    loop: dict[str, Any] = {
        "name": name,
        "type": kind,
        "frame_a": {"link": a, "xyz": xyz_a},
        "frame_b": {"link": b, "xyz": xyz, "rpy": rpy},
    }
    if kind == "distance":
        loop["length"] = length
    else:
        loop["axis_a"] = axis
        loop["axis_b"] = normal if kind == "universal" else axis
    if kind in ("point", "hinge", "universal", "weld") and random.random() < 0.5:
        loop["rows_in"] = "world"
    builder.loops.append(loop)


def _one_loop(builder: Builder, plane_normal: Array | None, freedoms: int) -> None:
    random = builder.random
    rows = ROWS if plane_normal is None else PLANAR_ROWS
    kind = str(random.choice(list(rows)))
    coupled = random.random() < 0.15
    n = rows[kind] + freedoms + coupled
    first = int(random.integers((n + 1) // 2, n + 1))
    a = _chain(builder, "a", first, plane_normal)
    b = _chain(builder, "b", n - first, plane_normal) or ["base"]
    _close(builder, kind, a[-1], b[-1], plane_normal)
    if random.random() < 0.15:
        duplicate = dict(builder.loops[0], name="again")
        builder.loops.append(duplicate)
    if coupled:
        joint, other = random.choice([part.name for part in builder.parts], 2, replace=False).tolist()
        ratio = float(random.uniform(-1.5, 1.5))
        offset = builder.guess[joint] - ratio * builder.guess[other]
        builder.couplings.append({"joint": joint, "other": other, "ratio": ratio, "offset": offset})


def _two_loops(builder: Builder, plane_normal: Array | None, freedoms: int) -> None:
    """Build a trunk with two branches that are closed on it, or on the ground."""
    random = builder.random
    rows = ROWS if plane_normal is None else PLANAR_ROWS
    kinds = random.choice(
        ["point", "point_2d", "hinge"] if plane_normal is not None else ["point", "distance", "universal"], 2
    )
    n = sum(rows[str(kind)] for kind in kinds) + freedoms
    trunk = _chain(builder, "a", (n + 1) // 2, plane_normal)
    second = (n - len(trunk)) // 2
    for name, count, kind in zip("bc", (second, n - len(trunk) - second), kinds, strict=True):
        links = _chain(builder, name, count, plane_normal) or ["base"]
        at = trunk[-1] if name == "b" else trunk[int(random.integers(len(trunk) // 2, len(trunk)))]
        _close(builder, str(kind), at, links[-1], plane_normal, f"loop_{name}")


def _platform(builder: Builder) -> None:
    """Build a free plate on rods and points, or on legs whose joint coordinates determine its pose."""
    random = builder.random
    underdetermined = [["distance"] * 5, ["distance"] * 4, ["point", "distance"], ["hinge"], ["universal"], ["point"]]
    determined = [["weld"], ["weld", "distance"], ["point"] * 3, ["hinge", "universal"], ["point", "hinge"]]
    is_determined = random.random() < 0.7
    kinds = (
        determined[int(random.integers(len(determined)))]
        if is_determined
        else underdetermined[int(random.integers(len(underdetermined)))]
    )
    rows = sum(ROWS[kind] for kind in kinds)
    joints = max(0, rows - 6) + int(random.integers(1, 3)) if is_determined else int(random.integers(0, 3))
    joint_counts = np.diff([0, *sorted(random.integers(0, joints + 1, len(kinds) - 1).tolist()), joints])
    for k, (kind, count) in enumerate(zip(kinds, joint_counts, strict=True)):
        leg = _chain(builder, "abcdef"[k], int(count), None) or ["base"]
        _close(builder, kind, leg[-1], "world", None, f"loop_{k}")


def _springs(builder: Builder) -> None:
    random = builder.random
    for _ in range(int(random.choice([0, 0, 0, 1, 2]))):
        stiffness = float(10 ** random.uniform(0, 3))
        damping = float(10 ** random.uniform(-2, 1)) if random.random() < 0.5 else 0.0
        part = builder.parts[int(random.integers(len(builder.parts)))] if builder.parts else None
        if part is not None and random.random() < 0.5:
            sprung_joints = {spring.get("joint") for spring in builder.springs}
            unit = builder.scale**2 if part.kind != "prismatic" else 1.0
            rest = float(random.uniform(-1, 1) * (builder.scale if part.kind == "prismatic" else 1.0))
            if part.name not in sprung_joints:
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
                "frame_a": "world", "frame_b": {"link": link, "xyz": builder.random_vector(0.4)},
                "rest_length": float(random.uniform(0, 0.5) * builder.scale),
                "stiffness": stiffness, "damping": damping,
            })  # fmt: skip
