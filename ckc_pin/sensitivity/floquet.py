"""How a periodic motion answers to a push: its monodromy matrix and Floquet multipliers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.base.summary import format_eigenvalues

if TYPE_CHECKING:
    from rich.text import Text

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.point_path import PointPath
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.control.torques import Torques
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.prepare import prepare
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import Progress, simulate
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.parts import scene_controller, scene_mechanism
from ckc_pin.scene.scene import Scene, apply_overrides, as_scene, make_scene
from ckc_pin.sensitivity.parameters import derivatives_of
from ckc_pin.sensitivity.sensitivities import sensitivities

__all__ = ["Floquet", "floquet"]

RETURNS = 1e-5  # rad, m and their rates, of the motion's own size: a motion that comes back
SHARE, ROUNDING = 1e-2, 1e-9  # of how far it goes, if that is little: what hardly moves has not come back from anywhere
LEAST = 1e-9  # s: nothing moves in less
CLOCK = 1e-12  # of a period: how near its end is to a sample
INSTANTS = 24  # at which what drives it is compared with a period later
BETWEEN = 9  # steps from a multiplier to the unit circle


@dataclass(frozen=True, eq=False, repr=False)
class Floquet(HasSummary):
    """A periodic motion to first order.

    Attributes
    ----------
    states : tuple of str
        Rows and columns: the independent coordinates, then their rates.
    monodromy : (2 d, 2 d) array
        What a small change of the start has become after a period.
    multipliers : (2 d,) complex array
        Its eigenvalues, the largest first: beyond 1 in size the motion is unstable.
    stable : bool or None
        Whether pushes die out; False where one grows. None where the largest multiplier is 1 in size, to within
        `uncertainty`.
    uncertainty : float
        By how much the monodromy matrix may be another one, of its norm: what the motion misses of coming back, and
        its tolerance; coordinates by their reach, rates by that in 1 / 2 pi of a period. A double multiplier at 1 moves
        by the root of it.
    period : float
        s.
    run : Run
    """

    states: tuple[str, ...]
    monodromy: Array
    multipliers: np.ndarray[Any, np.dtype[np.complex128]]
    stable: bool | None
    uncertainty: float
    period: float
    run: Run

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return floquet_summary(self)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON has it, complex numbers as [re, im]."""
        return {
            "name": self.run.scene_name,
            "states": list(self.states),
            "period": self.period,
            "monodromy": self.monodromy.tolist(),
            "multipliers": [[float(x.real), float(x.imag)] for x in self.multipliers],
            "stable": self.stable,
            "uncertainty": self.uncertainty,
        }


def floquet(
    scene: Scene | str | Path,
    period: float,
    overrides: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Floquet:
    """Return the monodromy matrix and the Floquet multipliers of a scene's motion, which is periodic from its start.

    Parameters
    ----------
    scene : str, Path or Scene
    period : float
        s.
    overrides : mapping, optional
        As of `simulate`.
    progress : callable, optional
        Called as progress(t, period) along the variational equations, every 0.05 s or so.

    Returns
    -------
    Floquet

    Raises
    ------
    InputError
        The motion, or what drives it, does not come back after the period: the message says by how much it misses.
    NumericalError
        It does not get to its end.
    """
    if not is_number(period):
        raise InputError(f"floquet: period: {describe_value(period)} was given; it takes a number of seconds")
    if not np.isfinite(period) or period <= 0:
        raise InputError(f"period = {period:g}: a positive number of seconds is needed")
    if period < LEAST:
        raise InputError(f"period = {period:g} s is none: nothing moves in less than {LEAST:g} s")
    given = as_scene(scene, overrides, "floquet")
    loaded = make_scene(apply_overrides(given.to_dict(), {"t_end": float(period)}), given.name, given.sources)
    mechanism = scene_mechanism(loaded)
    if root := mechanism.independent_root_coordinates:
        raise InputError(
            f"{mechanism.name}: the independent coordinate {root[0]!r} belongs to a free root, whose rotation has no "
            "monodromy matrix; choose other independent coordinates, or fix the root"
        )
    if isinstance(loaded.spec.controller, FeedbackSpec) and loaded.spec.controller.sample_time is not None:
        _require_whole_samples(loaded.spec.controller, loaded.spec.controller.sample_time, float(period), loaded.name)
    if (drive := _drive(scene_controller(loaded, mechanism), mechanism)) is not None:
        _require_period_of_drive(drive, float(period))
    if loaded.spec.initial.at is not None:
        loaded = _from_coordinates(loaded, mechanism)
    names = mechanism.independent
    pushes = [f"initial.{of}.{name}" for of in ("q", "q_dot") for name in names]
    try:
        prepare(loaded, derivatives=derivatives_of(pushes))  # what has no derivatives is refused before anything is run
    except InputError as error:
        raise InputError(f"floquet: {str(error).removeprefix('sensitivities: ')}") from None
    _miss(simulate(loaded), period)  # the motion alone: the variational equations are 2 d more of it
    found = sensitivities(loaded, pushes, None, progress)
    run, q = found.run, mechanism.partition.q
    monodromy = np.concatenate([found.q_tree[-1][q], found.v_tree[-1][q]])
    multipliers = np.linalg.eigvals(monodromy).astype(np.complex128)
    order = np.argsort(-np.abs(multipliers), kind="stable")
    states = (*names, *(f"{name}_dot" for name in names))
    uncertainty = _miss(run, period) + loaded.spec.solver.rtol
    reach = mechanism.tree.step_scale[q]
    scale = np.concatenate([reach, 2 * np.pi / period * reach])
    stable = _verdict(monodromy / scale[:, None] * scale, multipliers, uncertainty)
    return Floquet(states, monodromy, multipliers[order], stable, uncertainty, float(period), run)


def _verdict(
    monodromy: Array, multipliers: np.ndarray[Any, np.dtype[np.complex128]], uncertainty: float
) -> bool | None:
    """Whether all multipliers are within the unit circle, or one beyond, of every matrix that near.

    A multiplier may be on it where, all the way to it, M - z I is as near to singular.
    """
    error = uncertainty * float(np.linalg.norm(monodromy, 2))
    on_circle = []
    for x in multipliers:
        way = np.geomspace(max(abs(x), 1e-300), 1.0, BETWEEN)
        rest = (monodromy - size * np.exp(1j * np.angle(x)) * np.eye(len(monodromy)) for size in way)
        on_circle.append(all(np.linalg.svd(matrix, compute_uv=False)[-1] <= error for matrix in rest))
    if np.any((np.abs(multipliers) > 1) & ~np.array(on_circle)):
        return False
    return None if any(on_circle) else True


class _Drive(NamedTuple):
    """What a scene gives over time: until when, and which of its numbers are angles."""

    what: str
    at: Callable[[float], Array]
    end: float
    turns: BoolArray


def _drive(law: SetPoint | Tracking | Torques | None, mechanism: Mechanism) -> _Drive | None:
    if isinstance(law, Torques):
        still = Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n))
        return _Drive("the torque over time", lambda t: law.tau(t, still), float(law.times[-1]), np.zeros(0, bool))
    if not isinstance(law, Tracking):
        return None
    way, turns = law.desired, ~mechanism.tree.in_metres[mechanism.partition.q]
    if isinstance(way, PointPath):
        way, turns = way.place, turns[:0]
    end = float(getattr(way, "end", np.inf))
    return _Drive("the desired motion", lambda t: np.concatenate(way(t)[:2]), end, turns)


def _require_whole_samples(controller: FeedbackSpec, sample_time: float, period: float, name: str) -> None:
    """Refuse a sampled controller that is not where it began at the period's end: about to look at q and q_dot."""
    if controller.delay > 0:
        raise InputError(
            f"{name}: controller.delay: what is on its way at the end of a period is part of the state, and the "
            "monodromy matrix is of q and q_dot; leave it out, or let check tell whether the sampled loop is stable"
        )
    samples = period / sample_time
    if not abs(samples - max(1.0, round(samples))) <= CLOCK * samples:
        raise InputError(
            f"{name}: controller.sample_time: period = {period:.9g} s is {samples:.9g} samples; the motion comes back "
            "to where it began after a whole number of them"
        )


def _require_period_of_drive(drive: _Drive, period: float) -> None:
    """Refuse what is desired, or torques over time, that is another a period later, as far as it is given."""
    for t in period * np.arange(INSTANTS) / INSTANTS:
        if t + period > drive.end * (1 + 1e-12):
            return
        before, after = drive.at(t), drive.at(t + period)
        miss, angles = after - before, len(drive.turns)
        miss[:angles] = np.where(drive.turns, _turned(miss[:angles]), miss[:angles])
        worst = float(np.abs(miss).max())
        if not worst <= RETURNS * max(1.0, float(np.abs(before).max())):
            raise InputError(
                f"period = {period:.9g} s is none: from t = {t:.6g} s to then {drive.what} is off by {worst:.6g}"
            )


def _turned(angle: Array) -> Array:
    """The rest of an angle, whole turns taken off."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def _from_coordinates(scene: Scene, mechanism: Mechanism) -> Scene:
    """Start where a scene does, with its coordinates as numbers: they are what is pushed."""
    start = find_start(mechanism, scene)
    q = mechanism.tree.named(mechanism.tree.to_coordinates(start.at.q_tree))
    return make_scene(
        apply_overrides(scene.to_dict(), {"initial": {"q": q, "q_dot": scene.spec.initial.q_dot}}),
        scene.name,
        scene.sources,
    )


def _miss(run: Run, period: float) -> float:
    """Return by how much a motion ends otherwise than it began, by its reach; turns of a joint are one place.

    Raises
    ------
    InputError
        Too much for a periodic one.
    """
    if run.status == "interrupted":
        raise interrupt_again(run.message)
    if run.status != "done" or run.t[-1] < period * (1 - 1e-12):
        raise NumericalError(f"floquet: the motion does not reach the end of its period: {run.message}")
    tree, largest = run.mechanism.tree, 0.0
    for what, values, unit in (("", run.q_tree, 1.0), (" (rate)", run.v_tree, 2 * np.pi / period)):
        miss = values[-1] - values[0]
        if not what:
            miss = np.where(tree.in_metres, miss, _turned(miss))
        scale = max(1.0, float(np.abs(values).max()))
        allowed = np.minimum(RETURNS * scale, ROUNDING * scale * min(1.0, period) + SHARE * np.ptp(values, axis=0))
        worst = int(np.argmax(np.abs(miss) / allowed))
        if not np.abs(miss[worst]) <= allowed[worst]:
            raise InputError(
                f"period = {run.t[-1]:.9g} s is none: after it {run.coordinates[worst]}{what} is off by "
                f"{miss[worst]:.6g} from its {values[0, worst]:.6g} at the start"
            )
        largest = max(largest, float(np.abs(miss / (unit * tree.step_scale)).max()))
    return largest


def floquet_summary(found: Floquet) -> Summary:
    """Return the multipliers of a periodic motion, and what they say."""
    return Summary(f"Floquet of {found.run.scene_name}, period {found.period:.9g} s", [
        ("states", list(found.states)),
        ("multipliers", format_eigenvalues(found.multipliers)),
        ("verdict", multipliers_say(found)),
    ])  # fmt: skip


def multipliers_say(found: Floquet) -> str:
    """Say what the multipliers of a periodic motion mean for it."""
    says = {
        False: "pushes grow, the motion is unstable",
        True: "pushes die out",
        None: "to first order pushes neither grow nor die out as a power",
    }[found.stable]
    largest = np.abs(found.multipliers[0])
    return f"largest {largest:.6g} in size: {says} (their matrix is known to {found.uncertainty:.1g})"


def floquet_text(found: Floquet) -> Text:
    """Return the multipliers of a periodic motion for people, and what they say."""
    from rich.text import Text

    return Text(
        f"Motion of {found.run.scene_name}, period {found.period:.9g} s\n"
        f"  states  {', '.join(found.states)}\n"
        f"  Floquet multipliers {format_eigenvalues(found.multipliers)}; {multipliers_say(found)}"
    )


def save_floquet(found: Floquet, path: Path) -> Path:
    """Write a periodic motion's monodromy matrix and multipliers as NumPy's npz without pickle (docs/reference.md).

    Raises
    ------
    InputError
        It cannot be written.
    """
    arrays: dict[str, Any] = {"monodromy": found.monodromy, "multipliers": found.multipliers}
    arrays |= {"states": np.array(found.states, dtype=str), "period": found.period, "name": found.run.scene_name}
    with open_atomic(path) as file:
        np.savez_compressed(file, **arrays)
    return path
