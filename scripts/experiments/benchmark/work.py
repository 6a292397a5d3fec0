"""Works of the benchmark: motions of shipped mechanisms, with the quantities and instants of the comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.library import compile_terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import Scene, load_scene
from scripts.experiments.benchmark.mechanisms import parallel_chains, pendulum

__all__ = ["WORKS", "Budget", "Work"]

INSTANTS = 10  # at which motions are compared, the end among them


@dataclass(frozen=True)
class Budget:
    """Time budget of one run, s, in ckc_pin and in the other programs."""

    ours: float
    peer: float


@dataclass(frozen=True)
class Work:
    """A motion to compute.

    Attributes
    ----------
    key : str
    says : str
        Title in a few words.
    scene : str or callable
        Name of a shipped scene, or a function that makes one.
    t_end : float
        s.
    overrides : mapping
        Values of the scene by dotted key.
    point : str or None
        Name of the mechanism's point whose position is compared; None compares all coordinates.
    quick : bool
        Whether it is part of the quick report.
    planar : bool
        Whether everything moves in one plane.
    tight : float
        Relative tolerance of the reference. Long chains have rounding errors above the smallest tolerances.
    """

    key: str
    says: str
    scene: str | Callable[[], Scene]
    t_end: float
    overrides: Mapping[str, Any] = field(default_factory=dict)
    point: str | None = None
    quick: bool = False
    planar: bool = True
    tight: float = 1e-13

    def load(self, **solver: Any) -> Scene:
        """Return the scene, with values of its solver and formulation: load(formulation="dae", solver__rtol=1e-6)."""
        overrides = {
            **self.overrides, "t_end": self.t_end, "solver.output_dt": self.t_end / INSTANTS,
            **{name.replace("__", "."): value for name, value in solver.items()},
        }  # fmt: skip
        return (
            load_scene(self.scene, overrides)
            if isinstance(self.scene, str)
            else self._python_scene.with_overrides(overrides)
        )

    @cached_property
    def _python_scene(self) -> Scene:
        assert callable(self.scene)
        return self.scene()

    @cached_property
    def mechanism(self) -> Mechanism:
        """The mechanism, loaded once."""
        return load_scene_mechanism(self.load())

    @cached_property
    def terms(self) -> str:
        """Terms of the runs: "generated" (compiled here if necessary) or, for large trees, "pinocchio"."""
        try:
            compile_terms(self.mechanism)
        except InputError:
            return "pinocchio"
        return "generated"

    @property
    def controlled(self) -> bool:
        """Whether a controller acts, so that energy is not conserved."""
        return self.load().spec.controller is not None

    @cached_property
    def epsilon(self) -> float:
        """Epsilon of the singular perturbation formulation."""
        return float(self.load().spec.epsilon)

    @property
    def instants(self) -> Array:
        """Times at which motions are compared, s, shape (INSTANTS + 1,), with the start."""
        return np.linspace(0.0, self.t_end, INSTANTS + 1)

    def observed(self, q_tree: Array) -> Array:
        """Return the compared quantities of (m, n) coordinates: the coordinates, or (m, 3) positions of the point."""
        if self.point is None:
            return q_tree
        from_coordinates, positions = self.mechanism.tree.from_coordinates, self.mechanism.point_positions
        return np.array([positions(from_coordinates(row))[self.point] for row in q_tree])


def _n_four_bar(N: int, quick: bool = False) -> Work:
    row = f"N-four-bar, N = {N}, 10 s"
    return Work(f"n_four_bar_{N}", row, "n_four_bar", 10.0, {"mechanism.N": N}, point="B0", quick=quick)


def _tracking(epsilon: float, quick: bool = False) -> Work:
    says = f"five-bar, tracking, 9.5 s, ε = {epsilon:.0e}"
    return Work(f"tracking_{epsilon:.0e}", says, "five_bar/tracking", 9.5, {"epsilon": epsilon}, quick=quick)


def _chains(depth: int, loop_size: int, t_end: float, *, quick: bool = False, tight: float = 1e-13) -> Work:
    says = f"generalized_rbda's chains, depth {depth}, loop size {loop_size}, {t_end:g} s"
    scene = partial(parallel_chains, depth, loop_size)
    return Work(f"chains_{depth}_{loop_size}", says, scene, t_end, quick=quick, tight=tight)


WORKS = (
    Work("swing", "five-bar, free swing, 2 s", "five_bar/swing", 2.0, quick=True),
    Work("swing_20", "five-bar, free swing, 20 s", "five_bar/swing", 20.0),
    _tracking(1e-2),
    _tracking(1e-4, quick=True),
    _tracking(1e-8),
    Work("set_point", "five-bar, set-point control, 9.5 s", "five_bar/set_point", 9.5),
    Work("andrews", "Andrews' squeezer, 0.05 s", "andrews", 0.05, quick=True),
    Work("pendulum", "pendulum, 10 s", pendulum, 10.0, point="P1"),
    _n_four_bar(1),
    _n_four_bar(2),
    _n_four_bar(4, quick=True),
    _n_four_bar(16),
    _n_four_bar(40),
    Work("bricard", "Bricard's six-bar, 10 s", "bricard", 10.0, planar=False),
    Work("flyball", "stiff flyball governor, 10 s", "flyball", 10.0, planar=False),
    Work("slider_crank", "slider-crank, 5 s", "slider_crank", 5.0),
    Work("delta", "Delta, let go, 5 s", "delta", 5.0, planar=False),
    Work("two_ur5", "two UR5 on one bar, let go, 2 s", "two_ur5", 2.0, planar=False),
    _chains(5, 5, 1.0, quick=True),
    _chains(10, 9, 1.0),
    _chains(40, 17, 0.5, tight=1e-9),
)
