"""``python -m ckc_pin`` is ``ckc``."""

from ckc_pin.cli import main

if __name__ == "__main__":
    main()
