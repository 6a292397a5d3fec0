"""``python -m scripts.experiments NAME ...``: run an experiment by name."""

from __future__ import annotations

import runpy
import sys

EXPERIMENTS = {
    "paper": "scripts.experiments.paper.page",
    "errata": "scripts.experiments.paper.errata",
    "tikhonov": "scripts.experiments.paper.tikhonov",
    "stability": "scripts.experiments.stability.suite",
    "rank_loss": "scripts.experiments.rank_loss",
    "benchmark": "scripts.experiments.benchmark.make",
    "fuzz": "scripts.experiments.fuzz.main",
    "scenes": "scripts.experiments.scenes",
    "map": "scripts.experiments.bench_map",
    "stream": "scripts.experiments.bench_stream",
    "robots": "scripts.experiments.published_robots",
    "pictures": "scripts.experiments.pictures",
}


def main() -> None:
    """Hand the rest of the command line to the experiment."""
    if len(sys.argv) < 2 or sys.argv[1] not in EXPERIMENTS:
        print(f"usage: ./scripts/experiment NAME ...; NAME is one of {', '.join(EXPERIMENTS)}", file=sys.stderr)
        sys.exit(2)
    name = sys.argv.pop(1)
    runpy.run_module(EXPERIMENTS[name], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
