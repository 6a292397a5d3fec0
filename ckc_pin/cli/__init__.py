"""The commands: parse, call, print. The only place that knows exit codes.

`main` is the entry point of the process, `app` finds the command; each group of commands is a module, which is imported
when one of its commands is called.
"""

from __future__ import annotations

from ckc_pin.cli.signals import interrupts

TYPE_CHECKING = False  # importing `typing` would delay the handlers of signals
if TYPE_CHECKING:
    from typing import NoReturn

__all__ = ["main"]


def main() -> NoReturn:
    """Handle signals, then import everything else, run the command line of this process and end the process."""
    interrupts.install(loading=True)
    from ckc_pin.cli.app import main as run

    interrupts.exit(run())
