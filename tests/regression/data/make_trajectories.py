"""Makes the reference trajectories beside it: ``python -m tests.regression.data.make_trajectories``.

Only the numpy five-bar, numpy and scipy take part. Every case is integrated twice, in formulations that
share neither coordinates nor solver: eq. 6 on the closed-form sigma with DOP853, which is what the files
hold, and eq. 1 with multipliers in all four angles with RK45 (Dormand-Prince 5). The
largest difference of the two in q' is kept in each file and must stay below `AGREEMENT`.

A file holds, a row an instant of `t`: `q_tree`, `v_tree` (4, order of `coordinates`), `u` (2, order of
`independent`), `lambda` (2, the multipliers of eq. 27's rows, eq. 1 with ``+ J^T lambda`` on the side of
the forces) and `energy`; `controller_scale` says by what the controller's idea of the masses and of the
inertias about the centres of mass is multiplied.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import DOP853, RK45, OdeSolver, solve_ivp

from tests.analytic.five_bar import (
    AS_PRINTED,
    FIVE_BAR,
    Array,
    Controller,
    FiveBar,
    Q,
    no_control,
    set_point,
    tracking,
)

AGREEMENT = 1e-11
PLANTS = {"five_bar": FIVE_BAR, "five_bar_as_printed": AS_PRINTED}
Q_D = np.array([np.pi / 4, np.pi / 4])  # the shipped set-point scenes' target


@dataclass(frozen=True)
class Case:
    """One reference trajectory, from rest at the hanging equilibrium moved by `offset` in q."""

    mechanism: str
    scene: str
    t: tuple[float, ...]
    controller: Callable[[FiveBar], Controller]
    offset: float = 0.0
    mass: float = 1.0  # by what the controller's masses and inertias differ from the plant's
    inertia: float = 1.0


TRACKING_T = (0.5, 2.0, 4.0, 7.0, 9.5)
SET_POINT_T = (0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
SWING_T = (0.5, 1.0, 1.5, 2.0)


def _set_point(model: FiveBar) -> Controller:
    return set_point(model, Q_D)


def _none(model: FiveBar) -> Controller:
    return no_control


CASES = {
    "tracking": Case("five_bar", "tracking", TRACKING_T, tracking),
    # the controller's links 20 % too heavy: everything in their <inertial> but the centre of mass times 1.2
    "tracking_heavy_links": Case("five_bar", "tracking", TRACKING_T, tracking, mass=1.2, inertia=1.2),
    # the other reading: masses times 1.2, inertias about the centres of mass right
    "tracking_heavy_masses": Case("five_bar", "tracking", TRACKING_T, tracking, mass=1.2),
    "set_point": Case("five_bar", "set_point", SET_POINT_T, _set_point),
    "set_point_as_printed": Case("five_bar_as_printed", "set_point", SET_POINT_T, _set_point),
    "swing": Case("five_bar", "swing", SWING_T, _none, offset=0.5),
    "swing_as_printed": Case("five_bar_as_printed", "swing", SWING_T, _none, offset=0.5),
}


def reduced(plant: FiveBar, u: Controller, start: Array, t: Array) -> tuple[Array, Array]:
    """q' and v' at `t` by eq. 6: the state is (q, q_dot), sigma is closed form."""

    def right_hand_side(t: float, y: Array) -> Array:
        q_tree, q_dot = plant.sigma(y[:2]), y[2:]
        return np.concatenate([q_dot, plant.acceleration(q_tree, q_dot, u(t, q_tree, q_dot))])

    y = _integrate(right_hand_side, np.concatenate([start[Q], np.zeros(2)]), t, DOP853, 1e-13)
    q_tree = np.array([plant.sigma(row[:2]) for row in y])
    return q_tree, np.array([plant.rho(x) @ row[2:] for x, row in zip(q_tree, y, strict=True)])


def with_multipliers(plant: FiveBar, u: Controller, start: Array, t: Array) -> tuple[Array, Array]:
    """The same by eq. 1 in all four angles, phi differentiated twice and not corrected."""

    def right_hand_side(t: float, y: Array) -> Array:
        q_tree, v_tree = y[:4], y[4:]
        a, _ = plant.acceleration_and_multipliers(q_tree, v_tree, u(t, q_tree, v_tree[Q]))
        return np.concatenate([v_tree, a])

    y = _integrate(right_hand_side, np.concatenate([start, np.zeros(4)]), t, RK45, 1e-12)
    return y[:, :4], y[:, 4:]


def _integrate(f: Callable[..., Array], y: Array, t: Array, method: type[OdeSolver], rtol: float) -> Array:
    # from instant to instant, so that no value is an interpolated one
    rows = []
    for begin, end in zip([0.0, *t[:-1]], t, strict=True):
        solution = solve_ivp(f, (begin, end), y, method=method, rtol=rtol, atol=rtol / 10, t_eval=[end])
        if not solution.success:
            raise RuntimeError(solution.message)
        y = solution.y[:, -1]
        rows.append(y)
    return np.array(rows)


def trajectory(case: Case) -> dict[str, object]:
    """The content of one file."""
    plant = PLANTS[case.mechanism]
    u = case.controller(plant.heavier(case.mass, case.inertia))
    start, t = plant.sigma(plant.equilibrium()[Q] + case.offset), np.array(case.t)
    q_tree, v_tree = reduced(plant, u, start, t)
    q_check, _ = with_multipliers(plant, u, start, t)
    difference = float(np.abs(q_tree - q_check).max())
    if not difference < AGREEMENT:
        raise RuntimeError(f"{case}: the two formulations differ by {difference:.1e}")
    torques = np.array([u(*row) for row in zip(t, q_tree, v_tree[:, Q], strict=True)])
    rows = list(zip(q_tree, v_tree, torques, strict=True))
    return {
        "mechanism": case.mechanism,
        "scene": case.scene,
        "controller_scale": {"mass": case.mass, "inertia": case.inertia},
        "difference_of_two_formulations": difference,
        "coordinates": ["theta_1", "theta_2", "theta_3", "theta_4"],
        "independent": ["theta_1", "theta_3"],
        "q_tree_start": start.tolist(),
        "t": list(case.t),
        "q_tree": q_tree.tolist(),
        "v_tree": v_tree.tolist(),
        "u": torques.tolist(),
        "lambda": [plant.acceleration_and_multipliers(*row)[1].tolist() for row in rows],
        "energy": [float(plant.energy(*row[:2])) for row in rows],
    }


def main() -> None:
    """Write every file."""
    for name, case in CASES.items():
        content = trajectory(case)
        path = Path(__file__).with_name(f"{name}.json")
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        print(f"{path.name}: two formulations within {content['difference_of_two_formulations']:.1e}")


if __name__ == "__main__":
    main()
