"""Every example runs, asserts what it claims, and has its picture in the gallery."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest
from matplotlib.figure import Figure

from scripts.site.gallery import Example, examples
from scripts.site.run_examples import run
from scripts.site.thumbnail import reduce_to_thumbnail

MAX_LINES = 200  # of an example
TESTED_ELSEWHERE = {"swing_up", "five_bar"}  # by test_swing_up.py and by the test of the notebook


@pytest.fixture(autouse=True)
def no_display() -> Iterator[None]:
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    before = mpl.get_backend()
    mpl.use("Agg")
    yield
    plt.close("all")
    mpl.use(before)


def test_gallery_has_at_least_a_dozen_examples() -> None:
    assert len(examples()) >= 12


@pytest.mark.parametrize("example", [e for e in examples() if e.name not in TESTED_ELSEWHERE], ids=lambda e: e.name)
def test_example_runs(example: Example) -> None:
    figure = run(example)
    assert figure.get_axes()


@pytest.mark.parametrize("example", examples(), ids=lambda e: e.name)
def test_example_is_short_and_has_a_picture(example: Example) -> None:
    assert example.title
    assert example.about
    assert len(example.path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES or example.path.suffix == ".ipynb"
    assert example.picture.is_file(), "python -m scripts.site.run_examples draws it"
    assert example.thumbnail.is_file(), "python -m scripts.site.run_examples draws it"


def test_thumbnail_is_the_largest_axes_without_letters() -> None:
    figure = Figure(layout="constrained")
    small, large = figure.subplots(1, 2, width_ratios=(1, 3))
    figure.suptitle("a title")
    figure.text(0.5, 0.5, "a note")
    small.plot([0, 1], label="small")
    large.plot([0, 1e-9], label="large")
    large.set(xlabel="t (s)", ylabel="q (rad)", title="of the axes")
    large.set_title("on the left", loc="left")
    large.annotate("here", (0.5, 0.0))
    large.legend()
    figure.legend()
    reduce_to_thumbnail(figure)
    figure.canvas.draw()
    assert figure.axes == [large]
    assert len(large.lines) == 1
    legends = [legend for legend in (large.get_legend(), *figure.legends) if legend.get_visible()]
    labels = [*large.get_xticklabels(), *large.get_yticklabels(), *large.texts, *figure.texts]
    texts = [*labels, large.xaxis.label, large.yaxis.label, large.yaxis.get_offset_text(), large.title]
    assert legends == []
    assert [text.get_text() for text in texts if text.get_visible() and text.get_text()] == []
    assert large.get_title(loc="left") == ""
    box = large.get_position()
    assert box.width * box.height > 0.8


@pytest.mark.parametrize("example", [e for e in examples() if e.path.suffix == ".py"], ids=lambda e: e.name)
def test_example_asserts_its_claims(example: Example) -> None:
    tree = ast.parse(example.path.read_text(encoding="utf-8"))
    assert any(isinstance(node, ast.Assert) for node in ast.walk(tree))
