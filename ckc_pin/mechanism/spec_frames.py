"""What the structures of a mechanism file share: numbers with bounds, names, frames."""

from __future__ import annotations

from typing import Annotated

import msgspec

from ckc_pin.base.toml import FileStruct

__all__ = ["Frame", "FrameSpec", "Name", "NonNegative", "Positive", "Vector3"]

Vector3 = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Name = Annotated[str, msgspec.Meta(min_length=1)]


class FrameSpec(FileStruct, frozen=True):
    """A frame placed in a link (or ``joint:NAME``, or ``world``).

    Attributes
    ----------
    link
        A link, ``joint:NAME`` or ``world``.
        ``link = "rod"``
    xyz : m
        Position in it.
        ``xyz = [0.6, 0.0, 0.0]``
    rpy : rad
        Orientation in it: roll, pitch, yaw about fixed axes, as in a URDF.
        ``rpy = [0.0, 1.5707963, 0.0]``
    """

    link: Name
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)


Frame = Name | FrameSpec
