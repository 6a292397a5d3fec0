"""Stops and friction of joints, for a mechanism's files and for the references."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Contact", "JointStop", "add_contacts", "list_joint_stops", "set_limits"]


@dataclass(frozen=True)
class Contact:
    """Stops and friction of one joint. It has no stops if both limits are infinite."""

    friction: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    restitution: float = 0.0

    @property
    def stops(self) -> bool:
        return bool(np.isfinite(self.lower) or np.isfinite(self.upper))


@dataclass(frozen=True)
class JointStop:
    """One end of a joint's range: the gap is sign (q - limit)."""

    column: int
    sign: int
    limit: float
    restitution: float


NO_LIMIT = 1e4  # rad or m: a limit that is not reached


def list_joint_stops(labels: Sequence[str], contacts: Mapping[str, Contact]) -> list[JointStop]:
    """Return the stops in the order of the coordinates."""
    stops = []
    for column, label in enumerate(labels):
        contact = contacts.get(label)
        if contact is None:
            continue
        if np.isfinite(contact.lower):
            stops.append(JointStop(column, 1, contact.lower, contact.restitution))
        if np.isfinite(contact.upper):
            stops.append(JointStop(column, -1, contact.upper, contact.restitution))
    return stops


def add_contacts(texts: Mapping[str, str], contacts: Mapping[str, Contact]) -> dict[str, str]:
    """Return a mechanism's files with limits in the URDF and [[joint]] tables for stops and friction."""
    files = dict(texts)
    for name, contact in contacts.items():
        table = f'\n[[joint]]\nname = "{name}"\n'
        if contact.friction:
            table += f"friction = {contact.friction!r}\n"
        if contact.stops:
            table += f"stops = true\nrestitution = {contact.restitution!r}\n"
            lower, upper = max(contact.lower, -NO_LIMIT), min(contact.upper, NO_LIMIT)
            for file in [file for file in files if file.endswith(".urdf")]:
                files[file] = set_limits(files[file], name, lower, upper)
        files["mechanism.toml"] += table
    return files


def set_limits(urdf: str, joint: str, lower: float, upper: float) -> str:
    """Return a URDF with limits of a joint; unchanged if it has no such joint."""
    before, tag, after = urdf.partition(f'<joint name="{joint}"')
    if not tag:
        return urdf
    body, closing, remainder = after.partition("</joint>")
    body = re.sub(r"<limit[^>]*/>", "", body).replace('type="continuous"', 'type="revolute"')
    return (
        f'{before}{tag}{body}<limit lower="{lower!r}" upper="{upper!r}" effort="1" velocity="1"/>{closing}{remainder}'
    )
