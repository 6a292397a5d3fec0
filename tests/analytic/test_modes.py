"""Modes of linear models: exact zeros, slow modes, shapes of equal eigenvalues, and animations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, linearize, load
from ckc_pin.dynamics import Terms
from ckc_pin.linear.linear_model import linear_model
from ckc_pin.linear.mode_animation import animate_mode, animate_modes

BODY = ('<link name="{name}"><inertial><origin xyz="{x} 0.02 -0.03"/><mass value="{m}"/>'
        '<inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0.001" ixz="-0.002" iyz="0.0005"/></inertial>'
        "</link>")  # fmt: skip
HINGE = ('<joint name="hinge" type="continuous"><parent link="a"/><child link="b"/>'
         '<origin xyz="0.3 0.1 0"/><axis xyz="0.1 0.2 1"/></joint>')  # fmt: skip
SLIDE = ('<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/><axis xyz="1 0 0"/>'
         '<limit lower="-9" upper="9" effort="1" velocity="1"/></joint>')  # fmt: skip


def load_mechanism(folder: Path, body: str, text: str) -> Mechanism:
    (folder / "it.urdf").write_text(f'<robot name="it">{body}</robot>')
    (folder / "mechanism.toml").write_text(f'name = "it"\n{text}')
    return load(str(folder / "mechanism.toml"))


def two_free_bodies(folder: Path, gravity: float = 0.0) -> Mechanism:
    bodies = BODY.format(name="a", x=0.1, m=1.3) + BODY.format(name="b", x=0.2, m=0.7) + HINGE
    return load_mechanism(folder, bodies, f'gravity = [0, 0, {-gravity}]\n[[tree]]\nfile = "it.urdf"\nroot = "free"\n'
                '[[spring]]\njoint = "hinge"\nstiffness = 3.0\nrest = 0.4\n')  # fmt: skip


def two_masses(folder: Path, weak: float, strong: float) -> Mechanism:
    """A mass on a spring to the ground, and a second mass on a spring to the first."""
    bodies = '<link name="ground"/>' + BODY.format(name="a", x=0, m=1.5) + BODY.format(name="b", x=0, m=0.5)
    bodies += SLIDE.format(name="x", parent="ground", child="a") + SLIDE.format(name="y", parent="a", child="b")
    springs = "".join(
        f'[[spring]]\njoint = "{k}"\nstiffness = {c}\nrest = 0.0\n' for k, c in (("x", weak), ("y", strong))
    )
    return load_mechanism(folder, bodies, f'urdf = "it.urdf"\n{springs}')


def at_rest(mechanism: Mechanism, q_tree: np.ndarray) -> Terms:
    return Terms(mechanism, mechanism.kinematics(q_tree), np.zeros(mechanism.n))


@pytest.mark.parametrize(("gravity", "motions"), [(0.0, 6), (9.81, 4)])
@pytest.mark.parametrize("seed", range(3))
def test_free_bodies_have_twelve_eigenvalues_that_are_exactly_zero(
    seed: int, gravity: float, motions: int, tmp_path: Path
) -> None:
    """Rounding would make 1e-8 of a double zero. With gravity, rotations out of its direction are not rigid."""
    mechanism, random = two_free_bodies(tmp_path, gravity), np.random.default_rng(seed)
    q_tree = mechanism.tree.integrate(mechanism.q_tree, random.uniform(-1, 1, mechanism.n))
    numbers = mechanism.tree.to_coordinates(q_tree)
    numbers[mechanism.tree.index["hinge"]] = 0.4
    state = at_rest(mechanism, mechanism.tree.from_coordinates(numbers))
    model = linear_model(state, np.zeros(1), at="anywhere")
    assert sum(mode.eigenvalue == 0 for mode in model.modes) == 12
    compliance = np.linalg.inv(state.D_tree)[-1, -1]  # acceleration of the hinge for a unit torque on it
    assert abs(model.modes[-1].eigenvalue) == pytest.approx(np.sqrt(3.0 * compliance), rel=1e-9)
    shapes = np.array([mode.shape for mode in model.modes[:12]])
    assert np.linalg.matrix_rank(shapes, tol=1e-6) == motions
    assert not shapes.imag.any()
    assert "rigid modes  12, eigenvalue 0 1/s" in repr(model)
    assert np.sum(model.eigenvalues == 0) == 12


@pytest.mark.parametrize(("weak", "strong"), [(1e-6, 5.0), (1e-10, 5.0), (1e-6, 1e6), (0.0, 1e9)])
def test_a_slow_mode_is_not_taken_for_a_rigid_one(weak: float, strong: float, tmp_path: Path) -> None:
    """Even if another mode is a hundred million times faster. Without a spring the eigenvalue is exactly zero."""
    mechanism = two_masses(tmp_path, weak, strong)
    model = linear_model(at_rest(mechanism, mechanism.q_tree), np.zeros(2), at="somewhere")
    mass = np.array([[2.0, 0.5], [0.5, 0.5]])
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(mass, np.diag([weak, strong]))))
    slow = np.sqrt(weak / 2.0) if weak else 0.0  # to first order both masses move together
    assert abs(model.modes[0].eigenvalue) == pytest.approx(slow, rel=1e-5)
    assert abs(model.modes[-1].eigenvalue) == pytest.approx(np.sqrt(squares[1]), rel=1e-9)


def test_modes_of_equal_frequency_have_independent_real_shapes() -> None:
    """Modes of the Stewart platform come in pairs. Any linear combination of a pair is an eigenvector of A."""
    model = linearize("stewart")
    at = [model.coordinates.index(name) for name in model.states[:6]]
    for one, two in ((0, 1), (4, 5)):
        pair = np.array([model.modes[k].shape for k in (one, two)])
        assert model.modes[one].frequency == pytest.approx(model.modes[two].frequency, rel=1e-9)
        assert not pair.imag.any()
        assert np.linalg.matrix_rank(pair.real, tol=1e-3) == 2
        for shape in pair.real[:, at]:
            square = model.modes[one].eigenvalue.imag ** 2
            assert np.abs(model.A[6:, :6] @ shape + square * shape).max() < 1e-8 * square


def test_animations_keep_locked_joints_in_place() -> None:
    model = linearize("talos")
    runs = animate_modes(model)
    assert len(model.locked) == 20
    assert list(runs) == [1, 2, 3, 4, 5, 6]
    locked = [model.coordinates.index(name) for name in model.locked]
    for run in runs.values():
        assert np.abs(run.q_tree[:, locked] - model.q_tree[locked]).max() < 1e-12
        assert run.max_phi < 1e-9
        assert run.max_phi_dot < 1e-9


def test_animation_of_a_real_mode_has_its_time_constant(tmp_path: Path) -> None:
    """The upright five-bar has a decay and a growth of equal rates."""
    model = linearize("five_bar", {"theta_1": 1.9, "theta_3": 1.2})
    growth = next(k for k, mode in enumerate(model.modes, 1) if mode.eigenvalue.real > 1 and not mode.frequency)
    decay = next(k for k, mode in enumerate(model.modes, 1) if mode.eigenvalue.real < -1 and not mode.frequency)
    for number in (growth, decay):
        run, rate = animate_mode(model, number), model.modes[number - 1].eigenvalue.real
        assert run is not None
        assert run.t[-1] == pytest.approx(3 / abs(rate))
        k = int(np.argmax(np.abs(model.modes[number - 1].shape)))
        moved = run.q_tree[:, k] - model.q_tree[k]
        assert np.abs(moved).max() == pytest.approx(0.2, rel=0.2)
        ends = moved[[0, -1]] if rate < 0 else moved[[-1, 0]]
        assert ends[1] / ends[0] == pytest.approx(np.exp(-3), rel=0.2)
        assert run.max_phi < 1e-9
    with pytest.raises(InputError, match=r"mode 1 is rigid"):
        animate_mode(
            linear_model(at_rest(two_free_bodies(tmp_path), two_free_bodies(tmp_path).q_tree), np.zeros(1), at="x"), 1
        )
    with pytest.raises(InputError, match=r"mode 9: five_bar has modes 1 to 3"):
        animate_mode(model, 9)
