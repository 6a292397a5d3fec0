"""Array types, properties that are computed once, and a base of immutable structures with arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Array",
    "BoolArray",
    "Immutable",
    "IntArray",
    "lazy",
]

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

T = TypeVar("T")


class lazy(Generic[T]):
    """A property that is computed at the first access and then stored in the object.

    As `functools.cached_property`, but without its lock, which on Python 3.11 costs more than some of these values.
    """

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self.compute = compute
        self.name = compute.__name__
        self.__doc__ = compute.__doc__

    @overload
    def __get__(self, owner: None, kind: type) -> lazy[T]: ...
    @overload
    def __get__(self, owner: object, kind: type) -> T: ...
    def __get__(self, owner: Any, kind: type) -> Any:
        if owner is None:
            return self
        value = owner.__dict__[self.name] = self.compute(owner)
        return value


class Immutable(msgspec.Struct, frozen=True, eq=False):
    """Base of immutable structures whose arrays are read-only. A deep copy shares them.

    They are no data classes, because Python 3.11 takes 0.5 ms to define one, and a command imports dozens of them.
    """

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self
