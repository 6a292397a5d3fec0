"""Values of a scene that only Python has: arrays for tables by name, mechanisms, and columns for files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.tables import to_csv_text
from ckc_pin.base.toml import read_text
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.mechanism.files import choose_local_name, local_texts
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["MODEL_FOLDER", "embed_file", "embed_files", "name_arrays"]

MODEL_FOLDER = "model/"  # of the files of a controller's own model, among those of its scene
BY_COORDINATE = (
    ("initial", "q"), ("initial", "q_dot"), ("controller", "q_d"), ("controller", "desired"),
    ("controller", "sensor", "resolution"), ("controller", "sensor", "q_noise"),
    ("controller", "sensor", "q_dot_noise"),
)  # fmt: skip
BY_MOTOR = (
    ("controller", "torque_limit"), ("controller", "allocation", "weights"), ("controller", "allocation", "preload"),
    ("controller", "drive", "torque_resolution"), ("controller", "drive", "torque_rate"),
)  # fmt: skip


def name_arrays(data: dict[str, Any], load: Callable[[], Mechanism], source: str) -> None:
    """Replace lists by tables by coordinate or motor, in place.

    Lists are in the order of `independent`, or of `actuated`. Only `initial.q` may have all coordinates instead.

    Parameters
    ----------
    data : dict
        A scene's data.
    load : callable
        Returns the scene's mechanism. It is called only if there is a list.
    source : str
        Name of the scene, for messages.

    Raises
    ------
    InputError
        A list of another length; what `load` raises.
    """
    mechanism = None
    for path in (*BY_COORDINATE, *BY_MOTOR):
        *tables, key = path
        table: Any = data
        for name in tables:
            table = table.get(name) if isinstance(table, Mapping) else None
        if not isinstance(table, dict) or not isinstance(table.get(key), list):
            continue
        if key == "torque_limit" and _is_pair_of_limits(table[key]):
            continue
        mechanism = mechanism or load()
        names = mechanism.actuated if path in BY_MOTOR else mechanism.independent
        choices = [names, mechanism.coordinates] if path == ("initial", "q") else [names]
        table[key] = mechanism.name_values(table[key], f"{source}: {'.'.join(path)}", *choices)


def _is_pair_of_limits(limits: list[Any]) -> bool:
    """Whether a list is a lower and an upper limit, of which one is not positive, not the limits of two motors."""
    return len(limits) == 2 and all(map(is_number, limits)) and min(limits) <= 0


def embed_files(controller: dict[str, Any], texts: dict[str, str], *, reads_paths: bool) -> None:
    """Replace mechanisms and columns in a controller's table by names of texts, in place.

    Parameters
    ----------
    controller : dict
        `model` may be a mechanism, and each `file` a table of columns by name, such as a DataFrame.
    texts : dict of str to str
        Receives the texts. A name among them is left as it is.
    reads_paths : bool
        Whether names of other files and mechanisms are read here, relative to the working directory.

    Raises
    ------
    InputError
        A file that cannot be read, columns of different lengths, or a model that has no files of its own.
    """
    model = controller.get("model")
    if isinstance(model, Mechanism) or (reads_paths and isinstance(model, str | Path) and model not in texts):
        mechanism = as_mechanism(model, "controller.model")
        if mechanism.overrides or mechanism.prescribed:
            names = ", ".join((*mechanism.overrides, *mechanism.prescribed))
            raise InputError(
                f"controller.model: a mechanism file has no parameters ({names}); make the model from a URDF with "
                "these values, or give a controller object with this model"
            )
        texts |= {f"{MODEL_FOLDER}{file}": text for file, text in local_texts(mechanism).items()}
        controller["model"] = f"{MODEL_FOLDER}{MECHANISM_FILE}"
    embed_file(controller, "torques.csv", texts, "controller.file", reads_paths=reads_paths)
    embed_file(controller.get("desired"), "desired.csv", texts, "controller.desired.file", reads_paths=reads_paths)


def embed_file(table: Any, default: str, texts: dict[str, str], where: str, *, reads_paths: bool) -> None:
    """Replace the columns, or the path of a file, that a table has as its `file` by the name of a text, in place.

    Parameters
    ----------
    default : str
        Name of a text of columns.
    where : str
        Name of the key, for messages.
    texts, reads_paths
        As of `embed_files`.

    Raises
    ------
    InputError
        A file that cannot be read, or columns of different lengths.
    """
    if not isinstance(table, dict) or "file" not in table:
        return
    file = table["file"]
    if _has_columns(file):
        name = choose_local_name(default, texts)
        texts[name] = _to_csv(file, where)
        table["file"] = name
    elif reads_paths and isinstance(file, str | PathLike) and fspath(file) not in texts:
        name = choose_local_name(str(file), texts)
        texts[name] = read_text(Path(file), "file")
        table["file"] = name


def _has_columns(value: Any) -> bool:
    return isinstance(value, Mapping) or (hasattr(value, "keys") and hasattr(value, "__getitem__"))


def _to_csv(columns: Any, where: str) -> str:
    """Return CSV text of columns by name, with all digits of each number."""
    values: dict[str, Any] = {str(name): to_toml_value(np.asarray(columns[name])) for name in columns.keys()}  # noqa: SIM118
    lengths = {name: len(column) if isinstance(column, list) else 0 for name, column in values.items()}
    if "t" not in values or len(set(lengths.values())) != 1:
        counts = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"{where}: expected columns of equal length, one of them t; got {counts or 'none'}")
    for name, column in values.items():
        wrong = next((x for x in column if not is_number(x)), None)
        if wrong is not None:
            raise InputError(f"{where}: column {name!r}: expected numbers, got {describe_value(wrong)}")
    t = values.pop("t")
    return to_csv_text("t", t, {name: np.array(column) for name, column in values.items()})
