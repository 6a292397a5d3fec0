"""An erratum of the paper, with the number that shows it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Erratum"]


@dataclass(frozen=True)
class Erratum:
    """A place where the paper is not as it should be; its texts are in ``templates/errata``.

    Attributes
    ----------
    key : str
        What the command line calls it.
    where : str
    printed, correct : str
        The two forms.
    difference : float
        How far the printed form is from what is true, as measured.
    agreement : float
        The same of the correct form: rounding or truncation errors.
    unit : str
        Of both.
    measured : str
        What was compared with what.
    commands : tuple of str
        What else a reader can run to see it; ``./scripts/experiment errata KEY`` always shows it.
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
