"""The paper, statement by statement: runs every study and writes docs/paper.md with its figures, and docs/errata.md."""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

import ckc_pin
from ckc_pin.errors import CkcError
from scripts.experiments.markdown import escaped, table
from scripts.experiments.paper import errata
from scripts.experiments.paper.claim import Claim, Verdict
from scripts.experiments.paper.show import print_claim

__all__ = ["SECTIONS", "STUDIES", "collect", "main", "page"]

ROOT = Path(__file__).resolve().parents[3]
WORKERS = 2
LONG = 20  # rows of a table that are shown at once

# Which module of this room answers what; those that take longest come first.
STUDIES: dict[str, tuple[str, ...]] = {
    "tracking": ("tracking-lyapunov", "tracking-skew", "tracking-gains", "tracking-deviations"),
    "cost_claims": ("cost",),
    "set_point": (
        "set-point-lyapunov", "set-point-gradient-bound", "set-point-gain-condition", "set-point-unique",
    ),
    "along_eq21": ("no-singularities",),
    "results": (
        "appendix", "initial-equilibrium", "figure-3", "figure-4", "torques", "tracking-error-law",
    ),
    "tikhonov": ("tikhonov-order", "tikhonov-velocity"),
    "consistent_start": ("epsilon-irrelevant",),
    "boundary_layer": ("boundary-layer", "eq-13"),
    "singular_claims": ("singular-type-1", "singular-type-2", "singular-freedoms"),
    "domain": ("implicit-function", "spf-domain"),
}  # fmt: skip

# The paper's order.
SECTIONS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("II. Problem definition", ("implicit-function",)),
    (
        "II-A. Singular perturbation formulation",
        ("tikhonov-order", "boundary-layer", "eq-13", "epsilon-irrelevant", "spf-domain"),
    ),
    (
        "II-B. Set-point control",
        ("set-point-gradient-bound", "set-point-gain-condition", "set-point-unique", "set-point-lyapunov"),
    ),
    ("II-C. Tracking control", ("tracking-lyapunov", "tracking-skew", "tracking-gains", "tikhonov-velocity")),
    ("III-A. Singular configurations", ("singular-type-1", "singular-type-2", "singular-freedoms")),
    ("III-B. Set-point control, results", ("initial-equilibrium", "figure-3", "cost")),
    (
        "III-C. Tracking control, results",
        ("no-singularities", "figure-4", "torques", "tracking-error-law", "tracking-deviations"),
    ),
    ("Appendix", ("appendix",)),
)


def collect(studies: Iterable[str], figures: Path) -> list[Claim]:
    """Run studies, several at a time, and return their claims.

    Parameters
    ----------
    studies : iterable of str
        Keys of `STUDIES`.
    figures : Path
        Where they write their figures.

    Raises
    ------
    CkcError
        A run failed.
    RuntimeError
        A study's claims are not those listed here.
    """
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # small matrices: more threads only wait for each other
        os.environ.setdefault(threads, "1")
    claims: list[Claim] = []
    with ProcessPoolExecutor(WORKERS, mp_context=multiprocessing.get_context("spawn")) as pool:
        running = {pool.submit(_answer, study, figures): study for study in studies}
        for done in as_completed(running):
            claims += done.result()
            print(f"{running[done]}: {', '.join(STUDIES[running[done]])}", file=sys.stderr, flush=True)
    return claims


def _answer(study: str, figures: Path) -> list[Claim]:
    claims: list[Claim] = importlib.import_module(f"scripts.experiments.paper.{study}").claims(figures)
    keys = tuple(claim.key for claim in claims)
    if sorted(keys) != sorted(STUDIES[study]):
        raise RuntimeError(f"paper/{study}.py answers {', '.join(keys)}; listed are {', '.join(STUDIES[study])}")
    return claims


def page(claims: Sequence[Claim], figures: str = "paper") -> str:
    """Return docs/paper.md.

    Parameters
    ----------
    claims : sequence of Claim
        Those of `SECTIONS`, all of them.
    figures : str
        The folder of figures as the page refers to it.
    """
    by_key = {claim.key: claim for claim in claims}
    own = ckc_pin.__version__
    versions = ", ".join([f"ckc_pin {own}", *(f"{name} {version(name)}" for name in ("pin", "numpy", "scipy"))])
    lines = [
        "# The paper, statement by statement",
        "",
        "Each statement of the paper that can be tested, with the experiment, the number or figure, and the verdict: "
        f"{_counts(claims)}. A verdict follows from the measured numbers by a criterion in the code. What the paper "
        "misprints is in [errata.md](errata.md); where it contradicts itself both readings are measured: `five_bar` "
        "takes Table I as numbered around the loop, `five_bar_as_printed` as printed.",
        "",
        f"Computed with {versions}. `./scripts/experiment paper` writes this page, its figures and the errata again; "
        "`./scripts/experiment paper --only KEY` prints one entry. `ckc` is in `.venv/bin`. Symbols are written as in "
        "the code: `q_dot`, `phi_z`, `K_P`; errors are q - q_d. Numbers of the size of rounding errors, and processor "
        "times, differ between machines.",
        "",
        *table(("statement", "where", "verdict"), []),
    ]
    ordered = [by_key[key] for _, keys in SECTIONS for key in keys]
    for claim in ordered:
        cells = (escaped(text, table=True) for text in (_capital(claim.says), claim.where))
        lines.append(f"| {' | '.join(cells)} | [{claim.verdict}](#{claim.key}) |")
    for title, keys in SECTIONS:
        lines += ["", f"## {title}"]
        for key in keys:
            lines += ["", *_entry(by_key[key], figures)]
    return "\n".join(lines) + "\n"


def _counts(claims: Sequence[Claim]) -> str:
    texts: dict[Verdict, str] = {
        "holds": "hold", "holds with a condition": "hold with a condition", "does not hold": "do not hold",
    }  # fmt: skip
    verdicts = [claim.verdict for claim in claims]
    return f"of {len(claims)}, " + ", ".join(f"{verdicts.count(verdict)} {text}" for verdict, text in texts.items())


def _entry(claim: Claim, figures: str) -> list[str]:
    lines = [
        f"### {claim.key}",
        "",
        f"> {escaped(_capital(claim.says))} ({escaped(_capital(claim.where))})",
        "",
        f"**The statement {claim.verdict}.** {escaped(claim.found)}",
    ]
    if claim.table is not None:
        lines += ["", *_folded(table(*claim.table))]
    lines += ["", "```sh", *claim.command.split("; "), "```"]
    for name in claim.figures:
        lines += ["", f"![{claim.key}: {name}]({figures}/{name})"]
    return lines


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _folded(lines: list[str]) -> list[str]:
    """Fold a long table, which a reader opens when the sentence above is not enough."""
    rows = len(lines) - 2
    if rows <= LONG:
        return lines
    return ["<details>", f"<summary>Table of {rows} rows</summary>", "", *lines, "", "</details>"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages, or print one entry; return the exit code."""
    keys = {key: study for study, answers in STUDIES.items() for key in answers}
    parser = argparse.ArgumentParser(prog="paper", description=__doc__)
    parser.add_argument("--only", metavar="KEY", help=f"print one entry: {', '.join(keys)}")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for pages and figures (docs; with --only: out/paper)"
    )
    options = parser.parse_args(arguments)
    if options.only is not None and options.only not in keys:
        parser.error(f"--only {options.only}: no such entry; there are {', '.join(keys)}")
    out: Path = options.out or (ROOT / "docs" if options.only is None else Path("out"))
    try:
        (out / "paper").mkdir(parents=True, exist_ok=True)
        if options.only is None:
            _write(out)
        else:
            claims = _answer(keys[options.only], out / "paper")
            print_claim(next(claim for claim in claims if claim.key == options.only), Console(highlight=False))
    except CkcError as error:
        print(f"paper: {error}", file=sys.stderr)
        return 3
    except OSError as error:
        parser.error(f"--out {out}: cannot be written: {error.strerror}")
    except KeyboardInterrupt:
        return 130
    return 0


def _write(out: Path) -> None:
    claims = collect(STUDIES, out / "paper")
    (out / "paper.md").write_text(page(claims), encoding="utf-8")
    (out / "errata.md").write_text(errata.page(errata.find([])), encoding="utf-8")
    shown = {name for claim in claims for name in claim.figures}
    for figure in (out / "paper").glob("*.png"):
        if figure.name not in shown:
            figure.unlink()
    print(f"written: {out / 'paper.md'}, {out / 'errata.md'}, {len(shown)} figures", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
