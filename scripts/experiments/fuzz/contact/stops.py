"""Stops and friction of joints, as a mechanism's files say them and as the references read them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Contact", "JointStop", "contacts_of", "with_contacts", "with_limits"]


@dataclass(frozen=True)
class Contact:
    """Stops and friction of one joint; without stops where both limits are infinite."""

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


FAR = 1e4  # rad, m: a limit that is not there


def contacts_of(labels: Sequence[str], contacts: Mapping[str, Contact]) -> list[JointStop]:
    """All stops, by coordinate."""
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


def with_contacts(texts: Mapping[str, str], contacts: Mapping[str, Contact]) -> dict[str, str]:
    """A mechanism's files with limits in the URDF and [[joint]] tables for stops and friction."""
    made = dict(texts)
    for name, contact in contacts.items():
        table = f'\n[[joint]]\nname = "{name}"\n'
        if contact.friction:
            table += f"friction = {contact.friction!r}\n"
        if contact.stops:
            table += f"stops = true\nrestitution = {contact.restitution!r}\n"
            lower, upper = max(contact.lower, -FAR), min(contact.upper, FAR)
            for file in [file for file in made if file.endswith(".urdf")]:
                made[file] = with_limits(made[file], name, lower, upper)
        made["mechanism.toml"] += table
    return made


def with_limits(urdf: str, joint: str, lower: float, upper: float) -> str:
    """Give a joint of a URDF limits, if it is there."""
    before, found, after = urdf.partition(f'<joint name="{joint}"')
    if not found:
        return urdf
    own, end, rest = after.partition("</joint>")
    own = re.sub(r"<limit[^>]*/>", "", own).replace('type="continuous"', 'type="revolute"')
    return f'{before}{found}{own}<limit lower="{lower!r}" upper="{upper!r}" effort="1" velocity="1"/>{end}{rest}'
