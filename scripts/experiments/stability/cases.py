"""Cases of the suite: extremes of epsilon, masses, lengths, gains, speeds and springs; near-singular, published.

The end times are chosen so that the conditioning of the motion permits a comparison: two references, from starts that
differ by 1e-10 or from two solvers, agree far within the allowed error. A tumbling five-bar is chaotic, so fast ones
make a few turns only.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import acos, cos, hypot, pi, sin, sqrt
from typing import Any

from scripts.experiments.stability.cell import Case, Variant
from scripts.experiments.stability.equations import set_point, tracking
from scripts.experiments.stability.planar import JointSpring, LineSpring, Planar
from scripts.experiments.stability.reference import FiveBarEquations, NFourBarClosedForm, PublishedValues, Returns

__all__ = ["GROUPS"]

PAPER = Planar()
EQUILIBRIUM = (-1.4343085080901642, -1.7073321688743597)  # theta_1, theta_3 of the hanging five-bar
SWING = (EQUILIBRIUM[0] + 0.5, EQUILIBRIUM[1] + 0.5)
TYPE_1 = acos(PAPER.base / 2 / PAPER.l[0])  # rad: theta_1 at which both elbows coincide, with theta_3 = pi - theta_1
MODELS = (Variant("reduced"), Variant("spf"), Variant("dae"))
OUTPUTS = 20


def _scene(q: tuple[float, float], t_end: float, q_dot: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
    return {
        "initial.q": {"theta_1": q[0], "theta_3": q[1]},
        "initial.q_dot": {"theta_1": q_dot[0], "theta_3": q_dot[1]},
        "t_end": t_end,
        "solver.output_dt": t_end / OUTPUTS,
    }


def methods() -> Iterator[Case]:
    """Yield the swing by every method at three tolerances."""
    for rtol in (1e-5, 1e-8, 1e-11):
        variants = [Variant(f, m, rtol) for f in ("reduced", "dae") for m in ("auto", "DOP853", "RK45", "Radau")]
        variants += [Variant("spf", m, rtol, printed=True) for m in ("DOP853", "RK45", "Radau")]
        scene = {**_scene(SWING, 1.0), "epsilon": 1e-3}
        yield Case("method", f"swing at rtol {rtol:g}", "five_bar", scene, FiveBarEquations(PAPER), tuple(variants))


def epsilons() -> Iterator[Case]:
    """Yield epsilons from 1e-1 to 1e-12: on the manifold, off it, and moving with the largest possible w."""
    q_dot = (1.0, -2.0)
    far = 0.9 * (PAPER.l[1] + PAPER.l[3] - _elbows(PAPER, SWING))
    levels = {"w(0) = 0": (0.0, 0.0), "w(0) = (0.01, -0.006)": (0.01, -0.006), "w(0) large": (-far, 0.0)}
    for exponent in range(-1, -13, -1):
        epsilon = 10.0**exponent
        for name, w in levels.items():
            variants = [Variant("spf"), Variant("spf", "Radau", printed=True)]
            if epsilon >= 1e-3:  # explicit methods need steps of the size of epsilon
                variants += [Variant("spf", m, printed=True) for m in ("RK45", "DOP853")]
            scene = {**_scene(SWING, 1.0, q_dot), "epsilon": epsilon}
            if any(w):
                scene["initial.w"] = list(w)
            reference = FiveBarEquations(PAPER, w=w, epsilon=epsilon)
            yield Case("epsilon", f"{epsilon:.0e}, {name}", "five_bar", scene, reference, tuple(variants), not any(w))


def _elbows(p: Planar, q: tuple[float, float]) -> float:
    return hypot(p.base + p.l[2] * cos(q[1]) - p.l[0] * cos(q[0]), p.l[2] * sin(q[1]) - p.l[0] * sin(q[0]))


def masses() -> Iterator[Case]:
    """Yield masses of one link or one chain that differ from the others by factors up to 1e8."""
    for exponent in (-8, -6, -4, -2, 2, 4, 6, 8):
        r = 10.0**exponent
        for name, factors in (("link 2", (1.0, r, 1.0, 1.0)), ("left chain", (r, r, 1.0, 1.0))):
            p = PAPER.heavier(factors)
            yield Case("mass", f"{name} x {r:.0e}", p, _scene(SWING, 1.0), FiveBarEquations(p), MODELS)


def lengths() -> Iterator[Case]:
    """Yield scaled lengths; times scale with the square root of lengths."""
    for exponent in range(-3, 4):
        s = 10.0**exponent
        p = PAPER.longer(s / PAPER.base)
        yield Case("length", f"base {s:g} m", p, _scene(SWING, 2.0 * sqrt(s)), FiveBarEquations(p), MODELS)


def gains() -> Iterator[Case]:
    """Yield set points and tracking with gains from 1e-3 to 1e6, also without damping."""
    raised = (pi / 4, pi / 4)
    # With low gains a mechanism that starts far from its target leaves the chart of q, so the target is near.
    near_target = (EQUILIBRIUM[0] + 0.3, EQUILIBRIUM[1] + 0.2)
    pairs = [(10.0**k, 10.0**k) for k in range(-3, 7)] + [(k, 0.0) for k in (10.0, 1e2, 1e4, 1e6)]
    for K_P, K_V in pairs:
        target = raised if K_P >= 10 and K_V else near_target
        t_end = 2.0 if K_V else 10.0 / sqrt(K_P / 0.02)
        scene = _scene(EQUILIBRIUM, t_end)
        q_d = {"theta_1": target[0], "theta_3": target[1]}
        scene["controller"] = {"type": "set_point", "K_P": K_P, "K_V": K_V, "q_d": q_d}
        reference = FiveBarEquations(PAPER, set_point(PAPER, target, K_P, K_V))
        yield Case("gain", f"set point, K_P = {K_P:g}, K_V = {K_V:g}", "five_bar", scene, reference, MODELS, False)
    for exponent in range(-3, 7):
        K_D = 10.0**exponent
        scene = _scene(EQUILIBRIUM, 3.0)
        scene["controller"] = {"type": "tracking", "Lambda": 1.0, "K_D": K_D, "desired": _EQ_21}
        stiff = (Variant("reduced", "Radau"), Variant("spf", "Radau", printed=True)) if exponent >= 2 else ()
        scene["epsilon"] = 1e-4
        reference = FiveBarEquations(PAPER, tracking(1.0, K_D))
        yield Case("gain", f"tracking, K_D = {K_D:g}", "five_bar", scene, reference, (*MODELS, *stiff), False)


_EQ_21 = {
    "theta_1": {"harmonics": [[pi / 3, 1.0, 0.0]]},
    "theta_3": {"offset": pi / 4, "harmonics": [[pi / 4, 1.0, -pi / 2]]},
}


def near_singular() -> Iterator[Case]:
    """Yield starts at rest near coincident elbows (type 1, above and below) and near aligned distal links (type 2)."""
    stretched = _stretched(PAPER, -2.0)
    for exponent in range(-1, -13, -1):
        delta = 10.0**exponent
        for name, q in (
            ("type 1 above", (TYPE_1 + delta, pi - TYPE_1)),
            ("type 1 below", (-TYPE_1 - delta, TYPE_1 - pi)),
            ("type 2", (-2.0, stretched - delta)),
        ):
            yield Case(
                "singular", f"{name}, {delta:.0e} away", "five_bar", _scene(q, 0.5), FiveBarEquations(PAPER), MODELS
            )


def _stretched(p: Planar, theta_1: float) -> float:
    """Return the larger theta_3 in (-pi, 0) at which the distal links are aligned."""
    low, high = theta_1, 0.0
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if _elbows(p, (theta_1, middle)) < p.l[1] + p.l[3] else (low, middle)
    return low


def speeds() -> Iterator[Case]:
    """Yield initial rates up to 1e3 rad/s, and swings that cross type 2."""
    for exponent in range(4):
        rate = 10.0**exponent
        for name, ratio in (("together", 1.0), ("apart", -0.3)):
            scene = _scene(EQUILIBRIUM, min(1.0, 5.0 / rate), (rate, ratio * rate))
            yield Case("speed", f"{rate:g} rad/s, {name}", "five_bar", scene, FiveBarEquations(PAPER), MODELS)
    for rate in (6.0, 9.0, 12.0):
        scene = _scene(EQUILIBRIUM, 0.5, (rate, -rate))  # errors grow by 1e4 in two seconds
        yield Case("speed", f"crossing type 2, {rate:g} rad/s", "five_bar", scene, FiveBarEquations(PAPER), MODELS)


def springs() -> Iterator[Case]:
    """Yield springs on the tip or a joint up to 1e9 N/m, undamped (for 60 rad of oscillation) or overdamped."""
    for exponent in range(0, 10):
        k = 10.0**exponent
        line = LineSpring(k, 0.0, 0.5, 0.1, 0.1)
        t_end = min(1.0, 60.0 / sqrt(k / 0.1))
        p = Planar(line=line)
        yield Case("spring", f"line {k:.0e} N/m", p, _scene(SWING, t_end), FiveBarEquations(p), MODELS)
        damped = Planar(line=LineSpring(k, 2.0 * sqrt(k), 0.5, 0.1, 0.1))
        reference = FiveBarEquations(damped, stiff=True)
        scene = _scene(SWING, min(1.0, 10 * t_end))
        yield Case("spring", f"line {k:.0e} N/m, damped", damped, scene, reference, MODELS, False)
    for k in (1e3, 1e6, 1e9):
        p = Planar(joint=JointSpring(k, 0.0, SWING[0] + 1e-3))
        yield Case(
            "spring", f"joint {k:.0e} N m/rad", p, _scene(SWING, 60.0 / sqrt(k / 0.02)), FiveBarEquations(p), MODELS
        )


ANDREWS_START = {
    "beta": -0.0617138900142764496,
    "theta": 0.0,
    "gamma": 0.455279819163070380,
    "phi": 0.222668390165885885,
    "delta": 0.487364979543842550,
    "omega": -0.222668390165885885,
    "eps": 1.23054744454982119,
}
ANDREWS = {
    "beta": 15.81077119515370,
    "theta": -15.75637105841184,
    "gamma": 0.04082224011964587,
    "phi": -0.5347301163420793,
    "delta": 0.5244099658799541,
    "omega": 0.5347301163420791,
    "eps": 1.048080741041938,
}
BRICARD_P3 = (0.27448132, -0.88670794, -0.46233000)
BRICARD_PERIOD = 4.99171151369


def published() -> Iterator[Case]:
    """Yield Andrews' squeezer, Bricard's mechanism and N-four-bars."""
    andrews = {"initial.q": ANDREWS_START, "t_end": 0.03, "solver.output_dt": 0.03}
    source = "published values (Hairer and Wanner), thirteen digits"
    implicit = Variant("dae", "Radau"), Variant("reduced", "Radau")
    tolerances = Variant("reduced", rtol=1e-10), Variant("dae", rtol=1e-5), Variant("dae", rtol=1e-11)
    ways: tuple[Variant, ...] = (*MODELS, *implicit, Variant("dae", "RK45"), *tolerances)
    yield Case("published", "Andrews", "andrews", andrews, PublishedValues(source, 1e-12, ANDREWS), ways)
    bricard = {"initial.at": "assembled", "solver.output_dt": 0.05}
    position = PublishedValues("published position, eight digits", 1e-8, points={"P3": BRICARD_P3})
    yield Case("published", "Bricard at 1 s", "bricard", {**bricard, "t_end": 1.0}, position, (*MODELS, *implicit))
    period = {**bricard, "t_end": BRICARD_PERIOD, "solver.output_dt": BRICARD_PERIOD}
    back = Returns("published period: back at the start, at rest", 1e-10)
    yield Case("published", "Bricard, one period", "bricard", period, back, MODELS)
    for N in (1, 2, 7, 40):
        k = 9.81 * 3 * (3 * N + 1) / (2 * (4 * N + 1))
        row = {"initial.q": {"theta_0": pi / 2}, "initial.q_dot": {"theta_0": -1.0}}
        generated = {"generator": "n_four_bar", "N": N}
        short = {**row, "t_end": 0.6, "solver.output_dt": 0.05}
        yield Case("published", f"N-four-bar, N = {N}, 0.6 s", generated, short, NFourBarClosedForm(k), MODELS)
        if N == 40:
            continue
        through = {**row, "t_end": 3.0 if N > 2 else 10.0, "solver.output_dt": 0.25}
        ways = tuple(Variant("dae", rtol=rtol) for rtol in (1e-6, 1e-8, 1e-10))
        yield Case(
            "published", f"N-four-bar, N = {N}, through rank losses", generated, through, NFourBarClosedForm(k), ways
        )


GROUPS = {
    "method": methods,
    "epsilon": epsilons,
    "mass": masses,
    "length": lengths,
    "gain": gains,
    "singular": near_singular,
    "speed": speeds,
    "spring": springs,
    "published": published,
}
