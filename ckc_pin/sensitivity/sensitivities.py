"""Derivatives of a run with respect to parameters, by the variational equations in the step loop."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.base.atomic_files import open_atomic, write_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.tables import require_names, to_csv_text, to_data_frame
from ckc_pin.base.validation import describe_value, require_callable, require_path, require_type, suggest_name
from ckc_pin.control.controllers import ControlLaw, Controller
from ckc_pin.control.sampled import Sampled
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose
from ckc_pin.native import EventQuantity, NonDifferentiableReason
from ckc_pin.native.sensitivity_tables import SensitivityParameter
from ckc_pin.run.columns import derivative_unit, key_unit, list_quantities, unknown_quantity
from ckc_pin.run.events import Event
from ckc_pin.run.prepare import Prepared, prepare
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import Progress, build_run, record_rows
from ckc_pin.scene.scene import Scene, as_scene
from ckc_pin.sensitivity.parameters import sensitivity_setup

if TYPE_CHECKING:
    import pandas

    from ckc_pin.view.inline import Figures

__all__ = ["Sensitivities", "compute_point_sensitivities", "sensitivities"]

TABLE_ARRAYS = ("q_tree", "v_tree", "u", "tau", "point_positions")  # of the quantities whose derivatives are computed
POINT_PREFIX = "point:"  # older names of points begin with it
EXPECTED_NAMES = 'a list of names, as ["link.link_2.mass"]'


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(HasSummary):
    """A run with its derivatives with respect to parameters, at fixed times.

    Attributes
    ----------
    run : Run
    parameters : tuple of str
        The columns. A vector has three of them.
    q_tree, v_tree : (m, n, p) arrays
        By output instant, coordinate and parameter: rad, m, rad/s or m/s for the parameter's unit. A free root has the
        twist in its own axes, and the derivative of the twist's rate.
    u, tau : (m, d, p) and (m, motors, p) arrays
        Derivatives of `Run.u` and `Run.tau`; zero without a controller. `tau` is NaN if the mechanism has more motors
        than freedoms.
    end_time : (p,) array or None
        Derivative of the time of the event that ended the run, s; None if no such event did.
    sensitivity_parameters : tuple of SensitivityParameter
        How each parameter acts.
    """

    run: Run
    parameters: tuple[str, ...]
    q_tree: Array
    v_tree: Array
    u: Array
    tau: Array
    end_time: Array | None
    sensitivity_parameters: tuple[SensitivityParameter, ...]

    @property
    def t(self) -> Array:
        """Output instants, s."""
        return self.run.t

    @lazy
    def points(self) -> dict[str, Array]:
        """Derivatives of the positions of the mechanism's points, (m, 3, p) each, in world axes."""
        mechanism = self.run.mechanism
        return compute_point_sensitivities(mechanism, self.sensitivity_parameters, self.run.q_tree, self.q_tree)

    def __getitem__(self, key: str | tuple[str, str]) -> Array:
        """Return the derivatives of a quantity by its name, as ``run[name]`` takes it.

        Parameters
        ----------
        key : str or (str, str)
            ``result["theta_1"]`` has a column for each parameter, shape (m, p).
            ``result["tip.x", "link.rod.mass"]`` is the derivative with respect to one of them, shape (m,).

        Raises
        ------
        InputError
            Unknown quantity or parameter, or a quantity whose derivative is not computed. The message lists valid ones.
        """
        name, parameter = key if isinstance(key, tuple) and len(key) == 2 else (key, None)
        quantity = list_quantities(self.run.mechanism).get(str(name).removeprefix(POINT_PREFIX))
        arrays: dict[str, Array] = {"q_tree": self.q_tree, "v_tree": self.v_tree, "u": self.u, "tau": self.tau}
        if quantity is not None and quantity.array == "point_positions":
            arrays["point_positions"] = np.concatenate([*self.points.values()], axis=1)
        if quantity is None:
            raise unknown_quantity(f"sensitivities[{describe_value(name)}]", name, self.run.mechanism)
        if quantity.array not in arrays:
            raise InputError(
                f"sensitivities[{describe_value(name)}]: this derivative is not computed; there are those of "
                "coordinates, of v., u., tau., and of the positions of points"
            )
        values = arrays[quantity.array][:, quantity.column]
        if parameter is None:
            return values
        if parameter not in self.parameters:
            nearest = suggest_name(parameter, self.parameters)
            raise InputError(f"no parameter {parameter!r} among these; there are {', '.join(self.parameters)}{nearest}")
        return np.array(values[:, self.parameters.index(parameter)], dtype=float)

    def of(self, name: str, parameter: str) -> Array:
        """Return the derivative of a quantity with respect to a parameter along the run, shape (m,).

        Parameters
        ----------
        name : str
            A coordinate, ``theta_1``, or its rate, ``v.theta_1``; a force on an independent coordinate, ``u.theta_1``;
            a motor torque, ``tau.MOTOR``; a coordinate of a point, ``tip.x`` (formerly ``point:tip.x``).
        parameter : str
            One of `parameters`.

        Raises
        ------
        InputError
            Unknown quantity or parameter. The message lists the valid ones.
        """
        return self[name, parameter]

    def summary(self) -> Summary:
        """Return the largest derivatives of independent coordinates and points, as `repr` and a notebook show them."""
        run = self.run
        tree, indices = run.mechanism.tree, [run.coordinates.index(name) for name in run.independent]
        names = [*run.independent, *self.points]
        units = [*(tree.units()[k] for k in indices), *("m" for _ in self.points)]
        rows: list[Row] = [
            ("instants", f"{len(self.t)}, from t = {self.t[0]:g} to {self.t[-1]:g} s"),
            ("largest along it", ""),
        ]
        for k, name in enumerate(self.parameters):
            unit = key_unit(run.mechanism, name)
            largest = [np.abs(self.q_tree[:, j, k]).max() for j in indices]
            largest += [np.linalg.norm(array[:, :, k], axis=1).max() for array in self.points.values()]
            quantity_units = [derivative_unit(quantity_unit, unit) for quantity_unit in units]
            rows.append((f"by {name}", format_quantities(names, np.array(largest), quantity_units, 4)))
        if self.end_time is not None:
            delays = zip(self.parameters, self.end_time.tolist(), strict=True)
            rows.append(
                ("end time", [f"{x:.4g} {derivative_unit('s', key_unit(run.mechanism, name))}" for name, x in delays])
            )
        outcome = run.message if run.message.startswith(run.status) else f"{run.status}: {run.message}"
        return Summary(f"Sensitivities of {run.scene_name}, {outcome}", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the derivatives as JSON-ready data; lists are by instant, coordinate and parameter."""
        run = self.run
        names = {"coordinates": run.coordinates, "independent": run.independent, "actuated": run.actuated}
        arrays = {name: getattr(self, name).tolist() for name in ("t", "q_tree", "v_tree", "u", "tau")}
        return {
            "name": run.scene_name, "status": run.status, "message": run.message,
            "parameters": list(self.parameters), **{key: list(x) for key, x in names.items()}, **arrays,
            "points": {name: x.tolist() for name, x in self.points.items()},
            "end_time": None if self.end_time is None else self.end_time.tolist(),
            "stats": run.stats,
        }  # fmt: skip

    # --- figures, export -------------------------------------------------------------------------

    def plot(self) -> Figures:
        """Draw the derivatives over time. A notebook shows the figure and `save(folder)` writes it."""
        import ckc_pin

        return ckc_pin.plot(self)

    def to_pandas(self, columns: Sequence[str] | None = None) -> pandas.DataFrame:
        """Return a pandas DataFrame by t with a column for each quantity and parameter (needs the extra `data`).

        Its columns have two levels: ``frame["theta_1"]`` has a column for each parameter, and
        ``frame["theta_1", "link.rod.mass"]`` is one curve, as in ``result["theta_1", "link.rod.mass"]``.

        Parameters
        ----------
        columns : sequence of str, optional
            As for `to_csv`.
        """
        frame = to_data_frame("t", self.t, self._list_columns(columns, "Sensitivities.to_pandas"))
        return frame.rename_axis(columns=["quantity", "parameter"])

    def to_csv(self, path: str | Path, columns: Sequence[str] | None = None) -> Path:
        """Write the derivatives as CSV, with all digits of each number.

        The columns are t and one for each quantity and parameter, ``theta_1 by link.rod.mass``.

        Parameters
        ----------
        path : str or Path
        columns : sequence of str, optional
            Names of quantities as in ``result[name]``. Default: coordinates, ``v.``, ``u.``, ``tau.`` and positions of
            points.

        Raises
        ------
        InputError
            The file cannot be written, or a quantity is unknown or has no derivative here.
        """
        require_path(path, "Sensitivities.to_csv: path")
        pairs = self._list_columns(columns, "Sensitivities.to_csv")
        named = {f"{quantity} by {parameter}": values for (quantity, parameter), values in pairs.items()}
        write_atomic(Path(path), to_csv_text("t", self.t, named))
        return Path(path)

    def _list_columns(self, columns: Sequence[str] | None, where: str) -> dict[tuple[str, str], Array]:
        """Return the columns of the table by quantity and parameter."""
        if columns is None:
            quantities = list_quantities(self.run.mechanism).items()
            names = [name for array in TABLE_ARRAYS for name, quantity in quantities if quantity.array == array]
        else:
            names = require_names(columns, where)
        return {
            (name, parameter): values
            for name in names
            for parameter, values in zip(self.parameters, self[name].T, strict=True)
        }

    def save(self, path: str | Path) -> Path:
        """Write the derivatives to a file, NumPy's npz without pickle (docs/reference/run_file.md).

        The file is written completely or not at all.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        require_path(path, "Sensitivities.save: path")
        run, path = self.run, Path(path)
        meta = {"name": run.scene_name, "status": run.status, "message": run.message}
        names = {"parameters": self.parameters, "coordinates": run.coordinates, "independent": run.independent,
                 "actuated": run.actuated, "points": tuple(self.points)}  # fmt: skip
        no_points = np.zeros((len(self.t), 0, 3, len(self.parameters)))
        arrays = {
            **{name: getattr(self, name) for name in ("t", "q_tree", "v_tree", "u", "tau")},
            **{key: np.array(x, dtype=str) for key, x in names.items()},
            "point_moved": np.stack(list(self.points.values()), axis=1) if self.points else no_points,
            "end_time": np.full(len(self.parameters), np.nan) if self.end_time is None else self.end_time,
            "meta": np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8),
        }
        with open_atomic(path) as file:
            np.savez_compressed(file, **arrays)
        return path


def sensitivities(
    scene: Scene | str | Path,
    parameters: Sequence[str],
    overrides: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    *,
    controller: Controller | Sampled | ControlLaw | Mapping[str, Any] | None = None,
    events: Sequence[Event | Mapping[str, Any]] = (),
    instants: Array | None = None,
    directions: Mapping[str, Mapping[str, float]] | None = None,
) -> Sensitivities:
    """Run a scene and compute the derivatives of its motion with respect to parameters.

    The variational equations S' = f_y S + f_p are integrated together with eq. 1, under the same tolerances. They are
    independent of the choice of coordinates. S jumps where a joint sticks, slides, touches a stop or bounces
    (saltation). The derivatives are exact, except that a caller's controller is differentiated by finite differences.

    Parameters
    ----------
    scene : Scene, str or Path
    parameters : sequence of str
        Any named parameter of the mechanism (docs/reference/parameters.md): ``link.NAME.mass`` (the same body with
        another density), ``joint.NAME.xyz``, ``spring.K.stiffness``, ``motor.NAME.ratio``, ``gravity`` and others; K
        counts from 0. Of the controller ``controller.K_P``, ``controller.K_P.NAME``, ``controller.K_V`` and others. Of
        the start ``initial.q.NAME`` and ``initial.q_dot.NAME``. The name of a vector stands for its components, which
        end in ``.x``, ``.y`` and ``.z``.
        The `model` of a controller does not depend on the parameters. Eq. 14 without a model compensates the gravity
        of the mechanism with its parameters.
    overrides : mapping, optional
        As in `simulate`.
    progress : callable, optional
        As in `simulate`.
    controller : Controller, Sampled, function or mapping, optional
        As in `simulate`; it must give u. It is differentiated by central differences, with 4 n calls for each
        right-hand side or sample.
    events : sequence of Event or mapping, optional
        As in `simulate`.
    instants : (m,) array, optional
        Output instants, instead of the scene's, s: increasing, from 0 to at most t_end.
    directions : mapping of str to mapping of str to float, optional
        Directional derivatives by name, after those of the parameters: coefficients of masses, centres of mass and
        inertias of links, as ``{"all masses": {"link.rod.mass": 1.0, "link.crank.mass": 0.5}}``.

    Returns
    -------
    Sensitivities

    Raises
    ------
    InputError
        Unknown parameter, or unsupported scene: a sensor or drive, an SPF off phi = 0, a caller's controller that reads
        terms which depend on the parameters, or a start with `at = "assembled"` whose q_guess is beyond a stop.
    NumericalError
        The start is singular, or the motion has no derivative there.
    MechanismError
        As in `simulate`.
    """
    scene = as_scene(scene, overrides, "sensitivities")
    require_callable(progress, "sensitivities: progress", "a function of (t, t_end)")
    parameters = [parameters] if isinstance(parameters, str | bytes) else parameters
    require_type(parameters, Sequence, "sensitivities: parameters", EXPECTED_NAMES)
    for name in parameters:
        require_type(name, str, "sensitivities: parameters", EXPECTED_NAMES)
    if not parameters and not directions:
        raise InputError("sensitivities: name at least one parameter")
    setup = sensitivity_setup(tuple(parameters), directions)
    ready = prepare(scene, controller, events, set_up_sensitivities=setup)
    if instants is not None:
        ready = replace(ready, instants=_require_instants(instants, scene.spec.t_end))
    started = perf_counter()
    try:
        rows, status, message = record_rows(ready, progress)
    except NumericalError as error:
        if (reason := _explain_missing_derivative(ready)) is None:
            raise
        raise NumericalError(f"sensitivities: {reason}", t=0.0) from error
    message = _explain_missing_derivative(ready) or message
    _require_independent_terms(ready)
    run = build_run(ready, rows, status=status, message=message, wall_s=perf_counter() - started)
    run.stats["changes_by_terms"] = dict(zip(("generated", "pinocchio"), ready.loop.rate_evaluations(), strict=True))
    q_tree, v_tree, u, tau = _split_rows(ready, rows)
    if np.isnan(q_tree[0]).any():
        raise NumericalError(f"sensitivities: {_explain_start(ready)}", t=0.0)
    sensitivity_parameters = _sensitivity_parameters(ready)
    names = tuple(x.name for x in sensitivity_parameters)
    return Sensitivities(run, names, q_tree, v_tree, u, tau, _compute_end_time(ready), sensitivity_parameters)


def _require_instants(instants: Array, t_end: float) -> Array:
    times = np.asarray(instants, dtype=float)
    valid = times.ndim == 1 and len(times) > 0 and times[0] == 0 and times[-1] <= t_end and np.all(np.diff(times) > 0)
    if not valid:
        raise InputError(
            f"sensitivities: instants: expected increasing times from 0 to at most t_end = {t_end:g} s, "
            f"got {describe_value(instants)}"
        )
    return times


def _sensitivity_parameters(ready: Prepared) -> tuple[SensitivityParameter, ...]:
    return ready.sensitivities.sensitivity_parameters if ready.sensitivities else ()


# --- motions without a derivative ----------------------------------------------------------------


def _explain_missing_derivative(ready: Prepared) -> str | None:
    """Return why the motion is not differentiable where the run stopped, or None."""
    event = ready.loop.non_differentiable_event()
    if event is None:
        return None
    joint, parameter = ready.mechanism.coordinates[event.coordinate], _sensitivity_parameters(ready)[event.parameter]
    t, name = float(ready.loop.t), parameter.name
    where = "at the start" if t == 0.0 else f"at t = {t:.6g} s"
    if t == 0.0 and parameter.assembled_at == event.coordinate:
        cause = f"{joint} is assembled at its stop, and a step in {name} moves its start for one sign only"
    elif event.reason == NonDifferentiableReason.MARGINALLY_LOCKED:
        cause = f"the holding force of {joint} is at its limit, and one sign of a step in {name} releases {joint}"
    elif event.reason == NonDifferentiableReason.RESTITUTION:
        cause = (
            f"{joint} and joints that move only with it hit their stops at the same instant, and a step in {name} "
            "changes which of their restitutions counts"
        )
    elif event.of_rate:
        cause = f"{joint} begins to move from rest, and after a step in {name} it is not at rest at this instant"
    else:
        cause = f"{joint} comes to its stop, and after a step in {name} it is not at its stop at this instant"
    return f"stopped {where}: {cause}; the one-sided derivatives differ, so the motion has no derivative"


def _require_independent_terms(ready: Prepared) -> None:
    """Refuse a caller's controller that has read terms which depend on the parameters (InputError)."""
    parameters = _sensitivity_parameters(ready)
    name = next((x.name for x in parameters if any(derivative.changes_terms for derivative in x.derivatives)), None)
    if name is not None and ready.loop.term_requested:
        raise InputError(
            f"sensitivities: {name}: the controller reads terms whose parameter dependence is unknown; "
            "use q, q_dot, q_tree and v_tree, and the terms of a separate mechanism"
        )


def _explain_start(ready: Prepared) -> str:
    """Return why the derivatives of the start are unknown."""
    mechanism = ready.mechanism
    names = ", ".join(mechanism.independent)
    if ready.scene.spec.initial.at == "equilibrium":
        return (
            "the derivatives of the start are unknown: the equilibrium is not isolated, or "
            f"{names} do not determine the configuration there"
        )
    verb = "does" if len(mechanism.independent) == 1 else "do"
    return (
        f"at the start phi_z is singular: {names} {verb} not determine the other coordinates; choose other independent "
        "coordinates"
    )


# --- results ---------------------------------------------------------------------------------------


def _split_rows(ready: Prepared, rows: Array) -> list[Array]:
    """Return the derivatives of q', v', u and tau, (m, size, p) each, from the columns that follow the motion's."""
    mechanism, p = ready.mechanism, len(_sensitivity_parameters(ready))
    sizes = [2 * mechanism.n, mechanism.d, len(mechanism.actuated)]
    end = rows.shape[1] - p * sum(sizes)
    arrays = []
    for size in sizes:
        columns = rows[:, end : end + p * size].reshape(len(rows), p, size).transpose(0, 2, 1)
        arrays.append(np.array(columns, dtype=float))
        end += p * size
    q_and_v, u, tau = arrays
    return [q_and_v[:, : mechanism.n], q_and_v[:, mechanism.n :], u, tau]


def _compute_end_time(ready: Prepared) -> Array | None:
    """Return the derivative of the time of the event that ended a run, (p,) in s."""
    last = [event for x in ready.loop.occurrences() if (event := ready.events[x.event]).stop]
    if not last:
        return None
    final = last[-1].event
    if final.quantity not in (EventQuantity.Q, EventQuantity.Q_DOT):
        return None
    return ready.loop.time_shifts(final.coordinate, of_rate=final.quantity == EventQuantity.Q_DOT)


def compute_point_sensitivities(
    mechanism: Mechanism, parameters: Sequence[SensitivityParameter], q_tree: Array, by_parameter: Array
) -> dict[str, Array]:
    """Return the derivatives of the positions of a mechanism's points.

    Parameters
    ----------
    mechanism : Mechanism
    parameters : sequence of SensitivityParameter
    q_tree : (m, n) array
        Coordinates by instant.
    by_parameter : (m, n, p) array
        Their derivatives; of a free root as a twist in its own axes.

    Returns
    -------
    dict of str to (m, 3, p) arrays
        In world axes, m for the parameter's unit.
    """
    positions = {name: np.zeros((len(q_tree), 3, len(parameters))) for name in mechanism.points}
    if not positions:
        return positions
    placing = [(k, parameter) for k, parameter in enumerate(parameters) if parameter.placements]
    for row, (coordinates, derivative) in enumerate(zip(q_tree, by_parameter, strict=True)):
        q = mechanism.tree.from_coordinates(coordinates)
        for name, jacobian in mechanism.point_jacobians(q).items():
            positions[name][row] = jacobian @ derivative
        if not placing:
            continue
        pose = Pose(mechanism.tree, mechanism.closure.anchors, q)
        for number, (name, position) in enumerate(mechanism.point_positions(q).items()):
            carriers = set(mechanism.tree.model.supports[mechanism.points[name].joint])
            for k, parameter in placing:
                positions[name][row, :, k] += _displace_by_placement(parameter, number, carriers, position, pose)
    return positions


def _displace_by_placement(
    parameter: SensitivityParameter, number: int, carriers: set[int], position: Array, pose: Pose
) -> Array:
    """Return the derivative of a point's position by its own placement and by that of the joints that carry it."""
    total = np.zeros(3)
    for derivative in parameter.placements:
        assert derivative.placement is not None
        placed, index = derivative.placement.placed, derivative.index
        if (placed == "joint" and index in carriers) or (placed == "reported" and index == number):
            axis = pose.rotation[derivative.placement.carrier] @ derivative.placement.axis
            arm = position - pose.translation[derivative.placement.carrier]
            total += derivative.values[0] * (np.cross(axis, arm) if derivative.placement.revolute else axis)
    return total
