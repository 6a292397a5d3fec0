"""Demo: run the paper's five-bar under both controllers as SPF and reduced model; write figures and print a table."""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path
from typing import NoReturn

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import ckc_pin
from ckc_pin.view.figures import plot_runs

ROOT = Path(__file__).resolve().parent.parent
CASES = ("set_point", "tracking")
# The SPF is eq. 8 as printed: from w(0) = 0, the coordinates of eq. 17 would compute the reduced model again.
FORMULATIONS = {"spf": {"formulation": "spf", "spf_coordinates": "z"}, "reduced": {"formulation": "reduced"}}
STEADY = 4.0  # s: time from which tracking is in steady state
BOUND, BOUND_STEADY = 30.0, 5.0  # N m: the paper's bounds of |u| in tracking, at first and in steady state


def main() -> int:
    """Run the demo and return the exit code: 0 only if all runs are complete."""
    out = parse_arguments()
    runs: list[ckc_pin.Run] = []
    for case, formulation in product(CASES, FORMULATIONS):
        runs.append(simulate(f"five_bar/{case}", formulation))
        if runs[-1].status == "interrupted":
            raise KeyboardInterrupt
    files: list[Path] = []
    try:
        for case in CASES:
            pair = [run for run in runs if run.scene_name.endswith(case)]
            files += [run.save(out / case / run.scene["formulation"] / "run.npz") for run in pair]
            files += plot_runs(pair, out / case)
    except OSError as error:
        fail(f"--out {out}: {error.strerror}")
    except ckc_pin.InputError as error:
        fail(f"--out {out}: {error}")
    console = Console(highlight=False)
    console.print(table(runs))
    lines = ["Files:", *(f"  {shorten_path(path)}" for path in files), f"Watch: {playback(out / 'tracking')}"]
    console.print(*lines, sep="\n", markup=False, soft_wrap=True)
    for run in runs:
        if run.status != "done":
            print(f"{run.scene_name}, {run.scene['formulation']}: {run.message}", file=sys.stderr)
    return 0 if all(run.status == "done" for run in runs) else 3


def parse_arguments() -> Path:
    """Return the output folder from the command line."""
    parser = argparse.ArgumentParser(prog="demo", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "demo", metavar="DIR", help="folder for runs and figures")
    out: Path = parser.parse_args().out
    try:
        out.mkdir(parents=True, exist_ok=True)  # before computing anything
    except OSError as error:
        fail(f"--out {out}: {error.strerror}")
    return out


def simulate(scene: str, formulation: str) -> ckc_pin.Run:
    """Run a scene, with a progress bar on a terminal."""
    errors = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("t = {task.completed:.2f} s"))
    with Progress(*columns, TimeRemainingColumn(), console=errors, disable=not errors.is_terminal) as bar:
        task = bar.add_task(f"{scene:<20} {formulation:<8}", total=None)
        return ckc_pin.simulate(
            scene,
            FORMULATIONS[formulation],
            progress=lambda t, t_end: bar.update(task, completed=t, total=t_end),
        )


def table(runs: list[ckc_pin.Run]) -> Table:
    """Return the table of results, one row per run."""
    results = Table(title="The paper's five-bar", box=box.SIMPLE_HEAD, padding=(0, 0), caption_justify="left")
    results.caption = (
        f"The paper's bounds in tracking: |u| <= {BOUND:g} N m, after {STEADY:g} s <= {BOUND_STEADY:g} N m."
    )
    results.add_column("\n\ncase", no_wrap=True)
    results.add_column("\n\nmodel", no_wrap=True)
    for heading in (
        "\n\nε",
        "\n\nstatus",
        "final\nq - q_d,\nrad",
        "largest\n|u|,\nN m",
        f"after\n{STEADY:g} s,\nN m",
        "largest\n|φ|,\nm",
        "right-\nhand\nsides",
        "\n\ns",
    ):
        results.add_column(heading, justify="right", no_wrap=True)
    for run in runs:
        columns = [run.column(name) for name in run.independent]
        formulation = run.scene["formulation"]
        error = run.q_tree[-1, columns] - desired(run)
        late = np.abs(run.u[run.t >= STEADY])
        results.add_row(
            run.scene_name.rpartition("/")[2],
            formulation,
            f"{run.scene['epsilon']:.0e}" if formulation == "spf" else "",
            run.status,
            f"{np.abs(error).max():.1e}",
            f"{np.abs(run.u).max():.2f}",
            f"{late.max():.2f}" if len(late) else "",
            f"{run.max_phi:.0e}",
            f"{run.stats['rhs']}",
            f"{run.stats['wall_s']:.1f}",
        )
    return results


def desired(run: ckc_pin.Run) -> np.ndarray:
    """Return q_d at the end of a run: the set point, or eq. 21."""
    controller = run.scene["controller"]
    if controller["type"] == "set_point":
        return np.array([controller["q_d"][name] for name in run.independent])
    t = run.t[-1]
    return np.array([np.pi / 3 * np.sin(t), np.pi / 4 * (1 - np.cos(t))])


def shorten_path(path: Path) -> Path:
    """Return a path relative to the working directory if possible."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def playback(folder: Path) -> str:
    """Return the command that plays SPF and reduced model together."""
    paths = (Path(sys.executable).parent / "ckc", folder / "reduced", folder / "spf")
    program, reduced, spf = (shorten_path(path) for path in paths)
    return f"{program} play {reduced} {spf}"


def fail(message: str) -> NoReturn:
    """Print a message and exit with code 2."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
