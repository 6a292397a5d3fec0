"""The report that the page needs once: sliders, motors, bodies that can be dragged, points and warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.dynamics.equilibrium import weight
from ckc_pin.explorer.map_panel import explain_no_map
from ckc_pin.explorer.messages import CoordinateInfo, MotorInfo, ParameterInfo, QuantityInfo, Setup
from ckc_pin.explorer.opening import Opened
from ckc_pin.explorer.paths import EXPLORED
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view.bodies import body_path
from ckc_pin.view.geometry import compute_view_axes, is_planar

__all__ = ["describe_setup"]

TORQUE_SCALE = 2.0  # of the scale of h (`weight`): end of the torque slider of a motor without limits


def describe_setup(
    opened: Opened,
    mechanism: Mechanism,
    parameters: list[ParameterInfo],
    quantities: list[QuantityInfo],
    modes: Sequence[str],
    *,
    can_save: bool,
) -> Setup:
    """Return the report on a mechanism with its present parameters, the parameters' sliders and the quantities."""
    planar = is_planar(mechanism)
    scene = opened.scene
    freedoms = "1 freedom" if mechanism.d == 1 else f"{mechanism.d} freedoms"
    constraints = "open loops" if opened.problem else f"{mechanism.rank} constraints"
    summary = f"{mechanism.n} coordinates, {constraints}, {freedoms}"
    warnings = [opened.problem] if opened.problem else []
    warnings += [] if mechanism.d else ["the loops leave no freedom: nothing can be moved"]
    joints = range(1, mechanism.tree.model.njoints)
    return Setup(
        title=opened.name,
        summary=summary,
        coordinates=_describe_coordinates(mechanism),
        motors=_describe_motors(mechanism),
        parameters=parameters,
        quantities=quantities,
        bodies={mechanism.tree.model.names[joint]: body_path(mechanism, EXPLORED, joint) for joint in joints},
        points={
            name: [mechanism.tree.model.names[frame.joint], *frame.translation.tolist()]
            for name, frame in mechanism.points.items()
            if frame.joint
        },
        normal=compute_view_axes(mechanism)[2].tolist() if planar else None,
        modes=list(modes),
        formulation=scene.spec.formulation if scene is not None else "reduced",
        can_map=not opened.problem and not explain_no_map(mechanism),
        can_branch=bool(mechanism.dependent) and not opened.problem,
        warnings=[*warnings, *mechanism.warnings],
        can_save=can_save,
    )


def _describe_coordinates(mechanism: Mechanism) -> list[CoordinateInfo]:
    tree, joints = mechanism.tree, mechanism.joints
    home = tree.to_coordinates(mechanism.q_tree)
    limits = np.array(tree.limits())
    half = np.where(tree.in_metres, mechanism.size, np.pi)
    infos = []
    for k, name in enumerate(mechanism.coordinates):
        low, high = limits[:, k]
        low = joints.lower[k] if np.isfinite(joints.lower[k]) else max(low, home[k] - half[k])
        high = joints.upper[k] if np.isfinite(joints.upper[k]) else min(high, home[k] + half[k])
        driving = np.flatnonzero(mechanism.motors.transmission[:, k])
        infos.append(
            CoordinateInfo(
                name=name,
                unit="m" if tree.in_metres[k] else "rad",
                lower=float(min(low, home[k])),
                upper=float(max(high, home[k])),
                has_stops=bool(joints.stopped[k]),
                is_independent=name in mechanism.independent,
                motors=[mechanism.actuated[motor] for motor in driving],
            )
        )
    return infos


def _describe_motors(mechanism: Mechanism) -> list[MotorInfo]:
    motors, tree = mechanism.motors, mechanism.tree
    torque = TORQUE_SCALE * (weight(mechanism) or 1.0)
    infos = []
    for m, name in enumerate(motors.names):
        driven = np.flatnonzero(motors.transmission[m])
        in_metres = bool(len(driven) and tree.in_metres[driven[0]])
        ratio = float(np.abs(motors.transmission[m]).max(initial=0.0)) or 1.0
        limit = float(np.abs(motors.torque_limit[:, m]).max())
        scale = torque / (mechanism.size if in_metres else 1.0) / ratio
        infos.append(
            MotorInfo(
                name=name,
                unit="N" if in_metres else "N m",
                limit=limit if np.isfinite(limit) else float(f"{scale:.1g}"),
                coordinates=[mechanism.coordinates[k] for k in driven],
            )
        )
    return infos
