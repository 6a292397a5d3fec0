"""``python -m scripts.experiments NAME ...``: run an experiment by name."""

from __future__ import annotations

import sys

from scripts.experiments.fuzz.main import main as fuzz

EXPERIMENTS = {"fuzz": fuzz}


def main() -> int:
    """Hand the rest of the command line to the experiment."""
    if len(sys.argv) < 2 or sys.argv[1] not in EXPERIMENTS:
        print(f"usage: ./scripts/experiment NAME ...; NAME is one of {', '.join(EXPERIMENTS)}", file=sys.stderr)
        return 2
    return EXPERIMENTS[sys.argv[1]](sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
