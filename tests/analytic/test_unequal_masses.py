"""Eq. 1 of chains whose masses differ by up to nine decades, against forty digits of the tests' own model of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import load_scene
from tests.analytic.many_digits import ManyDigits, exact

LENGTHS = [0.6, 0.5, 0.8, 0.7, 0.55, 0.65]
ANGLES = [-0.8, 0.7, -0.5, 0.9, -0.6, 0.8]
HEAVY = 1e9
# masses of the links, kg; whether the chain's end is pinned to the world
CHAINS = {
    "heavy load": ([1.0, 0.7, 1.3, HEAVY], False),
    "heavy link in between": ([2.0, 0.7, 1.1, HEAVY, 0.9, 1.4], False),
    "heavy link at the root": ([HEAVY, 0.7, 1.1, 0.9], False),
    "closed, heavy at the root": ([2 * HEAVY, 0.7, 1.0, 1.2, 0.9, 1.1], True),
    "closed, heavy in between": ([2.0, 0.7, HEAVY, 1.0], True),
    "closed, heavy at the end": ([1.0, 1.1, 0.9, 2 * HEAVY], True),
    "every decade": ([3e-4, 5e4, 2e-2, 7e2, 1.0, 4e-5], False),
}


def chain(folder: Path, masses: list[float], closed: bool) -> Path:
    """A planar chain of slender rods that falls."""
    links, joints, at = '<link name="base"/>', "", 0.0
    for k, (mass, length) in enumerate(zip(masses, LENGTHS, strict=False)):
        inertia = mass * length**2 / 12
        links += (
            f'<link name="rod_{k}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        parent = f"rod_{k - 1}" if k else "base"
        joints += (
            f'<joint name="joint_{k}" type="continuous"><parent link="{parent}"/><child link="rod_{k}"/>'
            f'<origin xyz="{at} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
        at = length
    guess = "".join(f"joint_{k} = {angle}\n" for k, angle in enumerate(ANGLES[: len(masses)]))
    text = f'name = "chain"\nurdf = "chain.urdf"\ngravity = [0.0, -9.81, 0.0]\n[q_guess]\n{guess}'
    if closed:
        text += (
            f'[[loop]]\nname = "end"\ntype = "point_2d"\nframe_a = {{link = "rod_{len(masses) - 1}", '
            f"xyz = [{at}, 0.0, 0.0]}}\n"
            f'frame_b = {{link = "world", xyz = [{0.6 * sum(LENGTHS[: len(masses)])}, 0.0, 0.0]}}\n'
        )
    (folder / "chain.urdf").write_text(f'<robot name="chain">{links}{joints}</robot>')
    (folder / "mechanism.toml").write_text(text)
    (folder / "default.scene.toml").write_text(
        'mechanism = "mechanism.toml"\nt_end = 0.3\n[initial]\nat = "assembled"\n'
    )
    return folder


@pytest.mark.parametrize("name", CHAINS)
def test_acceleration_of_unequal_masses_keeps_its_digits(name: str, tmp_path: Path) -> None:
    """Where the motion goes on from after a hundredth of a second."""
    ready = prepare(load_scene(chain(tmp_path, *CHAINS[name]), {"formulation": "dae", "solver.rtol": 1e-6}))
    ready.begin()
    ready.loop.advance(0.01, final=True, pause=1.0, budget=10.0)
    y, n = ready.loop.y, ready.mechanism.n
    computed = ready.loop.rhs(0.01, y)[n:]
    model = ManyDigits(ready.mechanism)
    right, _ = model.acceleration(model.configuration(y[:n]), exact(y[n:]), exact(np.zeros(n)))
    right = np.array(right, dtype=float)
    assert np.abs(computed - right).max() <= 1e-12 * np.abs(right).max()


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("name", CHAINS)
def test_step_count_grows_with_tolerance_as_the_order_predicts(name: str, formulation: str, tmp_path: Path) -> None:
    """A thousandth of the tolerance takes 10^(3/8) = 2.4 times the steps with a method of order eight."""
    folder = chain(tmp_path, *CHAINS[name])
    coarse, fine = (
        simulate(folder, {"formulation": formulation, "solver.rtol": rtol, "solver.max_rhs": 20_000})
        for rtol in (1e-6, 1e-9)
    )
    assert coarse.status == fine.status == "done"
    assert fine.stats["rhs"] <= 4 * coarse.stats["rhs"]
