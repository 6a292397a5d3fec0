"""Generated mechanisms: the scene key `mechanism = {generator, N}`, its bounds, and runs with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import MechanismError, Run, check, load, load_scene, simulate
from ckc_pin.mechanism.library import MAX_N, GeneratorSpec, generate
from ckc_pin.mechanism.tree import MAX_COORDINATES
from tests.contract.helpers.bad import Bad, expect
from tests.contract.helpers.command import ckc

TOO_MANY = f"at most {MAX_N}"
RUN = ("run", "n_four_bar", "--set")
SCENE = (
    'mechanism = {generator = "n_four_bar", N = 3}\nformulation = "reduced"\nt_end = 0.1\n[initial.q]\ntheta_0 = 1.0\n'
)

CASES = [
    Bad("none", [*RUN, "mechanism.N=0"], ["mechanism.N = 0: ", "at least 1"]),
    Bad("a thousand million", [*RUN, "mechanism.N=1000000000"], ["mechanism.N = ", TOO_MANY]),
    Bad("one too many", [*RUN, f"mechanism.N={MAX_N + 1}"], ["mechanism.N = ", TOO_MANY]),
    Bad("half a square", [*RUN, "mechanism.N=2.5"], ["mechanism.N", "integer"]),
    Bad("a word", [*RUN, "mechanism.N=many"], ["mechanism.N", "integer"]),
    Bad("another parameter", [*RUN, "mechanism.M=3"], ["mechanism: unknown key 'M'", "valid: generator, N"]),
    Bad("another generator", [*RUN, "mechanism.generator=n_bar"], ["mechanism.generator", "'n_bar'", "n_four_bar"]),
    Bad("N of a file", ["run", "bar", "--set", "mechanism.N=3"], ["mechanism", "is a value, not a table"]),
    Bad("check too", ["check", "x.scene.toml"], ["x.scene.toml: mechanism.N = ", TOO_MANY],
        files={"x.scene.toml": SCENE.replace("N = 3", "N = 1000000000")}),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_invalid_number_of_links_is_rejected(case: Bad, bar: Path) -> None:
    expect(case, bar)


def test_generator_by_name_has_default_size() -> None:
    result = ckc("check", "n_four_bar", "--json").json
    assert (result["n"], result["d"], result["rows"]) == (9, 1, 8)
    assert result["independent"] == ["theta_0"]
    assert ckc("check", "n_four_bar/default", "--json").json["n"] == 9
    terms = ckc("terms", "n_four_bar", "--q", '{"theta_0": 1.0}', "--json").json
    assert terms["D"] == [[pytest.approx((5 + 4 * 3) / 3)]]  # N + 1 rods turn about an end, N bars do not turn


@pytest.mark.parametrize("N", [1, 2, 13])
def test_generator_builds_any_size(N: int) -> None:
    result = check(load_scene("n_four_bar", {"mechanism.N": N}))
    assert (result.n, result.d, result.rows, result.rank) == (2 * N + 1, 1, 2 * N, 2 * N)
    assert result.warnings == ()


def test_users_scene_of_a_generator_runs(tmp_path: Path) -> None:
    path = tmp_path / "own.scene.toml"
    path.write_text(SCENE)
    run = simulate(path)
    assert run.status == "done"
    assert run.scene["mechanism"] == {"generator": "n_four_bar", "N": 3}
    assert len(run.coordinates) == 7


def test_generator_is_listed() -> None:
    entry = next(m for m in ckc("list", "--json").json["mechanisms"] if m["name"] == "n_four_bar")
    assert "any number N" in entry["about"]
    assert "default" in entry["scenes"]


def test_saved_run_contains_the_generated_mechanism(tmp_path: Path) -> None:
    run = simulate("n_four_bar", {"mechanism.N": 3, "t_end": 0.1})
    again = Run.load(run.save(tmp_path / "run.npz"))
    assert again.mechanism.coordinates == run.coordinates
    assert again.scene == run.scene
    np.testing.assert_array_equal(again.points["B0"], run.points["B0"])
    text, sources = generate(GeneratorSpec(generator="n_four_bar", N=3))
    assert again.texts["mechanism.toml"] == text
    assert again.texts["n_four_bar.urdf"] == sources.text("n_four_bar.urdf")


def test_generated_mechanism_can_be_saved_and_loaded(tmp_path: Path) -> None:
    text, sources = generate(GeneratorSpec(generator="n_four_bar", N=2))
    (tmp_path / "mechanism.toml").write_text(text)
    (tmp_path / "n_four_bar.urdf").write_text(sources.text("n_four_bar.urdf"))
    assert load(tmp_path).coordinates == load(GeneratorSpec(generator="n_four_bar", N=2)).coordinates


def test_too_large_tree_is_rejected(tmp_path: Path) -> None:
    """Factorizations take a time that grows with the cube of the coordinates, so a small file could take hours."""
    links = "".join(f'<link name="l{k}"/>' for k in range(MAX_COORDINATES + 2))
    joints = "".join(
        f'<joint name="j{k}" type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
        for k in range(MAX_COORDINATES + 1)
    )
    (tmp_path / "m.urdf").write_text(f'<robot name="chain">{links}{joints}</robot>')
    (tmp_path / "mechanism.toml").write_text('name = "chain"\nurdf = "m.urdf"\n')
    with pytest.raises(MechanismError, match=f"{MAX_COORDINATES + 1} coordinates.*at most {MAX_COORDINATES}"):
        load(tmp_path)
