"""Appearance of figures: matplotlib style, colours, line styles, symbols, units and labels.

Figures are `WIDTH_IN` wide, so that a figure scaled to a column of 3.5 inches has letters of 6 points. At most
`MAX_COLOURS` curves of a panel get a colour and a legend entry. The others are grey and lie behind them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ckc_pin.errors import InputError
from ckc_pin.run.run import Run

if TYPE_CHECKING:
    from contextlib import _GeneratorContextManager

__all__ = ["COLOURS", "DPI", "GREY", "MAX_COLOURS", "NOTE_SIZE_PT", "REST_COLOUR", "WIDE_WIDTH_IN", "WIDTH_IN",
           "assign_colours", "axis_label", "coordinate_symbol", "escape_mathtext", "figure_style", "label_runs",
           "line_styles", "rate_symbol", "select_largest", "sort_for_drawing"]  # fmt: skip

# The palette of Okabe and Ito without black and yellow. Yellow is too pale for a line on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MAX_COLOURS = len(COLOURS)
GREY = "#6E6E6E"
REST_COLOUR = "#C4C4C4"  # of curves without a legend entry
DPI = 220
WIDTH_IN = 5.2
WIDE_WIDTH_IN = 7.2  # of figures with a long legend beside the axes
NOTE_SIZE_PT = 7.5  # letters of notes and subtitles

RC_PARAMS: dict[str, Any] = {
    "figure.figsize": (WIDTH_IN, 3.1),
    "figure.constrained_layout.use": True,
    "font.size": 8.5,
    "axes.prop_cycle": f"cycler('color', {list(COLOURS)})",
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 8,
    "figure.titlesize": 10,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-4, 5),
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "ckc_pin",  # equal runs give equal files
    "svg.fonttype": "path",
}

# Runs in different formulations mostly coincide: the reduced model is a broad pale line, and the dashes of the SPF
# remain visible on it.
_LINE_STYLES: dict[str, dict[str, Any]] = {
    "reduced": {"linestyle": "-", "linewidth": 3.0, "alpha": 0.4},
    "dae": {"linestyle": (0, (1.0, 1.6)), "linewidth": 1.6},
    "spf": {"linestyle": (0, (4.0, 2.2)), "linewidth": 1.1},
}
_MORE_DASHES = ((0, (7.0, 2.0)), (0, (2.0, 1.2)), (0, (5.0, 1.5, 1.0, 1.5)))  # for further runs of one formulation
_DRAWING_ORDER = ("reduced", "dae", "spf")

GREEK = (
    "alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa", "lambda", "mu", "nu",
    "xi", "pi", "rho", "sigma", "tau", "phi", "chi", "psi", "omega",
)  # fmt: skip
MAX_NAME_LENGTH = 40  # characters of a name in a figure
_GREEK_NAME = re.compile(rf"({'|'.join(GREEK)})(?:_?(\d+))?")
_FORMULATION_NAMES = {"reduced": "reduced", "spf": "SPF", "dae": "DAE"}


def figure_style() -> _GeneratorContextManager[None]:
    """Return a context manager that applies the style of this package's figures to matplotlib.

    The style starts from matplotlib's defaults, so the user's own settings have no effect inside the context. They
    are restored afterwards. Use it in a ``with`` statement or as a decorator, ``@figure_style()``.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    try:
        from matplotlib import style
    except ModuleNotFoundError:
        raise InputError("figures need matplotlib: pip install 'ckc_pin[view]'") from None
    return style.context(["default", RC_PARAMS])


# --- colours and lines ---------------------------------------------------------------------------


def assign_colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour for each name; names beyond the palette get `REST_COLOUR`."""
    return {name: COLOURS[k] if k < MAX_COLOURS else REST_COLOUR for k, name in enumerate(names)}


def select_largest(sizes: Mapping[str, float]) -> list[str]:
    """Return the `MAX_COLOURS` names with the largest sizes, in the order of `sizes`."""
    largest = sorted(sizes, key=lambda name: -sizes[name])[:MAX_COLOURS]  # stable: the first of equals
    return [name for name in sizes if name in largest]


def sort_for_drawing(runs: Sequence[Run]) -> list[Run]:
    """Sort runs so that thin lines are drawn on top of broad lines."""
    return sorted(runs, key=lambda run: _DRAWING_ORDER.index(run.scene["formulation"]))


def line_styles(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return matplotlib's line properties for each run, by formulation; a single run gets a solid line."""
    if len(runs) == 1:
        return [{"linestyle": "-", "linewidth": 1.3}]
    repetitions: dict[str, int] = {}
    styles = []
    for run in runs:
        formulation = run.scene["formulation"]
        repetition = repetitions[formulation] = repetitions.get(formulation, -1) + 1
        line_style = dict(_LINE_STYLES[formulation])
        if repetition:
            line_style["linestyle"] = _MORE_DASHES[(repetition - 1) % len(_MORE_DASHES)]
        if repetition and formulation == "reduced":
            line_style |= {"linewidth": 1.3, "alpha": 1.0}
        styles.append(line_style)
    return styles


# --- symbols and labels --------------------------------------------------------------------------


def coordinate_symbol(coordinate: str) -> str:
    """Return a coordinate's name as mathtext: ``theta_1`` becomes a Greek letter with an index, others stay names."""
    match = _GREEK_NAME.fullmatch(coordinate)
    if match is None:
        return escape_mathtext(coordinate)
    return rf"$\{match[1]}_{{{match[2]}}}$" if match[2] else rf"$\{match[1]}$"


def rate_symbol(coordinate: str) -> str:
    """Return the symbol of a coordinate's rate as mathtext: a dotted Greek letter, or the name followed by "rate"."""
    match = _GREEK_NAME.fullmatch(coordinate)
    if match is None:
        return f"{escape_mathtext(coordinate)} rate"
    dotted = rf"\dot{{\{match[1]}}}"
    return f"${dotted}_{{{match[2]}}}$" if match[2] else f"${dotted}$"


def escape_mathtext(name: str) -> str:
    """Escape a user-supplied name for matplotlib's mathtext, and shorten it to `MAX_NAME_LENGTH` characters.

    An initial underscore is written as mathtext, because matplotlib's legends skip labels that begin with one.
    """
    text = "".join(letter if letter.isprintable() else "?" for letter in name)
    text = text if len(text) <= MAX_NAME_LENGTH else f"{text[: MAX_NAME_LENGTH - 1]}…"
    text = text.replace("$", r"\$")
    return rf"$\_${text[1:]}" if text.startswith("_") else text


def axis_label(name: str, unit: str) -> str:
    """Return the label of an axis, ``θ (rad)``; every figure uses this notation."""
    return f"{name} ({unit})" if unit else name


def label_runs(runs: Sequence[Run]) -> list[str]:
    """Return distinct labels of runs: formulation and epsilon, and where needed the scene's name or a number."""
    labels = []
    for run in runs:
        formulation = run.scene["formulation"]
        epsilon = f", ε = {_format_power(run.scene['epsilon'])}" if formulation == "spf" else ""
        labels.append(f"{_FORMULATION_NAMES[formulation]}{epsilon}")
    if len({run.scene_name for run in runs}) > 1:
        labels = [f"{run.scene_name}: {label}" for run, label in zip(runs, labels, strict=True)]
    if len(set(labels)) < len(labels):
        labels = [f"{k}. {label}" for k, label in enumerate(labels, 1)]
    return labels


def _format_power(x: float) -> str:
    """Format a power of ten with a superscript, 10⁻⁴, and any other number as it is."""
    exponent = round(math.log10(x))
    if not math.isclose(x, 10.0**exponent, rel_tol=1e-9):
        return f"{x:g}"
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
