"""Command line of the experiments, ``./scripts/experiment NAME ...``. Each experiment is imported when it is run."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

__all__ = ["app", "main"]

DOCS = Path(__file__).resolve().parents[2] / "docs"


class Listed(TyperGroup):
    """Command group that lists the experiments when a name is unknown."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] not in self.commands:
            ctx.fail(f"no experiment {args[0]!r}; there are {', '.join(self.commands)}")
        return super().resolve_command(ctx, args)


def examples(*lines: str) -> str:
    """Return the examples at the end of a command's help."""
    return "\b\nExamples:\n" + "\n".join(f"  ./scripts/experiment {line}" for line in lines)


app = typer.Typer(
    cls=Listed,
    help="Experiments on the package, each with --help.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Keys = Annotated[list[str] | None, typer.Argument(metavar="KEY", show_default=False)]


class Formulation(StrEnum):
    """Formulations that rank_loss can run."""

    dae = "dae"
    reduced = "reduced"
    spf = "spf"


def check_names(names: Sequence[str] | None, choices: Collection[str], kind: str) -> list[str]:
    """Return the names as a list.

    Raises
    ------
    typer.BadParameter
        A name is unknown; the message lists the choices.
    """
    for name in names or ():
        if name not in choices:
            raise typer.BadParameter(f"no {kind} {name!r}; there are {', '.join(choices)}")
    return list(names or ())


@app.command(epilog=examples("paper", "paper figure-3 cost --out out"))
def paper(
    keys: Keys = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="default: docs; with KEY out")] = None,
) -> None:
    """Check the paper statement by statement.

    Writes docs/paper.md with its figures, and docs/errata.md. With KEY it only prints those entries.
    """
    from scripts.experiments.paper.contents import KEYS

    names = check_names(keys, KEYS, "entry")
    from scripts.experiments.paper import page

    if names:
        figures = (out or Path("out")) / "paper"
        figures.mkdir(parents=True, exist_ok=True)
        print(page.entries(page.as_frame(page.collect(names, figures))), end="")
        return
    for path in page.write(out or DOCS):
        print(f"written: {path}")


@app.command(epilog=examples("errata", "errata multipliers"))
def errata(keys: Keys = None) -> None:
    """Compute the paper's errata, each with the number that shows it.

    docs/errata.md is written by `paper`.
    """
    from scripts.experiments.paper import page
    from scripts.experiments.paper.errata import ERRATA, find

    print(page.errata_entries(find(check_names(keys, ERRATA, "erratum"))), end="")


@app.command(epilog=examples("stability", "stability length"))
def stability(
    groups: Annotated[list[str] | None, typer.Argument(metavar="GROUP", show_default=False)] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="for page and table")] = DOCS,
) -> None:
    """Run the stability suite: every integrator up to its limits.

    Writes docs/stability.md, or prints the named groups. Exits with 1 if a cell FAILED.
    """
    from scripts.experiments.stability import suite
    from scripts.experiments.stability.page import as_frame, page, satisfied, save

    names = check_names(groups, suite.NAMES, "group")
    cells, long_runs = suite.measure(names or suite.NAMES)
    table = as_frame(cells)
    text = page(table, long_runs)
    if names:
        print(text, end="")
    else:
        out.mkdir(parents=True, exist_ok=True)
        (out / "stability.md").write_text(text, encoding="utf-8")
        save(table, out / "stability.csv.gz")
        print(f"written: {out / 'stability.md'}, stability.csv.gz")
    raise typer.Exit(0 if not cells or satisfied(table) else 1)


@app.command("rank_loss", epilog=examples("rank_loss --quick", "rank_loss --formulation reduced"))
def rank_loss(
    formulation: Formulation = Formulation.dae,
    quick: Annotated[bool, typer.Option("--quick", help="N = 1, 2, 7 and every third tolerance")] = False,
) -> None:
    """Cross positions where J loses rank, and compare with a closed form.

    Prints how many runs are right, stopped or wrong.
    """
    from scripts.experiments import rank_loss

    rank_loss.show(formulation.value, quick)


@app.command("generated_sizes", epilog=examples("generated_sizes", "generated_sizes 4 delta ring_12"))
def generated_sizes(
    mechanisms: Annotated[
        list[str] | None,
        typer.Argument(metavar="MECHANISM", show_default=False, help="shipped name, N squares in a row, ring_n"),
    ] = None,
) -> None:
    """Measure up to which size of mechanism compiled terms pay.

    Prints length of the C text, times and speed-up by size.
    """
    from scripts.experiments import generated_sizes

    generated_sizes.main(mechanisms or ())


@app.command("right_hand_sides", epilog=examples("right_hand_sides", "right_hand_sides talos 40 chains_40"))
def right_hand_sides(
    mechanisms: Annotated[
        list[str] | None,
        typer.Argument(metavar="MECHANISM", show_default=False, help="shipped name, N squares in a row, chains_DEPTH"),
    ] = None,
) -> None:
    """Measure one right-hand side by size of mechanism, beside Pinocchio's lcaba.

    Prints times, their ratios, and the exponent of growth with the number of squares.
    """
    from scripts.experiments import right_hand_sides

    right_hand_sides.main(mechanisms or ())


@app.command(
    epilog=examples("benchmark --quick --out out/report", "benchmark --page", 'benchmark --peer "python my_peer.py"')
)
def benchmark(
    quick: Annotated[bool, typer.Option("--quick", help="fewer motions, methods and tolerances: minutes")] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="default: docs/report, and with --peer out/report")
    ] = None,
    page: Annotated[bool, typer.Option("--page", help="measure nothing: page and figures from the tables")] = False,
    peer: Annotated[
        list[str] | None,
        typer.Option(metavar="COMMAND", help="a program to add, as docs/report/peers.md explains; repeatable"),
    ] = None,
    archive: Annotated[
        Path | None, typer.Option(metavar="FILE", help="measure nothing: pack the tables with checksums as a zip file")
    ] = None,
    peers: Annotated[
        bool, typer.Option("--peers", help="first install programs that need an environment of their own")
    ] = False,
) -> None:
    """Measure error against run time, here and in other programs.

    Writes docs/report. An interrupted benchmark resumes where it stopped.
    """
    from scripts.experiments.benchmark import make
    from scripts.experiments.benchmark.peers.protocol import add_programs

    if page and peer:
        raise typer.BadParameter("--page measures nothing, so it adds no --peer; leave one of them out")
    if archive:
        from scripts.experiments.benchmark.archive import pack

        print(f"written: {pack(out or DOCS / 'report', archive)}")
        return
    if peers:
        from scripts.experiments.benchmark.peers.environments import PROGRAMS, make_environment

        for program in PROGRAMS:
            print(make_environment(program), flush=True)
    folder = out or (Path("out/report") if peer else DOCS / "report")
    for path in make.report(folder, quick=quick, from_tables=page, added=add_programs(peer or ())):
        print(f"written: {path}")


@app.command(epilog=examples("iftomm", "iftomm --out out/iftomm"))
def iftomm(out: Annotated[Path, typer.Option(metavar="DIR", help="gets the files")] = Path("out/iftomm")) -> None:
    """Write problems A01 to A05 of IFToMM's library in its result format."""
    from scripts.experiments.benchmark.iftomm import write_solutions

    for path in write_solutions(out):
        print(f"written: {path}")


@app.command("peer", epilog=examples('peer "python my_peer.py"', "peer ./my_peer swing bricard"))
def peer_(
    command: Annotated[str, typer.Argument(metavar="COMMAND", help="as docs/report/peers.md explains")],
    works: Annotated[list[str] | None, typer.Argument(metavar="WORK", show_default=False)] = None,
) -> None:
    """Run works of the benchmark in another program and in ckc_pin.

    Prints errors and times. Exits with 1 if a run failed.
    """
    from scripts.experiments.benchmark.peer_table import print_table
    from scripts.experiments.benchmark.work import WORKS

    keys = check_names(works, [work.key for work in WORKS], "work")
    raise typer.Exit(0 if print_table(command, keys) else 1)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})
def fuzz(context: typer.Context) -> None:
    """Run random motions and compare them with an independent integration."""
    from scripts.experiments.fuzz import main as suite

    raise typer.Exit(suite.main(context.args))


@app.command(epilog=examples("scenes"))
def scenes() -> None:
    """Measure the errors of all shipped scenes with SciPy.

    Errors are in units of the tolerance. Exits with 1 if one is too large.
    """
    from scripts.experiments import scenes

    raise typer.Exit(scenes.main())


@app.command("map", epilog=examples("map --cells 200"))
def map_(cells: Annotated[int, typer.Option(min=8, help="along each axis")] = 400) -> None:
    """Measure how long the five-bar's singularity map takes."""
    from scripts.experiments import bench_map

    bench_map.main(cells)


@app.command(epilog=examples("stream --runs 3"))
def stream(runs: Annotated[int, typer.Option(min=1)] = 6) -> None:
    """Measure right-hand sides per second with and without viewers."""
    from scripts.experiments import bench_stream

    bench_stream.main(runs)


@app.command(epilog=examples("ensembles --quick"))
def ensembles(
    out: Annotated[Path, typer.Option(metavar="DIR", help="gets the figures")] = Path("out/ensembles"),
    quick: Annotated[bool, typer.Option("--quick", help="fewer members")] = False,
) -> None:
    """Run two ensemble studies: manufacturing tolerances of lengths, and a basin of attraction."""
    from scripts.experiments import ensemble_studies

    ensemble_studies.main(out, quick)


@app.command("bench_ensembles", epilog=examples("bench_ensembles --runs 1"))
def bench_ensembles(runs: Annotated[int, typer.Option(min=1, help="thousands of members")] = 3) -> None:
    """Measure ensembles against MuJoCo's rollout, and extrapolate to 10^9 members on many cores."""
    from scripts.experiments import bench_ensembles, ensemble_scaling

    bench_ensembles.main(runs)
    print()
    ensemble_scaling.main()


@app.command(epilog=examples("bench", 'bench --only "five_bar"'))
def bench(
    only: Annotated[str, typer.Option(metavar="WORDS", help="lines that have these words")] = "",
) -> None:
    """Measure processor times of common calls and commands.

    Exits with 1 if one exceeds its bound.
    """
    from scripts.experiments import bench, bench_generated, bench_sensitivities

    missed = bench.main(only)
    print()
    missed = max(missed, bench_generated.main(only))
    print()
    raise typer.Exit(max(missed, bench_sensitivities.main(only)))


@app.command(epilog=examples("allocations build/count_allocations.so"))
def allocations(library: Annotated[Path, typer.Argument(exists=True, help="the counter, preloaded")]) -> None:
    """Count allocations in the step loop; a step must make none.

    Exits with 1 if it does. ./scripts/check_native builds the counter and preloads it.
    """
    from scripts.experiments import count_allocations

    raise typer.Exit(count_allocations.main(library))


@app.command(epilog=examples("robots ~/robots"))
def robots(folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="of checkouts")]) -> None:
    """Import, check and move published robots.

    Prints the tables of docs/published_robots.md.
    """
    from scripts.experiments import published_robots

    published_robots.main(folder)


@app.command(epilog=examples("identification", "identification delta leg --trials 40 --method motion"))
def identification(
    cases: Annotated[list[str] | None, typer.Argument(metavar="CASE", show_default=False)] = None,
    trials: Annotated[int, typer.Option(min=1, help="of each case")] = 200,
    method: Annotated[str, typer.Option(help="torques or motion")] = "torques",
) -> None:
    """Count how often the truth is within two standard deviations of identified parameters.

    Prints the share by case. Exits with 1 if one is below its bounds.
    """
    from scripts.experiments import identification_trials

    names = check_names(cases, identification_trials.CASES, "case") or identification_trials.CASES
    raise typer.Exit(identification_trials.main(names, method, trials))


@app.command(epilog=examples("importers build/fmusim"))
def importers(fmusim: Annotated[Path, typer.Argument(exists=True, dir_okay=False)]) -> None:
    """Run exported FMUs in fmusim and compare them with runs.

    Prints the table of docs/guide/simulators.md.
    """
    from scripts.experiments import importers

    raise typer.Exit(importers.main(fmusim))


@app.command("exported_code", epilog=examples("exported_code", "exported_code five_bar"))
def exported_code(
    names: Annotated[list[str] | None, typer.Argument(metavar="MECHANISM", show_default=False)] = None,
) -> None:
    """Check exported C code and FMUs with compilers and analyzers, and time the controllers.

    Uses GCC, Clang, their sanitizers, cppcheck, and an emulated ARM processor. Exits with 1 if a check fails.
    """
    from scripts.experiments import exported_code

    chosen = check_names(names, exported_code.MECHANISMS, "mechanism") or exported_code.MECHANISMS
    raise typer.Exit(exported_code.main(chosen))


@app.command(epilog=examples("planning", "planning five_bar --tasks 10"))
def planning(
    cases: Annotated[list[str] | None, typer.Argument(metavar="CASE", show_default=False)] = None,
    tasks: Annotated[int | None, typer.Option(min=1, help="of each case; default: 270 of all cases")] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the random ends")] = 0,
) -> None:
    """Plan random motions from one configuration to another, and replay them.

    Prints the share of solved tasks, and the reasons of the others. Exits with 1 if less than 95 % are solved.
    """
    from scripts.experiments import planning_trials

    names = check_names(cases, planning_trials.CASES, "case") or planning_trials.CASES
    raise typer.Exit(planning_trials.main(names, tasks, seed))


@app.command("time_optimal", epilog=examples("time_optimal", "time_optimal delta --intervals 200"))
def time_optimal(
    cases: Annotated[list[str] | None, typer.Argument(metavar="CASE", show_default=False)] = None,
    intervals: Annotated[int, typer.Option(min=20, help="of the path")] = 1000,
) -> None:
    """Compare durations along paths with `toppra`, which has to be installed.

    Exits with 1 if one differs by more than 0.1 %.
    """
    from scripts.experiments import time_optimal_peer

    names = check_names(cases, time_optimal_peer.CASES, "case") or time_optimal_peer.CASES
    raise typer.Exit(time_optimal_peer.main(names, intervals))


@app.command(epilog=examples('pictures "$(./scripts/chromium)"'))
def pictures(chromium: Annotated[Path, typer.Argument(exists=True, dir_okay=False)]) -> None:
    """Make the pictures of docs/images with a browser."""
    from scripts.experiments import pictures

    pictures.main(chromium)


def main() -> NoReturn:
    """Run the command line. It exits with 2 for invalid input and with 3 if the numerics stopped."""
    try:
        app(prog_name="./scripts/experiment")
    except Exception as error:
        from ckc_pin.errors import CkcError, InputError

        if not isinstance(error, CkcError | OSError):
            raise
        print(f"./scripts/experiment: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, InputError | OSError) else 3)
    sys.exit(0)


if __name__ == "__main__":
    main()
