"""Text and files of the explorer's present state: [q_guess], Python lines, scenes, parameters and an SVG picture."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import write_files
from ckc_pin.base.toml_writer import to_toml_value, write_toml
from ckc_pin.errors import InputError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.names import SUFFIX
from ckc_pin.scene.saving import scene_texts
from ckc_pin.scene.scene import Scene
from ckc_pin.view.geometry import compute_placements, is_planar, projection_planes
from ckc_pin.view.links import find_link_shapes
from ckc_pin.view.outlines import GROUND_COLOUR, project_base, project_outline

__all__ = ["python_lines", "q_guess_text", "save_parameters", "save_scene", "scene_at", "svg", "write_new_texts"]

T_END = 10.0  # s, of a scene of a mechanism without one
PICTURE_WIDTH = 800.0  # px
MARGIN = 0.06  # of the larger side of the picture
LINK_COLOUR, PLATE_COLOUR, RAIL_COLOUR = "#0072B2", "#CCE3F0", "#000000"
LINE_WIDTH, RING_RADIUS = 0.008, 0.011  # of the mechanism's size


def _by_coordinate(mechanism: Mechanism, at: Kinematics) -> dict[str, float]:
    """Return all coordinates by name, rad or m."""
    return mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree))


def q_guess_text(mechanism: Mechanism, at: Kinematics) -> str:
    """Return a pose as the table [q_guess] of a mechanism file, with all coordinates and all their digits."""
    return write_toml({"q_guess": _by_coordinate(mechanism, at)})


def python_lines(source: str | Path, mechanism: Mechanism, at: Kinematics, scene: Scene | None = None) -> str:
    """Return Python lines that reproduce the present state.

    They define `mechanism` and `state`; with a scene, also `scene` and `simulator`, which starts at the pose.

    Parameters
    ----------
    source : str or Path
        Shipped name or path of the mechanism, or of the scene.
    mechanism : Mechanism
        With its present parameters.
    at : Kinematics
        The pose.
    scene : Scene, optional
        The scene at `source`.
    """
    name, q = str(source), _by_coordinate(mechanism, at)
    overrides = to_toml_value(mechanism.overrides)
    lines = ["import ckc_pin", ""]
    if scene is None:
        values = f", {overrides!r}" if overrides else ""
        lines += [
            f"mechanism = ckc_pin.load({name!r}{values})",
            f"q = {q!r}",
            "state = ckc_pin.terms(mechanism, q)",
        ]
    else:
        parameters = f'"parameters": {overrides!r}, ' if overrides else ""
        lines += [
            f"q = {q!r}",
            f'scene = ckc_pin.load_scene({name!r}, {{{parameters}"initial": {{"q": q}}}})',
            "simulator = ckc_pin.Simulator(scene)",
            "mechanism, state = simulator.mechanism, simulator.state",
        ]
    return "\n".join(lines) + "\n"


def scene_at(
    mechanism: Mechanism,
    scene: Scene | None,
    at: Kinematics,
    q_dot: Array | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Scene:
    """Return a scene that starts at a pose, with the mechanism's present parameters.

    Parameters
    ----------
    mechanism : Mechanism
    scene : Scene, optional
        The scene that is explored; without one, the mechanism moves freely for 10 s.
    at : Kinematics
        The pose.
    q_dot : (d,) array, optional
        Rates of the independent coordinates; default 0.
    overrides : mapping, optional
        Other keys of the scene, as in `Scene.with_overrides`.
    """
    rates = np.zeros(mechanism.d) if q_dot is None else q_dot
    initial: dict[str, Any] = {"q": _by_coordinate(mechanism, at)}
    if np.any(rates):
        initial["q_dot"] = dict(zip(mechanism.independent, rates.tolist(), strict=True))
    if scene is None:
        scene = Scene(mechanism, t_end=T_END, initial=initial)
    else:
        scene = scene.with_overrides({"initial": initial, "parameters": dict(mechanism.overrides)})
    return scene.with_overrides(overrides)


def write_new_texts(folder: str | Path, texts: Mapping[str, str]) -> None:
    """Write texts by file name into a folder. Files that have the same text already are left as they are.

    Raises
    ------
    InputError
        A file with another text is there already, or the folder cannot be written to.
    """
    folder = Path(folder)
    new = {}
    for file, text in texts.items():
        path = folder / file
        try:
            is_same = path.read_text(encoding="utf-8") == text if path.exists() else False
        except (OSError, UnicodeDecodeError):
            is_same = False
        if path.exists() and not is_same:
            raise InputError(f"{path}: there already, with other contents; choose another name")
        if not is_same:
            new[file] = text
    write_files(folder, new, overwrite=True)


def save_scene(folder: str | Path, name: str, mechanism: Mechanism, scene: Scene | None, at: Kinematics) -> Path:
    """Write a scene that starts at a pose, with its mechanism and tables, as `Scene.save`.

    Returns
    -------
    Path
        Of NAME.scene.toml.

    Raises
    ------
    InputError
        The scene has objects of Python, or a file with other contents is there already.
    """
    file = f"{name}{SUFFIX}"
    write_new_texts(folder, scene_texts(scene_at(mechanism, scene, at), file))
    return Path(folder) / file


def save_parameters(folder: str | Path, name: str, mechanism: Mechanism) -> Path:
    """Write the parameters that differ from the mechanism's files, as the table [parameters] of a scene.

    Returns
    -------
    Path
        Of NAME.parameters.toml.

    Raises
    ------
    InputError
        All parameters are those of the files, or a file with other contents is there already.
    """
    if not mechanism.overrides:
        raise InputError("save parameters: all parameters are those of the files; change one first")
    file = f"{name}.parameters.toml"
    write_new_texts(folder, {file: write_toml({"parameters": to_toml_value(mechanism.overrides)})})
    return Path(folder) / file


def svg(mechanism: Mechanism, at: Kinematics) -> str:
    """Return a picture of a planar mechanism as SVG: links, plates, slides, hinges and ground.

    Raises
    ------
    InputError
        The mechanism is spatial.
    """
    if not is_planar(mechanism):
        raise InputError(
            f"svg: {mechanism.name} is spatial, and SVG pictures show planar mechanisms; save a PNG of the view instead"
        )
    plane = projection_planes(mechanism)[0]
    pose = compute_placements(mechanism, at.q_tree[np.newaxis])
    shapes = find_link_shapes(mechanism, pose)
    outline, base = project_outline(mechanism, shapes, pose.select_row(0), plane), project_base(shapes, plane)
    points = np.vstack([base.ground, *base.rails, *outline.bars, *outline.plates, outline.rings, *outline.blocks])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN * max(float((high - low).max()), mechanism.size * MARGIN)
    low, high = low - margin, high + margin
    scale = PICTURE_WIDTH / float((high - low)[0])
    height = scale * float((high - low)[1])
    size = mechanism.size * scale

    def place(corners: Array) -> str:
        return " ".join(f"{scale * (x - low[0]):.2f},{scale * (high[1] - y):.2f}" for x, y in corners)

    def line(ends: Array, colour: str, width: float) -> str:
        return f'<polyline points="{place(ends)}" fill="none" stroke="{colour}" stroke-width="{width * size:.2f}"/>'

    def polygon(corners: Array, fill: str, stroke: str) -> str:
        return f'<polygon points="{place(corners)}" fill="{fill}" stroke="{stroke}" stroke-width="{width:.2f}"/>'

    width = LINE_WIDTH * size
    shapes_text = [polygon(base.ground, GROUND_COLOUR, "none")] if len(base.ground) > 2 else []
    shapes_text += [line(base.ground, GROUND_COLOUR, 1.5 * LINE_WIDTH)] if len(base.ground) == 2 else []
    shapes_text += [line(rail, RAIL_COLOUR, LINE_WIDTH / 3) for rail in base.rails]
    shapes_text += [polygon(plate, PLATE_COLOUR, LINK_COLOUR) for plate in outline.plates]
    shapes_text += [line(bar, LINK_COLOUR, LINE_WIDTH) for bar in outline.bars]
    shapes_text += [polygon(block, "white", LINK_COLOUR) for block in outline.blocks]
    for ring in outline.rings:
        x, y = place(ring[np.newaxis]).split(",")
        shapes_text.append(
            f'<circle cx="{x}" cy="{y}" r="{RING_RADIUS * size:.2f}" fill="white" stroke="{LINK_COLOUR}" '
            f'stroke-width="{width / 2:.2f}"/>'
        )
    title = escape("".join(c for c in mechanism.name if c.isprintable()))
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{PICTURE_WIDTH:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {PICTURE_WIDTH:.0f} {height:.0f}" stroke-linejoin="round" stroke-linecap="round">',
            f"<title>{title}</title>",
            *shapes_text,
            "</svg>",
            "",
        ]
    )
