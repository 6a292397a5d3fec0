"""How often the truth lies within two standard deviations of identified parameters.

Each trial adds other noise to one exact motion. The errors of all base combinations are compared with their standard
deviations. Combinations of one trial are correlated, so the bounds take trials, not combinations, as independent.

Parameters from torques also predict the torques of another motion, whose coordinates have noise too.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Mechanism
from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import RecordedTorques
from ckc_pin.formats.importing import import_texts
from ckc_pin.identification.motions import make_unknowns
from ckc_pin.identification.regressor import TorqueRegressor

__all__ = ["CASES", "TrialCounts", "main", "run_trials"]

EXPECTED = 0.9545  # of a normal variable within two standard deviations
LEG = """<robot name="leg"><link name="base"/>
  <link name="thigh"><inertial><origin xyz="0.036 0 0"/><mass value="0.23"/>
    <inertia ixx="1e-5" iyy="4e-5" izz="4.5e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="driver"><inertial><origin xyz="0.048 0 0"/><mass value="0.02"/>
    <inertia ixx="1e-6" iyy="1.6e-5" izz="1.6e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="shank"><inertial><origin xyz="0.04 0 0"/><mass value="0.2"/>
    <inertia ixx="5e-6" iyy="2e-5" izz="2.3e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="foot"><inertial><origin xyz="0.06 0.002 0"/><mass value="0.05"/>
    <inertia ixx="2e-6" iyy="2.1e-5" izz="2.2e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hip" type="continuous"><parent link="base"/><child link="thigh"/><axis xyz="0 0 1"/></joint>
  <joint name="knee" type="continuous" independent="true"><parent link="thigh"/><child link="driver"/>
    <origin xyz="0.011 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="support" type="continuous" independent="false"><parent link="thigh"/><child link="shank"/>
    <origin xyz="0.042 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="ankle" type="continuous" independent="false"><parent link="driver"/><child link="foot"/>
    <origin xyz="0.096 0 0"/><axis xyz="0 0 1"/></joint>
  <loop name="linkage" type="revolute"><predecessor link="foot"><origin xyz="0.031 0 0"/></predecessor>
    <successor link="shank"><origin xyz="0.096 0 0"/></successor><axis xyz="0 0 1"/></loop></robot>"""
LEG_KEYS = """
gravity = [0.0, -9.81, 0.0]
q_guess = {hip = -1.2, knee = 0.9, support = 0.9, ankle = -0.9}
"""


@dataclass(frozen=True)
class Case:
    """A mechanism, its motion, and the noise of its measurements.

    Attributes
    ----------
    waves : tuple of (float, float)
        Amplitude, rad or sizes of the mechanism, and frequency, rad/s, of three waves of each coordinate.
    noise, torque_noise : float
        Standard deviations of coordinates, rad or m, and of torques, N m or N.
    true : mapping
        Parameters that differ from the mechanism's files.
    parameters : sequence of str
        Estimated from torques.
    of_motion : sequence of str
        Estimated from motion.
    """

    waves: tuple[tuple[float, float], ...]
    noise: float
    torque_noise: float
    true: Mapping[str, float] = field(default_factory=dict)
    parameters: Sequence[str] = ("link.*.inertial",)
    of_motion: Sequence[str] = ()


CASES = {
    "five_bar": Case(
        ((0.25, 2.5), (0.15, 7.5), (0.05, 12.5)), 1e-4, 0.01,
        {f"joint.theta_{k}.{key}": x for k in (1, 2, 3, 4)
         for key, x in (("friction", 0.05 - 0.03 * (k % 2 == 0)), ("damping", 0.02 - 0.01 * (k % 2 == 0)))},
        ("link.*.inertial", "joint.*.friction", "joint.*.damping"), ("link.link_2.inertial", "joint.*.damping"),
    ),
    "delta": Case(
        ((0.3, 4.0), (0.1, 9.0), (0.05, 14.0)), 1e-4, 0.01,
        {f"joint.arm_{k}.damping": 0.02 for k in (1, 2, 3)},
        ("link.*.inertial", "joint.arm_*.damping"), ("link.plate.inertial", "joint.arm_*.damping"),
    ),
    "stewart": Case(
        ((0.1, 5.0), (0.06, 9.0), (0.02, 15.0)), 1e-5, 0.1,
        {f"joint.leg_{k}.damping": 5.0 for k in range(1, 7)},
        ("link.*.inertial", "joint.leg_*.damping"), ("link.plate.inertial", "joint.leg_*.damping"),
    ),
    "leg": Case(
        ((0.4, 4.0), (0.2, 9.0), (0.1, 14.0)), 1e-4, 0.002,
        {"joint.hip.damping": 0.003, "joint.knee.damping": 0.002},
        ("link.*.inertial", "joint.*.damping"), ("link.thigh.mass", "link.shank.mass", "joint.*.damping"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class TrialCounts:
    """Counts of a case.

    Attributes
    ----------
    inside, total : int
        Combinations within two standard deviations, and all.
    rms : float
        Root mean square of error over standard deviation; 1 if standard deviations are right.
    bounds : pair of float
        Of the share inside, four standard errors by the variation between trials.
    validation_rms : float or None
        Residual of the torques of a motion that was not fitted, relative to the noise of the torques; root mean square.
    """

    trials: int
    inside: int
    total: int
    rms: float
    bounds: tuple[float, float]
    validation_rms: float | None

    @property
    def share(self) -> float:
        """Share of the combinations within two standard deviations."""
        return self.inside / self.total


@cache
def load_case(name: str) -> Mechanism:
    """Return the true mechanism of a case."""
    true = dict(CASES[name].true)
    if name != "leg":
        return ckc_pin.load(name, true or None)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "leg.urdf").write_text(LEG)
        with warnings.catch_warnings(action="ignore"):  # it says what it guessed
            texts = import_texts(Path(folder) / "leg.urdf")
        lines = texts["mechanism.toml"].splitlines()
        kept = [line for line in lines if not line.startswith("gravity")]
        at = next(k for k, line in enumerate(kept) if line.startswith("urdf"))
        texts["mechanism.toml"] = "\n".join([*kept[: at + 1], LEG_KEYS, *kept[at + 1 :]])
        for file, text in texts.items():
            (Path(folder) / file).write_text(text)
        return ckc_pin.load(folder, true)


@cache
def exact_motion(name: str, t_end: float, dt: float, *, validation: bool = False) -> Any:
    """Return motion and torques without noise, of the motion that is fitted or of one with other phases."""
    mechanism, case = load_case(name), CASES[name]
    at = mechanism.partition.q
    start = mechanism.tree.to_coordinates(mechanism.q_tree)[at]
    desired = {
        coordinate: {
            "offset": float(q),
            "harmonics": [
                [a * scale, w * (1 + 0.13 * k), 2.1 * k + 0.7 * i + 0.4 if validation else 1.3 * k + i]
                for i, (a, w) in enumerate(case.waves)
            ],
        }
        for k, (coordinate, q, scale) in enumerate(
            zip(mechanism.independent, start, mechanism.tree.step_scale[at].tolist(), strict=True)
        )
    }
    law = {"type": "tracking", "Lambda": 1.0, "K_D": 10.0, "desired": desired}
    scene = ckc_pin.Scene(mechanism, t_end=t_end, controller=law, solver={"output_dt": dt})
    forces = ckc_pin.inverse_dynamics(scene)
    if forces.status != "done":
        raise RuntimeError(f"{name}: {forces.message}")
    return forces


def measure_torques(name: str, seed: int, *, validation: bool = False) -> dict[str, Array]:
    """Return noisy coordinates and torques of 4 s at 250 Hz."""
    mechanism, case, forces = load_case(name), CASES[name], exact_motion(name, 4.0, 0.004, validation=validation)
    rng = np.random.default_rng([seed, 1] if validation else seed)
    data = {"t": forces.t}
    for k, coordinate in zip(mechanism.partition.q, mechanism.independent, strict=True):
        data[coordinate] = forces.q_tree[:, k] + case.noise * rng.normal(size=len(forces.t))
    for motor, tau in zip(mechanism.motors.names, forces.tau.T, strict=True):
        data[f"tau.{motor}"] = tau + case.torque_noise * rng.normal(size=len(tau))
    return data


@cache
def exact_run(name: str) -> tuple[Any, Array]:
    """Return a run with the torques of the exact motion, 1 s, and the torques at its instants."""
    mechanism, forces = load_case(name), exact_motion(name, 1.0, 0.005)
    at = mechanism.partition.q
    run = ckc_pin.simulate(
        mechanism, t_end=1.0, formulation="dae", controller=RecordedTorques(forces.t, forces.tau, interpolates=True),
        initial={"q": dict(zip(mechanism.coordinates, forces.q_tree[0].tolist(), strict=True)),
                 "q_dot": dict(zip(mechanism.independent, forces.v_tree[0][at].tolist(), strict=True))},
        solver={"rtol": 1e-12, "atol": 1e-13, "output_dt": 0.005},
    )  # fmt: skip
    return run, forces.tau


def measure_motion(name: str, seed: int) -> dict[str, Array]:
    """Return noisy coordinates of a run of 1 s at 200 Hz, and its exact torques."""
    mechanism, case = load_case(name), CASES[name]
    run, tau = exact_run(name)
    rng = np.random.default_rng(seed)
    data = {"t": run.t}
    for coordinate in mechanism.independent:
        data[coordinate] = run[coordinate] + 10 * case.noise * rng.normal(size=len(run.t))
    return data | {f"tau.{motor}": x for motor, x in zip(mechanism.motors.names, tau.T, strict=True)}


def run_trials(name: str, method: str, trials: int, first: int = 0) -> TrialCounts:
    """Run trials with other noise each, and compare errors with standard deviations."""
    mechanism, case = load_case(name), CASES[name]
    names = case.of_motion if method == "motion" else case.parameters
    unknowns = make_unknowns(mechanism, names) if method == "motion" else TorqueRegressor(mechanism, names)
    truth = dict(zip(unknowns.names, unknowns.start, strict=True))
    ratios: list[Array] = []
    residuals: list[float] = []
    for seed in range(first, first + trials):
        data = measure_motion(name, seed) if method == "motion" else measure_torques(name, seed)
        other = () if method == "motion" else measure_torques(name, seed, validation=True)
        result = ckc_pin.identify(mechanism, data, names, method=method, physical=method == "motion", validation=other)
        residuals += [x.rms / case.torque_noise for x in result.validation.values()]
        off = [(x.value - sum(c * truth[key] for key, c in x.coefficients.items())) / x.std for x in result.base]
        ratios.append(np.abs(off))
    shares = np.array([np.mean(x <= 2) for x in ratios])
    error = 4 * float(shares.std(ddof=1) if trials > 1 else 0.0) / trials**0.5
    together = np.concatenate(ratios)
    return TrialCounts(
        trials, int(np.sum(together <= 2)), len(together), float(np.sqrt(np.mean(together**2))),
        (EXPECTED - error, EXPECTED + error), float(np.sqrt(np.mean(np.square(residuals)))) if residuals else None,
    )  # fmt: skip


def main(names: Collection[str], method: str, trials: int) -> int:
    """Print a table of all cases, and return 1 if the share of one is below its bounds."""
    print(
        "| case | trials | combinations | within 2 standard deviations | bounds | rms of error / std "
        "| torques of another motion, rms / noise |"
    )
    print("|---|---|---|---|---|---|---|")
    missed = 0
    for name in names:
        x = run_trials(name, method, trials)
        low, high = (f"{100 * bound:.1f}" for bound in x.bounds)
        rms = "" if x.validation_rms is None else f"{x.validation_rms:.3f}"
        print(f"| {name} | {trials} | {x.total // trials} | {100 * x.share:.1f} % | {low} to {high} % | {x.rms:.2f} "
              f"| {rms} |", flush=True)  # fmt: skip
        missed |= x.share < x.bounds[0]
    return int(missed)
