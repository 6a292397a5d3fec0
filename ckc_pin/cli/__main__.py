"""``python -m ckc_pin.cli`` is ``ckc``."""

from ckc_pin.cli.app import main

main()
