"""Which ways of running a scene are compared: formulation, method, tolerance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from ckc_pin.scene.scene import Scene, apply_overrides, make_scene

__all__ = ["FORMULATIONS", "Setting", "changed", "off_manifold", "settings"]

FORMULATIONS: dict[str, dict[str, Any]] = {
    "dae": {"formulation": "dae"},
    "reduced": {"formulation": "reduced"},
    "spf, w": {"formulation": "spf", "spf_coordinates": "w"},
    "spf, z": {"formulation": "spf", "spf_coordinates": "z"},
}
EVERY = tuple(10.0**-k for k in range(2, 13))
METHODS = {"auto": EVERY, "DOP853": EVERY, "RK45": EVERY[::2], "Radau": EVERY[::2]}


@dataclass(frozen=True)
class Setting:
    """How a scene is run.

    Attributes
    ----------
    formulation : str
        A key of `FORMULATIONS`.
    method : str
    rtol : float
    """

    formulation: str
    method: str
    rtol: float

    @property
    def family(self) -> tuple[str, str]:
        """All but the tolerance."""
        return self.formulation, self.method

    def overrides(self, scene: Scene) -> dict[str, Any]:
        """Values of the scene by dotted key, those that a person would give with --set."""
        found = {**FORMULATIONS[self.formulation], "solver.method": self.method, "solver.rtol": self.rtol}
        if scene.spec.solver.atol is not None:  # the scene's own goes with one rtol
            found["solver.atol"] = float(f"{self.rtol / 100:.0e}")
        if self.formulation != "dae":
            found |= _no_projection(scene)
        return found


def _no_projection(scene: Scene) -> dict[str, Any]:
    """Take away the keys that only a DAE has."""
    solver = scene.spec.solver
    return {"solver.baumgarte": None} if solver.baumgarte else {}


def settings(scene: Scene) -> Iterator[Setting]:
    """All settings, from loose to tight: first of "auto", so that a budget that is used up leaves out the others'."""
    formulations = [name for name in FORMULATIONS if name.startswith("spf") or not off_manifold(scene)]
    for methods in (["auto"], [name for name in METHODS if name != "auto"]):
        for rtol, method, formulation in product(EVERY, methods, formulations):
            if rtol in METHODS[method]:
                yield Setting(formulation, method, rtol)


def off_manifold(scene: Scene) -> bool:
    """Whether a scene starts with phi = w other than 0, which only the SPF can."""
    return any(scene.spec.initial.w or [])


def changed(scene: Scene, overrides: Mapping[str, Any]) -> Scene:
    """Return a scene with values replaced by dotted key; None removes a key."""
    return make_scene(apply_overrides(scene.to_dict(), overrides), scene.name, scene.sources)
