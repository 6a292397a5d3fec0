"""The manual can be skimmed: its sentences and paragraphs are short.

``python -m tests.docs.test_readability`` prints the figures of each page.
"""

from __future__ import annotations

from itertools import chain
from statistics import mean

import pytest

from scripts.site.gallery import ROOT, Example, examples
from tests.docs.prose import Paragraph, count_words, paragraphs

MAX_MEAN_WORDS = 19  # per sentence, on each page
MAX_WORDS = 40  # in any sentence
MAX_CHARACTERS = 720  # in a paragraph as it is displayed: six lines of 120

GUIDE = ["README.md", "docs/index.md", "docs/start.md", "docs/install.md", "docs/gallery.md"]
GUIDE += [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs" / "guide").glob("*.md"))]
THEORY = ["docs/errors.md"]
THEORY += [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs" / "theory").glob("*.md"))]
PAGES = GUIDE + THEORY


def read(page: str) -> list[Paragraph]:
    return paragraphs((ROOT / page).read_text(encoding="utf-8"))


def words_per_sentence(page: str) -> list[int]:
    return [count_words(sentence) for paragraph in read(page) for sentence in paragraph.sentences()]


@pytest.mark.parametrize("page", PAGES)
def test_sentences_are_short(page: str) -> None:
    long = [
        f"line {paragraph.line}, {count_words(sentence)} words: {sentence}"
        for paragraph in read(page)
        for sentence in paragraph.sentences()
        if count_words(sentence) > MAX_WORDS
    ]
    assert not long, "\n".join([f"{page}: sentences of more than {MAX_WORDS} words", *long])


@pytest.mark.parametrize("page", PAGES)
def test_paragraphs_are_short(page: str) -> None:
    long = [
        f"line {paragraph.line}, {len(paragraph.text)} characters: {paragraph.text[:60]}..."
        for paragraph in read(page)
        if len(paragraph.text) > MAX_CHARACTERS
    ]
    assert not long, "\n".join([f"{page}: paragraphs of more than {MAX_CHARACTERS} characters", *long])


@pytest.mark.parametrize("page", PAGES)
def test_mean_sentence_is_short(page: str) -> None:
    assert mean(words_per_sentence(page)) <= MAX_MEAN_WORDS


@pytest.mark.parametrize("example", examples(), ids=lambda example: example.name)
def test_example_descriptions_are_short(example: Example) -> None:
    description = paragraphs(example.about)
    assert max(count_words(sentence) for x in description for sentence in x.sentences()) <= MAX_WORDS
    assert max(len(x.text) for x in description) <= MAX_CHARACTERS


def test_parser_skips_what_is_not_prose() -> None:
    page = """# A heading

(label)=
![an image](a.png)

| a | table |
|---|---|

```sh
ckc list
```

$$
x = 1
$$
$$ y = 2 $$

:::{note}
:class: tip
Prose of a directive.
:::
% insert: commands
<br>
"""
    assert [paragraph.text for paragraph in paragraphs(page)] == ["Prose of a directive."]


def test_list_items_are_paragraphs() -> None:
    page = "Cases:\n- one item\n  goes on\n- **another**, [linked](a.md)\n\n1. last\n"
    assert [(paragraph.line, paragraph.text) for paragraph in paragraphs(page)] == [
        (1, "Cases:"),
        (2, "one item goes on"),
        (4, "another, linked"),
        (6, "last"),
    ]


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("One sentence. And another!", [2, 2]),
        ("See eq. 6 and Fig. 3, e.g. at 0.5 s. Then `ckc run a.b --set x=1.0` it.", [10, 3]),
        ("With $u = K x$, u = 0.5 q: a colon ends no sentence (nor does this.) Next.", [13, 1]),
        ("Is it? `tau` is.", [2, 2]),
    ],
)
def test_sentences_end_at_full_stops(text: str, counts: list[int]) -> None:
    (paragraph,) = paragraphs(text)
    assert list(map(count_words, paragraph.sentences())) == counts


def report() -> str:
    """Return the figures of each page and of all pages as text."""
    lines = ["  mean  over 40 words  over 720 characters"]
    for page in PAGES:
        words = words_per_sentence(page)
        long = sum(len(paragraph.text) > MAX_CHARACTERS for paragraph in read(page))
        lines.append(f"{mean(words):6.1f} {sum(count > MAX_WORDS for count in words):14} {long:20}  {page}")
    return "\n".join([*lines, f"{mean(chain.from_iterable(map(words_per_sentence, PAGES))):6.1f} over all pages"])


if __name__ == "__main__":
    print(report())
