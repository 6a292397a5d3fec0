"""Values of variables have their distribution, and do not depend on chunks."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ckc_pin.base.sources import Sources
from ckc_pin.ensembles.spec import parse_sweep
from ckc_pin.ensembles.variables import Variables
from ckc_pin.errors import InputError

SAMPLES = 20_000


def create_variables(
    specs: dict[str, Any], members: int | None = None, seed: int = 3, folder: Path | None = None
) -> Variables:
    sources = Sources("test.sweep.toml", folder)
    data = {"scene": "five_bar/swing", "variables": specs, "outputs": {"end": "q_tree"}, "seed": seed}
    return Variables(parse_sweep(data | ({"members": members} if members else {}), sources), sources)


@pytest.mark.parametrize(
    ("spec", "law"),
    [
        ({"uniform": [-2.0, 3.0]}, stats.uniform(-2, 5)),
        ({"normal": [1.0, 0.2]}, stats.norm(1, 0.2)),
        ({"loguniform": [0.01, 10.0]}, stats.loguniform(0.01, 10)),
        ({"lognormal": [0.5, 0.3]}, stats.lognorm(0.3, scale=np.exp(0.5))),
        ({"sobol": [-2.0, 3.0]}, stats.uniform(-2, 5)),
        ({"lhs": [-2.0, 3.0]}, stats.uniform(-2, 5)),
    ],
    ids=lambda x: next(iter(x)) if isinstance(x, dict) else "",
)
def test_values_have_the_specified_distribution(spec: dict[str, Any], law: Any) -> None:
    values = create_variables({"gravity.x": spec, "gravity.y": spec}, SAMPLES).values(0, SAMPLES)
    for column in values.T:
        assert stats.kstest(column, law.cdf).pvalue > 1e-3
    assert abs(stats.pearsonr(*values.T).statistic) < 0.03
    distance = stats.kstest(values[:, 0], law.cdf).statistic
    assert (distance < 1e-3) == (next(iter(spec)) in ("sobol", "lhs"))


def test_members_do_not_depend_on_the_chunks() -> None:
    variables = create_variables(
        {
            "gravity.x": {"uniform": [0, 1]}, "gravity.y": {"normal": [0, 1]}, "gravity.z": {"sobol": [0, 1]},
            "epsilon": {"lhs": [0, 1]}, "t_end": [1.0, 2.0, 3.0],
        },
        1000,
    )  # fmt: skip
    values = variables.values(0, variables.count)
    assert variables.count == 3000
    for first, end in ((0, 1), (1023, 1025), (777, 2900), (2999, 3000)):
        assert np.array_equal(variables.values(first, end), values[first:end])
    other = create_variables({"gravity.x": {"uniform": [0, 1]}}, 1000, seed=4).values(0, 1000)
    assert not np.isin(other[:, 0], values[:, 0]).any()


def test_grids_lists_and_files_are_crossed(tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text("gravity.y, epsilon\n1,10\n2,20\n")
    variables = create_variables(
        {"gravity.x": {"grid": {"start": 0, "stop": 1, "count": 3}}, "gravity.y": {"file": "pairs.csv"},
         "epsilon": {"file": "pairs.csv"}, "t_end": [5.0, 6.0]}, folder=tmp_path,
    )  # fmt: skip
    values = variables.values(0, variables.count)
    assert variables.count == 12
    assert {tuple(row) for row in values} == {(x, y, 10 * y, t) for x in (0, 0.5, 1) for y in (1, 2) for t in (5, 6)}
    assert values[:3].tolist() == [[0, 1, 10, 5], [0, 1, 10, 6], [0, 2, 20, 5]]


def test_a_grid_needs_memory_for_the_requested_members_only() -> None:
    tracemalloc.start()
    try:
        variables = create_variables({"gravity.x": {"grid": {"start": -1.0, "stop": 2.0, "count": 10**9}}})
        first, last = variables.values(0, 3)[:, 0], variables.values(10**9 - 2, 10**9)[:, 0]
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()
    assert variables.count == 10**9
    assert np.allclose(first, -1.0 + 3.0 / (10**9 - 1) * np.arange(3), rtol=0, atol=1e-15)
    assert last[0] < last[1] == 2.0
    for count in (1, 2, 7):
        few = create_variables({"gravity.x": {"grid": {"start": -0.1, "stop": 0.7, "count": count}}}).values(0, count)
        assert np.array_equal(few[:, 0], np.linspace(-0.1, 0.7, count))


@pytest.mark.parametrize(
    ("specs", "message"),
    [
        ({"gravity.x": {"uniform": [1, 0]}}, "expected the smaller number first"),
        ({"gravity.x": {"uniform": [0, 1], "normal": [0, 1]}}, "uniform and normal are given; give one of"),
        ({"gravity.x": {}}, "nothing is given; give one of uniform"),
        ({"gravity.x": {"loguniform": [0, 1]}}, "greater than 0"),
        ({"gravity.x": {"normal": [0, -1]}}, "deviation -1 is negative"),
        ({"gravity.x": {"uniform": [0, 1], "triangle": 1}}, "unknown key"),
        ({"gravity.x": {"uniform": [0, 1]}}, "members is missing; give a number"),
        ({"gravity.x": {"file": "none.csv"}}, "no such file"),
        ({"gravity.x": {"file": "bad.csv"}}, "line 3: gravity.x: expected a number"),
        ({"epsilon": {"file": "endless.csv"}}, "line 3: epsilon: inf is not a finite number"),
        ({"gravity.y": {"file": "bad.csv"}}, "no column 'gravity.y'; there are gravity.x"),
        (
            {"gravity.x": {"grid": {"start": 0, "stop": 1, "count": 10**9}}, "gravity.y": [1.0, 2.0]},
            "at most 1000000000",
        ),
        ({"gravity.x": ["x"]}, "gravity.x.list[0] = 'x': expected a number"),
        ({"gravity.x": [[1.0]]}, "gravity.x.list[0] = [1.0]: expected a number"),
        ({"gravity.x": [True]}, "gravity.x.list[0] = true: expected a number"),
        ({}, "name at least one"),
    ],
)
def test_wrong_variables_are_rejected(tmp_path: Path, specs: dict[str, Any], message: str) -> None:
    (tmp_path / "bad.csv").write_text("gravity.x\n1\nx\n")
    (tmp_path / "endless.csv").write_text("epsilon\n1\ninf\n")
    with pytest.raises(InputError) as error:
        create_variables(specs, folder=tmp_path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
