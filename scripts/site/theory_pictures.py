"""Draw the figures of the theory pages from reproducible runs: ``python -m scripts.site.theory_pictures``."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.mechanism.library import library
from ckc_pin.run.recorded import RecordedJoints
from ckc_pin.view import style
from ckc_pin.view.layout import legend_line, set_panel_title
from ckc_pin.view.style import figure_style
from scripts.experiments.chart import shrink

__all__ = ["error_control", "friction", "generated", "main"]

DOCS = Path(__file__).resolve().parents[2] / "docs"
TURN = (1.5, 3.0)  # s, of five_bar/friction: theta_1 comes to rest and reverses
SMOOTH = (0.2, 0.05)  # rad/s
BOUNCY = 0.7  # restitution
PUSH = -2.0  # N m, towards the stop
SHIPPED = ("five-bar", "delta", "Talos")
FORMULATIONS = ("dae", "reduced", "spf")
LENGTHS = (0.2794, 0.3048, 0.3048)  # m: proximal, distal, base
ANGLES_FROM_TYPE_2 = np.logspace(-0.6, -6, 40)  # rad from where links 2 and 4 are in line


def _figure(rows: int, columns: int, height: float, **grid: Any) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(style.WIDTH_IN, height), dpi=style.DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, **grid)


# --- friction and stops -----------------------------------------------------------------------------


def friction() -> Any:
    """Plot a joint that reverses with friction as events and smoothed, its force, and bounces down to contact."""
    figure, (rate, force, bounce) = _figure(3, 1, 5.6)
    dash_styles = ["-", (0, (4.0, 2.2)), (0, (1.0, 1.6))]
    for smooth, colour, dashes in zip((None, *reversed(SMOOTH)), style.COLOURS, dash_styles, strict=False):
        run = ckc_pin.simulate("five_bar/friction", {"friction_smoothing": smooth, "solver.output_dt": 0.005})
        here = (run.t >= TURN[0]) & (run.t <= TURN[1])
        k = run.column("theta_1")
        max_friction = float(run.mechanism.joints.friction[k])
        joints = RecordedJoints(run)
        forces = []
        for row in np.flatnonzero(here):
            terms = run.sel(t=float(run.t[row])).terms
            torques = run.mechanism.motors.transmission.T @ run.tau[row]
            forces.append(joints.force(int(row), terms, torques)[k] / max_friction)
        label = "events" if smooth is None else f"smoothed over {smooth:g} rad/s"
        rate.plot(run.t[here], run.v_tree[here, k], color=colour, linestyle=dashes, label=label)
        force.plot(run.t[here], forces, color=colour, linestyle=dashes)
        if smooth is None:
            rests = [e["t"] for e in run.events if e["name"].startswith("theta_1") and TURN[0] < e["t"] < TURN[1]]
    for ax in (rate, force):
        ax.axvspan(*rests[:2], color=style.COLOURS[0], alpha=0.12, linewidth=0)
        ax.set(xlim=TURN)
    rate.set(ylabel=r"$\dot{\theta}_1$ (rad/s)", ylim=(-0.3, 0.6))
    rate.legend()
    set_panel_title(rate, "a)  a joint reverses", "events: it rests, shaded; smoothed: it creeps")
    force.set(xlabel="$t$ (s)", ylabel="friction over F", ylim=(-1.25, 1.25), yticks=[-1, 0, 1])
    set_panel_title(
        force, "b)  friction force", "sliding: F against the motion; at rest: what equilibrium needs, up to F"
    )
    _bounces(bounce)
    return figure


def _bounces(ax: Any) -> None:
    """Plot bounces of theta_1, pushed against its stop by a constant torque."""
    with TemporaryDirectory() as folder:
        place = Path(folder) / "five_bar"
        shutil.copytree(library() / "five_bar", place)
        text = (place / "friction.toml").read_text(encoding="utf-8")
        (place / "friction.toml").write_text(
            f'{text}\n[[force]]\njoint = "theta_1"\nvalue = {PUSH}\n', encoding="utf-8"
        )
        overrides = {"controller": None, "t_end": 2.0, "initial.q_dot.theta_1": -1.0,
                   **{f"parameters.joint.theta_{k}.friction": 0.0 for k in (1, 2, 3, 4)},
                   "parameters.joint.theta_1.restitution": BOUNCY}  # fmt: skip
        run = ckc_pin.simulate(place / "friction.scene.toml", overrides)
    events = [e for e in run.events if e["coordinate"] == "theta_1" and e["of"] == "stop"]
    times = np.array([e["t"] for e in events if e["name"].endswith("bounces")])
    between = np.diff(times)
    count = np.arange(1, len(between) + 1)
    ax.semilogy(count, between, "o", color=style.COLOURS[0], markersize=3.5, label="between two bounces")
    ax.semilogy(count, between[-1] * BOUNCY ** (count - count[-1]), color=style.GREY, linewidth=0.9,
                label=f"factor {BOUNCY} per bounce")  # fmt: skip
    contact = next(e["t"] for e in events if e["name"].endswith("touches"))
    ax.axvline(len(times), color=style.COLOURS[1], linewidth=1.2, label=f"contact, at {contact:.3f} s")
    ax.set(xlabel="bounce", ylabel="time to the next (s)")
    ax.legend()
    set_panel_title(ax, "c)  bounces at a stop", f"restitution {BOUNCY}: finitely many, then contact")


# --- compiled terms ---------------------------------------------------------------------------------


def generated() -> Any:
    """Plot the length of the text and the time of a right-hand side, from the table on the page."""
    rows = _table((DOCS / "theory" / "generated.md").read_text(encoding="utf-8"))
    figure, (text, time) = _figure(1, 2, 2.9)
    kinds = {"N squares in a row": ("o", ("N =",)), "rings in space": ("s", ("ring",)), "shipped": ("^", SHIPPED)}
    for colour, (label, (marker, begin)) in zip(style.COLOURS, kinds.items(), strict=False):
        selected = [row for row in rows if row[0].startswith(begin)]
        n, operations = np.array([row[1] for row in selected]), np.array([row[2] for row in selected])
        joined = {} if label == "shipped" else {"linestyle": "-", "linewidth": 1.0}
        text.loglog(n, operations, marker, color=colour, markersize=4, label=label, **joined)
        ran = [row for row in selected if row[5] is not None]
        for column, face in ((5, colour), (6, "white")):
            time.loglog([row[2] for row in ran], [row[column] for row in ran], marker, color=colour, markersize=4,
                        markerfacecolor=face)  # fmt: skip
        for name, x, y in ((row[0], row[1], row[2]) for row in selected if label == "shipped"):
            text.annotate(
                name, (x, y), (4, -7), textcoords="offset points", fontsize=style.NOTE_SIZE_PT, color=style.GREY
            )
    text.set(xlabel="coordinates of the tree", ylabel="operations of a right-hand side")
    text.legend(fontsize=style.NOTE_SIZE_PT)
    set_panel_title(text, "a)  length of the text")
    time.set(xlabel="operations", ylabel="a right-hand side (µs)")
    set_panel_title(time, "b)  time of a right-hand side")
    shape = {"marker": "o", "linestyle": "none", "markersize": 4}
    time.legend(handles=[legend_line(style.GREY, "compiled terms", **shape),
                         legend_line(style.GREY, "Pinocchio's terms", markerfacecolor="white", **shape)],
                fontsize=style.NOTE_SIZE_PT)  # fmt: skip
    return figure


def _table(page: str) -> list[tuple[Any, ...]]:
    """Rows of the page's table: name of the mechanism, then numbers; None for an empty cell."""
    head = page.index("| mechanism | n |")
    table: list[tuple[Any, ...]] = []
    for row in page[head:].splitlines()[2:]:
        if not row.startswith("|"):
            break
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        numbers = [float(x.replace(",", "")) if re.fullmatch(r"[\d.,]+", x) else None for x in cells[1:]]
        table.append((cells[0], *numbers))
    return table


# --- error control ----------------------------------------------------------------------------------


def error_control() -> Any:
    """Plot the error against the tolerance, and the amplification of an error of q in z near the end of a chart."""
    figure, (reached, steep) = _figure(1, 2, 2.9)
    exact = ckc_pin.simulate("five_bar/swing", {"solver.rtol": 1e-13, "solver.atol": 1e-15})
    tolerances = np.logspace(-3, -11, 9)
    for name, colour, marker in zip(FORMULATIONS, style.COLOURS, "os^", strict=False):
        errors = []
        for rtol in tolerances:
            run = ckc_pin.simulate("five_bar/swing", {"formulation": name, "solver.rtol": float(rtol)})
            errors.append(max(np.abs(run.q_tree - exact.q_tree).max(), np.abs(run.v_tree - exact.v_tree).max()))
        label = {"dae": "DAE", "spf": "SPF"}.get(name, name)
        reached.loglog(tolerances, errors, marker + "-", color=colour, markersize=4, linewidth=1.0, label=label)
    reached.loglog(tolerances, tolerances, ":", color="black", linewidth=1.0, label="rtol")
    reached.set(xlabel="rtol", ylabel="largest error along 2 s (rad, rad/s)")
    reached.legend(fontsize=style.NOTE_SIZE_PT)
    set_panel_title(reached, "a)  error against tolerance")
    margins, of_z, of_rate = _amplified()
    steep.loglog(margins, of_rate, color=style.COLOURS[1], label=r"$\dot{z}$, with $\dot{q}$ = 1 rad/s")
    steep.loglog(margins, of_z, color=style.COLOURS[0], label="$z$")
    steep.invert_xaxis()
    steep.set(xlabel=r"$|\det\varphi_z| / (l_2 l_4)$", ylabel="its error for one of $q$")
    steep.legend(fontsize=style.NOTE_SIZE_PT)
    set_panel_title(steep, "b)  towards the end of a chart")
    return figure


def _amplified() -> tuple[Any, Any, Any]:
    """Return how an error in q is amplified in z and in its rate as the five-bar's distal links come into line."""
    proximal, distal, base = LENGTHS
    in_line = np.arccos((2 * distal - base) / (2 * proximal))
    mechanism = ckc_pin.load("five_bar")
    margins, of_z, of_rate = [], [], []
    for angle in ANGLES_FROM_TYPE_2:

        def slope(step: float, a: float = in_line + angle) -> Any:
            at = ckc_pin.terms(mechanism, {"theta_1": float(np.pi - a) + step, "theta_3": float(a)})
            return at, at.rho[[1, 3]]

        here, rho = slope(0.0)
        h = 1e-4 * angle
        bent = (slope(h)[1] - slope(-h)[1]) / (2 * h)
        margins.append(abs(np.linalg.det(here.at.phi_z)) / distal**2)
        of_z.append(np.linalg.norm(rho, 2))
        of_rate.append(np.linalg.norm(bent[:, 0]))
    return np.array(margins), np.array(of_z), np.array(of_rate)


def main() -> None:
    """Draw all figures."""
    for draw in (friction, generated, error_control):
        path = DOCS / "images" / "theory" / f"{draw.__name__}.png"
        with figure_style():
            draw().savefig(path)
        shrink(path)
        print(f"written: {path}")


if __name__ == "__main__":
    main()
