"""An erratum of the paper with the number that shows it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Erratum"]


@dataclass(frozen=True)
class Erratum:
    """An error in the paper; its texts are in ``templates/errata``.

    Attributes
    ----------
    key : str
        Name on the command line.
    where : str
    printed, correct : str
        The printed and the correct form.
    difference : float
        Measured error of the printed form.
    agreement : float
        Measured error of the correct form: rounding or truncation.
    unit : str
        Unit of both errors.
    measured : str
        Description of the comparison.
    commands : tuple of str
        Further commands that show it, besides ``./scripts/experiment errata KEY``.
    """

    key: str
    where: str
    printed: str
    correct: str
    difference: float
    agreement: float
    unit: str
    measured: str
    commands: tuple[str, ...] = ()
