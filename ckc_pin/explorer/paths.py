"""Paths of the explorer's objects in the scene."""

from __future__ import annotations

from ckc_pin.view.drawing import WORLD

__all__ = ["BRANCHES", "EXPLORED", "SHOWN"]

EXPLORED = f"{WORLD}/explored"  # the mechanism
BRANCHES = f"{WORLD}/branches"  # ghosts of its other assembly branches
SHOWN = f"{WORLD}/shown"  # drawings of quantities, one folder each
