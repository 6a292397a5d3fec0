"""Run works with Pinocchio's constraintDynamics or lcaba and Boost.Odeint's Runge-Kutta-Fehlberg 7(8), a C++ loop."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.motion import Motion, motion_without_data
from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.formulations import dae_acceleration
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.benchmark.peers.compiled import program, version
from scripts.experiments.benchmark.peers.pinocchio import closure_constraints, closure_unsupported
from scripts.experiments.benchmark.peers.stepping import start_of
from scripts.experiments.benchmark.work import Work

__all__ = ["PinocchioLoop"]

TOLERANCES = tuple(10.0**-k for k in range(2, 14))
QUICK_TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
# K_p, 1/s^2; K_d = 2 sqrt(K_p). lcaba runs with the gain that wins more often, to keep the benchmark below 40 minutes.
GAINS = {"constraintDynamics": (0.0, 100.0), "lcaba": (100.0,)}
# Proximal parameter mu, number of iterations, and the tightest tolerance that is tried with them. One iteration is
# cheapest; where J loses rank, mu must be large. lcaba adds J^T J / mu to the inertias: its accelerations carry a
# rounding error of about 1e-14 / mu, and each iteration multiplies the error of the constraints by about mu / sigma^2,
# sigma the singular values of J M^{-1/2}. The settings were chosen by the errors of accelerations along the works.
PROXIMAL = {
    "constraintDynamics": ((1e-12, 1, 1e-13), (1e-8, 3, 1e-13), (1e-4, 10, 1e-13), (1e-2, 12, 1e-13)),
    "lcaba": ((1e-6, 2, 1e-10), (1e-5, 10, 1e-11), (1e-4, 3, 1e-12), (1e-3, 5, 1e-13), (1e-2, 12, 1e-13)),
}
QUICK_PROXIMAL = {
    "constraintDynamics": PROXIMAL["constraintDynamics"][::2],
    "lcaba": PROXIMAL["lcaba"][:3],
}
SETTINGS_OF_ONE_CALL = (*PROXIMAL["lcaba"], *PROXIMAL["constraintDynamics"], (1e-8, 2, 0.0), (1e-10, 2, 0.0))
CHECKED = {"constraintDynamics": (1e-8, 3), "lcaba": (1e-3, 5)}  # mu and iterations of the comparison at the start
ACCURACY = 1e-13  # accuracy of the multipliers at which the proximal iterations end
START = 5.0  # s: allowance for the start of the program

Answer = dict[str, list[list[float]]]  # numbers of the program's output lines, by the first word of the line


class PinocchioLoop:
    """Adaptive explicit integration with Pinocchio, as an experienced user would write it in C++.

    Parameters
    ----------
    algorithm : "constraintDynamics" or "lcaba"
        The function of Pinocchio that computes the accelerations.
    """

    packaged = False  # the loop is written by hand

    def __init__(self, algorithm: str) -> None:
        self.algorithm = algorithm
        self.name = f"Pinocchio {algorithm}, RKF78 in C++"

    def missing(self, work: Work) -> str | None:
        return closure_unsupported(work) or program()[1]

    def version(self) -> str:
        return version()

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        proximal, tolerances = (QUICK_PROXIMAL, QUICK_TOLERANCES) if quick else (PROXIMAL, TOLERANCES)
        for gain, (mu, iterations, tightest) in product(GAINS[self.algorithm], proximal[self.algorithm]):
            for tolerance in tolerances:
                if tolerance >= tightest:
                    yield f"K_p {gain:g}, mu {mu:g}, iterations {iterations}, tolerance {tolerance:g}"

    def check(self, work: Work) -> str:
        """Compare D', the bias, the energy and the constrained acceleration at the start."""
        mechanism, tree = work.mechanism, work.mechanism.tree
        q_tree, v_tree = start_of(work)
        answer = _answer(_problem(work, self.algorithm, 0.0, *CHECKED[self.algorithm], TOLERANCES[0], []), None)
        numbers = {name: np.array(lines[0]) for name, lines in answer.items()}
        terms = Terms(mechanism, mechanism.kinematics(q_tree), v_tree)
        bias = pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree)
        energy = pin.computeMechanicalEnergy(tree.model, tree.data, q_tree, v_tree)
        mass = _relative_difference(numbers["D"].reshape(tree.n, tree.n), terms.D_tree)
        ours = dae_acceleration(terms, np.zeros(tree.n))
        return (
            f"D' agrees to {mass:.0e}, the bias to {_relative_difference(numbers['bias'], bias):.0e}, the energy to "
            f"{abs(numbers['energy'][0] - energy):.0e} J; the constrained acceleration differs by "
            f"{_relative_difference(numbers['acceleration'], ours):.0e}"
        )

    def acceleration_s(self, work: Work, accuracy: float) -> float | None:
        """Return the time of an acceleration at the start by the fastest setting that is accurate enough, s.

        Parameters
        ----------
        work : Work
        accuracy : float
            Largest difference from ckc_pin's acceleration, relative to its largest entry.
        """
        q_tree, v_tree = start_of(work)
        terms = Terms(work.mechanism, work.mechanism.kinematics(q_tree), v_tree)
        reference = dae_acceleration(terms, np.zeros(work.mechanism.n))
        times = []
        for mu, iterations, _ in SETTINGS_OF_ONE_CALL:
            answer = _answer(_problem(work, self.algorithm, 0.0, mu, iterations, TOLERANCES[0], []), None)
            if _relative_difference(np.array(answer["acceleration"][0]), reference) <= accuracy:
                times.append(answer["acceleration_s"][0][0])
        return min(times, default=None)

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        gain, mu, iterations, tolerance = (float(part.split()[1]) for part in setting.split(", "))
        tree = work.mechanism.tree
        try:
            problem = _problem(work, self.algorithm, gain, mu, int(iterations), tolerance, work.instants)
            answer = _answer(problem, budget)
        except subprocess.TimeoutExpired:
            return motion_without_data("refused", f"takes longer than the budget, {budget:.0f} s")
        except subprocess.CalledProcessError as error:
            render_blocks = " ".join(error.stderr.split()) or f"it ended with {error.returncode}"
            return motion_without_data("failed", render_blocks)
        states = np.array(answer["state"])
        q_tree = np.array([tree.to_coordinates(state) for state in states[:, : tree.model.nq]])
        wall, steps, rhs = answer["cost"][0]
        return Motion("done", "", q_tree, states[:, tree.model.nq :], wall, steps=int(steps), rhs=int(rhs))


def _answer(problem: str, budget: float | None) -> Answer:
    patience = None if budget is None else budget + START
    done = subprocess.run(
        [str(program()[0])], input=problem, capture_output=True, text=True, timeout=patience, check=True
    )
    answer: Answer = {}
    for line in done.stdout.splitlines():
        name, *numbers = line.split()
        answer.setdefault(name, []).append([float(x) for x in numbers])
    return answer


def _problem(
    work: Work,
    algorithm: str,
    gain: float,
    mu: float,
    iterations: int,
    tolerance: float,
    instants: Sequence[float] | Array,
) -> str:
    """Return a work as the program's input; without instants the program only evaluates the start."""
    mechanism = work.mechanism
    constraints = list(closure_constraints(mechanism))
    q_tree, v_tree = start_of(work)
    kinds = {pin.ContactType.CONTACT_3D: 3, pin.ContactType.CONTACT_6D: 6}
    parts: list[Any] = [*_tree(mechanism), algorithm, gain, len(constraints)]
    for kind, joint_a, on_a, joint_b, on_b in constraints:
        parts += [kinds[kind], joint_a, *_placed(on_a), joint_b, *_placed(on_b)]
    parts += [ACCURACY, mu, iterations, *_springs(mechanism), tolerance, *q_tree, *v_tree]
    parts += [len(instants), *instants]
    return " ".join(str(part) for part in parts)


def _tree(mechanism: Mechanism) -> Iterator[Any]:
    model = mechanism.tree.model
    yield from model.gravity.linear
    yield model.njoints - 1
    for k in range(1, model.njoints):
        yield from [model.parents[k], *_placed(model.jointPlacements[k])]
        if model.joints[k].nv == 6:
            yield "free"
        else:
            axis, turns = mechanism.tree.axis(k)
            yield from ["turns" if turns else "slides", *axis]
        inertia = model.inertias[k]
        yield from [inertia.mass, *inertia.lever, *inertia.inertia.ravel()]
    yield from model.armature


def _springs(mechanism: Mechanism) -> Iterator[Any]:
    springs = mechanism.springs
    count = len(springs.stiffness)
    yield count
    for k in range(count):
        for end in (k, count + k):
            yield from [springs.anchors.point_joint[end], *springs.anchors.point_local[end]]
        yield from [springs.stiffness[k], springs.rest_length[k], springs.damping[k]]
    for on_joints in (springs.joint_stiffness, springs.joint_rest, springs.joint_damping, springs.constant):
        yield from on_joints


def _placed(placement: pin.SE3) -> list[float]:
    return [*placement.rotation.ravel(), *placement.translation]


def _relative_difference(theirs: Array, ours: Array) -> float:
    return float(np.abs(theirs - ours).max() / max(float(np.abs(ours).max()), 1.0))
