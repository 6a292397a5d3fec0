"""Experiments on tracking control (eqs. 16 to 19), which `scripts.experiments.paper.tracking` evaluates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import Tracking
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene, load_scene
from scripts.experiments.paper.deviations import Deviation, Setting, Track, deviation, instants, track
from scripts.experiments.paper.lyapunov import Record, record

__all__ = [
    "ON_MANIFOLD",
    "SCENE",
    "SETTINGS",
    "SINCE",
    "START",
    "W0",
    "WHOLE",
    "deviations",
    "lyapunov_along",
    "off_manifold",
]

SCENE = "five_bar/tracking"
W0 = (0.01, -0.006)  # m
EXPLICIT = {"solver.method": "DOP853", "solver.rtol": 1e-12}
ON_MANIFOLD: dict[str, dict[str, Any]] = {
    "reduced, eq. 6": {"formulation": "reduced", **EXPLICIT},
    "SPF, eq. 17": {"formulation": "spf", **EXPLICIT},
    # Eq. 8 as printed limits explicit methods to steps of the size of epsilon.
    "SPF, eq. 8": {"formulation": "spf", "spf_coordinates": "z", "solver.method": "Radau", "solver.rtol": 1e-10},
    "DAE, eq. 1": {"formulation": "dae", **EXPLICIT},
}
SINCE = 0.1  # s: start of the records, after r has decayed (time constant 1/600 s)
START = {"t_end": SINCE, "solver.output_dt": 5e-5}
WHOLE = {"solver.method": "Radau", "solver.rtol": 1e-9, "solver.output_dt": 0.01}
PERIODS = 4


def lyapunov_along(overrides: Mapping[str, Any], since: float = 0.0, scene: str = SCENE) -> Record:
    """Run a tracking scene and compare the rate of eq. 18's function with the last line of eq. 19.

    Eq. 19 is used with d_1 = d_2 = 1 and M = I, and with the errors' rates in place of the rates.

    Parameters
    ----------
    overrides : mapping
        Overrides of the scene by dotted key.
    since : float
        Start of the record, s.
    scene : str

    Raises
    ------
    InputError
        The scene has no tracking controller.
    NumericalError
        The run stops early.
    """
    loaded = load_scene(scene, overrides)
    controller = _tracking(loaded)
    run = simulate(loaded)
    if run.status != "done":
        raise NumericalError(f"{scene}: {run.message}", t=float(run.t[-1]), run=run)
    run = _since(run, since)
    at = [run.column(name) for name in run.independent]

    def rate(k: int) -> float:
        q_d, q_d_dot, _ = controller.desired(float(run.t[k]))
        error, error_dot = run.q_tree[k, at] - q_d, run.v_tree[k, at] - q_d_dot
        stretched = controller.Lambda @ error
        on_manifold = -error_dot @ controller.K_D @ error_dot - stretched @ controller.K_D @ stretched
        layer = run.phi[k] @ run.phi[k] / loaded.spec.epsilon if loaded.spec.formulation == "spf" else 0.0
        return float(on_manifold - layer)

    return record(run, rate)


def _since(run: Run, since: float) -> Run:
    kept = run.t >= since
    lyapunov = run.lyapunov[kept] if run.lyapunov is not None else None
    rows = {name: getattr(run, name)[kept] for name in ("t", "q_tree", "v_tree", "phi", "energy")}
    return replace(run, lyapunov=lyapunov, **rows)


def _tracking(scene: Scene) -> Tracking:
    controller = build_scene_controller(scene, load_scene_mechanism(scene))
    if not isinstance(controller, Tracking):
        raise InputError(f"{scene.name}: not a scene with tracking control (eq. 16)")
    return controller


def off_manifold(epsilon: float, convention: str, moving: bool) -> Record:
    """Record eq. 18's function through the boundary layer of an SPF run from w(0) = W0."""
    start = {"initial.q_dot": {"theta_1": 1.0, "theta_3": -2.0}} if moving else {}
    layer = {"t_end": 20 * epsilon, "solver.output_dt": epsilon / 50}
    return lyapunov_along(
        {"formulation": "spf", "epsilon": epsilon, "coriolis_velocity": convention, "initial.w": list(W0),
         **EXPLICIT, **layer, **start}
    )  # fmt: skip


EXACT = Setting("reduced", "Radau", 1e-9)
# grouped by the source of the error
SETTINGS: dict[str, dict[str, Setting]] = {
    "nothing": {"SPF, eq. 8: Radau, rtol 1e-9": Setting("eq. 8", "Radau", 1e-9)},
    "integrator": {
        "reduced: RK45, rtol 1e-3": Setting("reduced", "RK45", 1e-3),
        "reduced: Radau, rtol 1e-3": Setting("reduced", "Radau", 1e-3),
        "SPF, eq. 8: Radau, rtol 1e-3": Setting("eq. 8", "Radau", 1e-3),
        "reduced: BDF, rtol 1e-3": Setting("reduced", "BDF", 1e-3),
        "SPF, eq. 8: BDF, rtol 1e-3": Setting("eq. 8", "BDF", 1e-3),
        "reduced: BDF, rtol 1e-2": Setting("reduced", "BDF", 1e-2),
        "SPF, eq. 8: BDF, rtol 1e-2": Setting("eq. 8", "BDF", 1e-2),
    },
    "sigma of both": {
        "sigma of both to 1e-2 m": Setting("reduced", "Radau", 1e-8, tolerance=1e-2),
        "sigma of both to 1e-3 m": Setting("reduced", "Radau", 1e-8, tolerance=1e-3),
    },
    "controller's sigma": {
        "controller's own sigma to 1e-2 m": Setting("reduced", "RK45", 1e-3, controller_tolerance=1e-2),
        "controller's own sigma to 1e-3 m": Setting("reduced", "RK45", 1e-3, controller_tolerance=1e-3),
    },
}


def deviations(
    settings: Mapping[str, Setting],
    periods: int = PERIODS,
    run: Callable[[str, Setting, Array], Track] = track,
) -> tuple[Array, Array, dict[str, Deviation]]:
    """Compare runs of the tracking scene with its exact one.

    Returns
    -------
    t : (m,) array
        s.
    error : (m,) array
        Largest |q - q_d| of the exact run, rad.
    by_setting : dict of str to Deviation
    """
    times = instants(periods)
    exact = run(SCENE, EXACT, times)
    controller = _tracking(load_scene(SCENE))
    desired = np.array([controller.desired(float(t))[0] for t in times])
    by_setting = {name: deviation(run(SCENE, setting, times), exact) for name, setting in settings.items()}
    return times, np.abs(exact.q - desired).max(axis=1), by_setting
