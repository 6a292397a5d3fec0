"""Find mechanism files by shipped name or path, and generate the files of parametrized mechanisms."""

from __future__ import annotations

import itertools
import re
from functools import cache
from os.path import exists, isdir, isfile
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert, read_text
from ckc_pin.errors import InputError
from ckc_pin.mechanism.foreign import is_foreign, read_foreign

__all__ = [
    "GENERATORS",
    "MAX_N",
    "GeneratorSpec",
    "describe_mechanism",
    "first_comment",
    "generate",
    "is_path",
    "library",
    "mechanism_file",
    "read_mechanism_texts",
    "shipped",
]

GENERATORS = ("n_four_bar",)
MAX_N = 1000  # squares: 2 N + 1 coordinates


class GeneratorSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A generated mechanism: ``mechanism = {generator = "n_four_bar", N = 40}`` of a scene.

    Attributes
    ----------
    generator
        N unit squares in a row that share their verticals.
        ``generator = "n_four_bar"``
    N
        Number of squares.
        ``N = 40``
    """

    generator: Literal["n_four_bar"]
    N: Annotated[int, msgspec.Meta(ge=1, le=MAX_N)] = 4


def generate(spec: GeneratorSpec) -> tuple[str, Sources]:
    """Generate a mechanism: return the text of its file, and the sources with its URDF.

    Parameters
    ----------
    spec : GeneratorSpec
        ``n_four_bar``: N unit squares in a row that share their verticals. N + 1 rods stand on ground pins one metre
        apart, and N bars lie on top. All are uniform, 1 m long, and weigh 1 kg. ``theta_k`` is the angle of rod k from
        +x. ``psi_k`` is the angle of bar k relative to rod k - 1, to whose top it is pinned.
    """
    N = spec.N
    rods = [_link(f"rod_{k}", z=0.0, colour="blue") for k in range(N + 1)]
    bars = [_link(f"bar_{k}", z=0.05, colour="orange") for k in range(1, N + 1)]
    feet = [_joint(f"theta_{k}", "ground", f"rod_{k}", x=k) for k in range(N + 1)]
    tops = [_joint(f"psi_{k}", f"rod_{k - 1}", f"bar_{k}", x=1) for k in range(1, N + 1)]
    urdf = _URDF.format(length=N + 0.2, middle=N / 2, parts="\n".join(rods + bars + feet + tops))
    guess = [f"theta_{k} = {_UP}" for k in range(N + 1)] + [f"psi_{k} = -{_UP}" for k in range(1, N + 1)]
    loops = [_LOOP.format(k=k) for k in range(1, N + 1)]
    text = _MECHANISM.format(N=N, most=MAX_N, guess="\n".join(guess), loops="\n".join(loops))
    return text, Sources(f"{spec.generator}, N = {N}", None, {"n_four_bar.urdf": urdf})


_UP = "1.5707963267948966"

_MECHANISM = """\
# N-four-bar: unit squares in a row that share their verticals, any number N of them up to {most}; here N = {N}.
name = "n_four_bar"
urdf = "n_four_bar.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["theta_0"]

# Rods upright, bars level.
[q_guess]
{guess}

{loops}
# The first top pin.
[[point]]
name = "B0"
frame = {{link = "rod_0", xyz = [1.0, 0.0, 0.0]}}
"""

_LOOP = """\
[[loop]]
name = "pin_{k}"
type = "point_2d"
frame_a = {{link = "bar_{k}", xyz = [1.0, 0.0, 0.0]}}
frame_b = {{link = "rod_{k}", xyz = [1.0, 0.0, 0.0]}}
rows_in = "world"
"""

_URDF = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- Uniform rods of 1 m and 1 kg: izz = 1/12 kg m^2; 40 mm square, the bars drawn in front of the rods. -->
<robot name="n_four_bar">
  <material name="steel"><color rgba="0.35 0.37 0.40 1"/></material>
  <material name="blue"><color rgba="0.12 0.30 0.60 1"/></material>
  <material name="orange"><color rgba="0.95 0.55 0.15 1"/></material>
  <link name="ground">
    <visual>
      <origin xyz="{middle} 0 -0.04"/>
      <geometry><box size="{length} 0.06 0.02"/></geometry>
      <material name="steel"/>
    </visual>
  </link>
{parts}
</robot>
"""

_PIN = """\
    <visual>
      <origin xyz="{x} 0 {z}"/>
      <geometry><cylinder radius="0.03" length="0.05"/></geometry>
      <material name="{colour}"/>
    </visual>"""


def _link(name: str, z: float, colour: str) -> str:
    pins = "\n".join(_PIN.format(x=x, z=z, colour=colour) for x in (0, 1))
    return f"""\
  <link name="{name}">
    <inertial>
      <origin xyz="0.5 0 0"/>
      <mass value="1"/>
      <inertia ixx="{0.04**2 / 6!r}" iyy="{1 / 12!r}" izz="{1 / 12!r}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual>
      <origin xyz="0.5 0 {z}"/>
      <geometry><box size="1 0.04 0.04"/></geometry>
      <material name="{colour}"/>
    </visual>
{pins}
  </link>"""


def _joint(name: str, parent: str, child: str, x: int) -> str:
    return f"""\
  <joint name="{name}" type="continuous">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{x} 0 0"/>
    <axis xyz="0 0 1"/>
  </joint>"""


MECHANISM_FILE = "mechanism.toml"


@cache
def library() -> Path:
    """Return the folder of the shipped mechanisms: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "urdf"
    return inside if inside.is_dir() else package.parent / "urdf"


def shipped() -> list[str]:
    """Return the names of the shipped mechanisms, from files and generated."""
    return sorted([*(p.parent.name for p in library().glob(f"*/{MECHANISM_FILE}")), *GENERATORS])


def is_path(name: str) -> bool:
    """Whether a name of a mechanism or scene is a path: it exists, or ends in .toml."""
    return name.endswith(".toml") or exists(name)  # unlike Path.exists, this accepts names that no file can have


def mechanism_file(name: str | Path) -> Path:
    """Return the path of a mechanism file.

    Raises
    ------
    InputError
        There is no such mechanism; the message lists the shipped ones.
    """
    if isinstance(name, Path) or is_path(name):
        path = Path(name)
        if path.name.endswith(".scene.toml"):
            raise InputError(f"{path}: a scene; expected a mechanism, such as the one that the scene names")
        return path / MECHANISM_FILE if isdir(path) else path
    path = library() / name / MECHANISM_FILE
    if Path(name).name != name or not isfile(path):
        if isfile(library() / f"{name}.scene.toml"):
            raise InputError(f"{name!r} is a scene; its mechanism is {Path(name).parts[0]!r}")
        raise InputError(
            f"no mechanism {name!r}; shipped: {', '.join(shipped())}; or give the path of a {MECHANISM_FILE}"
        )
    return path


def describe_mechanism(name: str) -> str:
    """Return the description of a shipped mechanism, which is the first sentence of its file's first comment."""
    return first_comment(read_mechanism_texts(name)[0])


def first_comment(text: str) -> str:
    """Return the first sentence of the first comment of a TOML text, without the # characters."""
    lines = text.splitlines()
    start = next((k for k, line in enumerate(lines) if line.startswith("#")), len(lines))
    comment = itertools.takewhile(lambda line: line.startswith("#"), lines[start:])
    sentences = " ".join(line.lstrip("# ").strip() for line in comment)
    return re.split(r"(?<=\.) +(?=[A-Z])", sentences, maxsplit=1)[0]


def read_mechanism_texts(name: str | Path | GeneratorSpec) -> tuple[str, Sources]:
    """Return the text of a mechanism file, and the sources of the texts that it names.

    Raises
    ------
    InputError
        The file is missing or cannot be read.
    """
    if isinstance(name, GeneratorSpec):
        return generate(name)
    if name in GENERATORS and not is_path(str(name)):
        return generate(convert({"generator": name}, GeneratorSpec, str(name)))
    if is_foreign(name):
        sources = read_foreign(Path(name))
        return sources.text(MECHANISM_FILE), sources
    path = mechanism_file(name)
    return read_text(path, "mechanism file"), Sources(str(path), path.parent)
