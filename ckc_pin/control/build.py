"""Build a controller from the `[controller]` table of a scene."""

from __future__ import annotations

from collections.abc import Callable

from ckc_pin.base.sources import Sources
from ckc_pin.control.controllers import ControllerModel, RecordedTorques, SetPoint, Tracking
from ckc_pin.control.desired import read_columns
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.point_path import make_desired
from ckc_pin.control.spec import ControllerSpec, JointServoSpec, SetPointSpec, TorquesSpec, gain_matrix
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.errors import InputError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["make_controller", "read_torques"]

END_TOLERANCE = 1e-9  # relative to t_end: torques may end this much earlier


def make_controller(
    spec: ControllerSpec,
    plant: Mechanism,
    convention: CoriolisVelocity,
    t_end: float,
    sources: Sources,
    start: Kinematics,
    load_model: Callable[[str], Mechanism],
) -> SetPoint | Tracking | RecordedTorques | JointServo:
    """Build and check a controller.

    Parameters
    ----------
    spec : ControllerSpec
    plant : Mechanism
    convention : "rho" or "actual"
        Where C takes its velocity, for plant and controller alike.
    t_end : float
        Time that a tabulated trajectory must cover, s.
    sources : Sources
        The scene's files.
    start : Kinematics
        A configuration of the plant's assembly branch on which a run starts.
    load_model : callable
        Loads the controller's own mechanism file, if it has one.

    Raises
    ------
    InputError, MechanismError
        Wrong gains, a target that cannot be reached, or an unusable trajectory or model.
    """
    if isinstance(spec, TorquesSpec):
        return read_torques(spec, plant, sources, t_end)
    if isinstance(spec, JointServoSpec):
        return JointServo(plant, spec.motor, gravity=spec.gravity, sample_time=spec.sample_time)
    names = plant.independent
    model = ControllerModel(load_model(spec.model), plant, convention) if spec.model is not None else None
    if isinstance(spec, SetPointSpec):
        return SetPoint(
            model.mechanism if model else plant,
            gain_matrix(spec.K_P, names, "K_P"),
            gain_matrix(spec.K_V, names, "K_V"),
            plant.vector(spec.q_d, names, "controller.q_d"),
            None if model else start,
        )
    desired = make_desired(spec.desired, plant, sources, t_end)
    return Tracking(gain_matrix(spec.Lambda, names, "Lambda"), gain_matrix(spec.K_D, names, "K_D"), desired, model)


def read_torques(spec: TorquesSpec, mechanism: Mechanism, sources: Sources, t_end: float) -> RecordedTorques:
    """Read a CSV file of motor torques: the column `t` and one column for each motor.

    Raises
    ------
    InputError
        The file has other columns or missing values, or ends before the run.
    """
    times, values = read_columns(sources.text(spec.file), mechanism.actuated, spec.file, 2, "torques over time need")
    interpolates = spec.interpolation == "linear"
    end = float(times[-1] if interpolates else 2 * times[-1] - times[-2])
    if end < t_end * (1 - END_TOLERANCE):
        raise InputError(
            f"{spec.file}: the torques end at t = {end:g} s, before the scene's t_end = {t_end:g} s; "
            "record longer or shorten the run"
        )
    return RecordedTorques(times, values, interpolates=interpolates)
