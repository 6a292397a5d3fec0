"""Extract the prose of a Markdown page: its paragraphs and their sentences.

Headings, tables, code blocks, display math, HTML, images and directive lines are left out. A list item is a paragraph
of its own. Inline code and inline math count as one word each.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

FENCE = re.compile(r"^\s*(```+|~~~+)")
DISPLAY_MATH = re.compile(r"^\s*\$\$")
DIRECTIVE = re.compile(r"^\s*(:::+|:[\w-]+:( |$)|%|\([\w-]+\)=$|<|\|)")
HEADING = re.compile(r"^\s*#{1,6} ")
LIST_ITEM = re.compile(r"^\s*(?:[-*+]|\d+[.)]) +")
ABBREVIATION = re.compile(r"\b(e\.g|i\.e|eqs?|figs?|sects?|refs?|nos?|vs|cf|approx|vol|pp?)\.", re.IGNORECASE)
SENTENCE_END = re.compile(r"(?<=[.!?])[)\"'*_]*\s+")
WORD = re.compile(r"[^\W_]")


@dataclass(frozen=True)
class Paragraph:
    """A paragraph or list item: the line where it begins, and its text in one line, as it is displayed."""

    line: int
    text: str

    def sentences(self) -> list[str]:
        """Return the sentences; a colon or semicolon ends none."""
        text = ABBREVIATION.sub(r"\1", re.sub(r"`[^`]+`", "code", self.text))
        text = re.sub(r"\$[^$]+\$", "math", text)
        return [sentence for sentence in SENTENCE_END.split(text) if count_words(sentence)]


def count_words(text: str) -> int:
    """Count the words: tokens with a letter or a digit."""
    return sum(bool(WORD.search(token)) for token in text.split())


def paragraphs(page: str) -> list[Paragraph]:
    """Return the paragraphs of a page in order."""
    blocks: list[tuple[int, list[str]]] = []
    fence = ""
    in_math = in_paragraph = False
    for number, line in enumerate(page.splitlines(), start=1):
        opening = FENCE.match(line)
        if fence or opening:
            if opening and not fence:
                fence = opening[1]
            elif line.strip() == fence:
                fence = ""
            in_paragraph = False
        elif in_math or DISPLAY_MATH.match(line):
            in_math ^= line.count("$$") % 2 == 1
            in_paragraph = False
        elif not line.strip() or HEADING.match(line) or DIRECTIVE.match(line):
            in_paragraph = False
        else:
            item = LIST_ITEM.match(line)
            if item or not in_paragraph:
                blocks.append((number, []))
            blocks[-1][1].append(line[item.end() :] if item else line)
            in_paragraph = True
    shown = [Paragraph(number, _as_displayed(" ".join(lines))) for number, lines in blocks]
    return [paragraph for paragraph in shown if count_words(paragraph.text)]


def _as_displayed(text: str) -> str:
    """Return text without images, with the text of its links, and with single spaces."""
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"(?m)^> ?|\*\*|</?\w+[^>]*>", "", text)
    return re.sub(r"\s+", " ", text).strip()
