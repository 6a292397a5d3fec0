"""The command excite: motions that make parameters known."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    ProgressBar,
    format_destination,
    make_folder,
    print_json,
    print_summary,
    skip_figures_without_matplotlib,
)
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import InputError

__all__ = ["excite"]


@click.command(
    epilog=options.format_examples(
        "ckc excite five_bar --out motion",
        "ckc excite delta --parameters link.plate.inertial --limit 'tau.*=4.0' --limit 'v.arm_*=3.0'",
        "ckc excite five_bar --period 5 --limit theta_1=[-2.0,-0.8] --criterion log_det --json",
    )
)
@options.mechanism
@click.option(
    "--parameters",
    metavar="NAMES",
    default="link.*.inertial",
    help="Parameters to make known, with wildcards, separated by commas.",
)
@click.option("--period", metavar="SECONDS", type=float, default=10.0, help="Period of the motion.")
@click.option("--harmonics", metavar="N", type=int, default=5, help="Waves of each coordinate.")
@click.option(
    "--limit",
    "limits",
    metavar="NAME=VALUE",
    multiple=True,
    help="Limit of a quantity, with wildcards: v.crank=3.0, a.*=20.0, tau.*=5.0, crank=[-2.0,-0.8]. May be repeated.",
)
@click.option(
    "--margin", metavar="NUMBER", type=float, default=0.3, help="Smallest singular values, relative to the start's."
)
@click.option(
    "--criterion",
    type=click.Choice(["condition", "log_det"]),
    default="condition",
    help="Small condition number, or large determinant of the information.",
)
@click.option(
    "--set",
    "settings",
    metavar="NAME=VALUE",
    multiple=True,
    help="Override a parameter of the mechanism. May be repeated.",
)
@click.option("--random", metavar="N", type=int, default=50, help="Random motions to start from and to compare with.")
@click.option("--seed", metavar="N", type=int, default=0, help="Seed of the random motions.")
@click.option("--rate", metavar="HERTZ", type=float, default=100.0, help="Rows of excite.csv in a second.")
@options.out(help="Folder for excite.scene.toml, excite.csv and the figure.")
@options.as_json
def excite(
    mechanism: str,
    parameters: str,
    period: float,
    harmonics: int,
    limits: tuple[str, ...],
    margin: float,
    criterion: str,
    settings: tuple[str, ...],
    random: int,
    seed: int,
    rate: float,
    out: Path | None,
    as_json: bool,
) -> None:
    """Find motions that make parameters known. It compares them with random motions within the same limits."""
    if not 0 < rate <= 1e5:
        raise InputError(f"--rate {rate:g}: expected a number above zero, at most 100000")
    loaded = ckc_pin.load(mechanism, options.read_overrides("--set", settings) or None)
    if out is not None:
        make_folder(out)
    with ProgressBar.percentage(f"excite {mechanism}") as progress:
        result = ckc_pin.excite(
            loaded,
            [name.strip() for name in parameters.split(",") if name.strip()],
            period=period,
            harmonics=harmonics,
            limits=options.read_overrides("--limit", limits),
            margin=margin,
            criterion=criterion,  # type: ignore[arg-type]
            random=random,
            seed=seed,
            progress=progress,
        )
    if out is not None:
        with ExitStack() as stack:
            with interrupts.deferred():
                stack.enter_context(lock_folder(out))
                result.save(out, rate, overwrite=True)
            with skip_figures_without_matplotlib():
                result.plot().save(out)
    if as_json:
        print_json(result.to_dict())
    else:
        print_summary(result.summary())
        print(format_destination(out, "excite.scene.toml, to run, and excite.csv, for the robot"))
