"""Figures of sweeps of one and two variables: lines and maps, with stopped members grey and off the scale."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import ckc_pin
from ckc_pin import InputError
from ckc_pin.ensembles.members import DONE, FAILED, STOPPED
from ckc_pin.view.ensemble_figures import save_ensemble
from ckc_pin.view.style import REST_COLOUR

GREY_RGBA = [*(int(REST_COLOUR[k : k + 2], 16) / 255 for k in (1, 3, 5)), 1.0]


def dataset(variables: dict[str, Any], status: list[int], **outputs: Any) -> xr.Dataset:
    """A dataset as an ensemble returns it."""
    arrays = {key: ("member", x, {"is": "variable", "units": "kg"}) for key, x in variables.items()}
    arrays |= {key: ("member", x, {"is": "output", "units": "m"}) for key, x in outputs.items()}
    arrays["status"] = ("member", status, {})
    return xr.Dataset(arrays, attrs={"sweep": json.dumps({"variables": dict.fromkeys(variables)})})


def test_a_sweep_of_one_variable_is_a_sorted_line() -> None:
    figure = ckc_pin.plot(dataset({"mass": [3.0, 1.0, 2.0]}, [DONE] * 3, way=[9.0, 1.0, 4.0]))["way"]
    (ax,) = figure.axes
    assert ax.lines[0].get_xydata().tolist() == [[1.0, 1.0], [2.0, 4.0], [3.0, 9.0]]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("mass (kg)", "way (m)")
    assert figure.legends == []


def test_stopped_members_interrupt_the_line_and_do_not_set_its_scale() -> None:
    way, status = [1.0, 1e6, 3.0, np.nan], [DONE, STOPPED, DONE, FAILED]
    figure = ckc_pin.plot(dataset({"mass": [1.0, 2.0, 3.0, 4.0]}, status, way=way))["way"]
    (ax,) = figure.axes
    assert np.array_equal(ax.lines[0].get_ydata(), [1.0, np.nan, 3.0, np.nan], equal_nan=True)
    assert np.array_equal(ax.lines[1].get_ydata(), [1e6, np.nan], equal_nan=True)
    assert ax.get_ylim()[1] < 4.0
    assert [line.get_xdata()[0] for line in ax.lines[2:]] == [2.0, 4.0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["stopped or cannot begin: 2"]


def test_stopped_members_of_a_grid_are_grey_and_do_not_set_the_colours() -> None:
    mass, length = (x.ravel() for x in np.meshgrid([1.0, 2.0, 3.0], [5.0, 6.0], indexing="ij"))
    way = [1.0, 2.0, 1e6, 4.0, np.nan, 6.0]
    results = dataset({"mass": mass, "length": length}, [DONE, DONE, STOPPED, DONE, FAILED, DONE], way=way)
    figure = ckc_pin.plot(results)["way"]
    (mesh,) = figure.axes[0].collections
    assert mesh.get_clim() == (1.0, 6.0)
    assert mesh.get_array().tolist() == [[1.0, None, None], [2.0, 4.0, 6.0]]
    assert mesh.get_cmap().get_bad().tolist() == pytest.approx(GREY_RGBA)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["stopped or cannot begin: 2"]


def test_stopped_members_of_random_variables_are_grey_points() -> None:
    results = dataset({"mass": [1.0, 2.0, 3.0], "length": [5.0, 7.0, 6.0]}, [DONE, STOPPED, DONE], way=[1.0, 1e6, 2.0])
    stopped, done = ckc_pin.plot(results)["way"].axes[0].collections
    assert stopped.get_offsets().tolist() == [[2.0, 7.0]]
    assert stopped.get_facecolor()[0].tolist() == pytest.approx(GREY_RGBA)
    assert done.get_clim() == (1.0, 2.0)


def test_members_that_all_stopped_have_a_figure_without_a_scale() -> None:
    for variables in ({"mass": [1.0, 2.0]}, {"mass": [1.0, 2.0], "length": [5.0, 7.0]}):
        (figure,) = ckc_pin.plot(dataset(variables, [STOPPED] * 2, way=[np.nan] * 2)).values()
        assert len(figure.axes) == 1


def test_members_without_a_value_are_crosses() -> None:
    figure = ckc_pin.plot(dataset({"a": [1.0, 2.0, 4.0], "b": [5.0, 7.0, 6.0]}, [DONE] * 3, way=[1.0, np.nan, 2.0]))[
        "way"
    ]
    assert figure.axes[0].lines[0].get_xydata().tolist() == [[2.0, 7.0]]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["1 without a value"]


def test_an_array_has_an_axes_for_each_component(tmp_path: Path) -> None:
    results = ckc_pin.ensemble("five_bar/swing", {"initial.q.theta_1": [-1.2, -1.0, -1.1]}, {"end": "q_tree"},
                               overrides={"t_end": 0.05, "solver.terms": "pinocchio"}, progress=False)  # fmt: skip
    figures = ckc_pin.plot(results)
    axes = figures["end"].axes
    assert [ax.get_ylabel() for ax in axes] == [rf"$\theta_{{{k}}}$ (rad)" for k in (1, 2, 3, 4)]
    assert axes[-1].get_xlabel() == r"$\theta_{1}$ at the start (rad)"
    assert axes[2].lines[0].get_ydata().tolist() == results["end"].to_numpy()[[0, 2, 1], 2].tolist()
    (path,) = save_ensemble(results, tmp_path)
    assert path.name == "end.png"
    assert path.stat().st_size > 5000


def test_dataset_without_a_figure_is_rejected() -> None:
    with pytest.raises(InputError, match="is not that of an ensemble"):
        ckc_pin.plot(xr.Dataset({"a": ("x", [1.0])}))
    results = dataset({name: [1.0, 2.0] for name in "abc"}, [DONE] * 2, way=[1.0, 2.0])
    with pytest.raises(InputError, match="plot: nothing to draw: outputs over time, and"):
        ckc_pin.plot(results)
    with pytest.raises(InputError, match="plot: only runs can be drawn together"):
        ckc_pin.plot(results, results)
