"""Tables and figure of sensitivities: names of columns, values, round trip through CSV."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pandas
import pytest

import ckc_pin
from ckc_pin import InputError, Sensitivities

PARAMETERS = ["link.link_2.mass", "initial.q.theta_1"]
OVERRIDES = {"t_end": 0.2, "solver.rtol": 1e-10, "solver.atol": 1e-12}
JOINTS = [f"theta_{k}" for k in (1, 2, 3, 4)]
Q = ["theta_1", "theta_3"]
QUANTITIES = [*JOINTS, *(f"v.{x}" for x in JOINTS), *(f"u.{x}" for x in Q), *(f"tau.{x}" for x in Q),
              "tip.x", "tip.y", "tip.z"]  # fmt: skip


@pytest.fixture(scope="module")
def result() -> Sensitivities:
    return ckc_pin.sensitivities("five_bar/swing", PARAMETERS, OVERRIDES)


def test_data_frame_has_a_column_for_each_quantity_and_parameter(result: Sensitivities) -> None:
    frame = result.to_pandas()
    assert list(frame.columns) == [(quantity, parameter) for quantity in QUANTITIES for parameter in PARAMETERS]
    assert list(frame.columns.names) == ["quantity", "parameter"]
    assert frame.index.name == "t"
    assert np.array_equal(frame.index, result.t)
    assert np.array_equal(frame["theta_3"], result.q_tree[:, 2])
    assert np.array_equal(frame["tip.y", PARAMETERS[1]], result.points["tip"][:, 1, 1])
    assert list(result.to_pandas(["v.theta_4"]).columns) == [("v.theta_4", name) for name in PARAMETERS]


def test_column_is_the_difference_of_two_runs(result: Sensitivities) -> None:
    mass = ckc_pin.load("five_bar").tree.model.inertias[2].mass
    step = 1e-4
    low, high = (
        ckc_pin.simulate("five_bar/swing", OVERRIDES | {"parameters": {"link.link_2.mass": mass + sign * step}})
        for sign in (-1, 1)
    )
    for name in ("theta_1", "v.theta_4", "tip.x"):
        difference = (high[name] - low[name]) / (2 * step)
        scale = np.abs(difference).max()
        assert np.abs(result.to_pandas()[name, "link.link_2.mass"] - difference).max() < 1e-5 * scale


def test_csv_has_all_digits_and_one_header_row(result: Sensitivities, tmp_path: Path) -> None:
    with result.to_csv(tmp_path / "s.csv", ["theta_1", "tip.x"]).open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["t", *(f"{name} by {parameter}" for name in ("theta_1", "tip.x") for parameter in PARAMETERS)]
    values = np.array(rows, dtype=float)
    assert np.array_equal(values, np.column_stack([result.t, result["theta_1"], result["tip.x"]]))
    whole = pandas.read_csv(result.to_csv(tmp_path / "all.csv"), index_col="t")
    assert np.array_equal(whole, result.to_pandas())


def test_figure(result: Sensitivities) -> None:
    assert repr(result.plot()) == "Figures(sensitivities)"


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["theta_9"], r"sensitivities\['theta_9'\]: no such quantity; the nearest names are 'theta_1'"),
        (["energy.total"], r"this derivative is not computed"),
        ("theta_1", r"Sensitivities.to_pandas: columns: expected a list of names"),
    ],
)
def test_unknown_columns_are_rejected(result: Sensitivities, columns: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        result.to_pandas(columns)
