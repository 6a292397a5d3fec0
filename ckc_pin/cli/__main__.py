"""Run the command line by ``python -m ckc_pin.cli``."""

from ckc_pin.cli import main

main()
