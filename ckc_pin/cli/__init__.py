"""Command line: parse arguments, call the package, print the result. Only this room knows exit codes.

`main` is the entry point of the process. `app` finds the command, and imports the module that defines it.
"""

from __future__ import annotations

from ckc_pin.cli.signals import interrupts

TYPE_CHECKING = False  # Importing `typing` would delay the installation of signal handlers.
if TYPE_CHECKING:
    from typing import NoReturn

__all__ = ["main"]


def main() -> NoReturn:
    """Install signal handlers, then import everything else, run the command line and end the process."""
    interrupts.install(loading=True)
    from ckc_pin.cli.app import main as run_command_line

    interrupts.exit(run_command_line())
