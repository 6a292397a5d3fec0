"""The commands: parse, call, print. The only place that knows exit codes.

`app` is the entry point; each group of commands is a module, which is imported when one of its commands is called.
"""

from ckc_pin.cli.app import main

__all__ = ["main"]
