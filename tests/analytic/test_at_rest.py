"""Linear models at rest: balance by stops, motors and friction, locked joints, and states without a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

from ckc_pin import InputError, Mechanism, NumericalError, linearize, load, load_scene, simulate, terms
from ckc_pin.control.actuation import Actuation
from ckc_pin.dynamics import Terms, dae_acceleration
from ckc_pin.linear.statics import balance_at_rest
from ckc_pin.mechanism.library import mechanism_file
from tests.analytic.small_models import plate_on_springs

G = 9.81
BOB = '<link name="{name}"><inertial><origin xyz="0 0 -{l}"/><mass value="{m}"/>{no}</inertial></link>'
NO = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
SLIDES = ('<joint name="slide" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="0.8 0 0.6"/>'
          '<limit lower="-1" upper="0.5" effort="1" velocity="1"/></joint>')  # fmt: skip
SWINGS = ('<joint name="swing" type="revolute"><parent link="cart"/><child link="bob"/><axis xyz="0 1 0"/>'
          '<limit lower="-2" upper="0.4" effort="1" velocity="1"/></joint>')  # fmt: skip
M, m, L = 2.0, 0.7, 0.4


def cart_and_pendulum(folder: Path, more: str) -> Mechanism:
    """A cart on a slope of 3 in 5, and a pendulum on it."""
    cart, bob = BOB.format(name="cart", l=0, m=M, no=NO), BOB.format(name="bob", l=L, m=m, no=NO)
    (folder / "it.urdf").write_text(f'<robot name="it"><link name="base"/>{cart}{bob}{SLIDES}{SWINGS}</robot>')
    (folder / "mechanism.toml").write_text('name = "cart"\nurdf = "it.urdf"\n' + more)
    return load(str(folder / "mechanism.toml"))


def joint(name: str, key: str) -> str:
    return f'[[joint]]\nname = "{name}"\n{key}\n'


def agree(ours: np.ndarray, theirs: np.ndarray, tolerance: float = 1e-10) -> None:
    assert np.abs(ours - theirs).max() <= tolerance * max(np.abs(theirs).max(), 1e-300)


# --- stops ---------------------------------------------------------------------------------------


def test_a_joint_pushed_into_its_stop_is_locked(tmp_path: Path) -> None:
    """Gravity pulls the cart to its lower stop, so its motor needs no force."""
    mechanism = cart_and_pendulum(tmp_path, joint("slide", "stops = true"))
    model = linearize(mechanism, {"slide": -1.0, "swing": -0.6})
    assert model.locked == ("slide",)
    agree(model.tau, np.array([0.0, m * G * L * np.sin(-0.6)]), 1e-12)
    agree(model.A, np.array([[0.0, 1.0], [-G / L * np.cos(-0.6), 0.0]]))
    agree(model.B, np.array([[0.0, 0.0], [0.0, 1 / (m * L * L)]]))


def test_a_joint_pulled_off_its_stop_is_free(tmp_path: Path) -> None:
    mechanism = cart_and_pendulum(tmp_path, joint("slide", "stops = true"))
    model = linearize(mechanism, {"slide": 0.5, "swing": -0.6})
    free = linearize(cart_and_pendulum(tmp_path, ""), {"slide": 0.5, "swing": -0.6})
    assert not model.locked
    agree(model.tau, free.tau)
    agree(model.A, free.A)
    assert "at a stop without a force on it" in " ".join(model.notes)


def test_only_the_loaded_one_of_two_joints_at_stops_is_locked(tmp_path: Path) -> None:
    """The cart rests on its stop. The pendulum's stop would have to pull, so its motor holds it at 0.4 rad."""
    mechanism = cart_and_pendulum(tmp_path, joint("slide", "stops = true") + joint("swing", "stops = true"))
    model = linearize(mechanism, {"slide": -1.0, "swing": 0.4})
    assert model.locked == ("slide",)
    agree(model.tau, np.array([0.0, m * G * L * np.sin(0.4)]), 1e-12)


def test_a_loop_with_a_joint_at_its_stop_moves_as_in_a_run(tmp_path: Path) -> None:
    """The five-bar's left elbow stays at its upper stop. The model predicts the motion that small torques cause."""
    q = {"theta_1": -1.1, "theta_3": -1.6}
    numbers = terms(load("five_bar"), q).q_tree.tolist()
    there = mechanism_file("five_bar").parent
    turns = f'type="revolute"><limit lower="-9" upper="{numbers[1]!r}" effort="9" velocity="9"/>'
    urdf = (there / "five_bar.urdf").read_text().replace('name="theta_2" type="continuous">', f'name="theta_2" {turns}')
    text = (there / "mechanism.toml").read_text()
    for name, old, new in zip(
        load("five_bar").coordinates, ("-1.434", "0.248", "-1.707", "-0.248"), numbers, strict=True
    ):
        text = text.replace(f"{name} = {old}", f"{name} = {new!r}")
    (tmp_path / "five_bar.urdf").write_text(urdf)
    (tmp_path / "mechanism.toml").write_text(text + joint("theta_2", "stops = true"))
    mechanism = load(str(tmp_path / "mechanism.toml"))
    model = linearize(mechanism, dict(zip(mechanism.coordinates, numbers, strict=True)))
    assert model.locked == ("theta_2",)
    path, extra = tmp_path / "it.scene.toml", np.array([1e-5, -5e-6])
    path.write_text('mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 0.3\nsolver.rtol = 1e-11\n')
    still, moved = (
        simulate(load_scene(path, {"initial": {"q": q}}), controller=ConstantTorques(x))
        for x in (model.tau, model.tau + extra)
    )
    assert np.abs(still.q_tree - still.q_tree[0]).max() < 1e-12
    step = np.block([[model.A, (model.B @ extra)[:, None]], [np.zeros((1, 3))]])
    k = model.coordinates.index(model.states[0])
    assert moved.q_tree[-1, k] - moved.q_tree[0, k] == pytest.approx(expm(0.3 * step)[0, 2], rel=1e-4)


class ConstantTorques:
    """A controller that gives constant torques.

    Parameters
    ----------
    torques : (motors,) array
    """

    def __init__(self, torques: np.ndarray) -> None:
        self.torques = torques

    def tau(self, t: float, terms: Terms) -> np.ndarray:
        return self.torques


def test_a_state_beyond_its_stops_is_rejected(tmp_path: Path) -> None:
    mechanism = cart_and_pendulum(tmp_path, joint("swing", "stops = true"))
    with pytest.raises(InputError, match=r"at: swing = 0\.5 is beyond its stops, -2 to 0\.4"):
        linearize(mechanism, {"slide": 0.0, "swing": 0.5})
    mechanism = cart_and_pendulum(tmp_path, joint("swing", "stops = true") + SPRING)
    with pytest.raises(InputError, match=r"at its equilibrium swing = 0\.\d+ is beyond its stops, -2 to 0\.4"):
        linearize(mechanism)


SPRING = ('[[spring]]\njoint = "swing"\nstiffness = 90.0\nrest = 0.9\n'
          '[[spring]]\njoint = "slide"\nstiffness = 90.0\nrest = 0.1\n')  # fmt: skip

# --- motors and friction -------------------------------------------------------------------------


def test_dry_friction_holds_a_joint_without_a_motor(tmp_path: Path) -> None:
    """The force along the slope is 0.6 (M + m) g."""
    load = 0.6 * (M + m) * G
    for friction in (1.01 * load, 0.99 * load):
        rubs = joint("slide", f"friction = {friction}")
        mechanism = cart_and_pendulum(tmp_path, f'actuated = ["swing"]\n{rubs}')
        if friction > load:
            model = linearize(mechanism, {"slide": 0.1, "swing": 0.0})
            assert model.locked == ("slide",)
            assert "dry friction holds" in " ".join(model.notes)
            agree(model.A, np.array([[0.0, 1.0], [-G / L, 0.0]]))
        else:
            with pytest.raises(InputError, match=r"motor \(swing\) cannot hold .* along slide"):
                linearize(mechanism, {"slide": 0.1, "swing": 0.0})


def test_friction_helps_a_motor_at_its_limit(tmp_path: Path) -> None:
    load = 0.6 * (M + m) * G
    rubs = joint("slide", f"friction = {0.7 * load}")
    motors = f'[[motor]]\njoint = "slide"\ntorque_limit = {0.4 * load}\n[[motor]]\njoint = "swing"\n'
    model = linearize(cart_and_pendulum(tmp_path, motors + rubs), {"slide": 0.1, "swing": 0.0})
    assert 0.3 * load <= model.tau[0] <= 0.4 * load
    with pytest.raises(InputError, match=rf"slide would need {load:.4g}, its limit is {0.4 * load:.4g}"):
        linearize(cart_and_pendulum(tmp_path, motors), {"slide": 0.1, "swing": 0.0})


@pytest.mark.parametrize("limit", [None, {"theta_2": 0.05}])
def test_redundant_motors_share_the_load_as_in_a_run(tmp_path: Path, limit: dict[str, float] | None) -> None:
    for file in mechanism_file("five_bar").parent.iterdir():
        if file.is_file():
            text = file.read_text().replace(
                'actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1", "theta_3", "theta_2"]'
            )
            (tmp_path / file.name).write_text(text)
    path = tmp_path / "it.scene.toml"
    target = {"theta_1": -1.1, "theta_3": -1.6}
    path.write_text('mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 0.1\ninitial.at = "equilibrium"\n')
    control = {"type": "set_point", "K_P": 30.0, "K_V": 5.0, "q_d": target,
               "allocation": {"preload": {"theta_1": 0.4, "theta_2": -0.2}, "weights": {"theta_1": 2.0}}}  # fmt: skip
    if limit:
        control["torque_limit"] = limit
    scene = load_scene(path, {"controller": control, "initial": {"q": target}})
    run = simulate(scene)
    for at in ("target", target):
        model = linearize(scene, at)
        agree(model.tau, run.tau[-1], 1e-8)
        assert not any("accelerates" in note for note in model.notes)
        assert (model.closed_loop is not None) == (at == "target")


def test_a_static_balance_is_found_if_one_exists(tmp_path: Path) -> None:
    """A linear program decides whether random sliders at stops, with friction and motors, can be held."""
    random, count, feasible = np.random.default_rng(0), 4, []
    inertial = '<inertial><mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    for _ in range(40):
        side, friction = random.integers(-1, 2, count), random.uniform(0.2, 1.5, count) * random.integers(0, 2, count)
        body, text = '<link name="base"/>', "gravity = [0, 0, -1]\n"
        for k in range(count):
            axis = " ".join(str(x) for x in random.normal(size=3))
            body += f'<link name="m{k}">{inertial.format(random.uniform(0.5, 2.0))}</link>'
            body += f'<joint name="j{k}" type="prismatic"><parent link="base"/><child link="m{k}"/>'
            body += f'<axis xyz="{axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
            body += f'<dynamics friction="{friction[k]}"/></joint>'
            text += joint(f"j{k}", "stops = true")
        turns = random.normal(size=(random.integers(1, 4), count)) * random.integers(0, 2, count)
        turns[:, 0] += 0.1
        limit = random.uniform(0.2, 2.0, len(turns))
        for k, row in enumerate(turns):
            gear = ", ".join(f"j{i} = {x}" for i, x in enumerate(row) if x)
            text += f'[[motor]]\nname = "motor{k}"\njoints = {{ {gear} }}\ntorque_limit = {limit[k]}\n'
        (tmp_path / "it.urdf").write_text(f'<robot name="it">{body}</robot>')
        (tmp_path / "mechanism.toml").write_text(f'name = "it"\nurdf = "it.urdf"\n{text}')
        mechanism = load(str(tmp_path / "mechanism.toml"))
        state = Terms(mechanism, mechanism.kinematics(np.where(side, side, 0.3)), np.zeros(count))
        stops = [(0, None) if x < 0 else (None, 0) if x > 0 else (0, 0) for x in side]
        bounds = [(-x, x) for x in (*limit, *friction)] + stops
        forces = np.hstack([turns.T, np.eye(count), np.eye(count)])
        possible = linprog(np.zeros(forces.shape[1]), A_eq=forces, b_eq=state.h_tree, bounds=bounds).status == 0
        feasible.append(possible)
        if possible:
            balance = balance_at_rest(state, Actuation(mechanism), has_friction=True)
            assert np.all(np.abs(balance.tau) <= limit * (1 + 1e-9))
            assert set(balance.loaded_stops) <= set(np.flatnonzero(side))
        else:
            with pytest.raises(InputError, match="cannot hold"):
                balance_at_rest(state, Actuation(mechanism), has_friction=True)
    assert 10 < sum(feasible) < 30


# --- equilibrium ---------------------------------------------------------------------------------


def test_a_note_reports_a_start_that_does_not_stay_at_rest() -> None:
    start = {"initial": {"q": {"theta_1": -1.0, "theta_3": -1.5}}}
    model = linearize(load_scene("five_bar/swing", start), 0.0)
    state = Terms(model.mechanism, model.mechanism.kinematics(model.q_tree), np.zeros(4))
    a = dae_acceleration(state, np.zeros(4))
    k = int(np.argmax(np.abs(a)))
    expected = f"not in equilibrium: {model.coordinates[k]} accelerates at {a[k]:.4g} rad/s^2"
    assert any(expected in note for note in model.notes)
    assert not any("accelerates" in note for note in linearize("five_bar").notes)


@pytest.mark.parametrize("name", ["flyball", "stewart", "delta", "talos", "bricard", "three_rrr"])
def test_an_equilibrium_has_no_note_of_acceleration(name: str) -> None:
    """If springs carry the weight, the resultant force is the rounding of both."""
    assert not any("accelerates" in note for note in linearize(name).notes)


def test_a_balanced_mechanism_needs_no_motor(tmp_path: Path) -> None:
    """Two springs pull a slider in opposite directions, and gravity acts along the pendulum's axis."""
    text = 'actuated = []\n' + "".join(
        f'[[spring]]\nframe_a = {{link = "cart"}}\nframe_b = {{link = "base", xyz = [{0.8 * x}, 0, {0.6 * x}]}}\n'
        "stiffness = 900.0\n" for x in (1.3, -1.3)
    )  # fmt: skip
    mechanism = cart_and_pendulum(tmp_path, text.replace("actuated", "gravity = [0, -9.81, 0]\nactuated"))
    model = linearize(mechanism, {"slide": 0.0, "swing": 0.7})
    assert not any("accelerates" in note for note in model.notes)
    with pytest.raises(InputError, match="the mechanism has no motors"):
        linearize(mechanism, {"slide": 1e-6, "swing": 0.7})


def test_a_partly_constrained_free_root_has_an_equilibrium(tmp_path: Path) -> None:
    mechanism = plate_on_springs(tmp_path)
    model = linearize(mechanism)
    state = Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(model.q_tree)), np.zeros(mechanism.n))
    assert np.abs(dae_acceleration(state, np.zeros(mechanism.n))).max() < 1e-9
    assert model.eigenvalues.real.max() < 0, "with dampers, a minimum of the energy"


def test_an_equilibrium_where_q_is_not_a_chart_has_other_coordinates(tmp_path: Path) -> None:
    """Gravity pulls a slider-crank to its dead centre, where the slider's position is not a coordinate."""
    there, models = mechanism_file("slider_crank").parent, []
    for name in ("crank", "slider"):
        for file in there.iterdir():
            text = file.read_text().replace('independent = ["crank"]', f'independent = ["{name}"]')
            (tmp_path / file.name).write_text(text.replace("gravity = [0.0, -9.81, 0.0]", "gravity = [9.81, 0.0, 0.0]"))
        models.append(linearize(load(tmp_path / "mechanism.toml")))
    assert models[1].states[0] in ("crank", "rod")
    assert models[1].notes[0] == (
        f"slider does not determine the configuration there; the states are those of {models[1].states[0]}"
    )
    assert models[1].modes[0].frequency == pytest.approx(models[0].modes[0].frequency, rel=1e-9)
    assert not any("accelerates" in note for note in models[1].notes)


# --- no linear model -----------------------------------------------------------------------------


def test_the_error_names_a_spring_with_coincident_ends(tmp_path: Path) -> None:
    """At zero length only a spring without damping and with zero rest length has a derivative."""
    line = '[[spring]]\nframe_a = {link = "base"}\nframe_b = {link = "cart"}\nstiffness = 40.0\n'
    at = {"slide": 0.0, "swing": 0.0}
    for more in ("rest_length = 0.1\n", "damping = 2.0\n"):
        with pytest.raises(InputError, match=r"the ends of spring 2 coincide"):
            linearize(cart_and_pendulum(tmp_path, SPRING[: SPRING.rindex("[[")] + line + more), at)
    with_it, without = (linearize(cart_and_pendulum(tmp_path, more), at) for more in (line, ""))
    extra = with_it.A[2:] - without.A[2:]
    mass = np.linalg.inv(np.array([[M + m, -0.8 * m * L], [-0.8 * m * L, m * L * L]]))
    agree(extra[:, :2], -mass @ np.diag([40.0, 0.0]))


def test_a_freedom_without_mass_is_rejected(tmp_path: Path) -> None:
    mechanism = cart_and_pendulum(tmp_path, "")
    text = (tmp_path / "it.urdf").read_text().replace(f'<mass value="{m}"/>', '<mass value="0"/>')
    (tmp_path / "it.urdf").write_text(text)
    with pytest.raises(InputError, match=r"the motion along swing moves no mass"):
        linearize(load(str(tmp_path / "mechanism.toml")), {"slide": 0.1, "swing": 0.2})
    assert mechanism.n == 2


def test_a_time_after_the_run_stops_is_a_numerical_error() -> None:
    with pytest.raises(NumericalError, match=r"ends at t = .* s: stopped at"):
        linearize(load_scene("five_bar/swing", {"solver.max_rhs": 20}), 1.5)
