"""Many runs of one scene: the command `ckc sweep`."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import click

from ckc_pin.cli import options
from ckc_pin.cli.exits import STOPPED, interrupted
from ckc_pin.cli.output import errors, print_json, print_summary
from ckc_pin.ensembles.ensemble import SweepResult, load_sweep_task, run_sweep
from ckc_pin.ensembles.members import SweepTask
from ckc_pin.errors import InputError

__all__ = ["sweep"]

EPILOG = options.examples(
    "ckc sweep swing.sweep.toml --out sweeps/swing",
    "ckc sweep swing.sweep.toml --out sweeps/swing --workers 4",
    "ckc sweep swing.sweep.toml --out sweeps/swing --scheduler tcp://10.0.0.1:8786",
    "ckc sweep swing.sweep.toml --out sweeps/swing --worst drift    # runs for ckc play",
)


@click.command("sweep", epilog=EPILOG)
@click.argument("file", metavar="FILE", type=options.PATH, help="A *.sweep.toml: a scene, its variables, what is kept.")
@click.option(
    "--out", type=options.PATH, required=True, metavar="DIR", help="Gets results.zarr; what is there is gone on with."
)
@click.option("--threads", type=click.IntRange(min=1), help="Threads of this process; absent: one a core.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes on this machine, by Dask, in place of threads.")
@click.option("--scheduler", metavar="ADDRESS", help="A cluster of Dask's that is there.")
@click.option(
    "--chunk", type=click.IntRange(min=1), help="Members that are written together; absent: about a second's."
)
@click.option(
    "--worst", metavar="OUTPUT", multiple=True, help="Run the members where it is largest again, for ckc play."
)
@click.option(
    "--indices", type=click.IntRange(min=2), metavar="N", help="Sobol indices, from (variables + 2) N members."
)
@click.option("--figures/--no-figures", default=True, help="Draw fans, maps and which variable matters.")
@options.as_json
def sweep(
    file: Path,
    out: Path,
    threads: int | None,
    workers: int | None,
    scheduler: str | None,
    chunk: int | None,
    worst: tuple[str, ...],
    indices: int | None,
    figures: bool,
    as_json: bool,
) -> None:
    """Run a scene many times with other numbers.

    Killed at any time, the same command goes on where it was; the results do not depend on threads, chunks or workers.
    """
    if scheduler and workers:
        raise InputError("--workers and --scheduler: give one of them")
    task = load_sweep_task(file)
    unknown = [name for name in worst if name not in task.spec.outputs]
    if unknown:
        raise InputError(f"--worst {unknown[0]}: no such output; there are {', '.join(task.spec.outputs)}")
    if indices is not None:
        from ckc_pin.ensembles.sobol_indices import build_distributions

        build_distributions(task, indices)  # before anything is run
    found = run_sweep(task, out, threads=threads, workers=workers, scheduler=scheduler, chunk=chunk)
    if found.repairs:
        errors().print(found.repairs)
    if found.status == "done":
        _afterwards(found, out, worst, figures)
        if indices is not None:
            _weigh(task, indices, threads, out, figures)
    _print(found, out, as_json)
    if found.status != "done":
        errors().print(found.message)
        raise click.exceptions.Exit(STOPPED if found.status == "stopped" else interrupted(found.message))


def _print(result: SweepResult, out: Path, as_json: bool) -> None:
    if as_json:
        print_json(result.to_dict())
        return
    print_summary(result.summary())
    print(f"written to {out}")


def _weigh(task: SweepTask, count: int, threads: int | None, out: Path, figures: bool) -> None:
    """Write which variable matters, a row an output and variable, and draw it."""
    from ckc_pin.base.atomic_files import write_atomic
    from ckc_pin.ensembles.sobol_indices import compute_sobol_indices
    from ckc_pin.ensembles.store_layout import array_name

    found = compute_sobol_indices(task, count, threads)
    rows = ["output,variable,first_order,total_order"]
    for name in found["output"].to_numpy():
        of = found.sel(output=name)
        for variable in found["variable"].to_numpy():
            one = of.sel(variable=variable)
            rows.append(f"{name},{variable},{float(one['first_order'])!r},{float(one['total_order'])!r}")
        if figures:
            try:
                from ckc_pin.view.ensemble_figures import draw_sobol_indices

                draw_sobol_indices(of, out / f"indices_{array_name(str(name))}.png")
            except InputError as error:
                errors().print(f"no figures: {error}")
    write_atomic(out / "indices.csv", "\n".join(rows) + "\n")


def _afterwards(found: SweepResult, out: Path, worst: tuple[str, ...], figures: bool) -> None:
    """Draw figures, and run the worst members again."""
    results = found.open_results()
    if figures:
        try:
            from ckc_pin.view.ensemble_figures import draw_ensemble

            draw_ensemble(results, out)
        except InputError as error:  # matplotlib is an extra; the results are there
            errors().print(f"no figures: {error}")
    for name in worst:
        from ckc_pin.ensembles.ensemble import save_worst_members

        for folder in save_worst_members(found.prepared, results, name, out):
            errors().print(f"ckc play {quote(str(folder))}")
