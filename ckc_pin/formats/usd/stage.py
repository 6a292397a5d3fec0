"""Open a USD stage, and read its numbers and poses in SI units with z up.

Numbers of single precision are read as the shortest decimal numbers that they stand for, so that 0.1 is 0.1.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import from_quaternion
from ckc_pin.formats.repository import repository_of, resolve_links

__all__ = ["Stage"]

MAX_BYTES = 100 * 2**20  # of all layers
Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
QUATERNION_DIGITS = 7  # of single precision


class Stage:
    """A stage: its prims, parents first; metres and kilograms per unit; rotation to z up; notes on conversions."""

    def __init__(self, path: Path) -> None:
        try:
            from pxr import Tf, Usd, UsdGeom, UsdPhysics, UsdUtils
        except ImportError:
            raise InputError(
                f"{path}: reading USD files needs usd-core; install it with `pip install 'ckc_pin[usd]'`"
            ) from None
        self.path, self.read = path, set[tuple[Any, str]]()  # attributes that were read
        self._diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # pxr would print them
        if not path.is_file():
            raise InputError(f"{path}: no such USD file")
        self._check_size([path])
        try:
            self.usd: Any = Usd.Stage.Open(str(path))
            problems = [str(error) for error in self.usd.GetCompositionErrors()]
        except Tf.ErrorException as error:
            problems = re.findall(r" : '(.*?)\s*'(?:\n|$)", str(error), re.DOTALL) or [str(error)]
        if problems:
            raise InputError(f"{path}: not a complete USD stage: {' '.join(problems[0].split())}")
        self._check_layers()
        self.length, self.mass = UsdGeom.GetStageMetersPerUnit(self.usd), UsdPhysics.GetStageKilogramsPerUnit(self.usd)
        if not (0 < self.length < math.inf and 0 < self.mass < math.inf):
            units = f"metersPerUnit = {self.length:g} and kilogramsPerUnit = {self.mass:g}"
            raise InputError(f"{path}: {units}; expected positive numbers")
        is_y_up = UsdGeom.GetStageUpAxis(self.usd) == "Y"
        self.up = Y_TO_Z if is_y_up else np.eye(3)
        self.guessed = [f"lengths are converted from units of {self.length:g} m"] if self.length != 1 else []
        self.guessed += [f"masses are converted from units of {self.mass:g} kg"] if self.mass != 1 else []
        self.guessed += ["the y axis of the stage, which is up, is the z axis here"] if is_y_up else []
        self.prims = list(Usd.PrimRange.Stage(self.usd, Usd.TraverseInstanceProxies()))
        self._time = Usd.TimeCode.EarliestTime()
        self._transforms = UsdGeom.XformCache(self._time)

    def _check_size(self, paths: Sequence[Path]) -> None:
        if sum(path.stat().st_size for path in paths) > MAX_BYTES:
            raise InputError(f"{self.path}: larger than {MAX_BYTES // 2**20} MiB, the maximum size of a USD stage")

    def _check_layers(self) -> None:
        """Refuse layers outside of the model's repository."""
        root = repository_of(self.path.absolute().parent)
        names = [layer.realPath.partition("[")[0] for layer in self.usd.GetUsedLayers() if layer.realPath]
        paths = [path for name in dict.fromkeys(names) if (path := resolve_links(Path(name))) is not None]
        for path in paths:
            if path != resolve_links(self.path) and not path.is_relative_to(root):
                raise InputError(f"{self.path}: layer {path.name} is outside of the model's repository {root.name!r}")
        self._check_size(paths)

    def where(self, prim: Any) -> str:
        """Return the place of a prim for messages."""
        return f"{self.path}: {prim.GetPath()}"

    def value(self, prim: Any, name: str) -> Any:
        """Return the value of an attribute or its fallback; None if it has none."""
        attribute = prim.GetAttribute(name)
        self.read.add((prim.GetPath(), name))
        return attribute.Get(self._time) if attribute else None

    def numbers(self, prim: Any, name: str, default: Sequence[float], finite: bool = True) -> Array:
        """Return the numbers of an attribute, those of a quaternion with its real part first."""
        value = self.value(prim, name)
        if value is None:
            return np.array(default)
        is_quaternion = hasattr(value, "GetReal")
        try:
            values = np.array([value.GetReal(), *value.GetImaginary()] if is_quaternion else value, dtype=float).ravel()
        except (TypeError, ValueError):
            values = np.array([math.nan])
        if len(values) != len(default) or np.isnan(values).any() or (finite and np.isinf(values).any()):
            what = f"{len(default)} {'finite ' if finite else ''}number{'s' if len(default) > 1 else ''}"
            raise InputError(f"{self.where(prim)}: {name} = {value}; expected {what}")
        if str(prim.GetAttribute(name).GetTypeName()).startswith(("double", "quatd", "point3d", "vector3d")):
            return values
        decimals = np.array([float(str(np.float32(x))) for x in values])
        return decimals.round(QUATERNION_DIGITS) if is_quaternion else decimals

    def number(self, prim: Any, name: str, default: float, finite: bool = True) -> float:
        """Return the number of an attribute."""
        return float(self.numbers(prim, name, [default], finite)[0])

    def rotation(self, prim: Any, name: str) -> Array:
        """Return the rotation matrix of a quaternion, the identity if all of its numbers are zero."""
        values = self.numbers(prim, name, [1.0, 0.0, 0.0, 0.0])
        return from_quaternion(values) if values.any() else np.eye(3)

    def pose(self, prim: Any) -> tuple[pin.SE3, Array]:
        """Return the pose of a prim in the world, and the lengths of its axes (m per unit), negative in a mirror."""
        matrix = np.array(self._transforms.GetLocalToWorldTransform(prim)).T
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        if not (scale.min() > 0 and np.isfinite(matrix).all()):
            raise InputError(f"{self.where(prim)}: its transform has no inverse; expected a scale other than 0")
        left, _, right = np.linalg.svd(matrix[:3, :3] / scale)
        rotation = left @ right
        if np.linalg.det(rotation) < 0:
            rotation, scale = -rotation, -scale  # as pxr factors a mirror
        return pin.SE3(self.up @ rotation, self.length * self.up @ matrix[:3, 3]), self.length * scale
