"""Run the studies of the paper and write docs/paper.md with its figures, and docs/errata.md."""

from __future__ import annotations

import importlib
from collections.abc import Collection, Iterable
from dataclasses import asdict
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed, parallel_config

from scripts.experiments.chart import shrink
from scripts.experiments.pages import render, versions
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.contents import KEYS, SECTIONS, STUDIES
from scripts.experiments.paper.errata import Erratum, find

__all__ = ["as_frame", "collect", "entries", "errata_entries", "errata_page", "page", "write"]

WORKERS = 2


def collect(keys: Collection[str], figures: Path) -> list[Claim]:
    """Run the studies of the given claims in parallel; return these claims in the paper's order.

    Parameters
    ----------
    keys : collection of str
    figures : Path
        Folder for the figures.

    Raises
    ------
    CkcError
        A run failed.
    """
    chosen = [study for study, answers in STUDIES.items() if not set(answers).isdisjoint(keys)]
    with parallel_config("loky", n_jobs=min(WORKERS, len(chosen)), inner_max_num_threads=1):
        results = Parallel(verbose=5 if len(chosen) > 1 else 0)(delayed(_answer)(study, figures) for study in chosen)
    by_key = {claim.key: claim for claims in results for claim in claims}
    return [by_key[key] for key in KEYS if key in keys]


def _answer(study: str, figures: Path) -> list[Claim]:
    claims: list[Claim] = importlib.import_module(f"scripts.experiments.paper.{study}").claims(figures)
    return claims


def as_frame(claims: Iterable[Claim]) -> pd.DataFrame:
    """Return one row per claim with its section; a claim's table is a DataFrame in its cell."""
    section = {key: title for title, keys in SECTIONS.items() for key in keys}
    rows = [
        {
            **vars(claim),
            "section": section[claim.key],
            "table": None if claim.table is None else pd.DataFrame(claim.table[1], columns=list(claim.table[0])),
        }
        for claim in claims
    ]
    return pd.DataFrame(rows)


def page(claims: pd.DataFrame) -> str:
    """Return the text of docs/paper.md."""
    counts = {"holds": 0, "holds with a condition": 0, "does not hold": 0, **claims.verdict.value_counts()}
    return render("paper", claims=claims, counts=counts, versions=versions())


def entries(claims: pd.DataFrame) -> str:
    """Return claims in the format of docs/paper.md."""
    return render("entries", kind="paper", entries=claims)


def errata_page(errata: Iterable[Erratum]) -> str:
    """Return the text of docs/errata.md."""
    return render("errata", errata=pd.DataFrame(map(asdict, errata)))


def errata_entries(errata: Iterable[Erratum]) -> str:
    """Return errata in the format of docs/errata.md."""
    return render("entries", kind="errata", entries=pd.DataFrame(map(asdict, errata)))


def write(out: Path) -> list[Path]:
    """Run all studies; write both pages, their figures, and verdicts and errata as CSV. Return the pages' paths.

    Raises
    ------
    CkcError
        A run failed.
    """
    figures = out / "paper"
    figures.mkdir(parents=True, exist_ok=True)
    claims, errata = as_frame(collect(KEYS, figures)), find([])
    claims[["key", "verdict"]].to_csv(figures / "claims.csv", index=False, lineterminator="\n")
    numbers = pd.DataFrame(map(asdict, errata))[["key", "difference", "agreement", "unit"]]
    numbers.to_csv(out / "errata.csv", index=False, float_format="%.3g", lineterminator="\n")
    pages = {"paper.md": page(claims), "errata.md": errata_page(errata)}
    for name, text in pages.items():
        (out / name).write_text(text, encoding="utf-8")
    shown = set(claims.figures.explode())
    for figure in figures.glob("*.png"):
        if figure.name not in shown:
            figure.unlink()
        else:
            shrink(figure)
    return [out / name for name in pages]
