"""A mechanism k times as long and m times as heavy moves alike, sqrt(k) times slower: no hidden metre or kilogram."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Run, load, simulate

STARTS = {
    "five_bar": ({"theta_1": -1.434, "theta_3": -1.7}, {"theta_1": 1.0, "theta_3": -2.0}),
    "slider_crank": ({"crank": 0.7}, {"crank": 2.0}),
    "slider_crank_spatial": ({"crank": 0.3}, {"crank": 1.0}),
}
LENGTHS = re.compile(r'(?P<before>(?<!axis )xyz="|\bxyz = \[)(?P<numbers>[^"\]]*)')
INERTIAS = re.compile(r'(?P<before>\bi[xyz]{2}=")(?P<numbers>[^"]*)')
MASSES = re.compile(r'(?P<before><mass value=")(?P<numbers>[^"]*)')
SLIDES = re.compile(r"(?m)^(?P<before>slider = )(?P<numbers>.*)$")


def times(pattern: re.Pattern[str], text: str, factor: float) -> str:
    """Multiply the numbers that a pattern finds."""

    def larger(computed: re.Match[str]) -> str:
        separator = ", " if "," in computed["numbers"] else " "
        numbers = computed["numbers"].replace(",", " ").split()
        return computed["before"] + separator.join(repr(float(number) * factor) for number in numbers)

    return pattern.sub(larger, text)


def resized(folder: Path, name: str, length: float, mass: float) -> Path:
    """Write a shipped mechanism in another size."""
    folder.mkdir()
    for file, text in load(name).sources.texts.items():
        text = times(SLIDES, times(LENGTHS, text, length), length)
        text = times(MASSES, times(INERTIAS, text, mass * length**2), mass)
        (folder / file).write_text(text)
    return folder


def motion(folder: Path, name: str, length: float, mass: float, formulation: str, rtol: float) -> Run:
    """A second of the motion as it is shipped, in its own time."""
    q, q_dot = STARTS[name]
    slower = float(np.sqrt(length))
    scene = resized(folder, name, length, mass) / "scaled.scene.toml"
    start = [
        f"{key} = {{ {', '.join(f'{k} = {x / by!r}' for k, x in table.items())} }}"
        for key, table, by in (("q", q, 1.0), ("q_dot", q_dot, slower))
    ]
    lines = [
        'mechanism = "mechanism.toml"', f'formulation = "{formulation}"', f"t_end = {slower!r}", "[initial]", *start,
        "[solver]", f"rtol = {rtol!r}", f"output_dt = {slower / 100!r}",
    ]  # fmt: skip
    scene.write_text("\n".join(lines) + "\n")
    return simulate(scene)


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
@pytest.mark.parametrize("name", STARTS)
def test_motion_is_invariant_to_size_and_mass(tmp_path: Path, name: str, formulation: str) -> None:
    right = motion(tmp_path / "right", name, 1.0, 1.0, formulation, 1e-11)
    for k, (length, mass) in enumerate([(1e-6, 1e-12), (1e-3, 1e3), (1e3, 1e-3), (1e6, 1e12)]):
        for rtol in (1e-4, 1e-8):
            run = motion(tmp_path / f"{k} {rtol}", name, length, mass, formulation, rtol)
            assert run.status == "done", run.message
            assert run.max_phi <= 1e-12 * length
            unit = np.where(run.mechanism.tree.in_metres, length, 1.0)
            off_q = np.abs(run.q_tree / unit - right.q_tree).max()
            off_v = np.abs(run.v_tree / unit * np.sqrt(length) - right.v_tree).max() / np.abs(right.v_tree).max()
            assert max(off_q, off_v) <= 20 * rtol
