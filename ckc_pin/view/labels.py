"""Symbols, units and names as a person reads them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from ckc_pin.run.run import Run

__all__ = ["plain", "rate_symbol", "run_labels", "symbol", "with_unit"]

GREEK = (
    "alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa", "lambda", "mu", "nu",
    "xi", "pi", "rho", "sigma", "tau", "phi", "chi", "psi", "omega",
)  # fmt: skip
LONGEST = 40  # characters of a name in a figure
_PAPER = re.compile(rf"({'|'.join(GREEK)})(?:_?(\d+))?")
_NAMES = {"reduced": "reduced", "spf": "SPF", "dae": "DAE"}


def symbol(coordinate: str) -> str:
    """Return a coordinate as matplotlib's mathtext: theta_1 as the paper prints it, any other name as it is."""
    letter = _PAPER.fullmatch(coordinate)
    if letter is None:
        return plain(coordinate)
    return rf"$\{letter[1]}_{{{letter[2]}}}$" if letter[2] else rf"$\{letter[1]}$"


def rate_symbol(coordinate: str) -> str:
    """Return a coordinate's rate as mathtext: a dot on the paper's letters, a word after any other name."""
    letter = _PAPER.fullmatch(coordinate)
    if letter is None:
        return f"{plain(coordinate)} rate"
    dotted = rf"\dot{{\{letter[1]}}}"
    return f"${dotted}_{{{letter[2]}}}$" if letter[2] else f"${dotted}$"


def plain(name: str) -> str:
    """Return a stranger's name as matplotlib draws it as it is: no mathtext, no more than a figure has room for.

    A label that begins with an underscore is none to its legends.
    """
    shown = "".join(letter if letter.isprintable() else "?" for letter in name)
    shown = shown if len(shown) <= LONGEST else f"{shown[: LONGEST - 1]}…"
    shown = shown.replace("$", r"\$")
    return rf"$\_${shown[1:]}" if shown.startswith("_") else shown


def with_unit(name: str, unit: str) -> str:
    """Return what an axis shows, and in what: θ (rad). One notation for every figure."""
    return f"{name} ({unit})" if unit else name


def run_labels(runs: Sequence[Run]) -> list[str]:
    """Return a name for each run that tells it from the others: its formulation, epsilon, scene."""
    labels = []
    for run in runs:
        formulation = run.scene["formulation"]
        epsilon = f", ε = {_power(run.scene['epsilon'])}" if formulation == "spf" else ""
        labels.append(f"{_NAMES[formulation]}{epsilon}")
    if len({run.scene_name for run in runs}) > 1:
        labels = [f"{run.scene_name}: {label}" for run, label in zip(runs, labels, strict=True)]
    if len(set(labels)) < len(labels):
        labels = [f"{k}. {label}" for k, label in enumerate(labels, 1)]
    return labels


def _power(x: float) -> str:
    """Return 0.0001 as 10⁻⁴, anything that is no power of ten as it is."""
    exponent = round(math.log10(x))
    if not math.isclose(x, 10.0**exponent, rel_tol=1e-9):
        return f"{x:g}"
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
