"""Linear model of a mechanism about one state: the exact derivatives of eq. 1 in minimal coordinates."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.atomic_files import open_atomic, write_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary, format_eigenvalues, to_pairs
from ckc_pin.base.tables import require_distinct, to_csv_text, to_data_frame
from ckc_pin.base.validation import require_path
from ckc_pin.codegen.library import Library
from ckc_pin.control.forces import COMPONENTS, BodyForce, body_wrenches, generalized_force, unit_forces
from ckc_pin.dynamics.formulations import require_mass
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.linear.modes import MIN_DAMPING_RATIO, ComplexArray, Mode, compute_eigenvalues, compute_modes
from ckc_pin.linear.statics import compute_velocity_basis, has_unbalanced_force, orthonormal_null_space
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native.plant import NONE, AccelerationDerivatives, Plant

if TYPE_CHECKING:
    import pandas

    from ckc_pin.run.run import Run
    from ckc_pin.view.inline import Figures

__all__ = ["LinearModel", "Mode", "linear_model"]

COINCIDENCE_TOLERANCE = 1e-9  # relative to the mechanism's size, for the two ends of a spring
MAX_NAMES = 14  # in a list of names
MAX_MODES = 12  # in a summary


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(HasSummary):
    """Linear state-space model of a mechanism: ``dx/dt = A x + B tau`` and ``y = C x + D tau``.

    All variables are deviations from one state.

    Attributes
    ----------
    name : str
    mechanism : Mechanism
    at : str
        Description of the state.
    t : float or None
        Time of a state of a run, s.
    states, inputs, outputs : tuple of str
        The names of quantities of runs. The states are d coordinates, ``theta_1``, and then their rates,
        ``v.theta_1``. The inputs are the motor torques, ``tau.MOTOR``, and the components of the scene's forces on
        links, ``force.NAME.fx``. The outputs are the coordinates of the tree, points, ``tip.x``, and the multipliers
        of eq. 1, ``loop.LOOP.ROW``. A free root has tangent coordinates in its own axes.
    A, B, C, D : arrays
        SI units. D is the feedthrough.
    q_tree, v_tree : (n,) arrays
        The state, by coordinate.
    tau : (motors,) array
        Motor torques at the state, N m or N.
    motions : (n, d) array
        Velocity of the tree for a unit rate of each coordinate of the states.
    locked : tuple of str
        Joints that stick or are at a stop. They do not move.
    closed_loop : (2 d, 2 d) array or None
        State matrix with the scene's controller.
    notes : tuple of str
        Limits of the model's validity.
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
        """Names of the entries of `q_tree`, `v_tree` and mode shapes."""
        return self.mechanism.coordinates

    @cached_property
    def eigenvalues(self) -> ComplexArray:
        """Eigenvalues of A, 1/s, by decreasing real part."""
        return compute_eigenvalues(self.A, self._units)

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Modes of A, by increasing |eigenvalue|. About a motion they are those of the instant."""
        return compute_modes(self.A, self.motions, self._units, self.mechanism.tree.step_scale)

    @cached_property
    def _units(self) -> Array:
        """Scale of each coordinate of the states: 1 rad, or the mechanism's size."""
        tree = self.mechanism.tree
        return tree.step_scale[[tree.index[name] for name in self.states[: len(self.states) // 2]]]

    def animate_mode(self, number: int) -> Run | None:
        """Return a mode, counted from 1, as a run to play; see `ckc_pin.linear.mode_animation.animate_mode`."""
        from ckc_pin.linear.mode_animation import animate_mode

        return animate_mode(self, number)

    def plot(self) -> Figures:
        """Draw poles and mode shapes. A notebook shows the figures and `save(folder)` writes them."""
        import ckc_pin

        return ckc_pin.plot(self)

    def to_pandas(self) -> pandas.DataFrame:
        """Return A, B, C and D as one pandas DataFrame with names (needs the extra `data`).

        It is the block matrix ``[[A, B], [C, D]]``. Each row is an equation: the rate of a state, ``d/dt v.theta_1``,
        or an output, ``tip.x``. The columns are the states and then the inputs. ``frame.loc["tip.x", "theta_1"]`` is
        an entry of C.
        """
        return to_data_frame("equation", *self._table("LinearModel.to_pandas"))

    def to_csv(self, path: str | Path) -> Path:
        """Write the table of `to_pandas` as CSV, with all digits of each number.

        Raises
        ------
        InputError
            The file cannot be written, or two states or inputs have the same name.
        """
        require_path(path, "LinearModel.to_csv: path")
        write_atomic(Path(path), to_csv_text("equation", *self._table("LinearModel.to_csv")))
        return Path(path)

    def _table(self, where: str) -> tuple[tuple[str, ...], dict[str, Array]]:
        """Return the names of the rows, and the columns by name."""
        matrix = np.block([[self.A, self.B], [self.C, self.D]])
        columns = zip((*self.states, *self.inputs), matrix.T, strict=True)
        equations = (*(f"d/dt {state}" for state in self.states), *self.outputs)
        return equations, require_distinct(columns, "equation", where)

    def to_statespace(self) -> Any:
        """Convert to a `control.StateSpace` of python-control.

        Names are the same, with dots replaced by underscores. Equal names get a number.

        Raises
        ------
        InputError
            python-control is not installed, or the mechanism has no motors and so the model no inputs.
        """
        try:
            import control
        except ModuleNotFoundError as error:
            raise InputError(
                "to_statespace needs python-control, which is not installed: pip install ckc_pin[control]"
            ) from error
        if not self.inputs:
            raise InputError(
                f"{self.name}: to_statespace: python-control needs at least one input, but the mechanism has no motors"
            )
        states, inputs, outputs = (_make_distinct(x) for x in (self.states, self.inputs, self.outputs))
        (name,) = _make_distinct((self.name,))
        return control.ss(self.A, self.B, self.C, self.D, states=states, inputs=inputs, outputs=outputs, name=name)

    def to_dict(self) -> dict[str, Any]:
        """Return the model as JSON-ready data (docs/reference/json.md)."""
        closed_loop = None
        if self.closed_loop is not None:
            eigenvalues = to_pairs(compute_eigenvalues(self.closed_loop))
            closed_loop = {"A": self.closed_loop.tolist(), "eigenvalues": eigenvalues}
        return {
            "name": self.name,
            "states": self.states,
            "inputs": self.inputs,
            "outputs": self.outputs,
            **{name: getattr(self, name).tolist() for name in "ABCD"},
            "eigenvalues": to_pairs(self.eigenvalues),
            "modes": [
                {
                    "eigenvalue": to_pairs([mode.eigenvalue])[0],
                    "frequency": mode.frequency,
                    "damping_ratio": mode.damping_ratio,
                    "shape": dict(zip(self.coordinates, to_pairs(mode.shape), strict=True)),
                }
                for mode in self.modes
            ],
            "at": {
                "state": self.at,
                "t": self.t,
                "coordinates": self.coordinates,
                "q_tree": self.q_tree.tolist(),
                "v_tree": self.v_tree.tolist(),
                "tau": self.tau.tolist(),
            },
            "locked": self.locked,
            "closed_loop": closed_loop,
            "notes": self.notes,
        }

    def summary(self) -> Summary:
        """Return states, inputs, modes and notes, as `repr` and a notebook show them."""
        size = f"{len(self.states)} states, {len(self.inputs)} inputs, {len(self.outputs)} outputs"
        rows: list[Row] = [("states", list(self.states)), ("inputs", list(self.inputs) or "none")]
        rigid = sum(not mode.eigenvalue for mode in self.modes)
        if rigid:
            rows.append(("rigid modes", f"{rigid}, eigenvalue 0 1/s: nothing restores these motions"))
        last = min(rigid + MAX_MODES, len(self.modes))
        rows += [(f"mode {k + 1}", _describe_mode(self.modes[k])) for k in range(rigid, last)]
        if last < len(self.modes):
            rows.append(("more modes", f"{len(self.modes) - last}"))
        if self.closed_loop is not None:
            rows.append(("closed loop", f"{format_eigenvalues(compute_eigenvalues(self.closed_loop))} 1/s"))
        rows += [("note", note) for note in self.notes]
        return Summary(f"LinearModel of {self.name} {self.at}: {size}", rows)

    def save(self, path: str | Path) -> Path:
        """Write the model to a file, NumPy's npz without pickle (docs/reference/run_file.md).

        The file is written completely or not at all.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        require_path(path, "LinearModel.save: path")
        path = Path(path)
        names = (*"ABCD", "q_tree", "v_tree", "tau", "motions", "eigenvalues")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in names}
        labels = ("states", "inputs", "outputs", "coordinates")
        arrays |= {name: np.array(getattr(self, name), dtype=str) for name in labels}
        meta = {"name": self.name, "at": self.at, "t": self.t, "locked": self.locked, "notes": self.notes}
        if self.closed_loop is not None:
            arrays["closed_loop"] = self.closed_loop
        with open_atomic(path) as file:
            np.savez_compressed(file, **arrays, meta=np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8))
        return path


def _describe_mode(mode: Mode) -> str:
    if not mode.frequency:
        return mode.description
    value = mode.eigenvalue
    real = 0.0 if abs(mode.damping_ratio) < MIN_DAMPING_RATIO else value.real
    return f"{mode.description}, eigenvalue {real:.6g} +- {value.imag:.6g}i 1/s"


def _make_distinct(names: Sequence[str]) -> list[str]:
    """Replace dots by underscores, and number the names that are equal then."""
    distinct: list[str] = []
    for name in names:
        base = name.replace(".", "_")
        numbered = (f"{base}_{k}" for k in count(2))
        distinct.append(base if base not in distinct else next(x for x in numbered if x not in distinct))
    return distinct


def _join_names(names: Sequence[str]) -> str:
    """Join names, the last ones replaced by their number if there are many."""
    if len(names) > MAX_NAMES:
        names = (*names[: MAX_NAMES - 1], f"{len(names) - MAX_NAMES + 1} more")
    return ", ".join(names)


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
    forces: Sequence[BodyForce] = (),
    correction: Array | None = None,
    notes: tuple[str, ...] = (),
) -> LinearModel:
    """Linearize eq. 1 about a state.

    Parameters
    ----------
    terms : Terms
        A state on the constraint manifold.
    tau : (motors,) array
        Motor torques at the state.
    at : str
        Description of the state.
    t : float, optional
        Time of a state of a run, s.
    u_tree : (n,) array, optional
        Other forces on the tree that do not depend on the state, such as friction of sliding joints.
    locked : int array, optional
        Coordinates of joints that stick or are at a stop.
    smoothing : float, optional
        Rate over which dry friction grows, as a scene's friction_smoothing.
    library : Library, optional
        Compiled terms of the mechanism.
    forces : sequence of BodyForce, optional
        Constant forces on links, whose components become inputs.
    correction : (rows,) array, optional
        Minus the prescribed acceleration of the constraint rows.
    notes : tuple of str, optional
        Notes about the state, which come before those about the model.

    Raises
    ------
    NumericalError
        J has lost rank.
    InputError
        No freedom remains, a freedom moves no mass, or the ends of a spring coincide.
    """
    mechanism = terms.mechanism
    names = tuple(mechanism.coordinates[k] for k in locked)
    if coincident := mechanism.springs.find_without_direction(terms.q_tree, COINCIDENCE_TOLERANCE * mechanism.size):
        raise InputError(
            f"{mechanism.name}: the linear model does not exist there: the ends of {_join_names(tuple(coincident))} "
            "coincide, so the direction of its force is undefined; choose another configuration"
        )
    _require_mass(terms, locked)
    u_tree = mechanism.motors.force(tau) + u_tree
    plant = Plant(mechanism, smoothing, library).at(terms, u_tree, locked, forces, correction)
    push = unit_forces(forces, terms)
    u_tree = u_tree + generalized_force(body_wrenches(forces, 0.0, terms), terms)
    if not len(plant.at):
        raise InputError(f"{mechanism.name}: no freedom remains to linearize: {_explain_locked(mechanism, locked)}")
    if not np.all(np.isfinite(plant.A)):
        raise NumericalError(f"{mechanism.name}: the linear model does not exist there: its derivatives are not finite")
    chart = tuple(mechanism.coordinates[k] for k in plant.at)
    points = mechanism.point_jacobians(terms.q_tree)
    turns, zero = mechanism.motors.transmission.T, np.zeros((mechanism.n + 3 * len(points), len(plant.at)))
    positions = np.vstack([plant.T, *(x @ plant.T for x in points.values())])
    multipliers_by_q = plant.multipliers_q @ plant.T + plant.multipliers_v @ plant.V
    return LinearModel(
        name=mechanism.name,
        mechanism=mechanism,
        at=at,
        t=t,
        states=(*chart, *(f"v.{name}" for name in chart)),
        inputs=(
            *(f"tau.{motor}" for motor in mechanism.actuated),
            *(f"force.{force.name}.{component}" for force in forces for component in COMPONENTS),
        ),
        outputs=(
            *mechanism.coordinates,
            *(f"{name}.{axis}" for name in points for axis in "xyz"),
            *(f"loop.{loop}.{row}" for loop, row in mechanism.closure.names),
        ),
        A=plant.A,
        B=np.hstack([plant.B, np.vstack([np.zeros((len(chart), push.shape[1])), plant.a_u[plant.at] @ push])]),
        C=np.block([[positions, zero], [multipliers_by_q, plant.multipliers_v @ plant.T]]),
        D=np.vstack(
            [np.zeros((len(zero), turns.shape[1] + push.shape[1])), plant.multipliers_u @ np.hstack([turns, push])]
        ),
        q_tree=mechanism.tree.to_coordinates(terms.q_tree),
        v_tree=terms.v_tree,
        tau=tau,
        motions=plant.T,
        locked=names,
        notes=(*notes, *_describe_validity(terms, u_tree, plant, names)),
    )


def _require_mass(terms: Terms, locked: IntArray) -> None:
    """Raise InputError if a freedom moves no mass."""
    tangent = compute_velocity_basis(terms)
    tangent = tangent @ orthonormal_null_space(tangent[locked] / terms.mechanism.tree.step_scale[locked, None])
    if tangent.shape[1]:
        require_mass(terms, tangent, np.arange(terms.mechanism.n))


def _explain_locked(mechanism: Mechanism, locked: IntArray) -> str:
    if not len(locked):
        return "d = 0"
    names = ", ".join(mechanism.coordinates[k] for k in locked)
    remedy = "; friction_smoothing lets them slide" if np.any(mechanism.joints.friction[locked]) else ""
    return f"its joints stick or are at stops ({names}){remedy}"


def _describe_validity(
    terms: Terms, u_tree: Array, plant: AccelerationDerivatives, locked: tuple[str, ...]
) -> list[str]:
    """Return notes on the choice of coordinates, on locked joints and on a state that does not remain at rest."""
    mechanism, notes = terms.mechanism, []
    chart = tuple(mechanism.coordinates[k] for k in plant.at)
    if locked:
        notes.append(f"locked by friction or a stop, so they do not move: {_join_names(locked)}")
    elif chart != mechanism.independent:
        verb = "does" if len(chart) == 1 else "do"
        notes.append(
            f"{', '.join(mechanism.independent)} {verb} not determine the configuration there; the states are those of "
            f"{', '.join(chart)}"
        )
    if not terms.v_tree.any() and has_unbalanced_force(terms, u_tree, plant.T):
        k = int(np.argmax(np.abs(plant.acceleration / mechanism.tree.step_scale)))
        rate = f"{plant.acceleration[k]:.4g} {mechanism.tree.units('/s^2')[k]}"
        notes.append(f"at rest but not in equilibrium: {mechanism.coordinates[k]} accelerates at {rate}")
    return notes
