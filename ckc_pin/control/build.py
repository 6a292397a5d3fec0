"""A controller from the `[controller]` table of a scene."""

from __future__ import annotations

from collections.abc import Callable

from ckc_pin.base.sources import Sources
from ckc_pin.control.controllers import Model, SetPoint, Tracking
from ckc_pin.control.gains import gain_matrix
from ckc_pin.control.point_path import make_desired
from ckc_pin.control.spec import ControllerSpec, SetPointSpec, TorquesSpec
from ckc_pin.control.torques import Torques, read_torques
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["make_controller"]


def make_controller(
    spec: ControllerSpec,
    plant: Mechanism,
    convention: CoriolisVelocity,
    t_end: float,
    sources: Sources,
    near: Kinematics,
    load_model: Callable[[str], Mechanism],
) -> SetPoint | Tracking | Torques:
    """Build and check a controller.

    Parameters
    ----------
    spec : ControllerSpec
    plant : Mechanism
    convention : "rho" or "actual"
        Where C takes its velocity, plant and controller alike.
    t_end : float
        A tabulated trajectory must last as long, s.
    sources : Sources
        Where the scene's files come from.
    near : Kinematics
        On the plant's assembly branch that a run starts on.
    load_model : callable
        Loads the controller's own mechanism file, when it has one.

    Raises
    ------
    InputError, MechanismError
        Bad gains, an unreachable target, an unusable trajectory or model.
    """
    if isinstance(spec, TorquesSpec):
        return read_torques(spec, plant, sources, t_end)
    names = plant.independent
    model = Model(load_model(spec.model), plant, convention) if spec.model is not None else None
    if isinstance(spec, SetPointSpec):
        return SetPoint(
            model.mechanism if model else plant,
            gain_matrix(spec.K_P, names, "K_P"),
            gain_matrix(spec.K_V, names, "K_V"),
            plant.vector(spec.q_d, names, "controller.q_d"),
            None if model else near,
        )
    desired = make_desired(spec.desired, plant, sources, t_end)
    return Tracking(gain_matrix(spec.Lambda, names, "Lambda"), gain_matrix(spec.K_D, names, "K_D"), desired, model)
