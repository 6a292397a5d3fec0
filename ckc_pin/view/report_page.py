"""The report of an identification: one HTML file with its tables and figures in it, which needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import TYPE_CHECKING

from ckc_pin.base.summary import Summary
from ckc_pin.identification.result import Identification, Residual
from ckc_pin.view.inline import render_image
from ckc_pin.view.page import STATIC

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["render_report"]

CAPTIONS = {
    "torques": "Measured and predicted motor torques, of a record that was not fitted if there is one.",
    "motion": "Measured and predicted quantities, of a record that was not fitted if there is one.",
    "residuals": "Residuals of the fitted records. Grey is what independent noise gives.",
    "correlation": "Correlation of the errors of parameters with a value.",
    "ellipsoids": "Ellipsoids of constant density with the mass, centre and inertia of each link, in the plane of the "
    "link's axes in which they are longest. Where the measurements leave a choice, the estimate is the one closest to "
    "the start.",
}


def render_report(result: Identification, figures: Mapping[str, Figure]) -> str:
    """Return the page: what was identified, combinations, residuals and figures. Names are escaped."""
    parts = [_overview(result)]
    parts += [f"<h2>Parameters</h2>\n{_parameters(result)}"]
    parts += [f"<h2>Combinations that the measurements determine</h2>\n{_combinations(result)}"]
    parts += [f"<h2>Residuals</h2>\n{_residuals(result)}"]
    if figures:
        images = (
            f"<figure>{render_image(name, figure)}<figcaption>{escape(CAPTIONS[name])}</figcaption></figure>"
            for name, figure in figures.items()
        )
        parts.append("<h2>Figures</h2>\n" + "\n".join(images))
    else:
        parts.append("<p>Figures need matplotlib, which is not installed.</p>")
    template = Template((STATIC / "report.html").read_text(encoding="utf-8"))
    return template.substitute(title=escape(f"Identification of {result.mechanism.name}"), body="\n".join(parts))


def _overview(result: Identification) -> str:
    sources = [f"{x.source}{' (validation)' if x.validation else ''}" for x in result.motions]
    shown = ("base", "missing", "warning")
    rows = [(label, content) for label, content in result.summary().rows if label in shown]
    physical = "all inertias are those of bodies that can exist" if result.physical else "some inertias are impossible"
    about = [("records", ", ".join(sources)), ("method", f"{result.method}, {result.instants} instants"), *rows]
    return Summary("", [*about, ("inertias", physical)]).html()


def _parameters(result: Identification) -> str:
    """Return a table of the parameters with a value, and one of the others by reason."""
    rows, others = [], dict[tuple[str, str], list[str]]()
    for name, x in result.parameters.items():
        if x.value is None:
            others.setdefault((x.verdict, x.missing or ""), []).append(name)
            continue
        std = "" if x.std is None else f"{x.std:.2g}"
        rows.append([escape(name), _number(x.value, x.std), std, f"{x.start:.6g}", escape(x.verdict)])
    parts = [_table(["parameter", "value", "std", "start", "verdict"], rows, numbers=(1, 2, 3))] if rows else []
    if others:
        grouped = [[escape(verdict), escape(reason), escape(", ".join(names))]
                   for (verdict, reason), names in others.items()]  # fmt: skip
        parts.append(_table(["without a value", "because", "parameters"], grouped))
    return "\n".join(parts)


def _combinations(result: Identification) -> str:
    rows = [[escape(str(x)), _number(x.value, x.std), f"{x.std:.2g}"] for x in result.base]
    return _table(["combination", "value", "std"], rows, numbers=(1, 2))


def _residuals(result: Identification) -> str:
    groups: list[tuple[str, Mapping[str, Residual]]] = [("fitted", result.residuals), ("validation", result.validation)]
    rows = [
        [
            label,
            escape(name),
            f"{x.rms:.3g}",
            f"{x.expected:.3g}",
            f"{x.rms / x.expected:.2f}",
            f"{x.autocorrelation:.2f}",
        ]
        for label, residuals in groups
        for name, x in residuals.items()
    ]
    header = ["records", "quantity", "rms", "expected", "ratio", "autocorrelation"]
    return _table(header, rows, numbers=(2, 3, 4, 5))


def _number(value: float, std: float | None) -> str:
    """Return a number with the digits that its standard deviation leaves."""
    if not std:
        return f"{value:.6g}"
    digits = max(1, min(12, len(f"{abs(value) / std:.0f}") + 1))
    return f"{value:.{digits}g}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table of escaped cells."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "\n".join(
        "<tr>"
        + "".join(f"<td{' class=number' if k in numbers else ''}>{cell}</td>" for k, cell in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return f'<div class="table"><table><tr>{head}</tr>\n{body}\n</table></div>'
