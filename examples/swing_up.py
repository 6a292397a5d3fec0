"""A swing-up by IPOPT.

Motors that are too weak to hold the five-bar's arms level swing it up. IPOPT plans the motion, and the step loop
replays it. It leads from rest at the hanging equilibrium to rest with both arms straight up, on the assembly branch of
the start. Torques are constant on each interval.

- **Equations of motion:** the CasADi functions of `ckc_pin.symbolic`.
- **Method:** direct collocation. On each piece, a polynomial satisfies the equations of motion at the Gauss points. Its
  order at the end of the piece is 2 DEGREE.
- **End condition:** only on the independent angles and rates. The loops stay closed from the start. A second condition
  on them would give IPOPT constraints with linearly dependent gradients.
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
from ckc_pin.view.style import COLOURS, figure_style

T_END, INTERVALS = 1.6, 40  # s, and the number of intervals with constant u
PIECES, DEGREE = 2, 4  # pieces per interval, Gauss points per piece
TORQUE = 0.8  # N m, limit of each motor; holding both arms level takes 1.05
RATE_WEIGHT = 0.05  # N^2 m^2 s^2: weight of the squared rates in the cost, relative to the squared torques
UP = np.array([np.pi / 2, np.pi / 2])
REPLAY_TOLERANCE = 1e-6  # rad, rad/s: largest allowed difference of the replay
POSES = 5  # in the figure


@dataclass(frozen=True)
class Plan:
    """The planned motion.

    Attributes
    ----------
    t : (intervals + 1,) array
        Ends of the intervals, s.
    states : (intervals + 1, 8) array
        q' and v' at these times.
    u : (intervals, 2) array
        N m.
    """

    t: Array
    states: Array
    u: Array
    iterations: int
    seconds: float


def hanging() -> ckc_pin.Simulator:
    """Return a simulator of the five-bar at rest in its equilibrium, with a tight tolerance."""
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
    five_bar = ckc_pin.symbolic("five_bar")  # raises InputError without CasADi
    import casadi as cs

    count, columns = intervals * pieces, DEGREE + 1  # pieces; states of each: at its start and at the Gauss points
    h, hold = T_END / count, T_END / intervals
    piece, points, weights = _piece(five_bar, h)
    X, U = cs.MX.sym("X", 8, count * columns + 1), cs.MX.sym("U", 2, intervals)
    parts = cs.horzcat(*(X[:, k * columns : (k + 1) * columns + 1] for k in range(count)))
    end = X[:, -1]
    upright = cs.vertcat(end[0] - UP[0], end[2] - UP[1], end[4], end[6])
    constraints = cs.veccat(piece.map(count)(parts, cs.kron(U, np.ones((1, pieces)))), upright)
    share = h * np.tile(np.append(0.0, weights), count)
    cost = hold * cs.sumsqr(U) + RATE_WEIGHT * cs.sum1(X[4:, :-1] ** 2) @ share
    problem: Any = {"x": cs.veccat(X, U), "f": cost, "g": constraints}
    silent: Any = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9, "constr_viol_tol": 1e-10}}
    solver = cs.nlpsol("swing_up", "ipopt", problem, silent)

    times: Array = np.append([h * (k + x) for k in range(count) for x in (0.0, *points)], T_END)
    states, torques = _guess(times, np.array([hold * (k + 0.5) for k in range(intervals)]))
    free, limit = np.full(states[8:].shape, np.inf), np.full(torques.shape, torque)
    lower, upper = (np.concatenate([states[:8], sign * free, sign * limit]) for sign in (-1, 1))
    start = np.concatenate([states, np.clip(torques, -limit, limit)])
    started = perf_counter()
    numbers = np.array(solver(x0=start, lbx=lower, ubx=upper, lbg=0, ubg=0)["x"]).ravel()
    seconds, stats = perf_counter() - started, solver.stats()
    if not stats["success"]:
        raise NumericalError(f"swing-up: IPOPT reports {stats['return_status']} after {stats['iter_count']} iterations")
    ends = numbers[: len(states)].reshape(-1, 8)[:: columns * pieces]
    return Plan(times[:: columns * pieces], ends, numbers[len(states) :].reshape(-1, 2), stats["iter_count"], seconds)


def _piece(five_bar: Symbolic, h: float) -> tuple[Any, list[float], Array]:
    """Return the residual function of the collocation equations of a piece, its Gauss points and their weights."""
    import casadi as cs

    points = cs.collocation_points(DEGREE, "legendre")
    rates, end, weights = cs.collocation_coeff(points)
    x, u = cs.SX.sym("x", 8), cs.SX.sym("u", 2)
    tau = cs.vertcat(u[0], 0, u[1], 0)  # coordinates are theta_1 to theta_4
    x_dot = cs.Function("x_dot", [x, u], [cs.vertcat(x[4:], five_bar.v_dot(x[:4], x[4:], tau, five_bar.values))])
    states = cs.SX.sym("states", 8, DEGREE + 2)  # at the start, at the Gauss points, at the end
    slopes = cs.horzcat(*(x_dot(states[:, 1 + k], u) for k in range(DEGREE)))
    residuals = cs.horzcat(states[:, :-1] @ rates - h * slopes, states[:, :-1] @ end - states[:, -1])
    return cs.Function("piece", [states, u], [residuals]), points, np.array(weights).ravel()


def _guess(times: Array, middles: Array) -> tuple[Array, Array]:
    """Return the initial guess: states of both arms rising together, and the torques of eq. 6 without limits."""
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


def replay(solution: Plan) -> Array:
    """Simulate with the planned torques, and return the states at the ends of the intervals."""
    simulator = hanging()
    states = [simulator.state]
    states += [simulator.step(u, dt) for u, dt in zip(solution.u, np.diff(solution.t), strict=True)]
    return np.array([np.concatenate([state.q_tree, state.v_tree]) for state in states])


@figure_style()
def figure(solution: Plan, replayed: Array) -> Any:
    """Plot angles, torques, and poses with the path of the tip."""
    import matplotlib.pyplot as plt

    canvas, (angles, torques, poses) = plt.subplots(1, 3, figsize=(7.0, 3.0), width_ratios=(1, 1, 0.75))
    for k, arm in enumerate(("left arm, θ₁", "right arm, θ₃")):
        angles.plot(solution.t, solution.states[:, 2 * k], color=COLOURS[k], label=arm)
        angles.plot(solution.t, replayed[:, 2 * k], ".", ms=4, color=COLOURS[k])
        torques.stairs(solution.u[:, k], solution.t, baseline=None, lw=1.5, color=COLOURS[k])
    angles.axhline(UP[0], color="black", lw=0.8, ls=":", label="upright")
    torques.axhline(TORQUE, color="black", lw=0.8, ls="--", label="limits")
    torques.axhline(-TORQUE, color="black", lw=0.8, ls="--")
    angles.set(xlabel="t (s)", ylabel="angle (rad)", title="Arms (dots: replayed)")
    torques.set(xlabel="t (s)", ylabel="torque (N m)", title="Torques")
    path = _pins(solution)[:, :, :2]
    for pins in path[:: (len(path) - 1) // (POSES - 1)]:
        for ends, colour in ((pins[:3], COLOURS[0]), (pins[2:], COLOURS[1])):
            poses.plot(*ends.T, "-o", color=colour, lw=1.2, ms=2.5, alpha=0.55)
    poses.plot(*path[:, 2].T, color="black", lw=1.5, label="path of the tip")
    poses.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"Poses every {T_END / (POSES - 1):.1f} s")
    canvas.legend(loc="outside lower center", ncols=5)
    return canvas


def _pins(solution: Plan) -> Array:
    """Return the positions of left base, elbow, tip, elbow and right base, eight per interval: (instants, 5, 3), m."""
    simulator = hanging()
    states = [simulator.state]
    for u, dt in zip(solution.u, np.diff(solution.t), strict=True):
        states += [simulator.step(u, dt / 8) for _ in range(8)]
    poses = [state.terms.at.pose for state in states]
    return np.array([np.vstack([pose.translation[[1, 2]], pose.p[:1], pose.translation[[4, 3]]]) for pose in poses])


def main() -> Any:
    """Plan, replay, compare, and draw."""
    solution = plan()
    replayed = replay(solution)
    error = float(np.abs(replayed - solution.states).max())
    level = ckc_pin.terms(ckc_pin.load("five_bar"), {"theta_1": 0.0, "theta_3": 0.0}).h
    print(f"IPOPT: {solution.iterations} iterations, {solution.seconds:.1f} s")
    print(
        f"largest torque: {np.abs(solution.u).max():.6f} N m, limit {TORQUE:g}; both arms level take {level.max():.2f}"
    )
    print(f"replayed in {len(solution.u)} steps: largest difference {error:.1e}")
    assert error < REPLAY_TOLERANCE
    return figure(solution, replayed)


if __name__ == "__main__":
    main().savefig("swing_up.png")
