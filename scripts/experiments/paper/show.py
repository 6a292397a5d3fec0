"""A study as a command of its own: its claims as text and tables, its figures in a folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from scripts.experiments.paper.claim import Claim

__all__ = ["print_claim", "run_as_command"]


def run_as_command(name: str, about: str, studies: Sequence[Callable[[Path], list[Claim]]]) -> None:
    """Parse ``--out DIR``, run the studies, print their claims.

    Parameters
    ----------
    name : str
        The command; its figures go to out/NAME unless --out says otherwise.
    about : str
        What it does, in a sentence.
    studies : sequence of callables
        Each takes the folder of figures and returns claims.
    """
    parser = argparse.ArgumentParser(prog=name, description=about)
    parser.add_argument("--out", type=Path, default=Path("out") / name, help="folder for the figures (%(default)s)")
    out = parser.parse_args().out
    console = Console(highlight=False)
    waiting = Console(stderr=True)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for study in studies:
            with waiting.status("measuring"):
                claims = study(out)
            for claim in claims:
                print_claim(claim, console)
    except OSError as error:
        parser.error(f"--out {out}: cannot write figures there ({error.strerror}); give another folder")
    except KeyboardInterrupt:
        sys.exit(130)
    console.print(f"figures: {out}", soft_wrap=True)


def print_claim(claim: Claim, console: Console) -> None:
    """Print a claim: where, what it says, what was measured, the verdict."""
    console.rule(claim.key, align="left")
    console.print(f"{claim.where}: {claim.says}", markup=False)
    if claim.table is not None:
        header, rows = claim.table
        lines = (head.replace(": ", "\n") for head in header)
        columns = (Column(head, no_wrap=True, vertical="bottom") for head in lines)
        table = Table(*columns, box=None, padding=(0, 1, 0, 0), pad_edge=False)
        for row in rows:
            table.add_row(*row)
        console.print("", table, "")
    console.print(claim.found, markup=False)
    console.print(f"Verdict: {claim.verdict}. Figures: {', '.join(claim.figures) or 'none'}", markup=False)
    console.print()
