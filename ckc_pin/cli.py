"""The commands: parse, call, print. The only place that knows exit codes.

0 done; 2 the input is wrong, known before the first step; 3 the numerics stopped; 130 and 143 interrupted.
With --json, standard output is one JSON object and everything else goes to standard error.
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
import tempfile
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

import ckc_pin
from ckc_pin.errors import CkcError, InputError, NumericalError
from ckc_pin.mechanism.whole_file import alone_in, write_whole
from ckc_pin.simulation.arguments import read_changes, read_table
from ckc_pin.simulation.interrupts import Interrupts
from ckc_pin.simulation.report import (
    check_plain,
    check_table,
    profile_table,
    run_table,
    terms_plain,
    terms_table,
    to_json,
)

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

__all__ = ["main"]

DONE, WRONG_INPUT, STOPPED, INTERRUPTED, TERMINATED = 0, 2, 3, 130, 143

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

interrupts = Interrupts()


@cache
def errors() -> Console:
    """Standard error, for people; a command that has nothing to say there loads no rich."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)


def watched() -> bool:
    """Whether somebody is looking on."""
    return sys.stderr.isatty() and errors().is_terminal


BEGIN = """Dynamics and control of closed kinematic chains.

\b
Begin with
  ckc list                                     what is shipped
  ckc check five_bar                           freedoms, partition, assembled configuration
  ckc run five_bar/tracking --out runs/first   simulate; run.npz and figures go to the folder
  ckc play runs/first                          watch it in the browser
  ckc COMMAND --help                           what a command does, with examples
"""

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Out = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Folder for run.npz, figures and the scene as resolved.")
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key of the scene; may be given many times."),
]
Runs = Annotated[list[Path], typer.Argument(help="Run files, or folders that hold a run.npz.", metavar="RUN...")]

Port = Annotated[int, typer.Option("--port", help="Port on 127.0.0.1; 0: any free one.")]
Open = Annotated[bool, typer.Option("--open", help="Open your browser too.")]


def _examples(*lines: str) -> str:
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


@app.callback(invoke_without_command=True, help=BEGIN)
def begin(context: typer.Context) -> None:
    """Say where to begin when no command is given."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command("list", epilog=_examples("ckc list"))
def list_(as_json: Json = False) -> None:
    """Shipped mechanisms and scenes, a line each."""
    from ckc_pin.simulation.scene import catalogue

    entries = catalogue()
    if as_json:
        _print_json({"mechanisms": [{"name": n, "about": about, "scenes": scenes} for n, about, scenes in entries]})
        return
    for name, about, scenes in entries:
        print(f"{name:<22} {about}")
        for scene, says in scenes.items():
            print(f"  {name + '/' + scene:<30} {says}")


@app.command(epilog=_examples("ckc check five_bar", "ckc check five_bar_as_printed/tracking"))
def check(
    what: Annotated[str, typer.Argument(help="A mechanism or a scene.", metavar="MECHANISM|SCENE")],
    branches: Annotated[bool, typer.Option("--branches", help="List the assembly branches too.")] = False,
    as_json: Json = False,
) -> None:
    """Freedoms, rank, redundant rows, partition. For a scene also whether its trajectory stays in the workspace."""
    found = ckc_pin.check(what, branches=branches)
    if as_json:
        for warning in found.warnings:
            errors().print(f"warning: {warning}")
        _print_json(check_plain(found))
    else:
        _print_table(check_table(found))


@app.command(epilog=_examples('ckc terms five_bar --q \'{"theta_1": -1.2, "theta_3": -1.9}\' --v \'{"theta_1": 0.4}\''))
def terms(
    mechanism: Annotated[str, typer.Argument(help="A mechanism.", metavar="MECHANISM")],
    q: Annotated[str, typer.Option("--q", metavar="JSON", help="Table of coordinates.")],
    v: Annotated[str, typer.Option("--v", metavar="JSON", help="Table of rates; absent: at rest.")] = "{}",
    as_json: Json = False,
) -> None:
    """All terms at one state. Independent coordinates alone: sigma closes the loops, v_tree = rho q_dot."""
    loaded = ckc_pin.load(mechanism)
    found = ckc_pin.terms(loaded, read_table("--q", q), read_table("--v", v))
    if as_json:
        _print_json(terms_plain(found))
    else:
        _print_table(terms_table(found))


@app.command(
    epilog=_examples(
        "ckc run five_bar/tracking --out runs/spf",
        "ckc run five_bar/tracking --set formulation=reduced --set solver.rtol=1e-10 --json",
        "ckc run five_bar/tracking --meshcat --speed 1",
    )
)
def run(
    what: Annotated[str, typer.Argument(help="A scene, or a mechanism for its default scene.", metavar="SCENE")],
    changes: Set = None,
    out: Out = None,
    profile: Annotated[bool, typer.Option("--profile", help="Print which terms were evaluated, how often.")] = False,
    meshcat: Annotated[bool, typer.Option("--meshcat", help="Show it in the browser while it computes.")] = False,
    speed: Annotated[
        float | None, typer.Option("--speed", help="With --meshcat: 1 is real time; absent: as it is computed.")
    ] = None,
    port: Port = 0,
    open_browser: Open = False,
    as_json: Json = False,
) -> None:
    """Simulate a scene."""
    _check_view_options(meshcat, speed, port, open_browser)
    scene = ckc_pin.load_scene(what, read_changes("--set", changes or []))
    if scene.spec.controller is not None:
        for warning in ckc_pin.check(scene).warnings:
            errors().print(f"warning: {warning}")
    if out is not None:
        _make_folder(out)
    with ExitStack() as stack:
        view = stack.enter_context(_view(scene, speed, port, open_browser)) if meshcat else None
        with _progress_bar(scene.name) as progress:
            on_output = None if view is None else view.on_output
            finished = ckc_pin.simulate(scene, progress=progress, on_output=on_output, profile=profile)
        code = _report(finished, out, profile, as_json)
        if view is not None and finished.status != "interrupted":
            with suppress(KeyboardInterrupt):
                view.finish(finished, stay=watched())
    if code != DONE:
        raise typer.Exit(code)


def _report(finished: ckc_pin.Run, out: Path | None, profile: bool, as_json: bool) -> int:
    """Write and print a run; return the exit code."""
    stop = _write(finished, out) if out is not None else None
    if profile:
        errors().print(profile_table(finished))
    if as_json:
        _print_json(finished.summary())
    else:
        _print_table(run_table(finished))
        if out is not None:
            print(f"written to {out}")
    sys.stdout.flush()  # a view may keep the command alive
    if finished.status != "done":
        errors().print(finished.message)
        return STOPPED if finished.status == "stopped" else _interrupted(finished.message)
    return DONE if stop is None else _interrupted(str(stop))


def _check_view_options(meshcat: bool, speed: float | None, port: int, open_browser: bool) -> None:
    given = [name for name, x in (("--speed", speed), ("--port", port), ("--open", open_browser)) if x]
    if given and not meshcat:
        raise InputError(f"{given[0]} goes with --meshcat; give both")
    if speed is not None:
        _check_speed(speed)


def _check_speed(speed: float) -> None:
    if not (math.isfinite(speed) and speed > 0):
        raise InputError(f"--speed {speed:g}: it must be above zero, 1 is real time")


def _view(scene: ckc_pin.Scene, speed: float | None, port: int, open_browser: bool) -> Any:
    from ckc_pin.view.live import live_view

    return live_view(scene, speed, port, open_browser)


@app.command(epilog=_examples("ckc plot runs/reduced runs/spf --out figures"))
def plot(runs: Runs, out: Annotated[Path, typer.Option("--out", help="Folder for the figures.")] = Path()) -> None:
    """Figures of one or several runs, PNG and SVG."""
    from ckc_pin.view.figures import plot as plot_runs

    for path in plot_runs([ckc_pin.Run.load(path) for path in runs], out, ("png", "svg")):
        print(path)


@app.command(
    epilog=_examples(
        "ckc play runs/spf",
        "ckc play runs/reduced runs/spf --speed 0.5 --gap 1000",
        "ckc play runs/spf --html spf.html",
    )
)
def play(
    runs: Runs,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write one file that plays from disk instead.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Playback speed, 1 is real time.")] = 1.0,
    gap: Annotated[float, typer.Option("--gap", help="Draw the gaps of the loops so many times larger.")] = 0.0,
    meshes: Annotated[
        Path | None, typer.Option("--meshes", metavar="FOLDER", help="The mechanism's folder, for its mesh files.")
    ] = None,
    port: Port = 0,
    open_browser: Open = False,
) -> None:
    """Watch runs in the browser, on this machine only. Several runs lie on each other."""
    _check_speed(speed)
    loaded = [ckc_pin.Run.load(path) for path in runs]
    if html is None:
        ckc_pin.play(*loaded, speed=speed, gap=gap, meshes=meshes, port=port, open_browser=open_browser)
        return
    from ckc_pin.view.player import save_html

    print(f"written: {save_html(loaded, html, speed=speed, gap=gap, meshes=meshes)}")


@app.command(
    "map",
    epilog=_examples(
        "ckc map five_bar --scene tracking --out figures",
        "ckc map five_bar --space cartesian --out figures",
        "ckc map delta --space cartesian --over x,z --out figures",
        "ckc map delta --space cartesian --sections 6 --out figures",
    ),
)
def map_(
    mechanism: Annotated[str, typer.Argument(help="A mechanism.", metavar="MECHANISM")],
    scene: Annotated[str | None, typer.Option("--scene", help="Draw this scene's desired trajectory on top.")] = None,
    over: Annotated[str | None, typer.Option("--over", metavar="A,B", help="The axes; all others are held.")] = None,
    space: Annotated[str, typer.Option("--space", help="joint, or cartesian: where a point goes.")] = "joint",
    point: Annotated[str | None, typer.Option("--point", help="A [[point]]; absent: the first one.")] = None,
    cells: Annotated[int, typer.Option("--cells", help="Along each axis.")] = 200,
    sections: Annotated[
        int | None, typer.Option("--sections", metavar="N", help="With three freedoms: N heights of the point.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the figure.")] = None,
    as_json: Json = False,
) -> None:
    """Where it can go and where it is singular. Branch by branch, as the paper's Fig. 2."""
    from ckc_pin.analysis import map as maps
    from ckc_pin.view.map_figure import require_figures, save_map
    from ckc_pin.view.sections_figure import save_sections

    if out is not None:
        _make_folder(out)
        require_figures()
    if sections is not None and (space != "cartesian" or scene is not None):
        raise InputError("--sections goes with --space cartesian, and without --scene")
    axes = None if over is None else [name.strip() for name in over.split(",")]
    with _progress_bar(f"map of {mechanism}", "{task.percentage:.0f} %") as bar:
        progress = None if bar is None else lambda part: bar(part, 1.0)
        if sections is None:
            one = ckc_pin.singularity_map(
                mechanism, scene=scene, space=space, over=axes, point=point, cells=cells, progress=progress
            )
        else:
            stack = maps.workspace_sections(
                mechanism, point=point, over=axes or ("x", "y"), count=sections, cells=cells, progress=progress
            )
    if as_json:
        _print_json(maps.map_plain(one) if sections is None else maps.sections_plain(stack))
    else:
        _print_table(maps.map_table(one) if sections is None else maps.sections_table(stack))
    if out is not None:
        for path in save_map(one, out) if sections is None else save_sections(stack, out):
            (errors().print if as_json else print)(f"written: {path}")


@app.command("import", epilog=_examples("ckc import cassie.xml --out mechanisms/cassie"))
def import_(
    file: Annotated[Path, typer.Argument(help="MuJoCo's MJCF, a URDF, or a robot.yaml beside its URDF.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write to; absent: one named after it.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there already.")] = False,
    as_json: Json = False,
) -> None:
    """Take a robot from another format. Writes a mechanism.toml and a URDF, and says what was guessed and left out."""
    from ckc_pin.formats import importing

    draft = importing.read(file)
    written = importing.write(draft, out or Path(draft.name), overwrite)
    found, problem = None, ""
    try:
        found = ckc_pin.check(written[0])
    except ckc_pin.MechanismError as error:  # a finding: what was written is there to be corrected
        problem = str(error)
    if as_json:
        result = {"status": "done", **check_plain(found)} if found else {"status": "error", "message": problem}
        paths = [str(path) for path in written]
        said = {"left_out": draft.left_out, "guessed": draft.guessed}
        _print_json({"status": "done", "written": paths, **said, "check": result})
        return
    for verb, items in (("written", written), ("guessed", draft.guessed), ("left out", draft.left_out)):
        for item in items:
            print(f"{verb}: {item}")
    _print_table(check_table(found) if found else f"check: {problem}")


@app.command(epilog=_examples("ckc export five_bar --to mjcf > five_bar.xml", "ckc export mine --to mjcf --out models"))
def export(
    mechanism: Annotated[str, typer.Argument(help="A mechanism.", metavar="MECHANISM")],
    to: Annotated[str, typer.Option("--to", help="mjcf: a model of MuJoCo.")] = "mjcf",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write to; absent: print it.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there already.")] = False,
    as_json: Json = False,
) -> None:
    """Write a mechanism for another program. Says what moves otherwise there."""
    from ckc_pin.formats import exporting

    found = exporting.export(ckc_pin.load(mechanism), to)
    written = [] if out is None else [exporting.write(found, out, overwrite)]
    if as_json:
        text = {} if written else {"text": found.text}
        _print_json({"status": "done", "written": [str(path) for path in written], **text, "differs": found.differs})
        return
    print("\n".join(f"written: {path}" for path in written) if written else found.text)
    for difference in found.differs:
        (print if written else errors().print)(f"differs: {difference}")


def main() -> NoReturn:
    """Entry point of the `ckc` command."""
    as_json = "--json" in sys.argv
    interrupts.install()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that the terminal cannot show is no error
    code = DONE
    try:
        command = typer.main.get_command(app)
        with command.make_context("ckc", sys.argv[1:]) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as exit_:
        code = exit_.exit_code
    except NumericalError as error:
        _fail(str(error), STOPPED, as_json, status="stopped")
    except CkcError as error:
        _fail(str(error), WRONG_INPUT, as_json)
    except KeyboardInterrupt as stop:
        _fail(f"by {str(stop) or 'Ctrl-C'}", _interrupted(str(stop)), as_json, status="interrupted")
    except BrokenPipeError:  # the reader went away; nothing is wrong
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), WRONG_INPUT, as_json)
    except Exception as error:
        usage = _usage(error)
        if usage is None:
            raise
        _fail(usage, WRONG_INPUT, as_json)
    sys.exit(code)


def _usage(error: Exception) -> str | None:
    """What was wrong with the command line; None when that is not the error."""
    says = getattr(error, "format_message", None)
    if says is None:
        return None
    context = getattr(error, "ctx", None)
    path = "ckc" if context is None else context.command_path
    commands = getattr(getattr(context, "command", None), "commands", None)
    choices = f"Commands: {', '.join(commands)}" if commands else f"See {path} --help"
    what = says()
    return f"{path}: {what if what.endswith(('.', '?')) else f'{what}.'} {choices}"


def _fail(message: str, code: int, as_json: bool, status: str = "error") -> NoReturn:
    errors().print(f"{status}: {message}")
    if as_json:
        _print_json({"status": status, "message": message})
    sys.exit(code)


def _interrupted(message: str) -> int:
    return TERMINATED if "SIGTERM" in message else INTERRUPTED


def _by(stop: KeyboardInterrupt) -> str:
    return f" by {stop}" if str(stop) else ""


def _print_json(data: dict[str, Any]) -> None:
    print(to_json(data))


def _print_table(table: RenderableType) -> None:
    from rich.console import Console

    Console(highlight=False, markup=False, emoji=False).print(table)


def _make_folder(out: Path) -> None:
    """Find out before a run, not after it, whether it can be saved."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise InputError(f"--out {out}: no folder that can be written to: {error.strerror}") from None


def _write(finished: ckc_pin.Run, out: Path) -> KeyboardInterrupt | None:
    """Save a run, whatever signals come, then draw its figures; return what interrupted that."""
    try:
        with ExitStack() as stack:
            with interrupts.held():
                stack.enter_context(alone_in(out))
                finished.save(out / "run.npz")
                write_whole(out / "scene.json", json.dumps(finished.scene, indent=2) + "\n")
            _draw(finished, out)
    except KeyboardInterrupt as stop:
        errors().print(f"no figures: interrupted{_by(stop)}; the run is saved")
        return stop
    return None


def _draw(finished: ckc_pin.Run, out: Path) -> None:
    try:
        from ckc_pin.view.figures import plot as plot_runs

        plot_runs([finished], out)
    except InputError as error:  # matplotlib is an extra; the run itself is saved
        errors().print(f"no figures: {error}")


class _progress_bar:
    """A bar on a terminal, nothing in a pipe."""

    def __init__(self, title: str, says: str = "t = {task.completed:.2f} s") -> None:
        self.title, self.says = title, says
        self.bar: Any = None

    def __enter__(self) -> Any:
        if not watched():
            return None
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(self.says))
        self.bar = Progress(*columns, TimeRemainingColumn(), console=errors(), transient=True)
        task = self.bar.add_task(self.title, total=1.0)
        self.bar.start()
        return lambda t, t_end: self.bar.update(task, completed=t, total=t_end)

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()


if __name__ == "__main__":
    main()
