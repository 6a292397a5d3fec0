"""The `ckc` command: finds the module of a command, calls it, and turns errors and signals into exit codes."""

from __future__ import annotations

import io
import os
import sys
from importlib import import_module

import click

import ckc_pin
from ckc_pin.cli.exits import DONE, STOPPED, WRONG_INPUT, interrupted
from ckc_pin.cli.output import errors, forget_answer, has_answered, print_json
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import CkcError, NumericalError

__all__ = ["ckc", "main"]

BEGIN = """Dynamics and control of closed kinematic chains.

\b
Begin with
  ckc list                                     what is shipped
  ckc check five_bar                           freedoms, partition, assembled configuration
  ckc run five_bar/tracking --out runs/first   simulate; run.npz goes to the folder
  ckc play runs/first                          watch it in the browser
  ckc plot runs/first --out figures            draw it
  ckc new mine                                 a folder with a mechanism of your own to change
  ckc COMMAND --help                           what a command does, with examples
"""

# What a shell asks by, once its own file has: eval "$(_CKC_COMPLETE=bash_source ckc)", or zsh_source, fish_source.
COMPLETE = "_CKC_COMPLETE"

COMMANDS = {
    "new": "new:new",
    "list": "look:list_",
    "check": "look:check",
    "terms": "look:terms",
    "compile": "look:compile_",
    "run": "run:run",
    "inverse": "inverse:inverse",
    "linearize": "linearize:linearize",
    "sensitivities": "sensitivities:sensitivities",
    "sweep": "sweep:sweep",
    "plot": "view:plot",
    "play": "view:play",
    "map": "map:map_",
    "report": "report:report",
    "import": "exchange:import_",
    "export": "exchange:export",
}  # in the order of the help; module:function in this folder


class _Commands(click.Group):
    """A group that imports the module of a command when the command is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; None where there is none of that name."""
        if cmd_name not in COMMANDS:
            return None
        module, _, function = COMMANDS[cmd_name].partition(":")
        command: click.Command = getattr(import_module(f"ckc_pin.cli.{module}"), function)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Import the module of a command; only then may a signal raise KeyboardInterrupt."""
        found = super().resolve_command(ctx, args)
        interrupts.start_command()
        return found


@click.group(
    "ckc",
    cls=_Commands,
    help=BEGIN,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(ckc_pin.__version__, message="%(prog)s %(version)s")
@click.pass_context
def ckc(context: click.Context) -> None:
    """Say where to begin when no command is given."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def main() -> int:
    """Run the command line of this process and return the exit code."""
    if COMPLETE in os.environ:
        from click.shell_completion import shell_complete

        return int(shell_complete(ckc, {}, "ckc", COMPLETE, os.environ[COMPLETE]))
    as_json = "--json" in sys.argv
    forget_answer()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that the terminal cannot show is no error
    try:
        code = _run(as_json)
        interrupts.finish()
    except BaseException as error:
        stop = _interrupt_behind(error)
        if stop is None:
            raise
        interrupts.finish()
        _fail(f"by {str(stop) or 'Ctrl-C'}", as_json, status="interrupted")
        return interrupted(str(stop))
    return code


def _run(as_json: bool) -> int:
    """Run the command line; say what was wrong with it, and return the exit code."""
    try:
        with ckc.make_context("ckc", sys.argv[1:]) as context:
            ckc.invoke(context)
        sys.stdout.flush()
    except click.exceptions.Exit as exit_:
        return exit_.exit_code
    except BrokenPipeError:  # the reader went away; nothing is wrong
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (click.ClickException, CkcError, OSError) as error:
        if _interrupt_behind(error) is not None:
            raise
        stopped = isinstance(error, NumericalError)
        _fail(_message(error), as_json, status="stopped" if stopped else "error")
        return STOPPED if stopped else WRONG_INPUT
    return DONE


def _interrupt_behind(error: BaseException) -> KeyboardInterrupt | None:
    """Return the KeyboardInterrupt that an error is, or that a library has turned into this error."""
    return error if isinstance(error, KeyboardInterrupt) else interrupts.pending


def _message(error: Exception) -> str:
    if isinstance(error, click.ClickException):
        return _usage(error)
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _usage(error: click.ClickException) -> str:
    """Say what was wrong with the command line, and what would be right."""
    context = error.ctx if isinstance(error, click.UsageError) else None
    path = "ckc" if context is None else context.command_path
    command = None if context is None else context.command
    choices = f"Commands: {', '.join(COMMANDS)}" if command is ckc else f"See {path} --help"
    what = error.format_message()
    return f"{path}: {what if what.endswith(('.', '?')) else f'{what}.'} {choices}"


def _fail(message: str, as_json: bool, status: str) -> None:
    errors().print(f"{status}: {message}")
    if as_json and not has_answered():
        print_json({"status": status, "message": message})
