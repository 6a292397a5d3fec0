"""The command sweep: many runs of one scene."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import click

from ckc_pin.cli import options
from ckc_pin.cli.output import (
    error_console,
    exit_unless_done,
    print_json,
    print_summary,
    skip_figures_without_matplotlib,
)
from ckc_pin.ensembles.ensemble import SweepResult, load_sweep_task, run_sweep
from ckc_pin.ensembles.members import SweepTask
from ckc_pin.errors import InputError

__all__ = ["sweep"]


@click.command(
    epilog=options.format_examples(
        "ckc sweep swing.sweep.toml --out sweeps/swing",
        "ckc sweep swing.sweep.toml --out sweeps/swing --workers 4",
        "ckc sweep swing.sweep.toml --out sweeps/swing --scheduler tcp://10.0.0.1:8786",
        "ckc sweep swing.sweep.toml --out sweeps/swing --worst drift    # runs for ckc play",
    )
)
@click.argument("file", metavar="FILE", type=options.PATH, help="A *.sweep.toml: a scene, its variables and outputs.")
@click.option(
    "--out",
    type=options.PATH,
    required=True,
    metavar="DIR",
    help="Folder for results.zarr; an unfinished sweep there is continued.",
)
@click.option("--threads", type=click.IntRange(min=1), help="Threads of this process; default: one per core.")
@click.option("--workers", type=click.IntRange(min=1), help="Use Dask processes on this machine instead of threads.")
@click.option("--scheduler", metavar="ADDRESS", help="Use a running Dask cluster.")
@click.option("--chunk", type=click.IntRange(min=1), help="Members per write; default: about one second's.")
@click.option(
    "--worst", metavar="OUTPUT", multiple=True, help="Save the members with the largest OUTPUT as runs for ckc play."
)
@click.option(
    "--indices", type=click.IntRange(min=2), metavar="N", help="Sobol indices, from (variables + 2) N more members."
)
@click.option("--figures/--no-figures", default=True, help="Draw quantiles, maps and Sobol indices.")
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
    """Run a scene with many parameter values.

    If the command is killed, the same command continues the sweep. The results do not depend on threads, chunks or
    workers.
    """
    if scheduler and workers:
        raise InputError("--workers and --scheduler: give one of them")
    task = load_sweep_task(file)
    unknown = [name for name in worst if name not in task.spec.outputs]
    if unknown:
        raise InputError(f"--worst {unknown[0]}: no such output; there are {', '.join(task.spec.outputs)}")
    if indices is not None:
        from ckc_pin.ensembles.sobol_indices import build_distributions

        build_distributions(task, indices)  # Invalid variables are reported before the first run.
    result = run_sweep(task, out, threads=threads, workers=workers, scheduler=scheduler, chunk=chunk)
    if result.repairs:
        error_console().print(result.repairs)
    if result.status == "done":
        _draw_and_save_worst(result, out, worst, figures)
        if indices is not None:
            _save_sobol_indices(task, indices, threads, out, figures)
    _print_result(result, out, as_json)
    exit_unless_done(result.status, result.message)


def _print_result(result: SweepResult, out: Path, as_json: bool) -> None:
    if as_json:
        print_json(result.to_dict())
        return
    print_summary(result.summary())
    print(f"written to {out}")


def _save_sobol_indices(task: SweepTask, count: int, threads: int | None, out: Path, figures: bool) -> None:
    """Write the Sobol indices to indices.csv, a row for each output and variable, and draw them."""
    from ckc_pin.base.atomic_files import write_atomic
    from ckc_pin.ensembles.sobol_indices import compute_sobol_indices
    from ckc_pin.ensembles.store_layout import array_name
    from ckc_pin.view.ensemble_figures import draw_sobol_indices

    dataset = compute_sobol_indices(task, count, threads)
    rows = ["output,variable,first_order,total_order"]
    for name in dataset["output"].to_numpy():
        by_variable = dataset.sel(output=name)
        for variable in dataset["variable"].to_numpy():
            indices = by_variable.sel(variable=variable)
            rows.append(f"{name},{variable},{float(indices['first_order'])!r},{float(indices['total_order'])!r}")
        if figures:
            with skip_figures_without_matplotlib():
                draw_sobol_indices(by_variable, out / f"indices_{array_name(str(name))}.png")
    write_atomic(out / "indices.csv", "\n".join(rows) + "\n")


def _draw_and_save_worst(result: SweepResult, out: Path, worst: tuple[str, ...], figures: bool) -> None:
    """Draw figures, then run the worst members again and save the runs."""
    dataset = result.open_results()
    if figures:
        from ckc_pin.view.ensemble_figures import save_ensemble

        with skip_figures_without_matplotlib():
            save_ensemble(dataset, out)
    for name in worst:
        from ckc_pin.ensembles.ensemble import save_worst_members

        for folder in save_worst_members(result.prepared, dataset, name, out):
            error_console().print(f"ckc play {quote(str(folder))}")
