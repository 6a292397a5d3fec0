"""How a run changes with parameters, to first order, by the variational equations in the loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.kinds import require_callable, require_kind
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.prepare import Prepared, prepare
from ckc_pin.simulation.run import Run
from ckc_pin.simulation.scene import Scene, as_scene
from ckc_pin.simulation.simulate import Progress, run_of, run_rows
from ckc_pin.simulation.varying import varying_of

__all__ = ["Sensitivities", "sensitivities"]

NAMES = 'a list of names, as ["link.link_2.mass"]'
RATES = ("q", "q_dot")  # of which an event's time is known to change


@dataclass(frozen=True)
class Sensitivities:
    """A run with its derivatives by parameters, at fixed times.

    Attributes
    ----------
    run : Run
    parameters : tuple of str
        Columns; a vector's three components are three.
    q_tree, v_tree : (m, n, p) arrays
        By output instant, coordinate and parameter: rad, m, rad/s and m/s for the parameter's unit. Of a free root
        the twist in its own axes, and how the twist's rate changes.
    end_time : (p,) array or None
        How the time of the event that ended the run changes, s; None where it ended at `t_end`.
    """

    run: Run
    parameters: tuple[str, ...]
    q_tree: Array
    v_tree: Array
    end_time: Array | None

    @property
    def t(self) -> Array:
        """Output instants, s."""
        return self.run.t

    def of(self, coordinate: str, parameter: str) -> Array:
        """Return how a coordinate changes with a parameter along the run, shape (m,).

        Raises
        ------
        InputError
            No such coordinate or parameter; the message lists those there are.
        """
        if parameter not in self.parameters:
            raise InputError(f"no parameter {parameter!r} among these; there are {', '.join(self.parameters)}")
        if coordinate not in self.run.coordinates:
            raise InputError(f"no coordinate {coordinate!r}; there are {', '.join(self.run.coordinates)}")
        return np.array(
            self.q_tree[:, self.run.coordinates.index(coordinate), self.parameters.index(parameter)], dtype=float
        )


def sensitivities(
    scene: Scene | str | Path,
    parameters: Sequence[str],
    changes: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Sensitivities:
    """Run a scene together with how its motion changes with parameters, to first order.

    What is integrated beside eq. 1 are its variational equations, S' = f_y S + f_p, with S under the same tolerances as
    the motion. They hold through changes of coordinates; where a joint sticks, slides, touches or bounces, S jumps as
    the motion's kink or jump does (saltation). The derivatives are exact; none are differences.

    Parameters
    ----------
    scene : Scene, str or Path
    parameters : sequence of str
        Their names: ``link.NAME.mass`` (the same body of another density), ``.com``, ``.inertia.ixx``;
        ``joint.NAME.xyz``, ``.damping``, ``.friction``, ``.restitution``, ``.lower``, ``.upper``;
        ``loop.NAME.frame_a.xyz``, ``.frame_b.xyz``, ``.length``; ``coupling.K.offset``; ``spring.K.stiffness``,
        ``.damping``, ``.rest_length``, ``.rest``, ``.frame_a.xyz``; ``force.K.value``; ``gravity``;
        ``controller.K_P``, ``controller.K_P.NAME``, ``controller.K_V``; ``initial.q.NAME``, ``initial.q_dot.NAME``.
        K counts from 0. A vector stands for its components, which have ``.x``, ``.y`` and ``.z`` behind.
        A controller with a `model` keeps it; eq. 14 without one compensates what the changed mechanism needs.
    changes : mapping, optional
        As of `simulate`.
    progress : callable, optional
        As of `simulate`.

    Returns
    -------
    Sensitivities

    Raises
    ------
    InputError
        An unknown parameter, or a scene whose motion has no known derivatives: sampled control, an SPF off phi = 0.
    NumericalError
        A start that is singular; two joints that change what they do at the same instant.
    MechanismError
        As `simulate`.
    """
    scene = as_scene(scene, changes, "sensitivities")
    require_callable(progress, "sensitivities: progress", "a function of (t, t_end)")
    parameters = [parameters] if isinstance(parameters, str) else parameters
    require_kind(parameters, Sequence, "sensitivities: parameters", NAMES)
    for name in parameters:
        require_kind(name, str, "sensitivities: parameters", NAMES)
    if not parameters:
        raise InputError("sensitivities: name at least one parameter")
    ready = prepare(scene, parameters=tuple(parameters))
    labels = tuple(x.name for x in varying_of(ready.mechanism, scene, ready.controller, parameters))
    started = perf_counter()
    rows, status, message = run_rows(ready, progress)
    run = run_of(ready, rows, status, message, perf_counter() - started)
    if not ready.loop.together():
        t = float(ready.loop.t)
        raise NumericalError(
            f"sensitivities: at t = {t:.6g} s two joints come to a stop or to rest at once, and with these parameters "
            "one of them before the other: there the motion has no derivative",
            t=t,
        )
    n, p = ready.mechanism.n, len(labels)
    found = rows[:, rows.shape[1] - 2 * n * p :].reshape(len(rows), p, 2, n).transpose(2, 0, 3, 1)
    return Sensitivities(run, labels, found[0].copy(), found[1].copy(), _end_time(ready))


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
