"""Small mechanisms with joint friction and stops, written as files of a user."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ckc_pin.mechanism.library import library
from scripts.experiments.fuzz.contact.stops import set_limits

FORMULATIONS = ("dae", "reduced", "spf")

Make = Callable[..., Path]
Limits = tuple[float, float]


def slide(name: str, parent: str, link: str, mass: float, lower: float = -1e3) -> str:
    """Return the URDF of a link that slides along x."""
    return f"""<link name="{link}"><inertial><mass value="{mass!r}"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{link}"/><axis xyz="1 0 0"/>
        <limit lower="{lower!r}" upper="1e3" effort="1" velocity="1"/></joint>"""


@pytest.fixture
def scene_of(tmp_path: Path) -> Make:
    """Return a function that writes a URDF, a mechanism's file and a scene, and returns the scene's path."""

    def make(urdf: str, mechanism: str, start: str, t_end: float) -> Path:
        (tmp_path / "m.urdf").write_text(f'<robot name="m"><link name="base"/>{urdf}</robot>')
        (tmp_path / "m.toml").write_text(f'name = "m"\nurdf = "m.urdf"\n{mechanism}')
        path = tmp_path / "m.scene.toml"
        path.write_text(f'mechanism = "m.toml"\nformulation = "reduced"\nt_end = {float(t_end)!r}\n[initial]\n{start}')
        return path

    return make


@pytest.fixture
def with_joints(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes a shipped mechanism with [[joint]] tables and limits in its URDF."""

    def make(
        name: str, joints: dict[str, dict[str, Any]], limits: dict[str, tuple[float, float]] | None = None
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        for path in (library() / name).iterdir():
            text = path.read_text() if path.is_file() else ""
            for joint, (lower, upper) in (limits or {}).items():
                if path.suffix == ".urdf":
                    text = set_limits(text, joint, lower, upper)
            if path.name == "mechanism.toml":
                text += "".join(
                    f'\n[[joint]]\nname = "{joint}"\n'
                    + "".join(f"{key} = {str(value).lower()}\n" for key, value in table.items())
                    for joint, table in joints.items()
                )
            if text:
                (folder / path.name).write_text(text)
        return folder

    return make
