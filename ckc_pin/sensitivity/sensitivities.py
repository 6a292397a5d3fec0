"""How a run changes with parameters, to first order, by the variational equations in the loop."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.validation import require_callable, require_path, require_type
from ckc_pin.control.controllers import ControlLaw, Controller
from ckc_pin.control.sampled import Sampled
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.native.variation import SensitivityParameter
from ckc_pin.run.columns import derivative_unit, key_unit
from ckc_pin.run.events import Event
from ckc_pin.run.prepare import Prepared, prepare
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import Progress, build_run, record_rows
from ckc_pin.scene.scene import Scene, as_scene
from ckc_pin.sensitivity.moved_points import moved_points
from ckc_pin.sensitivity.parameters import derivatives_of

__all__ = ["Sensitivities", "sensitivities"]

NAMES = 'a list of names, as ["link.link_2.mass"]'
RATES = ("q", "q_dot")  # of which an event's time is known to change


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(HasSummary):
    """A run with its derivatives by parameters, at fixed times.

    Attributes
    ----------
    run : Run
    parameters : tuple of str
        Columns; a vector's three components are three.
    q_tree, v_tree : (m, n, p) arrays
        By output instant, coordinate and parameter: rad, m, rad/s and m/s for the parameter's unit. Of a free root
        the twist in its own axes, and how the twist's rate changes.
    u, tau : (m, d, p) and (m, motors, p) arrays
        How eq. 6's force and the motors' torques change, as `Run.u` and `Run.tau` have them; NaN where motors that are
        more than freedoms share a force. Zero without a controller.
    end_time : (p,) array or None
        How the time of the event that ended the run changes, s; None where it ended at `t_end`.
    sensitivity_parameters : tuple of SensitivityParameter
        What the parameters do.
    """

    run: Run
    parameters: tuple[str, ...]
    q_tree: Array
    v_tree: Array
    u: Array
    tau: Array
    end_time: Array | None
    sensitivity_parameters: tuple[SensitivityParameter, ...]

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return sensitivities_summary(self)

    @property
    def t(self) -> Array:
        """Output instants, s."""
        return self.run.t

    @lazy
    def points(self) -> dict[str, Array]:
        """How the mechanism's points move, (m, 3, p) in world axes: with the coordinates, and with what places them."""
        return moved_points(self.run.mechanism, self.sensitivity_parameters, self.run.q_tree, self.q_tree)

    def of(self, name: str, parameter: str) -> Array:
        """Return how a quantity changes with a parameter along the run, shape (m,).

        Parameters
        ----------
        name : str
            A coordinate, ``theta_1``; with ``v.`` before it its rate; ``u.`` and an independent coordinate, ``tau.``
            and a motor, or a point's, ``point:tip.x``.
        parameter : str

        Raises
        ------
        InputError
            No such quantity or parameter; the message lists those there are.
        """
        if parameter not in self.parameters:
            raise InputError(f"no parameter {parameter!r} among these; there are {', '.join(self.parameters)}")
        curves = self._curves()
        if name not in curves:
            raise InputError(f"no {name!r}; there are {', '.join(curves)}")
        return np.array(curves[name][:, self.parameters.index(parameter)], dtype=float)

    def _curves(self) -> dict[str, Array]:
        """By name, (m, p)."""
        run, found = self.run, dict[str, Array]()
        parts = {"": (run.coordinates, self.q_tree), "v.": (run.coordinates, self.v_tree),
                 "u.": (run.independent, self.u), "tau.": (run.actuated, self.tau)}  # fmt: skip
        for prefix, (names, array) in parts.items():
            found |= {prefix + name: array[:, k] for k, name in enumerate(names)}
        for name, moved in self.points.items():
            found |= {f"point:{name}.{axis}": moved[:, k] for k, axis in enumerate("xyz")}
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return them as JSON has them; a row of each list an instant, by coordinate and parameter."""
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

    def save(self, path: str | Path) -> Path:
        """Write them to a file, NumPy's npz without pickle (docs/reference/run_file.md): whole or not at all.

        Raises
        ------
        InputError
            It cannot be written.
        """
        require_path(path, "Sensitivities.save: path")
        run, path = self.run, Path(path)
        about = {"name": run.scene_name, "status": run.status, "message": run.message}
        names = {"parameters": self.parameters, "coordinates": run.coordinates, "independent": run.independent,
                 "actuated": run.actuated, "points": tuple(self.points)}  # fmt: skip
        none = np.zeros((len(self.t), 0, 3, len(self.parameters)))
        arrays = {
            **{name: getattr(self, name) for name in ("t", "q_tree", "v_tree", "u", "tau")},
            **{key: np.array(x, dtype=str) for key, x in names.items()},
            "point_moved": np.stack(list(self.points.values()), axis=1) if self.points else none,
            "end_time": np.full(len(self.parameters), np.nan) if self.end_time is None else self.end_time,
            "meta": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
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
    controller: Controller | Sampled | ControlLaw | None = None,
    events: Sequence[Event] = (),
) -> Sensitivities:
    """Run a scene together with how its motion changes with parameters, to first order.

    What is integrated beside eq. 1 are its variational equations, S' = f_y S + f_p, with S under the same tolerances as
    the motion. They hold through changes of coordinates; where a joint sticks, slides, touches or bounces, S jumps as
    the motion's kink or jump does (saltation). The derivatives are exact; none are differences but those of a caller's
    own controller.

    Parameters
    ----------
    scene : Scene, str or Path
    parameters : sequence of str
        Every number of the mechanism that has a name (docs/reference/parameters.md), as ``link.NAME.mass`` (the same
        body of another density), ``joint.NAME.xyz``, ``spring.K.stiffness``, ``motor.NAME.ratio``, ``gravity``; K
        counts from 0. Of eq. 14 ``controller.K_P``, ``controller.K_P.NAME``, ``controller.K_V``; of the start
        ``initial.q.NAME``, ``initial.q_dot.NAME``. A vector stands for its components, which have ``.x``, ``.y`` and
        ``.z`` behind.
        A controller with a `model` keeps it; eq. 14 without one compensates what the changed mechanism needs.
    overrides : mapping, optional
        As of `simulate`.
    progress : callable, optional
        As of `simulate`.
    controller : Controller, Sampled or function, optional
        As of `simulate`, giving u. How u changes with the state is found by central differences, 4 n calls a
        right-hand side or a sample.
    events : sequence of Event, optional
        As of `simulate`.

    Returns
    -------
    Sensitivities

    Raises
    ------
    InputError
        An unknown parameter, or a scene whose motion has no known derivatives: with a sensor or a drive, an SPF off
        phi = 0, a caller's controller that looks at terms which change with the parameters; a stop that holds a start
        `at = "assembled"` back from q_guess.
    NumericalError
        A start that is singular; two joints that change what they do at the same instant.
    MechanismError
        As `simulate`.
    """
    scene = as_scene(scene, overrides, "sensitivities")
    require_callable(progress, "sensitivities: progress", "a function of (t, t_end)")
    parameters = [parameters] if isinstance(parameters, str | bytes) else parameters
    require_type(parameters, Sequence, "sensitivities: parameters", NAMES)
    for name in parameters:
        require_type(name, str, "sensitivities: parameters", NAMES)
    if not parameters:
        raise InputError("sensitivities: name at least one parameter")
    ready = prepare(scene, controller, events, derivatives=derivatives_of(tuple(parameters)))
    started = perf_counter()
    try:
        rows, status, message = record_rows(ready, progress)
    except NumericalError as error:
        if (apart := _apart(ready)) is None:
            raise
        raise NumericalError(f"sensitivities: {apart}", t=0.0) from error
    message = _apart(ready) or message
    _refuse_terms(ready)
    run = build_run(ready, rows, status=status, message=message, wall_s=perf_counter() - started)
    run.stats["changes_by_terms"] = dict(zip(("generated", "pinocchio"), ready.loop.rates_found(), strict=True))
    q_tree, v_tree, u, tau = _parts(ready, rows)
    if np.isnan(q_tree[0]).any():
        raise NumericalError(f"sensitivities: {_start(ready)}", t=0.0)
    sensitivity_parameters = _sensitivity_parameters(ready)
    names = tuple(x.name for x in sensitivity_parameters)
    return Sensitivities(run, names, q_tree, v_tree, u, tau, _end_time(ready), sensitivity_parameters)


def _sensitivity_parameters(ready: Prepared) -> tuple[SensitivityParameter, ...]:
    return ready.derivatives.sensitivity_parameters if ready.derivatives else ()


def _apart(ready: Prepared) -> str | None:
    """Say where a joint has no one time to change what it does."""
    found = ready.loop.apart()
    if found is None:
        return None
    coordinate, of_rate, parameter, reason = found
    joint, name, t = (
        ready.mechanism.coordinates[coordinate],
        _sensitivity_parameters(ready)[parameter].name,
        float(ready.loop.t),
    )
    where = "at the start" if t == 0.0 else f"at t = {t:.6g} s"
    if t == 0.0 and _sensitivity_parameters(ready)[parameter].assembled_at == coordinate:
        return (
            f"stopped {where}: {joint} is assembled at its stop, and with another {name} it starts elsewhere one way "
            "only, so that the motion has no derivative"
        )
    if reason == "let_go":
        return (
            f"stopped {where}: the force that holds {joint} is at its limit, and with another {name} {joint} is let go "
            "one way only, so that the motion has no derivative"
        )
    if reason == "restitution":
        return (
            f"stopped {where}: {joint} and joints that move only with it are thrown back by their stops at once, and "
            f"with another {name} by one of them alone: either way the motion goes on differently, so that it has no "
            "derivative"
        )
    what = f"{joint} begins to move from rest" if of_rate else f"{joint} comes to its stop"
    there = "at rest" if of_rate else "there"
    return (
        f"stopped {where}: {what}, and with another {name} it is not {there} just then: either way the motion goes on "
        "differently, so that it has no derivative"
    )


def _refuse_terms(ready: Prepared) -> None:
    """Refuse what a caller's controller makes of terms that are other ones with other parameters."""
    name = next((x.name for x in _sensitivity_parameters(ready) if any(effect.is_term for effect in x.effects)), None)
    if name is not None and ready.loop.asked():
        raise InputError(
            f"sensitivities: {name}: the controller looks at terms of the mechanism, which change with it in a way "
            "that it alone knows; let it take q, q_dot, q_tree and v_tree, and terms of a mechanism of its own"
        )


def _start(ready: Prepared) -> str:
    """Say why how the start changes is not known."""
    mechanism = ready.mechanism
    if ready.scene.spec.initial.at == "equilibrium":
        return (
            "the start is an equilibrium beside which there are others, or where "
            f"{', '.join(mechanism.independent)} are no coordinates: which one it is with other parameters is not known"
        )
    names = mechanism.independent
    return (
        f"at the start phi_z is singular: {', '.join(names)} {'does' if len(names) == 1 else 'do'} not determine the "
        "others, so that how they change is not known; other independent coordinates would"
    )


def _parts(ready: Prepared, rows: Array) -> list[Array]:
    """Split what the loop has recorded behind the motion: by parameter q' and v' together, then u, then tau."""
    mechanism, p = ready.mechanism, len(_sensitivity_parameters(ready))
    sizes = [2 * mechanism.n, mechanism.d, len(mechanism.actuated)]
    end = rows.shape[1] - p * sum(sizes)
    found = []
    for size in sizes:
        part = rows[:, end : end + p * size].reshape(len(rows), p, size).transpose(0, 2, 1)
        found.append(np.array(part, dtype=float))
        end += p * size
    q_and_v, u, tau = found
    return [q_and_v[:, : mechanism.n], q_and_v[:, mechanism.n :], u, tau]


def _end_time(ready: Prepared) -> Array | None:
    """How much later the event that ended a run comes with each parameter."""
    last = [event for _, k, _ in ready.loop.met() if (event := ready.events[k]).stop]
    if not last:
        return None
    of, coordinate = last[-1].row[:2]
    if of >= len(RATES):
        return None
    found: Array | None = ready.loop.delays(coordinate, RATES[of] == "q_dot")
    return found


def sensitivities_summary(found: Sensitivities) -> Summary:
    """Return how far each parameter moves the independent coordinates, and the points, at most along the run."""
    run = found.run
    tree, at = run.mechanism.tree, [run.coordinates.index(name) for name in run.independent]
    names = [*run.independent, *found.points]
    units = [*(tree.units()[k] for k in at), *("m" for _ in found.points)]
    rows: list[Row] = [
        ("instants", f"{len(found.t)}, from t = {found.t[0]:g} to {found.t[-1]:g} s"),
        ("largest along it", ""),
    ]
    for k, name in enumerate(found.parameters):
        unit = key_unit(run.mechanism, name)
        most = [np.abs(found.q_tree[:, j, k]).max() for j in at]
        most += [np.linalg.norm(moved[:, :, k], axis=1).max() for moved in found.points.values()]
        rows.append(
            (f"by {name}", format_quantities(names, np.array(most), [derivative_unit(one, unit) for one in units], 4))
        )
    if found.end_time is not None:
        shown = [f"{x:.4g} {derivative_unit('s', key_unit(run.mechanism, name))}" for name, x in
                 zip(found.parameters, found.end_time.tolist(), strict=True)]  # fmt: skip
        rows.append(("the end comes later by", shown))
    said = run.message if run.message.startswith(run.status) else f"{run.status}: {run.message}"
    return Summary(f"Sensitivities of {run.scene_name}, {said}", rows)
