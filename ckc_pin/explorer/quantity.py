"""What every quantity of the explorer has: the state of which it is computed, its texts and its drawing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.control.actuation import Actuation
from ckc_pin.dynamics.equilibrium import weight
from ckc_pin.dynamics.formulations import tangent_basis
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.explorer.paths import SHOWN
from ckc_pin.kinematics.sigma import SINGULAR_MARGIN
from ckc_pin.linear.statics import balance_at_rest, closest_torques
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view import commands
from ckc_pin.view.commands import Command
from ckc_pin.view.geometry import Placements

__all__ = ["LiveQuantity", "PoseState", "ShownQuantities", "StaticForces", "format_number"]

DIGITS = 4
MAX_TORQUE_RATIO = 1e9  # of a torque to the weight times the mechanism's size: a larger one comes from rounding


def format_number(value: float, unit: str = "") -> str:
    """Return a number with its unit, as short as it can be read while it changes."""
    return f"{value + 0.0:.{DIGITS}g} {unit}".rstrip()


@dataclass
class ShownQuantities:
    """What the shown quantities give at one pose.

    Attributes
    ----------
    lines : dict of str to list of [label, value]
        By quantity.
    margins : dict of str to [value, reference]
        Of bars, dimensionless.
    commands : list of Command
        That move and replace the drawings.
    """

    lines: dict[str, list[list[str]]] = field(default_factory=dict)
    margins: dict[str, list[float]] = field(default_factory=dict)
    commands: list[Command] = field(default_factory=list)


@dataclass(frozen=True)
class StaticForces:
    """Forces that hold a pose at rest.

    Attributes
    ----------
    tau : (motors,) array
    passive_force : (n,) array
        Of loaded stops and dry friction on the tree.
    missing : (d,) array
        Part of h that remains, along the independent coordinates; NaN if it remains where phi_z is singular.
    reason : str
        Why a part remains, or an empty text.
    loaded_stops : tuple of str
        Coordinates that are pushed into a stop.
    uses_friction : bool
    """

    tau: Array
    passive_force: Array
    missing: Array
    reason: str = ""
    loaded_stops: tuple[str, ...] = ()
    uses_friction: bool = False


class PoseState:
    """A pose of the mechanism, at rest or in motion. Everything is computed at its first use.

    Parameters
    ----------
    mechanism : Mechanism
    actuation : Actuation
    at : Kinematics
    v_tree : (n,) array, optional
        Velocity during a run. Default: at rest.
    tau : (motors,) array, optional
        Motor torques during a run.
    link_wrenches : (joints, 6) array, optional
        Of other forces on the bodies during a run, see `control.forces.body_wrenches`.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        actuation: Actuation,
        at: Kinematics,
        v_tree: Array | None = None,
        tau: Array | None = None,
        link_wrenches: Array | None = None,
    ) -> None:
        self.mechanism, self.actuation, self.at = mechanism, actuation, at
        self.v_tree, self.tau, self.link_wrenches = v_tree, tau, link_wrenches

    @lazy
    def rest(self) -> Terms:
        """The terms at rest."""
        return Terms(self.mechanism, self.at, np.zeros(self.mechanism.n))

    @lazy
    def is_singular(self) -> bool:
        """Whether phi_z is singular to working precision, so that rho and h do not exist."""
        return self.at.margin() <= SINGULAR_MARGIN

    @lazy
    def velocities(self) -> Array:
        """Basis of the velocities that the loops allow, (n, d) (NumericalError where J has lost rank)."""
        return tangent_basis(self.rest, np.zeros(self.mechanism.closure.rows))[0]

    @lazy
    def static_forces(self) -> StaticForces:
        """Forces that hold the pose at rest (NumericalError where J has lost rank)."""
        mechanism, rest, velocities = self.mechanism, self.rest, self.velocities
        none, undefined = np.zeros(mechanism.n), np.full(mechanism.d, np.nan)
        reason, stops, uses_friction, missing = "", (), False, np.zeros(mechanism.d)
        try:
            balance = balance_at_rest(rest, self.actuation, has_friction=True)
            tau, passive, uses_friction = balance.tau, balance.passive_force, balance.uses_friction
            stops = tuple(mechanism.coordinates[k] for k in balance.loaded_stops)
        except InputError as error:
            tau, passive = closest_torques(rest, velocities, self.actuation), none
            reason = str(error).removeprefix(f"{mechanism.name}: ")
            remaining = rest.h_tree - mechanism.motors.force(tau)
            missing = undefined if self.is_singular else rest.rho.T @ remaining
        if np.abs(tau).max(initial=0.0) > MAX_TORQUE_RATIO * (1.0 + weight(mechanism)):
            reason = "no finite torque of the motors holds it: they are at a dead centre"
            return StaticForces(0.0 * tau, none, undefined, reason)
        return StaticForces(tau, passive, missing, reason, stops, uses_friction)

    @lazy
    def placements(self) -> Placements:
        """Placements of all bodies, m = 1."""
        return Placements(self.at.pose.rotation[None], self.at.pose.translation[None])

    @lazy
    def points(self) -> dict[str, Array]:
        """Positions of the named points in the world, m."""
        pose = self.at.pose
        return {
            name: pose.rotation[frame.joint] @ frame.translation + pose.translation[frame.joint]
            for name, frame in self.mechanism.points.items()
        }


class LiveQuantity(ABC):
    """A quantity that can be shown: lines of text, bars, and a drawing.

    Parameters
    ----------
    mechanism : Mechanism
    actuation : Actuation
    """

    name = ""
    label = ""

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        self.mechanism, self.actuation = mechanism, actuation

    @property
    def root(self) -> str:
        """Path of its drawing."""
        return f"{SHOWN}/{self.name}"

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        return ""

    def draw(self) -> Iterable[Command]:
        """Return the commands that draw it before its first evaluation."""
        return ()

    def remove(self) -> Iterable[Command]:
        """Return the commands that remove its drawing, and forget its past."""
        return [commands.delete(self.root)]

    @abstractmethod
    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return its lines [label, value] at a pose; add bars and commands to `shown`."""

    def close(self) -> None:  # noqa: B027
        """End its threads. Most quantities have none."""
