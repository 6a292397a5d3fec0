"""What can go wrong, all of it.

::

    CkcError
    ├── MechanismError        an unknown name, a closure that makes no sense, loops that cannot be
    │                         assembled, coordinates that cannot parametrise the mechanism
    ├── InputError            (also a ValueError) a value of the wrong shape, not finite, out of its
    │                         range; a file that is missing, malformed or has a key nobody knows
    └── NumericalError        the numerics stopped: sigma did not converge, a singular
                              configuration, an integration that cannot meet its tolerance

Every message says what was wrong, where, and what would be right. On the command line the first two
are exit code 2 (known before the first step), the third is exit code 3 (everything computed so far is
kept and printed).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["CkcError", "InputError", "MechanismError", "NumericalError"]


class CkcError(Exception):
    """Base of every error that ckc_pin raises on purpose.

    Its message is one line: what cannot be printed, of a stranger's names and paths, stands as an escape.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def printable(text: str) -> str:
    """Return a line of text whose letters can all be printed: the others stand as escapes, and move no cursor."""
    return text if text.isprintable() else "".join(map(_shown, text))


def _shown(letter: str) -> str:
    return letter if letter.isprintable() else letter.encode("unicode_escape").decode()


class MechanismError(CkcError):
    """A mechanism that does not exist as described."""


class InputError(CkcError, ValueError):
    """A value or a file that cannot be used, known before any computation."""


class NumericalError(CkcError):
    """The numerics stopped.

    Attributes
    ----------
    t : float or None
        Time of the stop in seconds, where there is one.
    q_tree : dict of str to float, or None
        The configuration it stopped at, by coordinate.
    run : Run or None
        Everything computed up to there.
    """

    def __init__(
        self,
        message: str,
        *,
        t: float | None = None,
        q_tree: Mapping[str, float] | None = None,
        run: Run | None = None,
    ) -> None:
        super().__init__(message)
        self.t = t
        self.q_tree = q_tree
        self.run = run
