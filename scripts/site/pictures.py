"""Draw the guide's figures and the home page's animation: ``python -m scripts.site.pictures``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.formats.exporting import export, write
from ckc_pin.view.gif import quantize_frames, save_gif
from ckc_pin.view.style import COLOURS, GREY, figure_style
from examples import pick_and_place
from scripts.experiments.chart import shrink

__all__ = ["main"]

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
BLUE, ORANGE, GREEN = COLOURS[:3]
FORBIDDEN = {"color": ORANGE, "lw": 2.4}
FREE = {"color": BLUE, "lw": 1.4, "ls": (0, (4.0, 1.6))}  # distinguishable without colours
# Translations along e1, e2, a and rotations about them that each loop type constrains.
FORBIDS = {
    "point": ("111", "000"), "point_2d": ("110", "000"), "hinge": ("111", "110"), "cylindrical": ("110", "110"),
    "universal": ("111", "010"), "prismatic": ("110", "111"), "weld": ("111", "111"), "distance": ("001", "000"),
}  # fmt: skip
AXES = {"e1": np.array([-0.80, -0.42]), "e2": np.array([0.92, -0.24]), "a": np.array([0.0, 1.0])}  # front view


def rows() -> Any:
    """Draw the eight loop types with the motions that each constrains."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 5.0), dpi=100, layout="constrained")
    axes: Any = figure.subplots(2, 4)
    for ax, (kind, (moves, turns)) in zip(axes.flat, FORBIDS.items(), strict=True):
        for k, (name, axis) in enumerate(AXES.items()):
            how = FORBIDDEN if moves[k] == "1" else FREE
            label = "r" if kind == "distance" and name == "a" else name
            ax.annotate("", axis, (0, 0), arrowprops={"arrowstyle": "-|>", **how})
            ax.text(*(1.16 * axis), label, ha="center", va="center", color=how["color"], fontsize=11)
            _arc(ax, axis, FORBIDDEN if turns[k] == "1" else FREE)
        ax.plot(0, 0, "o", color="black", ms=5)
        count = sum(map(int, moves + turns))
        ax.set_title(f"{kind}: {count} row{'s' if count > 1 else ''}", fontsize=11, family="monospace")
        ax.set(xlim=(-1.3, 1.3), ylim=(-0.6, 1.3), aspect="equal")
        ax.axis("off")
    return figure


def _arc(ax: Any, axis: Any, how: Mapping[str, Any]) -> None:
    """Draw a rotation about an axis as an open ellipse with an arrow head."""
    along = axis / np.linalg.norm(axis)
    across = np.array([-along[1], along[0]])
    angle = np.linspace(0.6, 5.4, 40)[:, np.newaxis]
    at = 0.62 * axis + 0.21 * np.cos(angle) * across + 0.08 * np.sin(angle) * along
    ax.plot(*at.T, **how)
    ax.annotate("", at[-1], at[-4], arrowprops={"arrowstyle": "-|>", "color": how["color"], "lw": 1.2})


def frames() -> Any:
    """Draw the guide's four-bar: links, coordinates, and the frames that the loop connects."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.4), dpi=100, layout="constrained")
    ax: Any = figure.subplots()
    a, b = np.array([0.0, 0.0]), np.array([0.5, 0.0])
    elbow = 0.2 * np.array([np.cos(1.2), np.sin(1.2)])
    reach = b - elbow
    distance = np.hypot(*reach)
    cosine = (0.6**2 + distance**2 - 0.4**2) / (2 * 0.6 * distance)
    at = np.arctan2(reach[1], reach[0]) + np.arccos(cosine)
    knee = elbow + 0.6 * np.array([np.cos(at), np.sin(at)])
    for ends, colour, name in ((np.array([a, elbow]), BLUE, "crank"), (np.array([elbow, knee]), ORANGE, "rod"),
                               (np.array([b, knee]), GREEN, "rocker")):  # fmt: skip
        ax.plot(*ends.T, color=colour, lw=7, alpha=0.55, solid_capstyle="round")
        ax.text(*(ends.mean(axis=0) - np.array([0.0, 0.045])), name, color=colour, ha="left", fontsize=12)
    for place, name, side in ((a, "shoulder", -1), (elbow, "elbow", -1), (b, "hip", 1)):
        ax.plot(*place, "o", ms=10, mfc="white", mec="black", mew=1.8)
        ax.text(place[0] + 0.03 * side, place[1] + 0.02, name, ha="right" if side < 0 else "left", fontsize=11)
    ax.plot([-0.1, 0.62], [-0.03, -0.03], color=GREY, lw=3)
    ax.text(0.25, -0.065, "ground", color=GREY, ha="center")
    for turn, colour, where, name in ((at, ORANGE, knee, "frame A, in rod"),
                                      (np.arctan2(*(knee - b)[::-1]), GREEN, knee, "frame B, in rocker")):  # fmt: skip
        for angle, letter in ((turn, "x"), (turn + np.pi / 2, "y")):
            tip = where + 0.1 * np.array([np.cos(angle), np.sin(angle)])
            ax.annotate("", tip, where, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2})
            ax.text(*(where + 0.115 * np.array([np.cos(angle), np.sin(angle)])), letter, color=colour, ha="center")
        ax.text(where[0] - 0.14, where[1] + (0.075 if colour == ORANGE else 0.045), name, color=colour, ha="right")
    ax.plot(*knee, "o", ms=13, mfc="none", mec="black", mew=2)
    ax.text(knee[0] - 0.14, knee[1] + 0.012, "cut here; the loop closes it: r = 0", color="black", ha="right")
    ax.set(aspect="equal", xlim=(-0.15, 0.82), ylim=(-0.09, 0.53))
    ax.axis("off")
    return figure


def pipeline() -> Any:
    """Draw the pipeline from files to the three formulations."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.4, 3.7), dpi=100, layout="constrained")
    ax = figure.subplots()
    boxes = {
        "urdf": (0.6, 3.0, "URDF\nthe tree", GREY), "toml": (0.6, 1.0, "mechanism.toml\nthe loops", GREY),
        "tree": (2.9, 3.0, "Pinocchio\nD', C', h'", BLUE), "rows": (2.9, 1.0, "rows\nφ, J, J̇v", BLUE),
        "split": (5.2, 1.0, "q' = (q, z)\nρ, σ", BLUE),
        "dae": (7.9, 3.3, "DAE (eq. 1)\nq', q̇', λ", ORANGE),
        "reduced": (7.9, 2.0, "reduced (eq. 6)\nq, q̇; z = σ(q)", ORANGE),
        "spf": (7.9, 0.7, "SPF (eqs. 8, 17)\nq, q̇, z or w", ORANGE),
    }  # fmt: skip
    for x, y, text, colour in boxes.values():
        style = {"boxstyle": "round,pad=0.5", "fc": "white", "ec": colour, "lw": 1.8}
        ax.text(x, y, text, ha="center", va="center", fontsize=10.5, bbox=style)
    for start, end in (("urdf", "tree"), ("toml", "rows"), ("rows", "split"), ("tree", "dae"), ("tree", "reduced"),
                       ("rows", "dae"), ("split", "reduced"), ("split", "spf"), ("tree", "spf")):  # fmt: skip
        (x, y), (to_x, to_y) = boxes[start][:2], boxes[end][:2]
        arrow = {"arrowstyle": "-|>", "color": GREY, "lw": 1.2, "shrinkA": 62 if start == "toml" else 44, "shrinkB": 52}
        ax.annotate("", (to_x, to_y), (x, y), arrowprops=arrow)
    ax.set(xlim=(-0.5, 9.3), ylim=(0, 4))
    ax.axis("off")
    return figure


@figure_style()
def fmu() -> Any:
    """Draw the motion of an FMU in FMPy beside the run, a five-bar whose driven links bounce off their stops."""
    import fmpy
    from matplotlib.figure import Figure

    parameters = {"gravity": [-9.81, -3.0, 0.0]} | {f"joint.theta_{k}.friction": 0.0 for k in (1, 2, 3, 4)}
    keys = {"formulation": "reduced", "controller": None, "t_end": 0.6, "parameters": parameters}
    scene = ckc_pin.load_scene("five_bar/friction", {**keys, "solver": {"rtol": 1e-11, "output_dt": 5e-3}})
    run, names = ckc_pin.simulate(scene), ("theta_1", "theta_3")
    with TemporaryDirectory() as folder:
        (path,) = write(export(scene, "fmu"), Path(folder))
        results = {
            kind: fmpy.simulate_fmu(
                str(path), fmi_type=kind, stop_time=0.6, output_interval=5e-3, relative_tolerance=rtol, output=names,
                record_events=False,
            )
            for kind, rtol in (("CoSimulation", 1e-11), ("ModelExchange", 1e-9))
        }  # fmt: skip
    figure = Figure(figsize=(8.0, 3.4), dpi=100, layout="constrained")
    motion, differences = figure.subplots(1, 2)
    for name, symbol, colour, stop in zip(names, ("θ₁", "θ₃"), (BLUE, ORANGE), (-1.45, -2.0), strict=True):
        motion.plot(run.t, run[name], color=colour, label=f"{symbol}, simulate")
        shown = results["CoSimulation"][::4]
        motion.plot(shown["time"], shown[name], "o", color=colour, mfc="none", ms=5, label=f"{symbol}, FMPy")
        motion.axhline(stop, color=GREY, lw=0.9, ls=":")
    motion.set(xlabel="t (s)", ylabel="angle (rad)", title="Two links fall on their stops")
    motion.legend()
    for (kind, result), colour in zip(results.items(), (BLUE, ORANGE), strict=True):
        difference = np.max([np.abs(result[name] - run[name]) for name in names], axis=0)
        differences.semilogy(run.t, np.maximum(difference, 1e-16), color=colour, label=kind)
    differences.set(xlabel="t (s)", ylabel="rad", title="Difference from simulate")
    differences.legend()
    return figure


@figure_style()
def moving(path: Path, count: int = 60) -> None:
    """Write an animation of the five-bar under tracking control."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    run = ckc_pin.simulate("five_bar/tracking", {"formulation": "reduced"})
    mechanism = run.mechanism
    instants = np.linspace(0, len(run.t) - 1, count).astype(int)
    pins = []
    for k in instants:
        named = dict(zip(run.coordinates, run.q_tree[k].tolist(), strict=True))
        pose = ckc_pin.terms(mechanism, named).at.pose
        pins.append(np.vstack([pose.translation[[1, 2]], pose.p[:1], pose.translation[[4, 3]]])[:, :2])
    path_of_tip = run.points["tip"]
    figure = Figure(figsize=(6.0, 3.2), dpi=110)
    canvas: Any = FigureCanvasAgg(figure)
    pose_ax, angles = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    pose_ax.plot(path_of_tip[:, 0], path_of_tip[:, 1], color=GREY, lw=0.8)
    (left,) = pose_ax.plot([], [], "-o", color=BLUE, lw=4, ms=5)
    (right,) = pose_ax.plot([], [], "-o", color=ORANGE, lw=4, ms=5)
    pose_ax.set(aspect="equal", xlim=(-0.35, 0.6), ylim=(-0.6, 0.55))
    pose_ax.axis("off")
    pose_ax.set_title("The paper's five-bar")
    columns = [run.column(name) for name in run.independent]
    for column, colour, name in zip(columns, (BLUE, ORANGE), ("θ₁", "θ₃"), strict=True):
        angles.plot(run.t, run.q_tree[:, column], color=colour, label=name)
    angles.plot(run.t, np.pi / 3 * np.sin(run.t), ":", color="black", label="desired")
    angles.plot(run.t, np.pi / 4 * (1 - np.cos(run.t)), ":", color="black")
    now = angles.axvline(0, color=GREY, lw=0.9)
    angles.set(xlabel="t (s)", ylabel="angle (rad)", title="Tracking control")
    figure.legend(loc="outside lower right", ncols=3)

    drawn = []
    for pin, instant in zip(pins, instants, strict=True):
        left.set_data(*pin[:3].T)
        right.set_data(*pin[2:].T)
        now.set_xdata([run.t[instant]] * 2)
        canvas.draw()
        drawn.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    first, *others = quantize_frames(drawn)
    first.save(path, save_all=True, append_images=others, duration=80, loop=0)


def picking(path: Path) -> None:
    """Draw the fastest pick-and-place motion of the delta."""
    run = ckc_pin.simulate(pick_and_place.plan_fastest().scene("open"))
    save_gif(run, path, speed=0.08, size=(420, 360), fps=20)


def main() -> None:
    """Draw all figures."""
    places = {rows: "guide/rows.png", frames: "guide/frames.png", pipeline: "theory/pipeline.png", fmu: "guide/fmu.png"}
    for draw, place in places.items():
        (IMAGES / place).parent.mkdir(parents=True, exist_ok=True)
        draw().savefig(IMAGES / place)
        shrink(IMAGES / place)
        print(f"written: {IMAGES / place}")
    for draw_gif, place in ((moving, "moving.gif"), (picking, "guide/pick_and_place.gif")):
        draw_gif(IMAGES / place)
        print(f"written: {IMAGES / place}")


if __name__ == "__main__":
    main()
