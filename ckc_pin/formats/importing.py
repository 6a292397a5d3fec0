"""Other people's files: one reader for each origin, one value between (`Draft`), one writer.

MuJoCo's MJCF (`mjcf`), URDFs with <loop> of generalized_rbda (`rbda_loops`), URDFs with a robot.yaml of
example-parallel-robots (`robot_yaml`), pairs of closing frames of onshape-to-robot (`closing_frames`), plain URDFs.
"""

from __future__ import annotations

from pathlib import Path

from ckc_pin.base.sources import strict_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError
from ckc_pin.formats.draft import Draft
from ckc_pin.formats.mechanism_file import mechanism_text, write
from ckc_pin.formats.mjcf.reader import read_mjcf
from ckc_pin.formats.partition import settle_independent
from ckc_pin.formats.urdf.reader import read_urdf, urdf_beside

__all__ = ["Draft", "mechanism_text", "read", "write"]


def read(path: Path) -> Draft:
    """Read a file of another format.

    Parameters
    ----------
    path : Path
        A MuJoCo model, a URDF, or the robot.yaml of a URDF beside it.

    Raises
    ------
    InputError, MechanismError
        What it is not, or what in it cannot be; the message names the place.
    """
    if path.suffix in (".yaml", ".yml"):
        if path.name != "robot.yaml":
            raise InputError(f"{path}: of YAML files only a robot.yaml beside its URDF is read")
        read_text(path, "YAML file")
        path = urdf_beside(path)
    text = read_text(path, "robot file")
    tag = strict_xml(text, str(path)).tag
    if tag not in ("mujoco", "robot"):
        raise InputError(f"{path}: the root element is <{tag}>; read are <mujoco> (MJCF) and <robot> (URDF)")
    draft = read_mjcf(text, path) if tag == "mujoco" else read_urdf(text, path)
    _drop_idle_loops(draft)
    settle_independent(draft)
    return draft


def _drop_idle_loops(draft: Draft) -> None:
    """Leave out loops within one rigid body: between two links on fixed joints, or with what moves in MuJoCo alone."""
    _, frames, _ = draft.tree()
    kept = []
    for spec, comment in draft.loops:
        ends = [frames.find(frame, f"loop {spec.name!r}").joint for frame in (spec.frame_a, spec.frame_b)]
        if ends[0] == ends[1]:
            draft.left_out.append(f"loop {spec.name}: both of its frames are on one rigid body here")
        else:
            kept.append((spec, comment))
    draft.loops = kept
