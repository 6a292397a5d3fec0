"""A swing-up by IPOPT.

Motors too weak to hold the five-bar's arms level swing it up: planned by IPOPT, replayed in the step loop. From rest
at the hanging equilibrium to rest with both arms straight up, on the branch of the start, torques constant on each
interval. The equations of motion are the CasADi functions that `ckc_pin.symbolic` gives. The motion is found by
direct collocation: on each piece a polynomial that meets the equations of motion at Gauss points, of order 2 DEGREE
where the piece ends. Only the independent angles and rates are asked for at the end: the closure follows from the
start, and asked for twice it would leave IPOPT with constraints whose gradients depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.base.arrays import Array
from ckc_pin.codegen.symbolic import Symbolic
from ckc_pin.errors import NumericalError
from ckc_pin.view.canvas import look
from ckc_pin.view.style import COLOURS

T_END, INTERVALS = 1.6, 40  # s, and on how many parts of it u is constant
PIECES, DEGREE = 2, 4  # of an interval; Gauss points of a piece
TORQUE = 0.8  # N m, of each motor; both arms level take 1.05
CALM = 0.05  # N^2 m^2 s^2: weight of the rates' squares beside the torques'
UP = np.array([np.pi / 2, np.pi / 2])
EQUAL = 1e-6  # rad, rad/s: how far the replay may be off
POSES = 5  # of the figure


@dataclass(frozen=True)
class Plan:
    """What IPOPT found.

    Attributes
    ----------
    t : (intervals + 1,) array
        Where intervals end, s.
    states : (intervals + 1, 8) array
        q' and v' there.
    u : (intervals, 2) array
        N m.
    """

    t: Array
    states: Array
    u: Array
    iterations: int
    seconds: float


def hanging() -> ckc_pin.Simulator:
    """Return the five-bar at rest in its equilibrium, to be stepped as a DAE at a tight tolerance."""
    at_rest = {"initial": {"at": "equilibrium"}, "solver.rtol": 1e-12}
    return ckc_pin.Simulator("five_bar/swing", at_rest)


def plan(intervals: int = INTERVALS, pieces: int = PIECES, torque: float = TORQUE) -> Plan:
    """Solve the optimal control problem.

    Raises
    ------
    InputError
        CasADi is not installed.
    NumericalError
        IPOPT does not converge.
    """
    five_bar = ckc_pin.symbolic("five_bar")  # says what to install
    import casadi as cs

    count, own = intervals * pieces, DEGREE + 1  # pieces, and columns of states of each: where it begins, Gauss points
    h, hold = T_END / count, T_END / intervals
    piece, points, weights = _piece(five_bar, h)
    X, U = cs.MX.sym("X", 8, count * own + 1), cs.MX.sym("U", 2, intervals)
    parts = cs.horzcat(*(X[:, k * own : (k + 1) * own + 1] for k in range(count)))
    end = X[:, -1]
    upright = cs.vertcat(end[0] - UP[0], end[2] - UP[1], end[4], end[6])
    constraints = cs.veccat(piece.map(count)(parts, cs.kron(U, np.ones((1, pieces)))), upright)
    share = h * np.tile(np.append(0.0, weights), count)
    cost = hold * cs.sumsqr(U) + CALM * cs.sum1(X[4:, :-1] ** 2) @ share
    problem: Any = {"x": cs.veccat(X, U), "f": cost, "g": constraints}
    silent: Any = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9, "constr_viol_tol": 1e-10}}
    solver = cs.nlpsol("swing_up", "ipopt", problem, silent)

    times: Array = np.append([h * (k + x) for k in range(count) for x in (0.0, *points)], T_END)
    states, torques = _guess(times, np.array([hold * (k + 0.5) for k in range(intervals)]))
    free, limit = np.full(states[8:].shape, np.inf), np.full(torques.shape, torque)
    least, most = (np.concatenate([states[:8], sign * free, sign * limit]) for sign in (-1, 1))
    start = np.concatenate([states, np.clip(torques, -limit, limit)])
    began = perf_counter()
    numbers = np.array(solver(x0=start, lbx=least, ubx=most, lbg=0, ubg=0)["x"]).ravel()
    seconds, found = perf_counter() - began, solver.stats()
    if not found["success"]:
        raise NumericalError(f"swing-up: IPOPT says {found['return_status']} after {found['iter_count']} iterations")
    ends = numbers[: len(states)].reshape(-1, 8)[:: own * pieces]
    return Plan(times[:: own * pieces], ends, numbers[len(states) :].reshape(-1, 2), found["iter_count"], seconds)


def _piece(five_bar: Symbolic, h: float) -> tuple[Any, list[float], Array]:
    """Return by how much a piece misses the equations of motion, its Gauss points, and their weights."""
    import casadi as cs

    points = cs.collocation_points(DEGREE, "legendre")
    rates, end, weights = cs.collocation_coeff(points)
    x, u = cs.SX.sym("x", 8), cs.SX.sym("u", 2)
    tau = cs.vertcat(u[0], 0, u[1], 0)  # coordinates are theta_1 to theta_4
    x_dot = cs.Function("x_dot", [x, u], [cs.vertcat(x[4:], five_bar.v_dot(x[:4], x[4:], tau, five_bar.values))])
    states = cs.SX.sym("states", 8, DEGREE + 2)  # where it begins, at Gauss points, where the next one begins
    moves = cs.horzcat(*(x_dot(states[:, 1 + k], u) for k in range(DEGREE)))
    misses = cs.horzcat(states[:, :-1] @ rates - h * moves, states[:, :-1] @ end - states[:, -1])
    return cs.Function("piece", [states, u], [misses]), points, np.array(weights).ravel()


def _guess(times: Array, middles: Array) -> tuple[Array, Array]:
    """States, and torques between them, of the arms going up together: the closure and eq. 6, which no limit bounds."""
    mechanism = ckc_pin.load("five_bar")
    start = hanging().state.q

    def at(t: float) -> tuple[Array, Array]:
        s = t / T_END
        q = start + (UP - start) * (3 * s**2 - 2 * s**3)
        q_dot, q_ddot = (UP - start) * 6 * (s - s**2) / T_END, (UP - start) * (6 - 12 * s) / T_END**2
        named = (dict(zip(mechanism.independent, x.tolist(), strict=True)) for x in (q, q_dot))
        terms = ckc_pin.terms(mechanism, *named)
        return np.append(terms.at.q_tree, terms.v_tree), terms.D @ q_ddot + terms.C @ q_dot + terms.h

    return np.concatenate([at(t)[0] for t in times]), np.concatenate([at(t)[1] for t in middles])


def replay(found: Plan) -> Array:
    """Step the library's own loop with the plan's torques; return its states where intervals end, as the plan's."""
    simulator = hanging()
    states = [simulator.state]
    states += [simulator.step(u, dt) for u, dt in zip(found.u, np.diff(found.t), strict=True)]
    return np.array([np.concatenate([state.q_tree, state.v_tree]) for state in states])


@look()
def figure(found: Plan, replayed: Array) -> Any:
    """Return angles, torques, and poses with the tip's path."""
    import matplotlib.pyplot as plt

    drawn, (angles, torques, poses) = plt.subplots(1, 3, figsize=(7.0, 3.0), width_ratios=(1, 1, 0.75))
    for k, arm in enumerate(("left arm, θ₁", "right arm, θ₃")):
        angles.plot(found.t, found.states[:, 2 * k], color=COLOURS[k], label=arm)
        angles.plot(found.t, replayed[:, 2 * k], ".", ms=4, color=COLOURS[k])
        torques.stairs(found.u[:, k], found.t, baseline=None, lw=1.5, color=COLOURS[k])
    angles.axhline(UP[0], color="black", lw=0.8, ls=":", label="upright")
    torques.axhline(TORQUE, color="black", lw=0.8, ls="--", label="limits")
    torques.axhline(-TORQUE, color="black", lw=0.8, ls="--")
    angles.set(xlabel="t (s)", ylabel="angle (rad)", title="Arms (dots: replayed)")
    torques.set(xlabel="t (s)", ylabel="torque (N m)", title="Torques")
    path = _pins(found)[:, :, :2]
    for pins in path[:: (len(path) - 1) // (POSES - 1)]:
        for ends, colour in ((pins[:3], COLOURS[0]), (pins[2:], COLOURS[1])):
            poses.plot(*ends.T, "-o", color=colour, lw=1.2, ms=2.5, alpha=0.55)
    poses.plot(*path[:, 2].T, color="black", lw=1.5, label="path of the tip")
    poses.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"Poses every {T_END / (POSES - 1):.1f} s")
    drawn.legend(loc="outside lower center", ncols=5)
    return drawn


def _pins(found: Plan) -> Array:
    """Left foot, elbow, tip, elbow, right foot eight times an interval, (instants, 5, 3), metres."""
    simulator = hanging()
    states = [simulator.state]
    for u, dt in zip(found.u, np.diff(found.t), strict=True):
        states += [simulator.step(u, dt / 8) for _ in range(8)]
    poses = [state.terms.at.pose for state in states]
    return np.array([np.vstack([pose.translation[[1, 2]], pose.p[:1], pose.translation[[4, 3]]]) for pose in poses])


def main() -> Any:
    """Plan, replay, compare, and draw."""
    found = plan()
    replayed = replay(found)
    off = float(np.abs(replayed - found.states).max())
    level = ckc_pin.terms(ckc_pin.load("five_bar"), {"theta_1": 0.0, "theta_3": 0.0}).h
    print(f"IPOPT: {found.iterations} iterations, {found.seconds:.1f} s")
    print(f"largest torque: {np.abs(found.u).max():.6f} N m of {TORQUE:g}; both arms level take {level.max():.2f}")
    print(f"replayed in {len(found.u)} steps: off by {off:.1e} at most")
    assert off < EQUAL
    return figure(found, replayed)


if __name__ == "__main__":
    main().savefig("swing_up.png")
