"""An imported mechanism before it is written: ``mechanism.toml`` as tables, and its URDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

import msgspec
import pinocchio as pin

from ckc_pin.base.sources import Sources
from ckc_pin.errors import MechanismError
from ckc_pin.formats.robot import Tables, WithComment
from ckc_pin.kinematics.assembly import OpenLoopsError, assemble_mechanism
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import JointSpec, MechanismSpec
from ckc_pin.mechanism.tree import Tree
from ckc_pin.mechanism.urdf import TreeText, UrdfTree, merge

__all__ = ["Draft", "choose_independent"]


@dataclass(kw_only=True)
class Draft(Tables):
    """A mechanism with the content of its files. `ckc_pin.formats.tree` makes it of a `Robot`."""

    robot: ElementTree.Element  # the tree as a URDF's <robot>
    joints: WithComment[JointSpec] = field(default_factory=list)  # armatures and stops, which a URDF cannot express

    @property
    def urdf_file(self) -> str:
        """Name of the URDF beside ``mechanism.toml``."""
        return f"{self.name}.urdf"

    def urdf_text(self) -> str:
        """Return the text of the URDF."""
        ElementTree.indent(self.robot)
        return '<?xml version="1.0"?>\n' + ElementTree.tostring(self.robot, encoding="unicode") + "\n"

    def to_spec(self) -> MechanismSpec:
        """Return the content of ``mechanism.toml`` as typed structures."""
        tables: dict[str, Any] = {name: [spec for spec, _ in entries] for name, entries in self.tables.items()}
        return MechanismSpec(
            name=self.name,
            urdf=self.urdf_file,
            gravity=self.gravity,
            independent=self.independent,
            actuated=None if self.motors else self.actuated,
            q_guess=self.q_guess,
            **tables,
        )

    @property
    def tables(self) -> dict[str, Sequence[tuple[msgspec.Struct, str]]]:
        """Tables of ``mechanism.toml`` with their comments, in the order in which they are written."""
        return {
            "loop": self.loops,
            "coupling": self.couplings,
            "spring": self.springs,
            "force": self.forces,
            "joint": self.joints,
            "motor": self.motors,
            "point": self.points,
        }

    def build_tree(self) -> tuple[Tree, Frames, UrdfTree]:
        """Build the tree without its loops, and return it with its frames and the checked URDF.

        Raises
        ------
        MechanismError
            Pinocchio cannot build the tree.
        """
        urdf = merge([TreeText(self.urdf_text(), self.source)])
        try:
            tree = Tree(pin.buildModelFromXML(ElementTree.tostring(urdf.root, encoding="unicode")))
        except MechanismError as error:
            raise MechanismError(f"{self.source}: {error}") from None
        except (ValueError, RuntimeError) as error:
            raise MechanismError(f"{self.source}: Pinocchio cannot build this tree: {error}") from None
        return tree, Frames(tree.model), urdf

    def build_mechanism(self) -> Mechanism:
        """Build and assemble the mechanism, as `ckc check` does for the written files, which explains open loops.

        Raises
        ------
        MechanismError
            The loops cannot be closed, or `independent` does not determine the configuration.
        """
        sources = Sources(self.name, None, {self.urdf_file: self.urdf_text()})
        return assemble_mechanism(self.to_spec(), sources, explain=False)


# --- independent coordinates ---------------------------------------------------------------------------------------


def choose_independent(draft: Draft) -> None:
    """Set `draft.independent`: the file's choice if it determines the configuration, otherwise the actuated joints.

    The actuated joints alone are tried first, because the assembly then keeps their values.
    A draft that cannot be assembled is not changed, because the user needs the file's choice to correct its loops.
    """
    if draft.independent is not None:
        declared = draft.independent
        try:
            draft.build_mechanism()
            return
        except OpenLoopsError:
            return
        except MechanismError as error:
            draft.independent = None
            mechanism = _try_to_build(draft)
            if mechanism is None:
                draft.independent = declared
                return
            reason = str(error).removeprefix(f"{draft.name}: ").removeprefix("independent: ")
            draft.guessed.append(f"independent is chosen by the program; the file's choice does not work: {reason}")
    elif draft.actuated and (draft.loops or draft.couplings):
        draft.independent, draft.why_independent = [*draft.actuated], "the actuated joints"
        try:
            draft.build_mechanism()
            return
        except MechanismError as error:
            draft.independent, draft.why_independent = None, ""
            mechanism = None if isinstance(error, OpenLoopsError) else _try_to_build(draft)
        names = [] if mechanism is None else list(mechanism.independent)
        if not set(draft.actuated) <= set(names):
            return
        draft.independent = names
        others = [name for name in names if name not in draft.actuated]
        draft.why_independent = "the actuated joints" + (
            f"; the program chose {', '.join(others)} in addition" if others else ""
        )
        if _try_to_build(draft) is None:
            draft.independent, draft.why_independent = None, ""


def _try_to_build(draft: Draft) -> Mechanism | None:
    try:
        return draft.build_mechanism()
    except MechanismError:
        return None
