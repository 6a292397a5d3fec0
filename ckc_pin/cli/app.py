"""The `ckc` command: find and call a command, and convert errors and signals into exit codes."""

from __future__ import annotations

import io
import os
import sys
import warnings
from importlib import import_module

import click

import ckc_pin
from ckc_pin.cli.output import error_console, has_printed_json, print_json, reset_json
from ckc_pin.cli.signals import DONE, STOPPED, WRONG_INPUT, interrupt_code, interrupts
from ckc_pin.errors import CkcError, ImportNote, NumericalError

__all__ = ["ckc", "main"]

INTRODUCTION = """Dynamics and control of closed kinematic chains.

\b
Begin with
  ckc list                                     list shipped mechanisms and scenes
  ckc check five_bar                           freedoms, partition, assembled configuration
  ckc explore five_bar                         drag the mechanism in the browser, loops closed
  ckc run five_bar/tracking --out runs/first   simulate, and save run.npz in the folder
  ckc play runs/first                          play the run in the browser
  ckc plot runs/first --out figures            draw figures of the run
  ckc keys motor                               print the keys of a table
  ckc new mine                                 create a folder with a mechanism to start from
  ckc COMMAND --help                           describe a command, with examples
"""

# The environment variable by which a shell asks for completions, if its startup file contains
# eval "$(_CKC_COMPLETE=bash_source ckc)", or zsh_source, fish_source.
COMPLETE_VARIABLE = "_CKC_COMPLETE"

# module:function in this folder, in the order of the help
COMMANDS = {
    "new": "files:new",
    "list": "inspection:list_",
    "keys": "inspection:keys",
    "check": "inspection:check",
    "explore": "explore:explore",
    "terms": "inspection:terms",
    "compile": "inspection:compile_",
    "run": "runs:run",
    "inverse": "analyses:inverse",
    "linearize": "analyses:linearize",
    "sensitivities": "analyses:sensitivities",
    "sweep": "sweep:sweep",
    "excite": "excite:excite",
    "identify": "identification:identify",
    "calibrate": "identification:calibrate",
    "optimize": "optimize:optimize",
    "plot": "runs:plot",
    "play": "runs:play",
    "map": "analyses:map_",
    "report": "report:report",
    "import": "files:import_",
    "export": "files:export",
}


class _Commands(click.Group):
    """A group that imports the module of a command when the command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, or None if there is no command of that name."""
        if cmd_name not in COMMANDS:
            return None
        module, _, function = COMMANDS[cmd_name].partition(":")
        command: click.Command = getattr(import_module(f"ckc_pin.cli.{module}"), function)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Import the module of a command. Signals raise KeyboardInterrupt only after that."""
        resolved = super().resolve_command(ctx, args)
        interrupts.start_command()
        return resolved


@click.group(
    "ckc",
    cls=_Commands,
    help=INTRODUCTION,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(ckc_pin.__version__, message="%(prog)s %(version)s")
@click.pass_context
def ckc(context: click.Context) -> None:
    """Print the introduction if no command is given."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def main() -> int:
    """Run the command line of this process and return the exit code."""
    if COMPLETE_VARIABLE in os.environ:
        from click.shell_completion import shell_complete

        return int(shell_complete(ckc, {}, "ckc", COMPLETE_VARIABLE, os.environ[COMPLETE_VARIABLE]))
    as_json = "--json" in sys.argv
    reset_json()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # for names that the terminal cannot show
    try:
        code = _run_command(as_json)
        interrupts.finish()
    except BaseException as error:
        stop = _find_interrupt(error)
        if stop is None:
            raise
        interrupts.finish()
        _print_error(f"by {str(stop) or 'Ctrl-C'}", as_json, status="interrupted")
        return interrupt_code(str(stop))
    return code


def _print_warning(message: Warning | str, *_: object, **__: object) -> None:
    error_console().print(f"note: {message}", markup=False, highlight=False)


def _run_command(as_json: bool) -> int:
    """Run the command line, print its error if there is one, and return the exit code."""
    try:
        with warnings.catch_warnings(), ckc.make_context("ckc", sys.argv[1:]) as context:
            warnings.simplefilter("always", ImportNote)
            warnings.showwarning = _print_warning
            ckc.invoke(context)
        sys.stdout.flush()
    except click.exceptions.Exit as exit_:
        return exit_.exit_code
    except BrokenPipeError:  # The reader of standard output has ended, as `head` does; this is no error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (click.ClickException, CkcError, OSError) as error:
        if _find_interrupt(error) is not None:
            raise
        is_numerical = isinstance(error, NumericalError)
        _print_error(_format_error(error), as_json, status="stopped" if is_numerical else "error")
        return STOPPED if is_numerical else WRONG_INPUT
    return DONE


def _find_interrupt(error: BaseException) -> KeyboardInterrupt | None:
    """Return the KeyboardInterrupt that is this error, or that a library has converted into this error."""
    return error if isinstance(error, KeyboardInterrupt) else interrupts.pending


def _format_error(error: Exception) -> str:
    if isinstance(error, click.ClickException):
        return _format_usage_error(error)
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _format_usage_error(error: click.ClickException) -> str:
    """Return what is wrong with the command line, followed by the valid commands or the command that shows help."""
    context = error.ctx if isinstance(error, click.UsageError) else None
    path = "ckc" if context is None else context.command_path
    command = None if context is None else context.command
    hint = f"Commands: {', '.join(COMMANDS)}" if command is ckc else f"See {path} --help"
    problem = error.format_message()
    return f"{path}: {problem if problem.endswith(('.', '?')) else f'{problem}.'} {hint}"


def _print_error(message: str, as_json: bool, status: str) -> None:
    error_console().print(f"{status}: {message}")
    if as_json and not has_printed_json():
        print_json({"status": status, "message": message})
