"""Answer section III-A and Fig. 2: singularities of types 1 and 2, and whether freedoms are lost there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.analysis.singular_curve import SingularCurve, trace_singular
from ckc_pin.analysis.singularities import SingularPoint, search_singular
from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.crossing import Crossing, cross
from scripts.experiments.paper.five_bar import FIVE_BAR, PRINTED, Links, elbow_distance, links, wrap

__all__ = ["Locus", "claims", "loci"]

STARTS = 60
SAME_CURVE_RAD = 1e-6  # largest distance of a configuration from a curve that it lies on


@dataclass(frozen=True)
class Locus:
    """A curve of singular configurations of a five-bar, with measurements along it.

    Attributes
    ----------
    name : "type 1", "type 2" or "type 1, opened"
        The paper's name. "type 1, opened" is type 1 with l2 != l4, where the elbows are |l2 - l4| apart.
    point : SingularPoint
        One of its configurations.
    curve : SingularCurve
    q : (m, 2) array
        Its projection on (theta_1, theta_3), each within [-pi, pi).
    sigma_min_J : float
        Smallest along the curve.
    smallest_chart : float
        Smallest value along the curve of the best chart's sigma_min(phi_z).
    """

    name: str
    point: SingularPoint
    curve: SingularCurve
    q: Array
    sigma_min_J: float
    smallest_chart: float


def loci(mechanism: Mechanism, starts: int = STARTS) -> list[Locus]:
    """Search for singular configurations and trace a curve through each one that is on no other curve."""
    curves: list[Locus] = []
    for point in search_singular(mechanism, starts):
        if not any(_on(point, locus) for locus in curves):
            curves.append(_measure(mechanism, point, trace_singular(mechanism, point)))
    return sorted(curves, key=lambda locus: (locus.point.kind, *np.round(locus.q[0], 6)), reverse=True)


def _on(point: SingularPoint, locus: Locus) -> bool:
    """Whether a configuration is as near to a curve as the curve's points are to each other."""
    away = np.abs(wrap(locus.curve.q_tree - point.at.q_tree)).max(axis=1)
    stride = np.abs(wrap(np.diff(locus.curve.q_tree, axis=0))).max()
    return bool(away.min() <= max(stride, SAME_CURVE_RAD) and point.kind == locus.point.kind)


def _measure(mechanism: Mechanism, point: SingularPoint, curve: SingularCurve) -> Locus:
    along = [mechanism.kinematics(q) for q in curve.q_tree]
    charts = [list(z) for z in combinations(range(mechanism.n), mechanism.rank)]
    best = [max(float(np.linalg.svd(at.J[:, z], compute_uv=False)[-1]) for z in charts) for at in along]
    q, lengths = wrap(curve.q_tree[:, mechanism.partition.q]), links(mechanism)
    stretched = elbow_distance(lengths, *q[0]) > max(lengths.l2, lengths.l4)
    return Locus(
        name="type 1" if point.kind == "locked" else "type 2" if stretched else "type 1, opened",
        point=point,
        curve=curve,
        q=q,
        sigma_min_J=min(float(np.linalg.svd(at.J, compute_uv=False)[mechanism.rank - 1]) for at in along),
        smallest_chart=min(best),
    )


def claims(figures: Path) -> list[Claim]:
    """Answer the statements of section III-A."""
    mechanisms = {name: load(name) for name in (FIVE_BAR, PRINTED)}
    by_mechanism = {name: loci(mechanism) for name, mechanism in mechanisms.items()}
    all_loci = [(name, locus) for name in by_mechanism for locus in by_mechanism[name]]
    crossings = [(name, locus.name, cross(mechanisms[name], locus.point)) for name, locus in all_loci]
    map_ = _draw_map(figures, by_mechanism)
    through = _draw_crossings(figures, crossings)
    return [
        _type_1(by_mechanism, map_),
        _type_2(by_mechanism, map_),
        _freedoms(all_loci, crossings, through),
    ]


def _type_1(by_mechanism: dict[str, list[Locus]], figure: str) -> Claim:
    ours = [locus for locus in by_mechanism[FIVE_BAR] if locus.name == "type 1"]
    printed = [locus for locus in by_mechanism[PRINTED] if locus.name == "type 1"]
    spread = max(float(np.ptp(locus.curve.q_tree[:, [0, 2]], axis=0).max()) for locus in ours)
    turn = min(float(np.abs(np.diff(np.unwrap(locus.curve.q_tree[:, 1]))).sum()) for locus in ours)
    lengths = links(load(PRINTED))
    opening = abs(lengths.l2 - lengths.l4)
    small = [locus for locus in by_mechanism[PRINTED] if locus.name == "type 1, opened"]
    apart = [elbow_distance(lengths, *locus.q.T) for locus in small]
    gap = max((float(np.abs(x - opening).max()) for x in apart), default=float("nan"))
    fold = min(abs(locus.point.fold) for locus in by_mechanism[PRINTED])
    return Claim(
        key="singular-type-1",
        verdict="holds with a condition" if len(ours) == 2 and not printed else "does not hold",
        figures=(figure,),
        **render_blocks(
            "claims/singular-type-1",
            points=[locus.q[0] for locus in ours],
            turn=turn,
            spread=spread,
            printed=len(printed),
            lengths=lengths,
            opening=opening,
            gap=gap,
            curves=len(small),
            fold=fold,
        ),
    )


def _type_2(by_mechanism: dict[str, list[Locus]], figure: str) -> Claim:
    rows, good = [], True
    for name, some in by_mechanism.items():
        lengths = links(load(name))
        for locus in some:
            if locus.name != "type 2":
                continue
            miss = float(np.abs(elbow_distance(lengths, *locus.q.T) - lengths.l2 - lengths.l4).max())
            good = good and locus.curve.closed and miss < 1e-8
            kind = "closed" if locus.curve.closed else "open"
            rows.append((name, f"{len(locus.q)}", kind, f"{lengths.l2 + lengths.l4:.4f}", f"{miss:.0e}"))
    return Claim(
        key="singular-type-2",
        verdict="holds" if good and len(rows) == 2 else "does not hold",
        figures=(figure,),
        table=(("mechanism", "points", "curve", "l2 + l4 (m)", "largest deviation (m)"), tuple(rows)),
        **render_blocks("claims/singular-type-2", curves=len(rows)),
    )


def _freedoms(all_loci: list[tuple[str, Locus]], crossings: Sequence[tuple[str, str, Crossing]], figure: str) -> Claim:
    rows = []
    for name, locus in all_loci:
        point = locus.point
        rows.append((
            name, locus.name, f"{point.rank_J}, {point.freedoms}", f"{locus.sigma_min_J:.4f}",
            f"{np.linalg.matrix_rank(point.at.phi_z, tol=1e-9)}", f"{point.q_rank}",
            f"{', '.join(point.chart)}: {point.chart_sigma_min:.3f}", f"{locus.smallest_chart:.3f}",
        ))  # fmt: skip
    kept = all(locus.point.freedoms == 2 and locus.sigma_min_J > 1e-3 for _, locus in all_loci)
    passed = [c for _, _, c in crossings]
    return Claim(
        key="singular-freedoms",
        verdict="does not hold" if kept else "holds",
        figures=(figure,),
        table=(
            ("mechanism", "singularity", "rank J, freedoms", "smallest sigma_min(J)", "rank phi_z", "rank of q-part",
             "a chart there: sigma_min", "smallest along curve"),
            tuple(rows),
        ),
        **render_blocks(
            "claims/singular-freedoms",
            curves=len(all_loci),
            sigma_min_J=min(locus.sigma_min_J for _, locus in all_loci),
            smallest_chart=min(locus.smallest_chart for _, locus in all_loci),
            half=abs(passed[0].t[0]),
            returned=max(c.returned for c in passed),
            drift=max(c.energy_drift for c in passed),
            signs=sum(c.changes_sign for c in passed),
            passages=len(passed),
        ),
    )  # fmt: skip


def _draw_map(figures: Path, by_mechanism: dict[str, list[Locus]]) -> str:
    figure, axes = chart(2)
    grid = np.linspace(-np.pi, np.pi, 401)
    theta_1, theta_3 = np.meshgrid(grid, grid)
    t = np.linspace(0.0, 2 * np.pi, 400)
    for ax, (name, some) in zip(axes, by_mechanism.items(), strict=True):
        lengths = links(load(name))
        _shade(ax, theta_1, theta_3, lengths)
        for locus in some:
            _draw_locus(ax, locus)
        ax.plot(np.pi / 3 * np.sin(t), np.pi / 4 * (1 - np.cos(t)), "--", color=BLACK, lw=1, label="eq. 21")
        handles = dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        ax.legend(
            handles.values(), handles.keys(), loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=9, ncols=3
        )
        ax.set(
            xlabel=r"$\theta_1$ (rad)", ylabel=r"$\theta_3$ (rad)", title=f"{name} (unreachable: gray)", aspect="equal"
        )
        ax.set(xlim=(-np.pi, np.pi), ylim=(-np.pi, np.pi))
    return save(figure, figures, "singular_configurations.png")


def _shade(ax: Any, theta_1: Array, theta_3: Array, lengths: Links) -> None:
    distance = elbow_distance(lengths, theta_1, theta_3)
    outside = np.maximum(distance - lengths.l2 - lengths.l4, abs(lengths.l2 - lengths.l4) - distance)
    ax.contourf(theta_1, theta_3, outside, levels=[0.0, np.inf], colors=["#cccccc"])


def _draw_locus(ax: Any, locus: Locus) -> None:
    colour = COLOURS[0] if locus.name == "type 2" else COLOURS[1]
    if locus.name == "type 1":
        ax.plot(*locus.q[0], "o", color=colour, ms=8, label="type 1: elbows coincide")
        return
    q = locus.q.copy()
    q[1:][np.abs(np.diff(locus.q, axis=0)).max(axis=1) > np.pi] = np.nan  # interrupt the line where an angle wraps
    label = "type 2: elbows l2 + l4 apart" if locus.name == "type 2" else "elbows |l2 - l4| apart"
    ax.plot(*q.T, color=colour, lw=2, label=label)


def _draw_crossings(figures: Path, crossings: Sequence[tuple[str, str, Crossing]]) -> str:
    figure, (left, right) = chart(2)
    shown = {name: crossing for mechanism, name, crossing in crossings if mechanism == FIVE_BAR}
    for name, crossing in shown.items():
        colour = COLOURS[0] if name == "type 2" else COLOURS[1]
        left.plot(1e3 * crossing.t, crossing.det_phi_z, color=colour, lw=2, label=f"{name} crossed")
        right.plot(1e3 * crossing.t, crossing.sigma_min_J, color=colour, lw=2, label=f"{name} crossed")
    left.axhline(0.0, color=BLACK, lw=0.8)
    left.set(xlabel="$t$ (ms)", ylabel=r"$\det\varphi_z$ (m²)", title="the chart (θ₁, θ₃) fails ...")
    right.set(xlabel="$t$ (ms)", ylabel="smallest singular value of J (m)", title="... the mechanism does not")
    right.set_ylim(0.0, 1.2 * max(crossing.sigma_min_J.max() for crossing in shown.values()))
    for ax in (left, right):
        ax.legend()
    return save(figure, figures, "singular_crossing.png")
