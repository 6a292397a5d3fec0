"""An instance of an FMU of FMI 2.0 or 3.0 for tests, with variables by name and the messages of its logger."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.simulation import instantiate_fmu

from ckc_pin.base.arrays import Array
from ckc_pin.formats.exporting import export, write
from ckc_pin.formats.fmu import writer
from ckc_pin.scene.scene import Scene

__all__ = ["Instance", "optimization", "write_fmu"]

ALIVE: list[Any] = []  # FMPy calls the logger of the FMU 2.0 that was made last, also after it is gone


@contextmanager
def optimization(level: str) -> Iterator[None]:
    """Compile the libraries of FMUs at a level of optimization; -O0 takes GCC a seventh of the time of -O2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "FLAGS", (level, *(x for x in writer.FLAGS if not x.startswith("-O"))))
        yield


def write_fmu(scene: Scene, folder: Path, fmi: str, level: str = "-O0") -> Path:
    """Export a scene to a folder and return the FMU's file."""
    with optimization(level):
        (path,) = write(export(scene, "fmu", fmi=fmi), folder)
    return path


class Instance:
    """An FMU after its initialization.

    Parameters
    ----------
    path : Path
        The FMU's file.
    kind : str
        "ModelExchange" or "CoSimulation".
    values : mapping, optional
        Start values and parameters.
    tolerance : float
    messages : list of str, optional
        Gets the messages of the FMU's logger. FMPy sends those of all FMUs 2.0 to the one that was made last.
    guid : str, optional
        Instead of the one in the model description.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        values: Mapping[str, float] | None = None,
        tolerance: float = 1e-11,
        messages: list[str] | None = None,
        guid: str | None = None,
    ) -> None:
        ALIVE.append(self)
        # A library must not be overwritten while it is loaded.
        folder = fmpy.extract(str(path), mkdtemp(dir=path.parent))
        self.description = fmpy.read_model_description(folder)
        self.description.guid = guid or self.description.guid
        self.is_old = self.description.fmiVersion == "2.0"
        self.messages: list[str] = [] if messages is None else messages
        self.fmu: Any = instantiate_fmu(folder, self.description, kind, logger=self._log)
        variables = self.description.modelVariables
        self.reference = {x.name: x.valueReference for x in variables}
        self.states = [x.variable.derivative.name for x in self.description.derivatives]
        self.inputs = [x.name for x in variables if x.causality == "input"]
        self.outputs = [x.name for x in variables if x.causality == "output"]
        start: dict[str, Any] = {"tolerance": tolerance, "startTime": 0.0}
        if self.is_old:
            self.fmu.setupExperiment(**start)
        self.fmu.enterInitializationMode(**({} if self.is_old else start))
        self.set(values or {})
        self.fmu.exitInitializationMode()
        if kind == "ModelExchange":
            self.update_events()

    def _log(self, *arguments: Any) -> None:
        self.messages.append(arguments[-1].decode())

    def set(self, values: Mapping[str, float]) -> None:
        setter = self.fmu.setReal if self.is_old else self.fmu.setFloat64
        setter([self.reference[name] for name in values], [*values.values()])

    def get(self, names: Sequence[str]) -> Array:
        getter = self.fmu.getReal if self.is_old else self.fmu.getFloat64
        return np.array(getter([self.reference[name] for name in names]))

    def set_states(self, states: Array) -> None:
        self.fmu.setContinuousStates(_pointer_to(np.array(states, dtype=float)), len(states))

    def get_states(self) -> Array:
        states = np.zeros(len(self.states))
        self.fmu.getContinuousStates(_pointer_to(states), len(states))
        return states

    def rates(self, t: float, states: Array) -> Array:
        """Return the derivatives of the states."""
        rates = np.zeros(len(states))
        self.fmu.setTime(t)
        self.set_states(states)
        get = self.fmu.getDerivatives if self.is_old else self.fmu.getContinuousStateDerivatives
        get(_pointer_to(rates), len(rates))
        return rates

    def update_events(self) -> None:
        """Update the discrete states in event mode, and return to continuous time."""
        (self.fmu.newDiscreteStates if self.is_old else self.fmu.updateDiscreteStates)()
        self.fmu.enterContinuousTimeMode()

    def derivatives(self, unknowns: Sequence[str], knowns: Sequence[str]) -> Array:
        """Return directional derivatives, a column for each known."""
        references = [[self.reference[name] for name in names] for names in (unknowns, knowns)]
        return np.transpose([self.fmu.getDirectionalDerivative(*references, x.tolist()) for x in np.eye(len(knowns))])


def _pointer_to(numbers: Array) -> Any:
    return numbers.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
