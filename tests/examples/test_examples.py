"""Every example runs, says what it claims by its own assertions, and has its picture in the gallery."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from scripts.site.gallery import Example, examples
from scripts.site.run_examples import run

LONGEST = 200  # lines of an example: one idea
ELSEWHERE = {"swing_up", "five_bar"}  # run once for all of their claims: here, and by the tests of the notebook


@pytest.fixture(autouse=True)
def no_display() -> Iterator[None]:
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    before = mpl.get_backend()
    mpl.use("Agg")
    yield
    plt.close("all")
    mpl.use(before)


def test_there_is_a_dozen() -> None:
    assert len(examples()) >= 12


@pytest.mark.parametrize("example", [e for e in examples() if e.name not in ELSEWHERE], ids=lambda e: e.name)
def test_an_example_runs(example: Example) -> None:
    """Each but those that have tests of their own."""
    figure = run(example)
    assert figure.get_axes()


@pytest.mark.parametrize("example", examples(), ids=lambda e: e.name)
def test_an_example_is_short_and_has_its_picture(example: Example) -> None:
    assert example.title
    assert example.about
    assert len(example.path.read_text(encoding="utf-8").splitlines()) <= LONGEST or example.path.suffix == ".ipynb"
    assert example.picture.is_file(), "python -m scripts.site.run_examples draws it"


@pytest.mark.parametrize("example", [e for e in examples() if e.path.suffix == ".py"], ids=lambda e: e.name)
def test_an_example_checks_what_it_claims(example: Example) -> None:
    tree = ast.parse(example.path.read_text(encoding="utf-8"))
    assert any(isinstance(node, ast.Assert) for node in ast.walk(tree))
