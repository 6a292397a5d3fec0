"""Section III-C, "no kinematic singularities occur along the trajectory": eq. 21 on both readings of Table I."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import Tracking
from ckc_pin.control.desired import Desired
from ckc_pin.control.workspace import follow_desired
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.five_bar import FIVE_BAR, PRINTED, elbow_distance, links

__all__ = ["Approach", "approach", "claims", "tracking", "widest"]

SAMPLES = 2000


@dataclass(frozen=True)
class Approach:
    """Distance of a desired trajectory from singular configurations of a five-bar.

    Attributes
    ----------
    leaves_at : float or None
        Time at which it leaves the workspace, s; None if it does not.
    out : (start, end) or None
        Interval in which the distance of the elbows exceeds the reach of the links, s.
    det, det_t : float
        Smallest |det phi_z| along it (m^2) and its time (s); NaN if it leaves the workspace.
    sigma_min, sigma_min_t : float
        Smallest singular value of phi_z along it (m) and its time (s).
    elbows, elbows_t : float
        Largest distance of the elbows (m) and its time (s).
    reach : float
        l2 + l4, m.
    """

    leaves_at: float | None
    out: tuple[float, float] | None
    det: float
    det_t: float
    sigma_min: float
    sigma_min_t: float
    elbows: float
    elbows_t: float
    reach: float


def approach(mechanism: Mechanism, desired: Desired, t_end: float) -> Approach:
    """Measure a five-bar's desired trajectory by continuation of sigma and by the distance of the elbows."""
    followed = follow_desired(mechanism, desired, t_end)
    elbows_t, elbows, reach = widest(mechanism, desired, t_end)
    lengths = links(mechanism)
    det_t, det = float("nan"), float("nan")
    if followed.leaves_at is None:
        det_t, det = _smallest_det(mechanism, desired, t_end)
    return Approach(
        leaves_at=followed.leaves_at,
        out=_interval_above_zero(lambda t: float(elbow_distance(lengths, *desired(t)[0])) - reach, elbows_t, t_end),
        det=det,
        det_t=det_t,
        sigma_min=followed.sigma_min,
        sigma_min_t=followed.closest_t,
        elbows=elbows,
        elbows_t=elbows_t,
        reach=reach,
    )


def widest(mechanism: Mechanism, desired: Desired, t_end: float) -> tuple[float, float, float]:
    """Return time (s) and value (m) of the largest distance of the elbows, and the reach l2 + l4 (m)."""
    lengths = links(mechanism)
    t = _minimize(lambda t: -float(elbow_distance(lengths, *desired(t)[0])), t_end)
    return t, float(elbow_distance(lengths, *desired(t)[0])), lengths.l2 + lengths.l4


def _smallest_det(mechanism: Mechanism, desired: Desired, t_end: float) -> tuple[float, float]:
    """Return time and value of the smallest |det phi_z| along sigma(q_d(t)), each sigma starting from the last."""
    last = [mechanism.assembled]

    def det(t: float) -> float:
        last[0] = sigma(mechanism, desired(t)[0], last[0]).at
        return abs(float(np.linalg.det(last[0].phi_z)))

    t = _minimize(det, t_end)
    return t, det(t)


def _minimize(f: Callable[[float], float], t_end: float) -> float:
    """Return the minimizer of f on [0, t_end]: the best sample, refined between its neighbours."""
    from scipy.optimize import minimize_scalar

    times = np.linspace(0.0, t_end, SAMPLES + 1)
    values = [f(t) for t in times]
    k = int(np.argmin(values))
    bounds = (times[max(k - 1, 0)], times[min(k + 1, SAMPLES)])
    finer = minimize_scalar(f, bounds=bounds, method="bounded", options={"xatol": 1e-10})
    return float(finer.x) if finer.fun < values[k] else float(times[k])


def _interval_above_zero(excess: Callable[[float], float], inside: float, t_end: float) -> tuple[float, float] | None:
    """Return the interval around a time in which a quantity is positive, None if it is not positive at that time."""
    from scipy.optimize import brentq

    if excess(inside) <= 0:
        return None
    times = np.linspace(0.0, t_end, SAMPLES + 1)
    below = np.array([excess(t) <= 0 for t in times])
    before, after = times[below & (times < inside)][-1], times[below & (times > inside)][0]
    return float(brentq(excess, before, inside, xtol=1e-13)), float(brentq(excess, inside, after, xtol=1e-13))


def tracking(name: str) -> tuple[Mechanism, Desired, float]:
    """Return mechanism, desired trajectory and t_end of a mechanism's tracking scene."""
    scene = load_scene(f"{name}/tracking")
    mechanism = load_scene_mechanism(scene)
    controller = build_scene_controller(scene, mechanism)
    if not isinstance(controller, Tracking):
        raise InputError(f"{scene.name}: it has no tracking controller")
    return mechanism, controller.desired, scene.spec.t_end


def claims(figures: Path) -> list[Claim]:
    """Answer whether eq. 21 stays away from singular configurations."""
    approaches = {name: approach(*tracking(name)) for name in (FIVE_BAR, PRINTED)}
    ours = simulate(f"{FIVE_BAR}/tracking")
    run = simulate(f"{PRINTED}/tracking")
    loose = {"solver.rtol": 1e-6}  # the other formulations only show where they stop
    stops = {how: simulate(f"{PRINTED}/tracking", {"formulation": how, **loose}) for how in ("reduced", "dae")}
    runs = {FIVE_BAR: ours, PRINTED: run}
    clear, leaves = approaches[FIVE_BAR].leaves_at is None, approaches[PRINTED].leaves_at is not None
    before, there = (np.abs(run.u[run.at(run.t[-1] - earlier)]).max() for earlier in (0.1, 0.0))
    return [
        Claim(
            key="no-singularities",
            verdict="holds with a condition" if clear and leaves else "holds" if clear else "does not hold",
            commands=(
                "ckc check five_bar/tracking",
                "ckc check five_bar_as_printed/tracking",
                "ckc run five_bar_as_printed/tracking; echo $?",
            ),
            figures=(_draw(figures, approaches, runs),),
            table=(("along eq. 21", *approaches), _rows(approaches, runs)),
            **render_blocks(
                "claims/no-singularities",
                t=run.t[-1],
                status=run.status,
                reduced=stops["reduced"].t[-1],
                dae=stops["dae"].t[-1],
                u=(before, there),
            ),
        )
    ]


def _rows(approaches: dict[str, Approach], runs: dict[str, Run]) -> tuple[tuple[str, ...], ...]:
    """Return the table: one row per quantity, one column per mechanism."""
    rows: list[tuple[str, Callable[[Approach], str]]] = [
        ("leaves the workspace", lambda a: "no" if a.leaves_at is None else f"at {a.leaves_at:.5f} s"),
        ("out of reach", lambda a: "never" if a.out is None else f"{a.out[0]:.5f} s to {a.out[1]:.5f} s"),
        ("smallest |det phi_z|", lambda a: "-" if np.isnan(a.det) else f"{a.det:.4f} m² at {a.det_t:.3f} s"),
        ("smallest sigma_min(phi_z)", lambda a: f"{a.sigma_min:.4f} m at {a.sigma_min_t:.3f} s"),
        ("elbows farthest apart", lambda a: f"{a.elbows:.4f} m at {a.elbows_t:.3f} s"),
        ("reach l2 + l4", lambda a: f"{a.reach:.4f} m"),
    ]
    smallest = ("smallest |det phi_z| of the run", *(f"{np.abs(_dets(run)).min():.1e} m²" for run in runs.values()))
    return (*((what, *(text(a) for a in approaches.values())) for what, text in rows), smallest)


def _dets(run: Run) -> Array:
    return np.array([np.linalg.det(run.mechanism.kinematics(q_tree).phi_z) for q_tree in run.q_tree])


def _draw(figures: Path, approaches: dict[str, Approach], runs: dict[str, Run]) -> str:
    figure, (left, right) = chart(2)
    for colour, (name, run) in zip(COLOURS, runs.items(), strict=False):
        mechanism, desired, t_end = tracking(name)
        times = np.linspace(0.0, t_end, 500)
        q_d = np.array([desired(float(t))[0] for t in times])
        left.plot(times, elbow_distance(links(mechanism), *q_d.T), color=colour, lw=2, label=f"{name}: eq. 21")
        left.axhline(approaches[name].reach, color=colour, ls="--", lw=1.2, label=f"{name}: l2 + l4")
        right.semilogy(run.t, np.abs(_dets(run)), color=colour, lw=2, label=f"{name}: run")
        _mark_stop(right, run, colour)
    left.set(xlabel="$t$ (s)", ylabel="distance of the elbows (m)", title="what eq. 21 asks for")
    right.set(xlabel="$t$ (s)", ylabel=r"$|\det\varphi_z|$ (m²)", title="what the closed loop does (x: stopped)")
    left.set_ylim(0.0, 0.75)
    left.legend(loc="lower right", fontsize=9, ncols=2)
    right.legend(loc="lower right", fontsize=9)
    right.axhline(approaches[FIVE_BAR].det, color=BLACK, lw=0.8, ls=":")
    return save(figure, figures, "along_eq21.png")


def _mark_stop(ax: Any, run: Run, colour: str) -> None:
    if run.status == "stopped":
        ax.plot(run.t[-1], np.abs(_dets(run))[-1], "x", color=colour, ms=10, mew=2)
