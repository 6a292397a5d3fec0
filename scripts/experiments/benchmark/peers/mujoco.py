"""Run works in MuJoCo, with loops as soft constraints and fixed steps. The model is that of `ckc export`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from importlib import metadata

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.motion import Motion
from ckc_pin.analysis.precision.mujoco import StateMap, configure_model, load_model, make_program
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.formats.exporting import export
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.benchmark.peers.stepping import (
    CONTROLLED,
    dividing_step,
    halved_steps,
    run_fixed_step,
    start_of,
)
from scripts.experiments.benchmark.work import Work

__all__ = ["Mujoco"]

COARSEST, STEPS, QUICK_STEPS, SOFT_STEPS = (
    2e-2,
    11,
    8,
    3,
)  # s, and numbers of halvings; few for default constraints, whose softness dominates
INTEGRATORS = ("Euler", "implicitfast", "RK4", "discrete")  # discrete: since MuJoCo 4; implicit never won
QUICK_INTEGRATORS = ("implicitfast", "RK4")
DEFAULT, STIFF, FIRM = "default", "solref 2 dt", "solref 4 dt"  # time constants of the constraints


class Mujoco:
    """MuJoCo with default constraint settings, and with the stiffest ones that its manual allows.

    The model has no shapes, and unused features are switched off. A diverged run must not reset itself.
    """

    name = "MuJoCo"
    packaged = True

    def missing(self, work: Work) -> str | None:
        if not _installed():
            return "not installed: pip install 'ckc_pin[peers]'"
        if work.controlled:
            return CONTROLLED
        try:
            load_model(_text(work.mechanism))
        except (InputError, ValueError) as error:
            return str(error)
        return None

    def version(self) -> str:
        return metadata.version("mujoco")

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        import mujoco

        integrators, steps = (QUICK_INTEGRATORS, QUICK_STEPS) if quick else (INTEGRATORS, STEPS)
        for integrator in integrators:
            if not hasattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}"):
                continue
            stiffnesses = {DEFAULT: SOFT_STEPS, STIFF: steps, **({FIRM: steps} if integrator == "RK4" else {})}
            for stiffness, many in stiffnesses.items():
                for dt in halved_steps(work, COARSEST, many):
                    yield f"{integrator}, {stiffness}, dt {dt:.3g}"

    def check(self, work: Work) -> str:
        """Compare D', the bias and the constrained acceleration at the start."""
        import mujoco

        tree = work.mechanism.tree
        q_tree, v_tree = start_of(work)
        model = load_model(_text(work.mechanism))
        data = mujoco.MjData(model)
        joints = StateMap(work.mechanism, model)
        to = joints.set_state(data, q_tree, v_tree)
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        terms = Terms(work.mechanism, work.mechanism.kinematics(q_tree), v_tree)
        ours = dae_acceleration(terms, np.zeros(tree.n))
        mass = np.abs(to.T @ M @ to - terms.D_tree).max() / np.abs(terms.D_tree).max()
        render_blocks = f"D' agrees to {mass:.0e}"
        if tree.is_euclidean:
            bias = pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree)
            off = np.abs(to.T @ data.qfrc_bias - bias).max() / max(float(np.abs(bias).max()), 1e-12)
            apart = np.abs(to.T @ data.qacc - ours).max() / max(float(np.abs(ours).max()), 1.0)
            render_blocks += f", the bias to {off:.0e}; the constrained acceleration differs by {apart:.0e}"
        return render_blocks

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        integrator, stiffness, step = setting.split(", ")
        dt, model = float(step.removeprefix("dt ")), load_model(_text(work.mechanism))
        configure_model(model, integrator, stiffness, dividing_step(work, dt))
        return run_fixed_step(work, dt, make_program(model, work.mechanism, start_of(work)), budget)


def _installed() -> bool:
    try:
        metadata.version("mujoco")
    except metadata.PackageNotFoundError:
        return False
    return True


@lru_cache(maxsize=1)
def _text(mechanism: Mechanism) -> str:
    return export(mechanism, "mjcf").text
