"""Compiled terms are as accurate as Pinocchio's with masses far from those of the mechanism's files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import ensemble, load, sensitivities, simulate
from ckc_pin.codegen import compiler
from ckc_pin.codegen.library import compile_terms
from ckc_pin.mechanism.parameters import values_of
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import load_scene
from tests.analytic.many_digits import ManyDigits, exact
from tests.conftest import QUICK

SCENES = {"stewart": 0.3, "five_bar/swing": 0.5, "four_bar/turning": 0.5}  # s
SETS = 6
# A leg so light that its spring alone would accelerate it with 1e8 m/s^2
LIGHT_LEG = {"link.piston_1.mass": 1e-6, "link.cylinder_1.mass": 1e-6}
# A set of masses with which the reduced model once stopped for a wrong reason
STOPPED = {
    "link.cylinder_1.mass": 2e-5, "link.piston_1.mass": 1e-6, "link.cylinder_2.mass": 20.0,
    "link.piston_2.mass": 1e-4, "link.cylinder_4.mass": 3e-4, "link.piston_5.mass": 8e-6,
}  # fmt: skip


@pytest.fixture(autouse=True)
def quick_compiler(cache: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile without optimization: rounding errors do not depend on it."""
    monkeypatch.setattr(compiler, "FLAGS", QUICK)


def masses(scene: str, random: np.random.Generator) -> dict[str, float]:
    """Return random masses from 1e-6 to 1e3 kg for about half of a mechanism's links."""
    mechanism = load(scene.partition("/")[0])
    names = [name for name in values_of(mechanism.spec, mechanism.urdf) if name.endswith(".mass")]
    return {name: float(10 ** random.uniform(-6, 3)) for name in names if random.random() < 0.5}


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("scene", SCENES)
def test_extreme_masses_take_as_many_steps_as_with_pinocchios_terms(scene: str, formulation: str) -> None:
    random = np.random.default_rng(3)
    for _ in range(SETS):
        overrides: dict[str, Any] = {**masses(scene, random), "formulation": formulation, "controller": None}
        overrides |= {"t_end": SCENES[scene], "solver.rtol": float(random.choice([1e-6, 1e-8, 1e-10]))}
        theirs, ours = (simulate(scene, {**overrides, "solver.terms": x}) for x in ("pinocchio", "generated"))
        assert ours.status == theirs.status == "done"
        assert ours.stats["rhs"] == pytest.approx(theirs.stats["rhs"], rel=0.1), overrides


@pytest.mark.parametrize("overrides", [LIGHT_LEG, STOPPED], ids=["light leg", "false reason"])
def test_general_elimination_takes_over_and_is_counted(overrides: dict[str, float]) -> None:
    settings = {**overrides, "formulation": "reduced", "controller": None, "t_end": 0.2, "solver.rtol": 1e-10}
    theirs, ours = (simulate("stewart", {**settings, "solver.terms": x}) for x in ("pinocchio", "generated"))
    assert ours.status == theirs.status == "done"
    by_terms = ours.stats["rhs_by_terms"]
    assert by_terms["general"] > 0
    assert sum(by_terms.values()) == ours.stats["rhs"] == pytest.approx(theirs.stats["rhs"], rel=0.1)


@pytest.mark.parametrize("scene", SCENES)
def test_masses_of_the_files_need_no_general_elimination(scene: str) -> None:
    for formulation in ("dae", "reduced"):
        overrides = {"formulation": formulation, "controller": None, "t_end": 0.3, "solver.terms": "generated"}
        run = simulate(scene, overrides)
        assert run.stats["rhs_by_terms"] == {"generated": run.stats["rhs"]}


def test_acceleration_of_a_light_leg_has_twelve_digits() -> None:
    """The reference is the tests' own model with forty digits."""
    settings = {**LIGHT_LEG, "formulation": "dae", "controller": None, "solver.terms": "generated"}
    ready = prepare(load_scene("stewart", settings))
    ready.begin()
    ready.loop.advance(0.01, final=True, pause=1.0, budget=10.0)
    y, nq, n = ready.loop.y, ready.mechanism.tree.nq, ready.mechanism.n
    model = ManyDigits(ready.mechanism)
    right = model.acceleration(model.configuration(y[:nq]), exact(y[nq:]), exact(np.zeros(n)))[0].astype(float)
    assert np.abs(ready.loop.rhs(0.01, y)[nq:] - right).max() <= 1e-12 * np.abs(right).max()


def test_a_library_does_not_depend_on_the_masses_of_the_first_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither its elimination order nor its check depends on them. Rounding errors with these masses are 1e-9."""
    names = []
    for k, overrides in enumerate([{}, STOPPED]):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / str(k)))
        names.append(Path(compile_terms(load("stewart", overrides)).path).name)
    assert names[0] == names[1]


def test_general_elimination_is_chosen_per_ensemble_member() -> None:
    """A member is bitwise equal to the run with its parameters, in any thread and after any other member."""
    overrides: dict[str, Any] = {"formulation": "reduced", "controller": None, "t_end": 0.2, "solver.rtol": 1e-9}
    overrides["solver.terms"] = "generated"
    light = {name: [1e-6, 1.0] for name in LIGHT_LEG}
    one, two = (
        ensemble("stewart", light, {"end": "q_tree"}, overrides=overrides, threads=threads, progress=False)[
            "end"
        ].values
        for threads in (1, 2)
    )
    assert np.array_equal(one, two)
    for k, (piston, cylinder) in enumerate([(a, b) for a in (1e-6, 1.0) for b in (1e-6, 1.0)]):
        run = simulate("stewart", {**overrides, "link.piston_1.mass": piston, "link.cylinder_1.mass": cylinder})
        assert np.array_equal(one[k], run.q_tree[-1])


def test_sensitivities_with_far_masses_are_those_of_pinocchios_terms() -> None:
    settings = {**LIGHT_LEG, "formulation": "dae", "controller": None, "t_end": 0.1, "solver.rtol": 1e-8}
    theirs, ours = (
        sensitivities("stewart", ["link.plate.mass"], {**settings, "solver.terms": x})
        for x in ("pinocchio", "generated")
    )
    assert ours.run.status == theirs.run.status == "done"
    assert ours.run.stats["rhs"] == pytest.approx(theirs.run.stats["rhs"], rel=0.1)
