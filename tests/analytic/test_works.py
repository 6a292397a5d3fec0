"""Works of motors, dampers, friction, forces and impacts: closed forms, quadrature, and the balance of the energy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson

from ckc_pin import InputError, Run, Simulator, ensemble, simulate
from ckc_pin.run.run_file import WORKS
from tests.analytic.small_models import WHEEL_INERTIA, wheel_urdf
from tests.conftest import assert_close

FORMULATIONS = ["dae", "reduced", "spf"]
PARAMETERS = {"joint.theta_1.damping": 0.02, "joint.theta_2.damping": 0.01, "joint.theta_3.friction": 0.05}
FORCE = [{"frame": "link_2", "axes": "frame", "force": [0.2, -0.4, 0.0]}]


def everything(**overrides: Any) -> dict[str, Any]:
    """A five-bar with motors, dampers, dry friction and a force."""
    return {
        "formulation": "dae", "t_end": 3.0, "parameters": PARAMETERS, "force": FORCE, "work": True,
        "solver": {"rtol": 1e-10, "output_dt": 0.01}, **overrides,
    }  # fmt: skip


def by_name(run: Run) -> dict[str, float]:
    assert run.works is not None
    return dict(zip(WORKS, run.works[-1].tolist(), strict=True))


# --- closed forms --------------------------------------------------------------------------------

INERTIA = WHEEL_INERTIA


def wheel_scene(folder: Path, damping: float = 0.0, friction: float = 0.0) -> Path:
    (folder / "wheel.urdf").write_text(wheel_urdf(damping, friction))
    (folder / "mechanism.toml").write_text('name = "wheel"\nurdf = "wheel.urdf"\nactuated = ["axle"]\n')
    path = folder / "turn.scene.toml"
    path.write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 2.0\nwork = true\n'
        "[initial]\nq = {axle = 0.0}\nq_dot = {axle = 3.0}\n[solver]\nrtol = 1e-11\n"
    )
    return path


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_damper_takes_the_kinetic_energy_of_a_wheel(tmp_path: Path, formulation: str) -> None:
    run = simulate(wheel_scene(tmp_path, damping=0.12), {"formulation": formulation})
    kinetic = 0.5 * INERTIA * 9.0 * np.exp(-2 * 0.12 / INERTIA * run.t)
    assert_close(run["work.dampers"], kinetic - kinetic[0], 1e-9)


@pytest.mark.parametrize("smoothing", [None, 1e-3])
def test_dry_friction_takes_its_torque_times_the_angle(tmp_path: Path, smoothing: float | None) -> None:
    overrides = {"friction_smoothing": smoothing, "t_end": 1.0}
    run = simulate(wheel_scene(tmp_path, friction=0.3), overrides)
    assert_close(run["work.friction"], -0.3 * run["axle"], 1e-9)  # it slides throughout, far from standstill
    if smoothing is None:
        assert run.dissipated is not None
        assert_close(run["work.friction"], -run.dissipated, 1e-9)


def test_a_moment_works_along_the_angle(tmp_path: Path) -> None:
    force = [{"frame": "disc", "moment": [0.1, 0.0, 0.7]}]
    run = simulate(wheel_scene(tmp_path), {"force": force})
    assert_close(run["work.forces"], 0.7 * (3.0 * run.t + 0.5 * 0.7 / INERTIA * run.t**2), 1e-9)


def test_impacts_take_the_kinetic_energy_that_is_missing(tmp_path: Path) -> None:
    path = wheel_scene(tmp_path)
    urdf = (tmp_path / "wheel.urdf").read_text()
    limit = '<limit lower="-10" upper="1.5" effort="100" velocity="100"/>'
    (tmp_path / "wheel.urdf").write_text(
        urdf.replace('"continuous"', '"revolute"').replace("<dynamics", f"{limit}<dynamics")
    )
    text = (tmp_path / "mechanism.toml").read_text()
    (tmp_path / "mechanism.toml").write_text(f'{text}[[joint]]\nname = "axle"\nstops = true\nrestitution = 0.5\n')
    run = simulate(path, {"t_end": 1.0})
    after = run.t > 0.5
    assert_close(run["work.impacts"], np.where(after, -0.5 * INERTIA * 9.0 * 0.75, 0.0), 1e-12)
    assert run.energy_error < 1e-12


# --- quadrature and balance ----------------------------------------------------------------------


@pytest.mark.usefixtures("either_terms")
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_the_energy_minus_the_works_is_constant(formulation: str, method: str) -> None:
    solver = {"rtol": 1e-10, "output_dt": 0.01, "method": method}
    run = simulate("five_bar/set_point", everything(formulation=formulation, solver=solver))
    works = by_name(run)
    assert run.status == "done"
    assert all(abs(works[name]) > 1e-3 for name in ("motors", "dampers", "friction", "forces"))
    assert works["impacts"] == 0.0
    assert run.energy_error < 1e-8


def test_works_are_the_integrals_of_the_powers() -> None:
    smooth = {name: x for name, x in PARAMETERS.items() if "friction" not in name}
    run = simulate("five_bar/set_point", everything(parameters=smooth, solver={"rtol": 1e-11, "output_dt": 5e-4}))
    motors = (run.tau * run.v_tree[:, [0, 2]]).sum(axis=1)
    dampers = -(run.v_tree[:, :2] ** 2 @ [0.02, 0.01])
    for name, power in (("motors", motors), ("dampers", dampers)):
        assert_close(run[f"work.{name}"][-1], simpson(power, x=run.t), 5e-7)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_work_of_a_prescribed_joint_is_its_motor_s(formulation: str) -> None:
    overrides = {
        "formulation": formulation, "work": True, "prescribed": [{"joint": "crank", "offset": 0.5, "rate": 5.0}],
        "parameters": {"joint.crank.damping": 0.01}, "friction_smoothing": 1e-3, "t_end": 1.0, "controller": None,
        "solver": {"rtol": 1e-10},
    }  # fmt: skip
    run = simulate("slider_crank", overrides)
    assert run.status == "done"
    assert run.energy_error < 1e-8
    power = run["tau.crank"] * run["v.crank"]
    assert_close(run["work.motors"][-1], simpson(power, x=run.t), 1e-5)


def test_the_balance_closes_to_the_tolerance() -> None:
    errors = [
        simulate("five_bar/set_point", everything(solver={"rtol": rtol, "output_dt": 0.05})).energy_error
        for rtol in (1e-4, 1e-7, 1e-10)
    ]
    assert errors[0] < 1e-3
    assert errors[1] < 1e-6
    assert errors[2] < 1e-9


def test_works_are_the_same_stepped_saved_and_in_ensembles(tmp_path: Path) -> None:
    run = simulate("five_bar/set_point", everything())
    saved = Run.load(run.save(tmp_path / "run.npz"))
    assert np.array_equal(saved["work.motors"], run["work.motors"])
    assert saved.energy_error == run.energy_error
    assert "work.motors" in run.to_pandas().columns
    assert "energy minus works" in repr(run)
    assert run.to_dict()["works"]["motors"] == run["work.motors"][-1]
    results = ensemble(
        "five_bar/set_point", {"link.link_2.mass": [0.2611]}, {"end": "work.motors"}, overrides=everything(),
        progress=False,
    )  # fmt: skip
    assert results["end"].to_numpy()[0] == pytest.approx(run["work.motors"][-1], abs=1e-8)
    simulator = Simulator("five_bar/set_point", everything(controller=None))
    assert simulator.step(None, 0.01).t == pytest.approx(0.01)


def test_a_run_without_works_says_how_to_get_them() -> None:
    run = simulate("five_bar/swing", {"t_end": 0.1})
    assert run.works is None
    assert np.isnan(run.energy_error)
    with pytest.raises(InputError, match="the run has no works; set work = true"):
        run["work.motors"]
    assert not [name for name in run.to_pandas().columns if name.startswith("work")]
