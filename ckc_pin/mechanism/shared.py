"""Values that nobody may change, and that copies of a mechanism therefore have in common."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["Shared"]


class Shared:
    """A frozen dataclass whose arrays are read-only: a copy of it is itself."""

    def __post_init__(self) -> None:
        for value in self.__dict__.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self
