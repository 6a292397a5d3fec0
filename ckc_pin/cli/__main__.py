"""``python -m ckc_pin.cli`` is ``ckc``."""

from ckc_pin.cli import main

main()
