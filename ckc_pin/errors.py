"""The exceptions of ckc_pin.

::

    CkcError
    ├── MechanismError        the mechanism cannot exist as described: an unknown name, an invalid loop
    │                         closure, loops that cannot be assembled, unsuitable independent coordinates
    ├── InputError            (also a ValueError) an argument or file is invalid: a wrong type, shape or
    │                         range, a number that is not finite, a missing file, an unknown key
    └── NumericalError        a computation stopped: sigma did not converge, a singular configuration,
                              an integration that cannot meet its tolerance

Every message says where the error is, what is wrong, and what would be right. On the command line the first
two end with exit code 2, before the first step. The third ends with exit code 3, and everything computed so
far is kept and printed.

`ImportNote` is a warning: what was guessed and left out of a file that was imported in memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["CkcError", "ImportNote", "InputError", "MechanismError", "NumericalError"]


class CkcError(Exception):
    """Base of the exceptions that ckc_pin raises on purpose.

    The message is one line. Characters of a user's names and paths that cannot be printed are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def printable(text: str) -> str:
    """Return a text as one line: characters that cannot be printed, such as cursor movements, are escaped."""
    return text if text.isprintable() else "".join(map(_escape, text))


def _escape(letter: str) -> str:
    return letter if letter.isprintable() else letter.encode("unicode_escape").decode()


class MechanismError(CkcError):
    """The mechanism cannot exist as described.

    Attributes
    ----------
    q_tree : dict of str to float, or None
        If its loops cannot be closed: the configuration nearest to closed ones that was reached, by coordinate.
    """

    def __init__(self, message: str, *, q_tree: Mapping[str, float] | None = None) -> None:
        super().__init__(message)
        self.q_tree = q_tree


class InputError(CkcError, ValueError):
    """An argument or a file is invalid, found before any computation."""


class ImportNote(UserWarning):
    """What was guessed and left out of a file in another program's format that was imported in memory."""


class NumericalError(CkcError):
    """A computation stopped before its end.

    Attributes
    ----------
    t : float or None
        Time at which it stopped, s.
    q_tree : dict of str to float, or None
        Configuration at which it stopped, by coordinate.
    run : Run or None
        The results until then.
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
