"""Move published robots: torques from inverse dynamics, applied in a run, reproduce the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

import ckc_pin
from ckc_pin import Mechanism, NumericalError, Terms
from ckc_pin.base.arrays import Array
from ckc_pin.control.desired import Table
from ckc_pin.formats.importing import Draft, write

__all__ = ["measure_reproduction_error"]

T_END = 0.005  # s; without feedback, rounding makes light rods under large forces diverge within milliseconds
ANGULAR_FREQUENCY = 1 / T_END  # rad/s: no coordinate reverses within T_END
AMPLITUDE = 0.01  # rad, or of the mechanism's size
SINGULAR_OFFSET = 0.3  # rad, or of the mechanism's size: from a singular configuration
STEPS = 100
SCENE = f"""mechanism = "mechanism.toml"
formulation = "dae"
t_end = {T_END}
initial.at = "assembled"
solver = {{output_dt = {T_END / STEPS}, rtol = 1e-12, atol = 1e-14}}
"""


@dataclass(frozen=True)
class _Torques:
    """Controller that applies torques as a function of time only."""

    table: Table

    def tau(self, t: float, terms: Terms) -> Array:
        return self.table(t)[0]


def measure_reproduction_error(draft: Draft) -> float:
    """Return how far the torques from inverse dynamics miss the motion that they were computed from.

    All independent coordinates oscillate and have motors. A free root has no motor; then the motors apply the torques
    of an oscillation of each coordinate alone. Joint ranges are not stops.

    Returns
    -------
    float
        Largest difference of coordinates and rates, relative to the largest value or to 1.

    Raises
    ------
    CkcError
        There is no such motion, or a run stops before its end.
    """
    imported = draft.build_mechanism()
    numbers = (
        imported.tree.to_coordinates(imported.q_tree)
        + SINGULAR_OFFSET * imported.tree.step_scale * imported.freedoms.singular
    )
    draft = replace(
        draft,
        joints=[(msgspec.structs.replace(spec, stops=False), comment) for spec, comment in draft.joints],
        independent=list(imported.independent),
        actuated=None,
        motors=[],
        q_guess=imported.tree.named(numbers),
    )
    with TemporaryDirectory() as folder:
        write(draft, Path(folder))
        scene = Path(folder) / "default.scene.toml"
        scene.write_text(SCENE, encoding="utf-8")
        mechanism = ckc_pin.load(Path(folder))
        overrides = {} if mechanism.independent_root_coordinates else _swing(mechanism)
        pushed = (
            ckc_pin.simulate(scene, controller=_push(mechanism)) if mechanism.independent_root_coordinates else None
        )
        motion = ckc_pin.inverse_dynamics(pushed or scene, None if pushed else overrides)
        run = ckc_pin.simulate(scene, overrides, controller=_Torques(Table(motion.t, motion.tau)))
    for part in (motion, run):
        if part.status != "done":
            raise NumericalError(part.message)
    pairs = ((run.q_tree, motion.q_tree), (run.v_tree, motion.v_tree))
    return max(float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max())) for ours, theirs in pairs)


def _swing(mechanism: Mechanism) -> dict[str, Any]:
    """Return overrides of the scene: the desired motion and the start of the independent coordinates."""
    tree, names = mechanism.tree, mechanism.independent
    offset, amplitude = tree.named(tree.to_coordinates(mechanism.q_tree)), tree.named(AMPLITUDE * tree.step_scale)
    desired = {
        name: {"offset": offset[name], "harmonics": [[amplitude[name], ANGULAR_FREQUENCY, 0.0]]} for name in names
    }
    return {
        "controller": {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": desired},
        "initial": {"at": "assembled", "q_dot": {name: ANGULAR_FREQUENCY * amplitude[name] for name in names}},
    }


def _push(mechanism: Mechanism) -> _Torques:
    """Return the torques that would make each motor swing with everything else free to move."""
    at = mechanism.assembled
    inertia = at.rho.T @ Terms(mechanism, at, np.zeros(mechanism.n)).D_tree @ at.rho
    moved = mechanism.motors.transmission @ at.rho
    force = AMPLITUDE * ANGULAR_FREQUENCY**2 / np.diag(moved @ np.linalg.solve(inertia, moved.T))
    t = np.linspace(0.0, T_END, STEPS + 1)
    return _Torques(Table(t, np.outer(np.cos(ANGULAR_FREQUENCY * t), force)))
