"""Tables of results: CSV text and pandas data frames."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import describe_value
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    import pandas

__all__ = ["require_distinct", "require_names", "to_csv_text", "to_data_frame"]


def require_names(names: Any, where: str) -> list[str]:
    """Return the names of a table's columns as a list; raise InputError for other values."""
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f'{where}: columns: expected a list of names, as ["theta_1", "tip.x"], got {describe_value(names)}'
        )
    return list(names)


def require_distinct(columns: Iterable[tuple[str, Array]], index: str, where: str) -> dict[str, Array]:
    """Return columns by name. Raise InputError if two columns, or a column and the index, have the same name."""
    by_name: dict[str, Array] = {}
    for name, values in columns:
        if name in by_name or name == index:
            raise InputError(f"{where}: two columns would be called {name!r}; rename that joint")
        by_name[name] = values
    return by_name


def to_csv_text(index: str, labels: Iterable[Any], columns: Mapping[str, Array]) -> str:
    """Return a table as CSV: the index, then the columns. All digits of each number are written.

    Parameters
    ----------
    index : str
        Name of the first column.
    labels : iterable
        Values of the first column.
    columns : mapping of str to (m,) array
    """
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([index, *columns])
    writer.writerows(zip(np.asarray(labels).tolist(), *(x.tolist() for x in columns.values()), strict=True))
    return text.getvalue()


def to_data_frame(index: str, labels: Iterable[Any], columns: Mapping[Any, Array]) -> pandas.DataFrame:
    """Return a table as a pandas DataFrame. Columns whose names are tuples get a MultiIndex.

    Raises
    ------
    InputError
        pandas is not installed.
    """
    try:
        import pandas
    except ModuleNotFoundError:
        raise InputError("to_pandas needs pandas: pip install 'ckc_pin[data]'") from None
    return pandas.DataFrame(dict(columns), index=pandas.Index(np.asarray(labels), name=index))
