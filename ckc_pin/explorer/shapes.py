"""Quantities that are drawn as shapes: ellipsoids, traces of points, the centre of mass, and frames of loops."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.errors import NumericalError
from ckc_pin.explorer.paths import EXPLORED
from ckc_pin.explorer.quantity import LiveQuantity, PoseState, ShownQuantities, format_number
from ckc_pin.kinematics.sigma import SINGULAR_MARGIN
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.units import joined
from ckc_pin.view import bodies, commands
from ckc_pin.view.commands import Command
from ckc_pin.view.geometry import compute_loop_gaps, homogeneous
from ckc_pin.view.visuals import Colour

__all__ = ["CentreOfMass", "Ellipsoids", "LoopFrames", "Traces", "compute_ellipsoids"]

ELLIPSOID_COLOUR: Colour = (0.34, 0.71, 0.91)
TRACE_COLOUR: Colour = (0.84, 0.37, 0.00)
MASS_COLOUR: Colour = (0.10, 0.10, 0.10)
ELLIPSOID_OPACITY = 0.35
NO_POINTS = "the mechanism has no points; add [[point]] to its file"
# Lengths relative to the mechanism's size.
HOME_ELLIPSOID = 0.3  # longest semi-axis at home
MIN_THICKNESS = 0.01  # of a flat ellipsoid
MAX_SEMI_AXIS = 2.0  # near a singular configuration
BALL_RADIUS = 0.05
GAP_TOLERANCE = 1e-6  # |phi| of an open loop
MIN_MOVE = 1e-4  # of a point, to be recorded
DEAD_CENTRE_RATIO = 1e-7  # of the singular values of the shaft rates: below it they do not determine the motion
TRACE_LENGTH = 2000  # positions of a point
CHUNK_LENGTH = 100  # positions in one line; only the last line is sent again


class Ellipsoids(LiveQuantity):
    """Manipulability ellipsoids of the named points: their velocities while the motors' rates have norm one."""

    name, label = "ellipsoids", "manipulability ellipsoids of points"

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        super().__init__(mechanism, actuation)
        self.scale = 1.0

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        if not self.mechanism.points:
            return NO_POINTS
        return "" if self.mechanism.d else "the mechanism has no freedoms"

    def draw(self) -> Iterable[Command]:
        """Return a ball of one metre for each point, which is scaled when it is evaluated."""
        try:
            maps = compute_ellipsoids(self.mechanism, self.mechanism.assembled)
            largest = max(float(np.linalg.norm(matrix, 2)) for matrix in maps.values())
        except NumericalError:
            largest = 0.0
        self.scale = HOME_ELLIPSOID * self.mechanism.size / largest if largest > 0 else 1.0
        material = commands.create_material(ELLIPSOID_COLOUR, ELLIPSOID_OPACITY)
        for name in self.mechanism.points:
            yield commands.draw_primitive(f"{self._path(name)}/ball", "sphere", [1.0], np.eye(4), material)
            yield commands.set_transform(self._path(name), homogeneous(1e-6 * np.eye(3), np.zeros(3)))

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return the semi-axes of each point; scale the balls."""
        mechanism, size = self.mechanism, self.mechanism.size
        unit = _input_unit(mechanism)
        lines = []
        for name, matrix in compute_ellipsoids(mechanism, state.at).items():
            axes, lengths, _ = np.linalg.svd(matrix)
            semi_axes = np.zeros(3)
            semi_axes[: len(lengths)] = lengths
            axes[:, 2] *= np.linalg.det(axes)  # A mirrored ball would be drawn inside out.
            drawn = np.clip(self.scale * semi_axes, MIN_THICKNESS * size, MAX_SEMI_AXIS * size)
            shown.commands.append(
                commands.set_transform(self._path(name), homogeneous(axes * drawn, state.points[name]))
            )
            texts = ", ".join(format_number(x) for x in np.where(semi_axes < 1e-12, 0.0, semi_axes))
            note = "; drawn shorter" if self.scale * semi_axes[0] > MAX_SEMI_AXIS * size else ""
            lines.append([name, f"{texts} m/s at 1 {unit}{note}"])
        return [*lines, ["drawn at", f"{format_number(self.scale)} m for 1 m/s"]]

    def _path(self, point: str) -> str:
        return f"{self.root}/{bodies.escape_path(point)}"


def compute_ellipsoids(mechanism: Mechanism, at: Kinematics) -> dict[str, Array]:
    """Return the maps from rates of norm one to the velocities of the named points, (3, d) each, m/s.

    The rates are those of the motors' shafts if there are as many motors as freedoms, otherwise q_dot.

    Raises
    ------
    NumericalError
        phi_z is singular, or the motors' rates do not determine the motion.
    """
    if at.margin() <= SINGULAR_MARGIN:
        raise NumericalError("phi_z is singular here, so q_dot does not determine the velocities")
    to_velocity = at.rho
    if _has_rates_of_motors(mechanism):
        rates = mechanism.motors.transmission @ at.rho
        sizes = np.linalg.svd(rates, compute_uv=False)
        if sizes[-1] <= DEAD_CENTRE_RATIO * sizes[0]:
            raise NumericalError("the motors are at a dead centre: their rates do not limit the velocities")
        to_velocity = at.rho @ np.linalg.inv(rates)
    return {name: jacobian @ to_velocity for name, jacobian in mechanism.point_jacobians(at.q_tree).items()}


def _has_rates_of_motors(mechanism: Mechanism) -> bool:
    return len(mechanism.actuated) == mechanism.d


def _input_unit(mechanism: Mechanism) -> str:
    """Return the unit and the name of the rates of `compute_ellipsoids`."""
    units, motors = np.array(mechanism.tree.units("/s")), mechanism.motors.transmission
    if _has_rates_of_motors(mechanism):
        return f"{joined(units[np.any(motors != 0, axis=0)].tolist())} of the motors"
    return f"{joined(units[mechanism.partition.q].tolist())} of q"


class Traces(LiveQuantity):
    """Paths of the named points while they are shown."""

    name, label = "traces", "traces of points"

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        super().__init__(mechanism, actuation)
        self._recent: dict[str, deque[Array]] = {}  # positions of the last line
        self._chunks: dict[str, int] = {}  # number of the last line

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        return "" if self.mechanism.points else NO_POINTS

    def remove(self) -> Iterable[Command]:
        """Return the commands that remove all traces, and forget them."""
        self._recent, self._chunks = {}, {}
        return super().remove()

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return the positions; extend the traces."""
        lines = []
        for name, position in state.points.items():
            lines.append([name, f"{', '.join(format_number(x) for x in position)} m"])
            recent = self._recent.setdefault(name, deque())
            if recent and np.linalg.norm(position - recent[-1]) < MIN_MOVE * self.mechanism.size:
                continue
            if len(recent) > CHUNK_LENGTH:
                self._chunks[name] = (self._chunks.get(name, 0) + 1) % (TRACE_LENGTH // CHUNK_LENGTH)
                recent = self._recent[name] = deque([recent[-1]])
            recent.append(position)
            if len(recent) > 1:
                path = f"{self.root}/{bodies.escape_path(name)}/{self._chunks.get(name, 0)}"
                shown.commands.append(commands.draw_polyline(path, np.array(recent), TRACE_COLOUR))
        return lines


class CentreOfMass(LiveQuantity):
    """The centre of mass of all moving bodies."""

    name, label = "centre_of_mass", "centre of mass"

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        return "" if self._mass() > 0 else "no moving body has a mass"

    def draw(self) -> Iterable[Command]:
        """Return a ball."""
        material = commands.create_material(MASS_COLOUR, on_top=True)
        size = [BALL_RADIUS * self.mechanism.size]
        return [commands.draw_primitive(f"{self.root}/ball", "sphere", size, np.eye(4), material)]

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return its coordinates and the moving mass; move the ball."""
        centre = self.mechanism.tree.evaluate(pin.centerOfMass, state.at.q_tree)
        shown.commands.append(commands.set_transform(self.root, homogeneous(np.eye(3), centre)))
        lines = [[axis, format_number(x, "m")] for axis, x in zip("xyz", centre, strict=True)]
        return [*lines, ["moving mass", format_number(self._mass(), "kg")]]

    def _mass(self) -> float:
        return sum(float(inertia.mass) for inertia in list(self.mechanism.tree.model.inertias)[1:])


class LoopFrames(LiveQuantity):
    """Both frames of each loop, and a rod across each loop that is open."""

    name, label = "loop_frames", "frames of loops"

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        super().__init__(mechanism, actuation)
        self._has_gaps = False

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        return "" if self.mechanism.spec.loop else "the mechanism has no loops between frames"

    def draw(self) -> Iterable[Command]:
        """Return the frames, which move with the bodies of the explored mechanism."""
        return bodies.draw_loop_frames(self.mechanism, EXPLORED, bodies.SOLID)

    def remove(self) -> Iterable[Command]:
        """Return the commands that remove frames and rods."""
        self._has_gaps = False
        return [*(commands.delete(command["path"]) for command in self.draw()), *super().remove()]

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return how far each loop is open; draw a rod across it."""
        residuals = self.mechanism.closure.largest_residuals(state.at.phi)
        if max(residuals.values(), default=0.0) <= GAP_TOLERANCE * self.mechanism.size:
            if self._has_gaps:
                self._has_gaps = False
                shown.commands.append(commands.delete(self.root))
            return []
        gaps = compute_loop_gaps(self.mechanism, state.at.q_tree[None])
        if not self._has_gaps:
            self._has_gaps = True
            shown.commands += bodies.draw_gaps(self.mechanism, self.root, bodies.SOLID)
        for path, values in bodies.stretch_gaps(self.mechanism, self.root, state.placements, gaps).items():
            linear = np.eye(3)
            if "quaternion" in values:
                linear = pin.Quaternion(values["quaternion"][0]).matrix() * values["scale"][0]
            shown.commands.append(commands.set_transform(path, homogeneous(linear, values["position"][0])))
        lengths = {loop: float(np.linalg.norm(gap)) for loop, gap in gaps.items()}
        return [[f"loop {loop}", f"open by {format_number(length, 'm')}"] for loop, length in lengths.items()]
