"""The paper's errata, each computed: ``./scripts/experiment errata [KEY...]``, and docs/errata.md."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from scripts.experiments.markdown import escaped, table
from scripts.experiments.paper.errata_control import CONTROL
from scripts.experiments.paper.errata_model import MODEL
from scripts.experiments.paper.errata_spf import SPF
from scripts.experiments.paper.erratum import Erratum

__all__ = ["ERRATA", "NOTATION", "Erratum", "find", "main", "page"]

COMMAND = "./scripts/experiment errata"

ERRATA: dict[str, Callable[[], Erratum]] = {
    compute.__name__.replace("_", "-"): compute for compute in (*MODEL, *SPF, *CONTROL)
}

# Slips of notation: nothing to measure.
NOTATION = (
    ("eqs. 1 and 23", "C'(q', q'_dot) and h', C'(q') and H'", "C'(q', q'_dot) and h' throughout"),
    ("eq. 6", "C(q', q'_dot), h(q)", "all of D, C, h at q' = sigma(q), C also at q'_dot = rho q_dot"),
    ("section II-A", "the reference [?]", "missing from the list"),
    ("eqs. 6 and 9", "h: the gravity vector, and the fast variables' solution h(t, x)", "two things"),
    ("eqs. 14, 20 and 22", "K_V, K_v; K_D, K_d", "K_V and K_D"),
    ("section II-B", "V(q): the potential, and the Lyapunov function in another font", "two things"),
    ("eqs. 13, 25, 27 and Table I", "c: a bound, an entry of C', the base link, a centre of mass", "four things"),
    ("sections II and III", "control impulse, in N m", "torque"),
    ("Table I", "no units, row 0 without a name", "m, kg, kg m²; row 0 is the base link, c of eq. 27"),
    ("Fig. 3a", "the target only as a picture", "chosen here: both proximal links 45 degrees up, see urdf/five_bar"),
    ("eq. 18", "d_1, d_2 and M not given", "chosen here: 1, 1 and the identity"),
)


def find(keys: Sequence[str]) -> list[Erratum]:
    """Compute errata by key, all of them when none is given.

    Raises
    ------
    KeyError
        An unknown key, with a message that lists the known ones.
    """
    unknown = [key for key in keys if key not in ERRATA]
    if unknown:
        raise KeyError(f"no erratum {unknown[0]!r}; there are {', '.join(ERRATA)}")
    return [ERRATA[key]() for key in (keys or ERRATA)]


def page(errata: Sequence[Erratum]) -> str:
    """Return docs/errata.md."""
    lines = [
        "# Errata of the paper",
        "",
        "Each entry gives the form that is printed, the right one, and a number that tells them apart, computed "
        "by the command below it. Equation numbers are the paper's, symbols are written as in the program's code. "
        "Rounding errors, the numbers around 1e-13, differ between machines. This page is written by "
        "`./scripts/experiment paper`.",
        "",
        "| key | place | printed form | correct form | unit |",
        "|---|---|---|---|---|",
    ]
    for erratum in errata:
        where, unit = (escaped(text, table=True) for text in (erratum.where, erratum.unit))
        numbers = f"{erratum.difference:.4g} | {erratum.agreement:.1g}"
        lines.append(f"| [{erratum.key}](#{erratum.key}) | {where} | {numbers} | {unit} |")
    for erratum in errata:
        lines += ["", *_entry(erratum)]
    lines += ["", "## Notation and what is missing", "", *table(("place", "printed", "meant"), NOTATION)]
    return "\n".join(lines) + "\n"


def _entry(erratum: Erratum) -> list[str]:
    return [
        f"## {erratum.key}",
        "",
        f"**{escaped(erratum.where[0].upper() + erratum.where[1:])}**",
        "",
        f"- Printed: {_sentence(erratum.printed)}",
        f"- Correct: {_sentence(erratum.correct)}",
        f"- Measured: {_sentence(erratum.measured)} Printed form **{erratum.difference:.6g}**, "
        f"correct form **{erratum.agreement:.1g}** ({escaped(erratum.unit)}).",
        "",
        "```sh",
        *([erratum.command] if erratum.command else []),
        f"{COMMAND} {erratum.key}",
        "```",
    ]


def _sentence(text: str) -> str:
    return escaped(text) if text.endswith(".") else f"{escaped(text)}."


def show(erratum: Erratum) -> str:
    """Return an erratum for a terminal."""
    return "\n".join([
        f"{erratum.key}: {erratum.where}",
        f"  printed   {erratum.printed}",
        f"  correct   {erratum.correct}",
        f"  measured  {erratum.measured}",
        f"  printed form: {erratum.difference:.6g}   correct form: {erratum.agreement:.1g}   ({erratum.unit})",
    ])  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Print errata, or write the page; return the exit code."""
    parser = argparse.ArgumentParser(prog="./scripts/experiment errata", description=__doc__)
    parser.add_argument("keys", nargs="*", metavar="KEY", help=f"one of {', '.join(ERRATA)}; none: all of them")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write all of them as Markdown")
    options = parser.parse_args(arguments)
    try:
        errata = find([] if options.page else options.keys)
    except KeyError as error:
        parser.error(str(error.args[0]))
    if options.page:
        try:
            options.page.write_text(page(errata), encoding="utf-8")
        except OSError as error:
            parser.error(f"--page {options.page}: cannot be written: {error.strerror}")
        return 0
    print("\n\n".join(show(erratum) for erratum in errata))
    return 0


if __name__ == "__main__":
    sys.exit(main())
