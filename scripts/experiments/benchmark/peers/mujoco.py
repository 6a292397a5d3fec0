"""MuJoCo: loops as soft constraints, fixed steps. The model is what `ckc export` writes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from importlib import metadata
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.mujoco import Joints
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.formats.exporting import export
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.benchmark.peers.stepping import CONTROLLED, divided, halved, start_of, stepped
from scripts.experiments.benchmark.row import Motion
from scripts.experiments.benchmark.work import Work

__all__ = ["Mujoco"]

COARSEST, STEPS, QUICK_STEPS, SOFT_STEPS = 2e-2, 13, 8, 5  # s, and how many halves; softness soon outweighs the step
INTEGRATORS = ("Euler", "implicitfast", "implicit", "RK4")
QUICK_INTEGRATORS = ("implicitfast", "RK4")
DEFAULT, STIFF, FIRM = "default", "solref 2 dt", "solref 4 dt"  # time constants of the constraints


class Mujoco:
    """MuJoCo with the constraints' default settings, and as stiff as its manual lets them be.

    The model has no shapes, and what it does not use is switched off; a run that blew up is not to start again.
    """

    name = "MuJoCo"
    packaged = True

    def missing(self, work: Work) -> str | None:
        if not _installed():
            return "not installed: pip install 'ckc_pin[peers]'"
        if work.controlled:
            return CONTROLLED
        try:
            _model(work.mechanism)
        except (InputError, ValueError) as error:
            return str(error)
        return None

    def version(self) -> str:
        return metadata.version("mujoco")

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        integrators, steps = (QUICK_INTEGRATORS, QUICK_STEPS) if quick else (INTEGRATORS, STEPS)
        for integrator in integrators:
            stiffnesses = {DEFAULT: SOFT_STEPS, STIFF: steps, **({FIRM: steps} if integrator == "RK4" else {})}
            for stiffness, many in stiffnesses.items():
                for dt in halved(work, COARSEST, many):
                    yield f"{integrator}, {stiffness}, dt {dt:.3g}"

    def check(self, work: Work) -> str:
        """Compare D', the bias and the constrained acceleration at the start."""
        import mujoco

        tree = work.mechanism.tree
        q_tree, v_tree = start_of(work)
        model = _model(work.mechanism)
        data = mujoco.MjData(model)
        joints = Joints(work.mechanism, model)
        to = joints.put(data, q_tree, v_tree)
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        terms = Terms(work.mechanism, work.mechanism.kinematics(q_tree), v_tree)
        ours = dae_acceleration(terms, np.zeros(tree.n))
        mass = np.abs(to.T @ M @ to - terms.D_tree).max() / np.abs(terms.D_tree).max()
        said = f"D' agrees to {mass:.0e}"
        if tree.flat:
            bias = pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree)
            off = np.abs(to.T @ data.qfrc_bias - bias).max() / max(float(np.abs(bias).max()), 1e-12)
            apart = np.abs(to.T @ data.qacc - ours).max() / max(float(np.abs(ours).max()), 1.0)
            said += f", the bias to {off:.0e}; the constrained acceleration differs by {apart:.0e}"
        return said

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        import mujoco

        integrator, stiffness, step = setting.split(", ")
        dt = float(step.removeprefix("dt "))
        model = _model(work.mechanism)
        model.opt.timestep = divided(work, dt)
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        if stiffness != DEFAULT:  # two steps are the shortest time constant that the manual allows; and no softness
            model.eq_solref[:] = [float(stiffness.split()[1]) * model.opt.timestep, 1.0]
            model.eq_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        for unused in ("AUTORESET", "CONTACT", "LIMIT", "FRICTIONLOSS", "SENSOR"):
            model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{unused}")
        data, joints = mujoco.MjData(model), Joints(work.mechanism, model)
        q_tree, v_tree = start_of(work)

        def reset() -> None:
            mujoco.mj_resetData(model, data)
            joints.put(data, q_tree, v_tree)

        return stepped(
            work, dt, reset, lambda k: mujoco.mj_step(model, data, nstep=k), lambda: joints.state(data), budget
        )


def _installed() -> bool:
    try:
        metadata.version("mujoco")
    except metadata.PackageNotFoundError:
        return False
    return True


@lru_cache(maxsize=1)
def _text(mechanism: Mechanism) -> str:
    root = ElementTree.fromstring(export(mechanism, "mjcf").text)
    for body in root.iter():
        for shape in body.findall("geom"):  # nothing collides, and placing them takes time
            body.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")


def _model(mechanism: Mechanism) -> Any:
    import mujoco

    mujoco.set_mju_user_warning(_silent)  # by default they go to a file in the current folder
    return mujoco.MjModel.from_xml_string(_text(mechanism))


def _silent(message: str) -> None:
    """Pass over a warning: a run that became unstable is told by its numbers."""
