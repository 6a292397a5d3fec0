"""Every example runs, asserts what it claims, and has its picture in the gallery."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from scripts.site.gallery import Example, examples
from scripts.site.run_examples import run

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


@pytest.mark.parametrize("example", [e for e in examples() if e.path.suffix == ".py"], ids=lambda e: e.name)
def test_example_asserts_its_claims(example: Example) -> None:
    tree = ast.parse(example.path.read_text(encoding="utf-8"))
    assert any(isinstance(node, ast.Assert) for node in ast.walk(tree))
