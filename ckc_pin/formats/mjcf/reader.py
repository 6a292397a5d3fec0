"""MuJoCo's MJCF: tree, equality constraints, tendons, actuated joints."""

from __future__ import annotations

from pathlib import Path

from ckc_pin.formats.draft import Draft, safe_name, vector
from ckc_pin.formats.mjcf.actuators import Actuators, moved_joints
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.document import Document
from ckc_pin.formats.mjcf.equality import Equalities
from ckc_pin.formats.mjcf.points import free_sites
from ckc_pin.formats.mjcf.tendons import Tendons
from ckc_pin.formats.mjcf.tree import MjcfTree

__all__ = ["read_mjcf"]


def read_mjcf(text: str, path: Path) -> Draft:
    """Read a MuJoCo model.

    Parameters
    ----------
    text : str
    path : Path
        Where the text is from; files that it names are looked for beside it.

    Raises
    ------
    InputError
        What is no MJCF, with the element's name; MuJoCo is not installed.
    """
    document = Document.read(text, path)
    compiled = Compiled.of(document)
    model = compiled.model
    tendons = Tendons(compiled)
    geared = model.eq_type == int(compiled.mujoco.mjtEq.mjEQ_JOINT)
    used = {int(joint) for joints in (model.eq_obj1id, model.eq_obj2id) for joint in joints[geared]}
    tree = MjcfTree(compiled, used | moved_joints(compiled) | tendons.used_joints)
    equalities = Equalities(compiled, tree, tendons)
    springs, of_tendons = tendons.springs(tree)
    actuators = Actuators(compiled, tree)
    name = safe_name(path, document.root.get("model", ""))
    tree.robot.set("name", name)
    medium = any(model.opt.wind) or model.opt.density or model.opt.viscosity
    off = _switched_off(compiled)
    return Draft(
        name,
        f"{path.name}, a MuJoCo model",
        tree.robot,
        loops=equalities.loops,
        couplings=equalities.couplings,
        springs=tree.springs + springs,
        forces=actuators.forces,
        joints=tree.joints,
        motors=[(motor, "") for motor in actuators.motors],
        points=free_sites(compiled, tree),
        actuated=actuators.joints or None,
        gravity=vector((0.0, 0.0, 0.0) if "gravity" in off else model.opt.gravity),
        q_guess=tree.q_guess,
        guessed=tree.guessed + [f"MuJoCo says: {said}" for said in compiled.warnings],
        left_out=[
            *tree.left_out,
            *equalities.left_out,
            *of_tendons,
            *actuators.left_out,
            *document.left_out,
            *(["forces of the medium (wind, density, viscosity)"] if medium else []),
            *(f"that the model switches its {what} off" for what in off if what != "gravity"),
        ],
    )


def _switched_off(compiled: Compiled) -> list[str]:
    """Return what flags of the model switch off that would act here."""
    bits = compiled.mujoco.mjtDisableBit
    flags = {
        "gravity": bits.mjDSBL_GRAVITY,
        "springs": bits.mjDSBL_SPRING,
        "dampers": bits.mjDSBL_DAMPER,
        "equality constraints": bits.mjDSBL_EQUALITY | bits.mjDSBL_CONSTRAINT,
        "dry friction": bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_CONSTRAINT,
        "ranges of joints": bits.mjDSBL_LIMIT | bits.mjDSBL_CONSTRAINT,
    }
    return [what for what, bit in flags.items() if compiled.model.opt.disableflags & int(bit)]
