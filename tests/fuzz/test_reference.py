"""The fuzz suite's reference integrator against closed forms, published results, conservation of energy, and eq. 1."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin.dynamics import Terms
from ckc_pin.dynamics.formulations import dae_acceleration
from scripts.experiments.fuzz.mechanisms import random_mechanism
from scripts.experiments.fuzz.read import Model, read_model
from scripts.experiments.fuzz.reference import ReferenceIntegrator
from scripts.experiments.fuzz.spatial import Array, apply
from scripts.experiments.fuzz.state import compute_energy, split_state, to_coordinates, to_state
from tests.regression.test_reference_cases import pendulum_constant

PENDULUM = {
    "mechanism.toml": 'name = "pendulum"\nurdf = "pendulum.urdf"\ngravity = [0.0, -9.81, 0.0]\n',
    "pendulum.urdf": '<robot name="p"><link name="ground"/><link name="rod"><inertial><origin xyz="0 0.6 0.8"/>'
    '<mass value="1"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="pin" type="continuous"><parent link="ground"/><child link="rod"/>'
    '<origin xyz="0 0 0" rpy="0 1.5707963267948966 0"/><axis xyz="-2 0 0"/></joint></robot>',
}
PERIOD = 2.36784194757624  # s, of a pendulum of 1 m released horizontally


def files_of(name: str) -> dict[str, str]:
    """Return the texts of a shipped mechanism's files."""
    return dict(ckc_pin.load(name).sources.texts)


def follow(reference: ReferenceIntegrator, q: Array, v: Array, times: Array, substeps: int = 4) -> tuple[Array, Array]:
    """Integrate one motion between consecutive times with a fixed number of steps."""
    q, v = q[None], v[None]
    for dt in np.diff(times):
        predicted = q + dt * v
        end, _ = reference.integrate(to_state(reference.model, q, v), predicted, np.array([dt]), substeps)
        q, v = to_coordinates(reference.model, end, predicted)
    return q[0], v[0]


def to_vector(model: Model, numbers: dict[str, float]) -> Array:
    """Return coordinates or rates by name as a vector in the model's order."""
    return np.array([numbers.get(label, 0.0) for label in model.labels])


def test_a_pendulum_returns_after_its_period() -> None:
    reference = ReferenceIntegrator(read_model(PENDULUM))
    # the axis is the world's z, and the mass is at (0.8, 0.6) in the plane perpendicular to it
    horizontal = np.array([-np.arctan2(0.6, 0.8)])
    x, *_ = split_state(to_state(reference.model, horizontal[None], np.zeros((1, 1))))
    assert np.abs(x[0, 0, 1]) < 1e-15
    q, v = follow(reference, horizontal, np.zeros(1), np.linspace(0, PERIOD, 21))
    assert abs(q[0] - horizontal[0]) < 1e-10
    assert abs(v[0]) < 1e-9


def test_acceleration_of_a_row_of_squares_is_the_closed_form() -> None:
    reference = ReferenceIntegrator(read_model(files_of("n_four_bar")))
    angle, N = 1.1, 4
    q, v = (
        to_vector(reference.model, {f"theta_{k}": x for k in range(N + 1)} | {f"psi_{k}": -x for k in range(1, N + 1)})
        for x in (angle, 0.7)
    )
    _, alpha, _ = reference.dynamics.compute_accelerations(to_state(reference.model, q[None], v[None]), q[None])
    rods = [reference.model.labels.index(f"theta_{k}") for k in range(N + 1)]
    assert np.abs(alpha[0, rods, 2] + pendulum_constant(N) * np.cos(angle)).max() < 1e-11


def test_andrews_mechanism_ends_at_the_published_state() -> None:
    reference = ReferenceIntegrator(read_model(files_of("andrews")))
    names = ["beta", "theta", "gamma", "phi", "delta", "omega", "eps"]
    first = [-0.0617138900142764496, 0, 0.455279819163070380, 0.222668390165885885, 0.487364979543842550,
             -0.222668390165885885, 1.23054744454982119]  # fmt: skip
    last = [15.81077119515370, -15.75637105841184, 0.04082224011964587, -0.5347301163420793, 0.5244099658799541,
            0.5347301163420791, 1.048080741041938]  # fmt: skip
    model = reference.model
    begin = to_vector(model, dict(zip(names, first, strict=True)))
    q, _ = follow(reference, begin, np.zeros(7), np.linspace(0, 0.03, 61))
    assert np.abs(q - to_vector(model, dict(zip(names, last, strict=True)))).max() < 1e-9


def test_bricards_third_hinge_ends_at_the_published_position() -> None:
    reference = ReferenceIntegrator(read_model(files_of("bricard")))
    q, v = follow(reference, np.zeros(5), np.zeros(5), np.linspace(0, 1, 11))
    x, R, _, _ = split_state(to_state(reference.model, q[None], v[None]))
    rod = reference.model.labels.index("hinge_2")
    hinge = x[0, rod] + apply(R[0, rod], np.array([0.0, -0.5, 0.0]))
    assert np.abs(hinge - [0.27448132, -0.88670794, -0.46233000]).max() < 2e-8


@pytest.mark.parametrize(
    "name", ["five_bar", "slider_crank_spatial", "delta", "stewart", "three_rrr", "two_ur5", "talos"]
)
def test_accelerations_of_shipped_mechanisms_are_those_of_eq_1(name: str) -> None:
    assert_same_accelerations(ckc_pin.load(name), files_of(name))


@pytest.mark.parametrize("seed", range(24))
def test_accelerations_of_random_mechanisms_are_those_of_eq_1(seed: int, tmp_path: Path) -> None:
    random_files = random_mechanism(seed)
    assert_same_accelerations(ckc_pin.load(random_files.write(tmp_path)), random_files.texts)


def assert_same_accelerations(mechanism: ckc_pin.Mechanism, files: dict[str, str]) -> None:
    reference, at = ReferenceIntegrator(read_model(files)), mechanism.assembled
    random = np.random.default_rng(0)
    J, v_tree = at.J, random.uniform(-1, 1, mechanism.n)
    v_tree = v_tree - np.linalg.pinv(J, rcond=1e-8) @ (J @ v_tree)
    right = dae_acceleration(Terms(mechanism, at, v_tree), np.zeros(mechanism.n))
    order = [mechanism.coordinates.index(label) for label in reference.model.labels]
    q, v = mechanism.tree.to_coordinates(mechanism.q_tree)[order][None], v_tree[order][None]
    Y = to_state(reference.model, q, v)
    back = to_coordinates(reference.model, Y, q)
    assert np.abs(back[0] - q).max() < 1e-12
    assert np.abs(back[1] - v).max() < 1e-12 * max(1, mechanism.size)
    step = 1e-4  # v' by differences of order 6 in the direction of dY/dt
    rate, _ = reference.dynamics.state_derivative(Y, q)
    ends = [to_coordinates(reference.model, Y + k * step * rate, q)[1][0] for k in (-3, -2, -1, 1, 2, 3)]
    v_dot = np.array([-1, 9, -45, 45, -9, 1]) @ np.array(ends) / (60 * step)
    scale = max(1.0, np.abs(right).max())
    assert np.abs(v_dot - right[order]).max() < 1e-8 * scale


@pytest.mark.parametrize("seed", [2, 5, 21])
def test_energy_of_random_mechanisms_is_conserved_without_dampers(seed: int) -> None:
    files = random_mechanism(seed).texts
    mechanism = files["mechanism.toml"]
    reference = ReferenceIntegrator(read_model({**files, "mechanism.toml": mechanism.replace("damping", "#")}))
    model = reference.model
    assert model.conservative
    guess = {key: float(value) for key, _, value in (line.partition(" = ") for line in mechanism.splitlines())
             if key in model.labels}  # fmt: skip
    q = to_vector(model, guess)
    q_end, v_end = follow(reference, q, np.zeros(model.n), np.linspace(0, 0.2, 9))
    (T_0, V_0), (T_1, V_1) = (
        compute_energy(model, q[None], np.zeros((1, model.n))),
        compute_energy(model, q_end[None], v_end[None]),
    )
    assert T_1[0] > 1e-6 or not model.gravity.any()
    assert abs(T_1 + V_1 - T_0 - V_0)[0] < 1e-10 * max(T_1[0], abs(V_0[0]))
