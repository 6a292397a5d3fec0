"""Live quantities of the explorer. Only those that are shown are computed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread, pivoted_columns
from ckc_pin.base.validation import suggest_name
from ckc_pin.control.actuation import DRIVE_TOLERANCE, Actuation
from ckc_pin.errors import CkcError, InputError
from ckc_pin.explorer.forces import Forces, HoldingTorques
from ckc_pin.explorer.messages import QuantityInfo
from ckc_pin.explorer.nearest import NearestSingularity
from ckc_pin.explorer.quantity import LiveQuantity, PoseState, ShownQuantities, format_number
from ckc_pin.explorer.shapes import CentreOfMass, Ellipsoids, LoopFrames, Traces
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rank import scale_jacobian
from ckc_pin.scene.parts import build_scene_actuation
from ckc_pin.scene.scene import Scene
from ckc_pin.view.commands import Command

__all__ = ["Conditioning", "MotorRoles", "Quantities", "ShownQuantities", "compute_margins"]

IDLE_RATIO = 1e-3  # of a motor's rate to that of its joints alone: below it the motor moves nothing


class Conditioning(LiveQuantity):
    """How far phi_z and J are from losing rank."""

    name, label = "conditioning", "how far from singular"

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        super().__init__(mechanism, actuation)
        self._at_home: dict[str, float] = {}

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        return "" if self.mechanism.dependent else "without loops there is no singular configuration"

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return the margins as text and as bars."""
        self._at_home = self._at_home or compute_margins(self.mechanism, self.mechanism.assembled)
        lines = []
        for name, value in compute_margins(self.mechanism, state.at).items():
            reference = self._at_home[name]
            shown.margins[name] = [value, reference]
            lines.append([name, f"{format_number(value)} (at home {format_number(reference)})"])
        return lines


def compute_margins(mechanism: Mechanism, at: Kinematics) -> dict[str, float]:
    """Return the smallest singular values of phi_z and J relative to |J|, scaled to be dimensionless.

    That of phi_z is zero where q does not determine the configuration, that of J where the loops lose rank.
    """
    J = scale_jacobian(at.J, mechanism.tree, mechanism.closure)
    sizes = np.linalg.svd(J, compute_uv=False)
    smallest = float(sizes[mechanism.rank - 1] / max(np.linalg.norm(J), 1e-300))
    return {"sigma_min(phi_z)": at.margin(), "sigma_min(J)": smallest}


class MotorRoles(LiveQuantity):
    """Which motors are redundant, and which move nothing at this pose."""

    name, label = "motors", "redundant and idle motors"

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        if not self.mechanism.actuated:
            return "the mechanism has no motors"
        return "" if self.mechanism.d else "the mechanism has no freedoms"

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return the number of internal torques, the motors that take part in them, and idle motors."""
        mechanism, names = self.mechanism, np.array(self.mechanism.actuated, dtype=object)
        scale = mechanism.tree.step_scale
        basis = np.linalg.qr(state.velocities / scale[:, None])[0]
        transmission = mechanism.motors.transmission * scale
        rates = transmission @ basis / np.linalg.norm(transmission, axis=1, keepdims=True)
        sizes = np.linalg.norm(rates, axis=1)
        idle = sizes < IDLE_RATIO
        active = rates[~idle] / sizes[~idle, None]
        freedoms, values, internal = np.linalg.svd(active.T)
        rank = int(np.sum(values > DRIVE_TOLERANCE * values.max(initial=0.0)))
        takes_part = np.linalg.norm(internal[rank:], axis=0) > DRIVE_TOLERANCE
        redundant = int((~idle).sum()) - rank
        text = "none"
        if redundant:
            text = f"{redundant}, of {', '.join(names[~idle][takes_part])}"
        lines = [["internal torques", text], ["idle here", ", ".join(names[idle]) or "none"]]
        if rank < mechanism.d:
            undriven = (scale[:, None] * basis @ freedoms[:, rank:])[mechanism.partition.q]
            columns = sorted(pivoted_columns(undriven.T)[0][: mechanism.d - rank])
            text = ", ".join(mechanism.independent[k] for k in columns)
            lines.append(["freedoms without a motor", f"{mechanism.d - rank}, along {text}"])
        return lines


QUANTITIES: tuple[type[LiveQuantity], ...] = (
    Conditioning, NearestSingularity, MotorRoles, HoldingTorques, Forces, Ellipsoids, Traces, CentreOfMass, LoopFrames,
)  # fmt: skip


class Quantities:
    """The quantities of a mechanism, and which of them are shown.

    Parameters
    ----------
    mechanism : Mechanism
    scene : Scene, optional
        Its torque limits and allocation hold for the motors.
    on_update : callable, optional
        Called in another thread when a slow quantity has a new result, so that a frame is worthwhile.
    """

    def __init__(
        self, mechanism: Mechanism, scene: Scene | None = None, on_update: Callable[[], None] | None = None
    ) -> None:
        self.mechanism = mechanism
        self.actuation = Actuation(mechanism) if scene is None else build_scene_actuation(scene, mechanism)
        self._quantities = {kind.name: kind(mechanism, self.actuation) for kind in QUANTITIES}
        self._unavailable = {name: one.explain_unavailable() for name, one in self._quantities.items()}
        self._shown: dict[str, LiveQuantity] = {}
        nearest = self._quantities[NearestSingularity.name]
        assert isinstance(nearest, NearestSingularity)
        nearest.on_update = on_update

    def infos(self) -> list[QuantityInfo]:
        """Return all quantities, and why some of them cannot be shown for this mechanism."""
        return [
            QuantityInfo(name=name, label=one.label, on=name in self._shown, unavailable=self._unavailable[name])
            for name, one in self._quantities.items()
        ]

    @property
    def visible_names(self) -> list[str]:
        """Names of the quantities that are shown."""
        return list(self._shown)

    def show(self, name: str, on: bool) -> list[Command]:
        """Show or hide a quantity; return the commands that draw it or remove its drawing.

        Raises
        ------
        InputError
            An unknown name, or a quantity that cannot be shown for this mechanism.
        """
        if name not in self._quantities:
            names = list(self._quantities)
            raise InputError(f"quantity {name!r}: there are {', '.join(names)}{suggest_name(name, names)}")
        if on == (name in self._shown):
            return []
        quantity = self._quantities[name]
        if not on:
            del self._shown[name]
            return list(quantity.remove())
        if self._unavailable[name]:
            raise InputError(f"{quantity.label}: {self._unavailable[name]}")
        self._shown[name] = quantity
        with one_blas_thread():
            return list(quantity.draw())

    def evaluate(
        self,
        at: Kinematics,
        v_tree: Array | None = None,
        tau: Array | None = None,
        link_wrenches: Array | None = None,
    ) -> ShownQuantities:
        """Return the texts, bars and drawing commands of the shown quantities at a pose.

        A quantity that does not exist at this pose has one line that tells why.

        Parameters
        ----------
        at : Kinematics
        v_tree : (n,) array, optional
            Velocity during a run. Default: at rest.
        tau : (motors,) array, optional
            Motor torques during a run.
        link_wrenches : (joints, 6) array, optional
            Of pushes during a run: on the bodies of the joints, in world axes, about the world's origin.
        """
        shown = ShownQuantities()
        if not self._shown:
            return shown
        state = PoseState(self.mechanism, self.actuation, at, v_tree, tau, link_wrenches)
        with one_blas_thread():
            for name, quantity in self._shown.items():
                try:
                    shown.lines[name] = quantity.evaluate(state, shown)
                except CkcError as error:
                    shown.lines[name] = [["not here", str(error)]]
        return shown

    def close(self) -> None:
        """End all threads."""
        for quantity in self._quantities.values():
            quantity.close()
