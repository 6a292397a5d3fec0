"""Whether a scene can be run from where it starts, under what controls it."""

from __future__ import annotations

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller, TorqueController, is_torque_controller
from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.formulations import refuse_massless
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation
from ckc_pin.scene.initial import Start, find_start, require_chart
from ckc_pin.scene.scene import Scene

__all__ = ["require_runnable"]


def require_runnable(
    scene: Scene,
    mechanism: Mechanism,
    controller: Controller | TorqueController | Sampled | None,
    actuation: Actuation,
    *,
    free: bool = False,
) -> Start:
    """Return where a scene starts, where it can be run from there under a controller.

    Raises
    ------
    InputError, NumericalError
        It cannot: no freedoms, no or a singular start, motors that cannot do what the controller wants.
    """
    if isinstance(controller, Sampled):
        with scene.sources.prefix_errors():
            controller.require_sample_count(scene.spec.t_end)
            controller.require_usable_sensor(mechanism)
    if mechanism.d == 0:
        raise InputError(f"{mechanism.name}: d = 0, the loops leave no freedom: nothing can move")
    if mechanism.splits_root and (controller is not None or free or scene.spec.formulation != "dae"):
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    start = find_start(mechanism, scene)
    with scene.sources.prefix_errors():
        if beyond := describe_stop_violation(mechanism, start.at.q_tree):
            raise InputError(f"initial: {beyond}; give another initial.q, or a q_guess within them")
    refuse_massless(Terms(mechanism, start.at, np.zeros(mechanism.n)), start.at.rho, start.at.partition.q)
    law = controller.controller if isinstance(controller, Sampled) else controller
    if law is not None and not is_torque_controller(law):
        require_chart(mechanism, start)
        actuation.require_driven_freedoms(start.at)
    return start
