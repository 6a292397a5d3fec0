"""The commands: parse, call, print. The only place that knows exit codes.

0 done; 2 the input is wrong, known before the first step; 3 the numerics stopped; 130 and 143 interrupted.
With --json, standard output is one JSON object and everything else goes to standard error.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import tomllib
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

import ckc_pin
from ckc_pin.errors import CkcError, InputError, MechanismError, NumericalError
from ckc_pin.simulation.report import check_plain, check_table, run_table, terms_plain, terms_table

__all__ = ["main"]

DONE, WRONG_INPUT, STOPPED, INTERRUPTED, TERMINATED = 0, 2, 3, 130, 143

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Dynamics and control of closed kinematic chains. Begin with: ckc list; ckc run five_bar/tracking",
)

errors = Console(stderr=True, highlight=False, soft_wrap=True)

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for run.npz, figures and the scene as resolved.")]
Runs = Annotated[list[Path], typer.Argument(help="Run files, or folders that hold a run.npz.", metavar="RUN...")]


@app.command("list")
def list_(as_json: Json = False) -> None:
    """Shipped mechanisms and scenes, a line each.

    Example: ckc list
    """
    from ckc_pin.simulation.scene import catalogue

    entries = catalogue()
    if as_json:
        _print_json({"mechanisms": [{"name": n, "about": about, "scenes": scenes} for n, about, scenes in entries]})
        return
    for name, about, scenes in entries:
        print(f"{name:<22} {about}")
        for scene, says in scenes.items():
            print(f"  {name + '/' + scene:<30} {says}")


@app.command()
def check(
    what: Annotated[str, typer.Argument(help="A mechanism or a scene.")],
    branches: Annotated[bool, typer.Option("--branches", help="List the assembly branches too.")] = False,
    as_json: Json = False,
) -> None:
    """Freedoms, rank, redundant rows, partition; for a scene whether its trajectory stays in the workspace.

    Example: ckc check five_bar_as_printed/tracking
    """
    found = ckc_pin.check(what, branches=branches)
    if as_json:
        for warning in found.warnings:
            errors.print(f"warning: {warning}", markup=False)
        _print_json(check_plain(found))
    else:
        Console(highlight=False).print(check_table(found))


@app.command()
def terms(
    mechanism: Annotated[str, typer.Argument(help="A mechanism.")],
    q: Annotated[str, typer.Option(help='JSON table, e.g. \'{"theta_1": -1.2, "theta_3": -1.9}\'.')],
    v: Annotated[str, typer.Option(help="JSON table of rates; absent: at rest.")] = "{}",
    as_json: Json = False,
) -> None:
    """All terms at one state. Independent coordinates alone: sigma closes the loops, v_tree = rho q_dot.

    Example: ckc terms five_bar --q '{"theta_1": -1.2, "theta_3": -1.9}' --v '{"theta_1": 0.4}'
    """
    loaded = ckc_pin.load(mechanism)
    found = ckc_pin.terms(loaded, _table(q, "--q"), _table(v, "--v"))
    if as_json:
        _print_json(terms_plain(found))
    else:
        Console(highlight=False).print(terms_table(found))


@app.command()
def run(
    what: Annotated[str, typer.Argument(help="A scene, or a mechanism for its default scene.", metavar="SCENE")],
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the scene, e.g. solver.rtol=1e-10.")
    ] = None,
    out: Out = None,
    profile: Annotated[bool, typer.Option("--profile", help="Print which terms were evaluated, how often.")] = False,
    as_json: Json = False,
) -> None:
    """Simulate a scene.

    Example: ckc run five_bar/tracking --set formulation=reduced --out runs/tracking
    """
    scene = ckc_pin.load_scene(what, _changes(changes or []))
    if scene.spec.controller is not None:
        for warning in ckc_pin.check(scene).warnings:
            errors.print(f"warning: {warning}", markup=False)
    signal.signal(signal.SIGTERM, _terminate)
    with _progress_bar(scene.name) as progress:
        finished = ckc_pin.simulate(scene, progress=progress, profile=profile)
    if out is not None:
        _write(finished, out)
    if profile:
        _print_profile(finished)
    if as_json:
        _print_json(finished.summary())
    else:
        Console(highlight=False).print(run_table(finished))
        if out is not None:
            print(f"written to {out}")
    if finished.status == "stopped":
        errors.print(finished.message, markup=False)
        raise typer.Exit(STOPPED)
    if finished.status == "interrupted":
        errors.print(finished.message, markup=False)
        raise typer.Exit(TERMINATED if "SIGTERM" in finished.message else INTERRUPTED)


@app.command()
def plot(runs: Runs, out: Annotated[Path, typer.Option("--out", help="Folder for the figures.")] = Path()) -> None:
    """Figures of one or several runs.

    Example: ckc plot runs/reduced runs/spf --out figures
    """
    from ckc_pin.view.figures import plot as plot_runs

    for path in plot_runs([ckc_pin.Run.load(path) for path in runs], out):
        print(path)


@app.command()
def play(
    runs: Runs,
    speed: Annotated[float, typer.Option(help="Playback speed, 1 is real time.", min=1e-6)] = 1.0,
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1; 0: any free one.", min=0, max=65535)] = 0,
) -> None:
    """Play runs back in the browser through meshcat, on this machine only.

    Example: ckc play runs/tracking
    """
    ckc_pin.play(*[ckc_pin.Run.load(path) for path in runs], speed=speed, port=port)


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help="MuJoCo's MJCF, a URDF, or a robot.yaml beside its URDF.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write to; absent: one named after it.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there already.")] = False,
    as_json: Json = False,
) -> None:
    """Write another format's robot as a mechanism.toml and a URDF, and say what was guessed and left out."""
    from ckc_pin.mechanism import importing

    draft = importing.read(file)
    written = importing.write(draft, out or Path(draft.name), overwrite)
    found, problem = None, ""
    try:
        found = ckc_pin.check(written[0])
    except ckc_pin.MechanismError as error:  # a finding: what was written is there to be corrected
        problem = str(error)
    if as_json:
        result = {"closed": True, **check_plain(found)} if found else {"closed": False, "message": problem}
        paths = [str(path) for path in written]
        said = {"left_out": draft.left_out, "guessed": draft.guessed}
        _print_json({"status": "done", "written": paths, **said, "check": result})
        return
    for verb, items in (("written", written), ("guessed", draft.guessed), ("left out", draft.left_out)):
        for item in items:
            print(f"{verb}: {item}")
    Console(highlight=False).print(check_table(found) if found else f"check: {problem}", markup=False)


def main() -> NoReturn:
    """Entry point of the `ckc` command."""
    as_json = "--json" in sys.argv
    code = DONE
    try:
        code = app(standalone_mode=False) or DONE  # the code of a typer.Exit, None without one
    except (InputError, MechanismError) as error:
        _fail(str(error), WRONG_INPUT, as_json)
    except NumericalError as error:
        _fail(str(error), STOPPED, as_json, status="stopped")
    except CkcError as error:
        _fail(str(error), WRONG_INPUT, as_json)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        sys.stderr.close()  # the reader went away; nothing is wrong
        sys.exit(DONE)
    except Exception as error:
        usage = getattr(error, "format_message", None)  # click's own errors about the command line
        if usage is None:
            raise
        _fail(usage(), WRONG_INPUT, as_json)
    sys.exit(code)


def _fail(message: str, code: int, as_json: bool, status: str = "error") -> NoReturn:
    errors.print(f"{status}: {message}", markup=False)
    if as_json:
        _print_json({"status": status, "message": message})
    sys.exit(code)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt("SIGTERM")


def _print_json(data: dict[str, Any]) -> None:
    print(json.dumps(_finite(data), ensure_ascii=False))


def _finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: null."""
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(text: str, option: str) -> dict[str, float]:
    try:
        table = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{option}: not JSON: {error}") from None
    if not isinstance(table, dict):
        raise InputError(f'{option}: a table by coordinate is needed, e.g. {{"theta_1": 0.4}}')
    for name, value in table.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{option}: {name} = {value!r} is not a number")
    return table


def _changes(settings: list[str]) -> dict[str, Any]:
    """Read KEY=VALUE; the value is TOML where it can be, else a plain string."""
    changes: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {setting}: write KEY=VALUE, e.g. solver.rtol=1e-10")
        try:
            value = tomllib.loads(f"x = {text}")["x"]
        except tomllib.TOMLDecodeError:
            value = text
        changes[key.strip()] = value
    return changes


def _write(finished: ckc_pin.Run, out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        finished.save(out / "run.npz")
        (out / "scene.json").write_text(json.dumps(finished.scene, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from None
    from ckc_pin.view.figures import plot as plot_runs

    plot_runs([finished], out)


def _print_profile(finished: ckc_pin.Run) -> None:
    errors.print(f"{'term':<20}{'evaluated':>12}{'ms':>10}")
    for name, cost in finished.profile.items():
        errors.print(f"{name:<20}{cost['calls']:>12}{1e3 * cost['seconds']:>10.2f}")


class _progress_bar:
    """A bar on a terminal, nothing in a pipe."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.bar: Any = None

    def __enter__(self) -> Any:
        if not errors.is_terminal:
            return None
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("t = {task.completed:.2f} s"))
        self.bar = Progress(*columns, TimeRemainingColumn(), console=errors, transient=True)
        task = self.bar.add_task(self.title, total=1.0)
        self.bar.start()
        return lambda t, t_end: self.bar.update(task, completed=t, total=t_end)

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()


if __name__ == "__main__":
    main()
