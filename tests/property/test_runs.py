"""Runs of random spatial mechanisms: every formulation gives the same motion, and energy goes where dampers are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ckc_pin import InputError, Run, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.mechanism.spec import LoopType
from scripts.experiments.mechanism_files import toml_value
from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.property.mechanisms import SPRINGS, Closed, closed_mechanism

T_END, RTOL = 0.3, 1e-9
WORLDS: list[tuple[LoopType, int, bool, bool]] = [  # loop, seed, free root, loop closed twice
    ("hinge", 2, True, False),
    ("weld", 5, True, True),
    ("point", 3, False, False),
    ("prismatic", 7, False, True),
    ("distance", 4, True, False),
]
WAYS: dict[str, dict[str, Any]] = {
    "reduced": {"formulation": "reduced"},
    "eq. 17": {"formulation": "spf", "epsilon": 1e-4},
    "dae": {"formulation": "dae"},
    "Radau": {"formulation": "dae", "solver.method": "Radau", "solver.rtol": 1e-7},
}
EQ_8 = {"eq. 8": {"formulation": "spf", "epsilon": 1e-2, "spf_coordinates": "z", "solver.rtol": 1e-8}}
worlds = pytest.mark.parametrize("world", WORLDS, ids=lambda w: f"{w[0]}{'-free' * w[2]}{'-twice' * w[3]}")


@worlds
def test_all_formulations_have_the_same_motion(tmp_path: Path, world: tuple[LoopType, int, bool, bool]) -> None:
    kind, seed, free, redundant = world
    closed = closed_mechanism(kind, seed, free=free, redundant=redundant)
    ways = WAYS if free else WAYS | EQ_8
    runs = {name: swing(tmp_path, closed, **overrides) for name, overrides in ways.items()}
    dae = runs.pop("dae")
    assert np.abs(dae.q_tree[-1] - dae.q_tree[0]).max() > 0.05  # it moves
    for name, run in runs.items():
        tolerance = 1e-6 if name == "eq. 8" else 1e-7
        assert_close(run.q_tree, dae.q_tree, tolerance)
        assert_close(run.v_tree, dae.v_tree, 100 * tolerance)
    for run in (dae, runs["reduced"]):
        assert run.max_phi <= 1e-12


def test_spf_in_z_rejects_free_roots(tmp_path: Path) -> None:
    """Its z are numbers of joints; a free root has none whose rates are its velocity."""
    with pytest.raises(InputError, match=r"eq\. 8 as printed"):
        swing(tmp_path, closed_mechanism("hinge", 2, free=True), t_end=0.01, **EQ_8["eq. 8"])


@worlds
def test_energy_is_conserved_without_dampers(tmp_path: Path, world: tuple[LoopType, int, bool, bool]) -> None:
    kind, seed, free, redundant = world
    closed = closed_mechanism(kind, seed, free=free, redundant=redundant)
    for formulation in ("reduced", "dae"):
        run = swing(tmp_path, closed, damped=False, formulation=formulation)
        assert_close(run.energy, run.energy[0], 1e-7 * kinetic(run).max())


@worlds
def test_dampers_dissipate_energy(tmp_path: Path, world: tuple[LoopType, int, bool, bool]) -> None:
    """At the rate v . damping_force, integrated along the run."""
    kind, seed, free, redundant = world
    run = swing(tmp_path, closed_mechanism(kind, seed, free=free, redundant=redundant), formulation="dae")
    mechanism = run.mechanism
    power = [
        v @ mechanism.springs.damping_force(mechanism.tree.from_coordinates(q), v)
        for q, v in zip(run.q_tree, run.v_tree, strict=True)
    ]
    dt = run.t[1] - run.t[0]
    taken = dt / 3 * (power[0] + 4 * sum(power[1:-1:2]) + 2 * sum(power[2:-1:2]) + power[-1])  # Simpson
    assert taken < 0
    assert_close(run.energy[-1] - run.energy[0], taken, 1e-6 * max(1.0, -taken))


def kinetic(run: Run) -> Array:
    """Kinetic energy along a run."""
    tree, states = run.mechanism.tree, zip(run.q_tree, run.v_tree, strict=True)
    terms = [Terms(run.mechanism, run.mechanism.kinematics(tree.from_coordinates(q)), v) for q, v in states]
    return np.array([t.energy - t.potential_energy for t in terms])


def swing(folder: Path, closed: Closed, *, damped: bool = True, **overrides: Any) -> Run:
    """From rest, no control, from files as a user writes them."""
    mechanism = closed.mechanism
    spec = mechanism.spec.to_dict()
    if not damped:
        spec["spring"] = [msgspec.to_builtins(msgspec.structs.replace(s, damping=0.0)) for s in SPRINGS]
    start = dict(zip(mechanism.independent, mechanism.independent_part(mechanism.q_tree), strict=True))
    scene = {
        "mechanism": "mechanism.toml",
        "formulation": "reduced",
        "t_end": T_END,
        "initial": {"q": {name: float(x) for name, x in start.items()}},
        "solver": {"rtol": RTOL, "output_dt": T_END / 300},
    }
    for name, content in (("mechanism.toml", spec), ("swing.scene.toml", scene)):
        (folder / name).write_text(
            "\n".join(f"{key} = {toml_value(x)}" for key, x in content.items() if x is not None), "utf-8"
        )
    for prefix in closed.world.stands:
        (folder / prefix).write_text(closed.world.urdf(prefix), "utf-8")
    run = simulate(folder / "swing.scene.toml", overrides)
    assert run.status == "done", run.message
    return run
