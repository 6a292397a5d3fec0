"""What the structures of files have in common."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import msgspec

__all__ = ["FileStruct"]


class FileStruct(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a table of a file says: unknown keys are errors, and nobody changes it."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Copy the tables; what is frozen stays what it is."""
        fields = ((name, getattr(self, name)) for name in self.__struct_fields__)
        copied = {name: twin for name, value in fields if (twin := deepcopy(value, memo)) is not value}
        return msgspec.structs.replace(self, **copied) if copied else self
