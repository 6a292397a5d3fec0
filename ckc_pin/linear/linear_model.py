"""The linear model of a mechanism about one state: eq. 1 in minimal coordinates, differentiated exactly."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.codegen.library import Library
from ckc_pin.dynamics.formulations import refuse_massless
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.linear.modes import NO_DAMPING, ComplexArray, Mode, eigenvalues_of, modes_of
from ckc_pin.linear.resting import kernel, motions, unbalanced
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native.plant import NONE, Plant

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["LinearModel", "Mode", "eigenvalues_of", "linear_model"]

COINCIDENT = 1e-9  # of the mechanism's size: ends of a spring so near to each other are at one place
MOST_NAMES, MOST_ROWS = 14, 12  # names in a list, and modes, in what is printed


@dataclass(frozen=True, eq=False)
class LinearModel:
    """dx/dt = A x + B tau, y = C x + D tau, of deviations from one state of a mechanism.

    Attributes
    ----------
    name : str
    mechanism : Mechanism
    at : str
        What that state is, in words.
    t : float or None
        Of an instant of a run, s.
    states, inputs, outputs : tuple of str
        d coordinates and then their rates, ``NAME_dot``; motors; coordinates of the tree, ``point:NAME.x`` and
        ``loop:LOOP.ROW``, the multipliers of eq. 1. Those of a free root are tangent coordinates, in its own axes.
    A, B, C, D : arrays
        D is the feedthrough. SI units.
    q_tree, v_tree : (n,) arrays
        The state itself, by coordinate.
    tau : (motors,) array
        What the motors do there.
    motions : (n, d) array
        What each coordinate moves of the tree.
    locked : tuple of str
        Joints that stick or touch, and do not move.
    closed_loop : (2 d, 2 d) array or None
        A with the scene's controller, which then has no inputs.
    notes : tuple of str
        What to know before one takes it for the whole truth.
    """

    name: str
    mechanism: Mechanism
    at: str
    t: float | None
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    D: Array
    q_tree: Array
    v_tree: Array
    tau: Array
    motions: Array
    locked: tuple[str, ...] = ()
    closed_loop: Array | None = None
    notes: tuple[str, ...] = field(default=())

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Labels of `q_tree`, `v_tree` and of the shapes of modes."""
        return self.mechanism.coordinates

    @cached_property
    def eigenvalues(self) -> ComplexArray:
        """Of A, 1/s, in falling order of their real parts."""
        return eigenvalues_of(self.A, self._units)

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Of A, in rising order of |eigenvalue|: of a motion, those of the instant."""
        return modes_of(self.A, self.motions, self._units, self.mechanism.tree.step_scale)

    @cached_property
    def _units(self) -> Array:
        tree = self.mechanism.tree
        return tree.step_scale[[tree.index[name] for name in self.states[: len(self.states) // 2]]]

    def sway(self, number: int) -> Run | None:
        """Return a mode, counted from 1, as a run to play; see `ckc_pin.linear.mode_animation.sway`."""
        from ckc_pin.linear.mode_animation import sway

        return sway(self, number)

    def to_statespace(self) -> Any:
        """Return the model for python-control, a `control.StateSpace` with the same names, dots as underscores.

        Of names that are the same then, the later ones get a number.

        Raises
        ------
        InputError
            python-control is not installed, or there are no motors, and with them no inputs.
        """
        try:
            import control
        except ModuleNotFoundError as error:
            raise InputError(
                "to_statespace needs python-control, which is not installed: pip install ckc_pin[control]"
            ) from error
        if not self.inputs:
            raise InputError(f"{self.name}: no motors, so that there are no inputs, which python-control asks for")
        states, inputs, outputs = (_distinct(x) for x in (self.states, self.inputs, self.outputs))
        (name,) = _distinct((self.name,))
        return control.ss(self.A, self.B, self.C, self.D, states=states, inputs=inputs, outputs=outputs, name=name)

    def __repr__(self) -> str:
        head = f"LinearModel of {self.name} {self.at}: {len(self.states)} states, {len(self.inputs)} inputs"
        shown = [f"  {says}" for says in (*_rows(self), *(f"note: {note}" for note in self.notes))]
        return "\n".join([f"{head}, {len(self.outputs)} outputs", f"  states  {_some(self.states)}", *shown])


def _distinct(names: tuple[str, ...]) -> list[str]:
    made: list[str] = []
    for name in names:
        plain = name.replace(".", "_")
        again = (f"{plain}_{k}" for k in count(2))
        made.append(plain if plain not in made else next(x for x in again if x not in made))
    return made


def _some(names: tuple[str, ...]) -> str:
    """Names as far as people read them."""
    return ", ".join(
        names if len(names) <= MOST_NAMES else (*names[: MOST_NAMES - 1], f"{len(names) - MOST_NAMES + 1} more")
    )


def _rows(model: LinearModel) -> list[str]:
    rows = [f"inputs  {_some(model.inputs) or 'none'}"]
    rigid = sum(not mode.eigenvalue for mode in model.modes)
    if rigid:
        rows.append(f"eigenvalue 0 1/s{f' ({rigid} times)' if rigid > 1 else ''}: motions that nothing brings back")
    for mode in model.modes[rigid : rigid + MOST_ROWS]:
        value = mode.eigenvalue
        still = bool(mode.frequency) and abs(mode.damping_ratio) < NO_DAMPING
        pair = f"{0.0 if still else value.real:.6g} +- {value.imag:.6g}i 1/s: " if mode.frequency else ""
        rows.append(f"eigenvalue {pair}{mode.says}")
    more = len(model.modes) - rigid - MOST_ROWS
    return rows + ([f"and {more} more"] if more > 0 else [])


def linear_model(
    terms: Terms,
    tau: Array,
    *,
    at: str,
    t: float | None = None,
    u_tree: Array | float = 0.0,
    locked: IntArray = NONE,
    smoothing: float | None = None,
    library: Library | None = None,
    notes: tuple[str, ...] = (),
) -> LinearModel:
    """Linearize eq. 1 about a state.

    Parameters
    ----------
    terms : Terms
        On the closure.
    tau : (motors,) array
        What the motors do there.
    at : str
        What the state is, in words.
    t : float, optional
        Of an instant of a run, s.
    u_tree : (n,) array, optional
        Other forces that do not change with the state, as of joints that slide.
    locked : int array, optional
        Coordinates of joints that stick or touch.
    smoothing : float, optional
        Rate over which dry friction grows, as a scene's friction_smoothing.
    library : Library, optional
        The mechanism's terms, compiled.

    Raises
    ------
    NumericalError
        J has lost rank.
    InputError
        Nothing is free to move, a motion moves no mass, a damper or spring has no direction.
    """
    mechanism = terms.mechanism
    names = tuple(mechanism.coordinates[k] for k in locked)
    if vague := mechanism.springs.without_direction(terms.q_tree, COINCIDENT * mechanism.size):
        raise InputError(
            f"{mechanism.name}: no linear model there: the ends of {_some(tuple(vague))} coincide, so that it has no "
            "direction to act along, and its force no derivative; take another configuration"
        )
    _refuse_massless(terms, locked)
    u_tree = mechanism.motors.force(tau) + u_tree
    found = Plant(mechanism, smoothing, library).at(terms, u_tree, locked)
    if not len(found.at):
        smoothed = "; friction_smoothing lets them slide" if np.any(mechanism.joints.friction[locked]) else ""
        why = f"its joints stick or touch ({', '.join(names)}){smoothed}" if names else "d = 0"
        raise InputError(f"{mechanism.name}: no freedom is left to linearize in: {why}")
    if not np.all(np.isfinite(found.A)):
        raise NumericalError(f"{mechanism.name}: no linear model there, its derivatives are not finite")
    chart = tuple(mechanism.coordinates[k] for k in found.at)
    if chart != mechanism.independent and not names:
        no, are = ("is no coordinate", "is") if len(chart) == 1 else ("are no coordinates", "are")
        notes = (*notes, f"{', '.join(mechanism.independent)} {no} there; {', '.join(chart)} {are}")
    if names:
        notes = (*notes, f"locked by friction or a stop, so that they do not move: {_some(names)}")
    if not terms.v_tree.any() and unbalanced(terms, u_tree, found.T):
        a = found.acceleration / mechanism.tree.step_scale
        k = int(np.argmax(np.abs(a)))
        rate = f"{found.acceleration[k]:.4g} {mechanism.tree.units('/s^2')[k]}"
        notes = (*notes, f"at rest, but nothing keeps it there: {mechanism.coordinates[k]} accelerates with {rate}")
    points = mechanism.point_jacobians(terms.q_tree)
    turns, zero = mechanism.motors.transmission.T, np.zeros((mechanism.n + 3 * len(points), len(found.at)))
    places = np.vstack([found.T, *(x @ found.T for x in points.values())])
    forces_q = found.multipliers_q @ found.T + found.multipliers_v @ found.V
    return LinearModel(
        name=mechanism.name,
        mechanism=mechanism,
        at=at,
        t=t,
        states=(*chart, *(f"{name}_dot" for name in chart)),
        inputs=mechanism.actuated,
        outputs=(
            *mechanism.coordinates,
            *(f"point:{name}.{axis}" for name in points for axis in "xyz"),
            *(f"loop:{loop}.{row}" for loop, row in mechanism.closure.names),
        ),
        A=found.A,
        B=found.B,
        C=np.block([[places, zero], [forces_q, found.multipliers_v @ found.T]]),
        D=np.vstack([np.zeros((len(zero), len(mechanism.actuated))), found.multipliers_u @ turns]),
        q_tree=mechanism.tree.to_coordinates(terms.q_tree),
        v_tree=terms.v_tree,
        tau=tau,
        motions=found.T,
        locked=names,
        notes=notes,
    )


def _refuse_massless(terms: Terms, locked: IntArray) -> None:
    tangent = motions(terms)
    tangent = tangent @ kernel(tangent[locked] / terms.mechanism.tree.step_scale[locked, None])
    if tangent.shape[1]:
        refuse_massless(terms, tangent, np.arange(terms.mechanism.n))
