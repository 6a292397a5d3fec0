"""Names of quantities in runs, tables and inverse dynamics, against what they denote, computed here."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import ckc_pin
from ckc_pin import InputError, Run, linearize, load, sensitivities, simulate, singularity_map
from ckc_pin.run.columns import iterate_quantities
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc

Array = NDArray[np.float64]

JOINTS = ("theta_1", "theta_2", "theta_3", "theta_4")
Q = ("theta_1", "theta_3")
DENSE = {"t_end": 0.6, "solver.output_dt": 1e-3, "solver.rtol": 1e-10}
AMPLITUDE_1, AMPLITUDE_3 = np.pi / 3, np.pi / 4  # eq. 21


@pytest.fixture(scope="module")
def tracked() -> Run:
    """Return a run of eq. 16 from a state near the desired motion."""
    start = {"q": {"theta_1": 0.1, "theta_3": 0.05}, "q_dot": {"theta_1": 1.0, "theta_3": 0.1}}
    return simulate("five_bar/tracking", DENSE | {"initial": start})


def _differences(values: Array, t: Array) -> Array:
    """Return derivatives at the inner instants by differences of fourth order."""
    return np.asarray((values[:-4] - 8 * values[1:-3] + 8 * values[3:-1] - values[4:]) / (12 * (t[1] - t[0])))


def assert_derivative(rates: Array, values: Array, t: Array, tolerance: float) -> None:
    """Check rates against differences, after the first 0.15 s in which the gains take away the error of the start."""
    after = t[2:-2] > 0.15
    assert_close(rates[2:-2][after], _differences(values, t)[after], tolerance)


def _by_state(run: Run, function: Callable[[Array, Array, Array], Any]) -> Array:
    return np.array([function(*row) for row in zip(run.q_tree, run.v_tree, run.u, strict=True)])


# --- runs --------------------------------------------------------------------------------------------


def test_coordinates_rates_and_accelerations(tracked: Run) -> None:
    for k, name in enumerate(JOINTS):
        assert np.array_equal(tracked[name], tracked.q_tree[:, k])
        assert np.array_equal(tracked[f"v.{name}"], tracked.v_tree[:, k])
        assert_derivative(tracked[f"v.{name}"], tracked[name], tracked.t, 1e-8)
        assert_derivative(tracked[f"a.{name}"], tracked[f"v.{name}"], tracked.t, 1e-5)
    expected = _by_state(tracked, lambda *row: FIVE_BAR.acceleration_and_multipliers(*row)[0])
    assert_close(np.column_stack([tracked[f"a.{name}"] for name in JOINTS]), expected, 1e-9)
    assert np.array_equal(tracked.q, np.column_stack([tracked[name] for name in Q]))
    assert np.array_equal(tracked.q_dot, np.column_stack([tracked[f"v.{name}"] for name in Q]))


def test_forces(tracked: Run) -> None:
    assert np.array_equal(tracked["u.theta_3"], tracked.u[:, 1])
    assert np.array_equal(tracked["tau.theta_1"], tracked.tau[:, 0])
    multipliers = _by_state(tracked, lambda *row: FIVE_BAR.acceleration_and_multipliers(*row)[1])
    assert_close(tracked["loop.elbow.x"], multipliers[:, 0], 1e-9)
    assert_close(tracked["loop.elbow.y"], multipliers[:, 1], 1e-9)


def test_wrenches_of_joints_balance_the_body_that_they_carry(tracked: Run) -> None:
    """Joint and loop accelerate link_2 against gravity. The moments about theta_2's axis are zero without a motor."""
    angle = tracked["theta_1"] + tracked["theta_2"]
    l, c, m = FIVE_BAR.l, FIVE_BAR.c, FIVE_BAR.m[1]
    pin = l[0] * np.column_stack([np.cos(tracked["theta_1"]), np.sin(tracked["theta_1"])])
    centre = pin + c[1] * np.column_stack([np.cos(angle), np.sin(angle)])
    rates = np.apply_along_axis(_differences, 0, centre, tracked.t)
    loop = np.column_stack([tracked["loop.elbow.x"], tracked["loop.elbow.y"]])
    joint = np.column_stack([tracked["joint.theta_2.fx"], tracked["joint.theta_2.fy"]])
    for axis, gravity in enumerate((0.0, -FIVE_BAR.g)):
        accelerations = (joint + loop)[2:-2, axis] / m + gravity
        assert_derivative(accelerations, rates[:, axis], tracked.t[2:-2], 1e-5)
    assert_close(tracked["joint.theta_2.mz"], 0.0, 1e-9)
    assert_close(tracked["joint.theta_1.mz"], tracked["tau.theta_1"], 1e-9)


def test_desired_motion_and_errors(tracked: Run) -> None:
    t = tracked.t
    q_d = np.column_stack([AMPLITUDE_1 * np.sin(t), AMPLITUDE_3 * (1 - np.cos(t))])
    rates = np.column_stack([AMPLITUDE_1 * np.cos(t), AMPLITUDE_3 * np.sin(t)])
    for k, name in enumerate(Q):
        assert_close(tracked[f"desired.{name}"], q_d[:, k], 1e-14)
        assert_close(tracked[f"desired.v.{name}"], rates[:, k], 1e-14)
        assert_close(tracked[f"error.{name}"], tracked[name] - q_d[:, k], 1e-14)
    assert tracked.desired is not None
    assert tracked.error is not None
    assert_close(tracked.desired, q_d, 1e-14)
    assert_close(tracked.error, tracked.q - q_d, 1e-14)


def test_desired_motion_of_other_controllers(tmp_path: Path) -> None:
    set_point = simulate("five_bar/set_point", {"t_end": 0.1})
    q_d = [set_point.scene["controller"]["q_d"][name] for name in Q]
    assert_close(set_point["desired.theta_3"], q_d[1], 0.0)
    assert_close(set_point["desired.v.theta_3"], 0.0, 0.0)
    assert_close(set_point["error.theta_1"], set_point["theta_1"] - q_d[0], 1e-15)
    free = simulate("five_bar/swing", {"t_end": 0.1})
    assert free.desired is None
    assert free.error is None
    with pytest.raises(InputError, match=r"run\['error\.theta_1'\]: the run has no desired motion"):
        free["error.theta_1"]

    def desired(t: float) -> tuple[Array, Array, Array]:
        return np.array([t - 1.4, -1.7]), np.array([1.0, 0.0]), np.zeros(2)

    run = simulate("five_bar/tracking", {"t_end": 0.1}, controller=ckc_pin.Tracking(np.eye(2), 10 * np.eye(2), desired))
    part = run.sel(t=slice(0.04, 0.1))
    assert_close(part["error.theta_1"], part["theta_1"] - (part.t - 1.4), 1e-14)
    assert Run.load(run.save(tmp_path / "run.npz")).desired is None, "a file does not contain a function"


def test_points_and_their_velocities(tracked: Run) -> None:
    a1, a2 = tracked["theta_1"], tracked["theta_1"] + tracked["theta_2"]
    l = FIVE_BAR.l
    assert_close(tracked["tip.x"], l[0] * np.cos(a1) + l[1] * np.cos(a2), 1e-12)
    assert_close(tracked["tip.y"], l[0] * np.sin(a1) + l[1] * np.sin(a2), 1e-12)
    for axis in "xyz":
        assert_derivative(tracked[f"tip.v.{axis}"], tracked[f"tip.{axis}"], tracked.t, 1e-8)
    rate = tracked["v.theta_1"] + tracked["v.theta_2"]
    expected = -l[0] * np.sin(a1) * tracked["v.theta_1"] - l[1] * np.sin(a2) * rate
    assert_close(tracked["tip.v.x"], expected, 1e-12)


def test_energies_residuals_and_singular_values(tracked: Run) -> None:
    kinetic = _by_state(tracked, lambda q, v, _: v @ FIVE_BAR.D_tree(q) @ v / 2)
    potential = _by_state(tracked, lambda q, v, _: FIVE_BAR.potential_energy(q))
    assert_close(tracked["energy.kinetic"], kinetic, 1e-12)
    assert_close(tracked["energy.potential"], potential, 1e-12)
    assert_close(tracked["energy.total"], kinetic + potential, 1e-12)
    assert np.array_equal(tracked["energy.total"], tracked["energy"])
    smallest = _by_state(tracked, lambda q, v, _: np.linalg.svd(FIVE_BAR.phi_z(q), compute_uv=False)[-1])
    assert_close(tracked["sigma_min"], smallest, 1e-12)
    phi = _by_state(tracked, lambda q, v, _: FIVE_BAR.phi(q))
    assert_close(tracked["phi.elbow.y"], phi[:, 1], 1e-14)
    off = simulate("five_bar/tracking", {"t_end": 0.1, "initial.w": [1e-3, 0.0]})
    assert_close(off["phi.max"], np.abs(off.phi - off.w).max(axis=1), 0.0)
    assert off["phi.max"].max() == pytest.approx(off.max_phi, rel=1e-6)
    assert off["w.elbow.x"][0] == pytest.approx(1e-3)
    with pytest.raises(InputError, match="the run starts off phi = 0"):
        off["a.theta_1"]


def test_accelerations_with_friction_are_those_of_the_run() -> None:
    run = simulate("five_bar/friction", {"t_end": 0.3, "solver.output_dt": 1e-3, "solver.rtol": 1e-10})
    inner = run.t[2:-2]
    smooth = np.all([np.abs(inner - event["t"]) > 3e-3 for event in run.events], axis=0)
    for name in run.coordinates:
        assert_close(run[f"a.{name}"][2:-2][smooth], _differences(run[f"v.{name}"], run.t)[smooth], 1e-4)


@pytest.mark.parametrize("name", ["five_bar", "delta", "two_ur5", "slider_crank"])
def test_every_name_denotes_one_number_for_each_instant(name: str) -> None:
    run = simulate(name, {"t_end": 0.01, "solver.output_dt": 0.005, "work": True})
    names = [key for key, _ in iterate_quantities(run.mechanism)]
    assert len(set(names)) == len(names)
    for key in names:
        if key.startswith(("desired.", "error.")) and run.desired is None:
            continue
        assert run[key].shape == run.t.shape, key
    assert list(load(name).coordinates) == names[: run.mechanism.n]


def test_nothing_is_computed_that_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    run = simulate("five_bar/swing", {"t_end": 0.05})
    monkeypatch.setattr("ckc_pin.run.derived.Terms", None)
    monkeypatch.setattr("ckc_pin.run.recorded.Terms", None)
    for name in ("v.theta_2", "u.theta_1", "tip.x", "tip.v.x", "energy.total", "phi.max"):
        assert np.isfinite(run[name]).all()
    with pytest.raises(TypeError):
        run["energy.kinetic"]


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("thetta_1", "theta_1"), ("tau.theta_2", "tau.theta_1"), ("tip.vx", "tip.v.x"), ("energy.kin", "energy.kinetic"),
     ("Theta_1", "theta_1"), ("loop.elbow.z", "loop.elbow.x")],
)  # fmt: skip
def test_unknown_name_lists_near_ones(name: str, nearest: str, tracked: Run) -> None:
    with pytest.raises(InputError, match=rf"run\['{name}'\]: no such quantity; the nearest names are '{nearest}', "):
        tracked[name]


# --- tables ------------------------------------------------------------------------------------------


def test_tables_have_the_columns_of_the_scheme(tracked: Run, tmp_path: Path) -> None:
    v, row = [f"v.{name}" for name in JOINTS], ["elbow.x", "elbow.y"]
    columns = [*JOINTS, *v, "u.theta_1", "u.theta_3", "tau.theta_1", "tau.theta_3", "desired.theta_1",
               "desired.theta_3", "desired.v.theta_1", "desired.v.theta_3", "error.theta_1", "error.theta_3", "tip.x",
               "tip.y", "tip.z", "tip.v.x", "tip.v.y", "tip.v.z", *(f"phi.{x}" for x in row),
               *(f"w.{x}" for x in row), "energy.total", "energy", "lyapunov"]  # fmt: skip
    frame = tracked.to_pandas()
    assert list(frame.columns) == columns
    with tracked.to_csv(tmp_path / "run.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["t", *columns]
    values = np.array(rows, dtype=float)
    for k, name in enumerate(columns):
        assert np.array_equal(values[:, k + 1], tracked[name]), name
        assert np.array_equal(frame[name].to_numpy(), tracked[name]), name


def test_tables_of_chosen_columns(tracked: Run, tmp_path: Path) -> None:
    names = ["a.theta_2", "energy.kinetic", "loop.elbow.x"]
    assert list(tracked.to_pandas(names).columns) == names
    path = tracked.to_csv(tmp_path / "run.csv", ["sigma_min"])
    assert path.read_text(encoding="utf-8").splitlines()[0] == "t,sigma_min"
    with pytest.raises(InputError, match=r"run\['sigma'\]: no such quantity; the nearest names are 'sigma_min'"):
        tracked.to_csv(path, ["sigma"])
    with pytest.raises(InputError, match=r"Run\.to_pandas: columns: 'q_tree' is an array of several columns"):
        tracked.to_pandas(["q_tree"])
    with pytest.raises(InputError, match=r"Run\.to_pandas: columns: expected a list of names"):
        tracked.to_pandas("theta_1")


def test_xarray_has_the_desired_motion(tracked: Run) -> None:
    data = tracked.to_xarray()
    assert np.array_equal(data["desired.v"].sel(independent="theta_3"), tracked["desired.v.theta_3"])
    assert np.array_equal(data["error"].sel(independent="theta_1"), tracked["error.theta_1"])
    assert np.array_equal(data["points.v"].sel(point="tip", axis="y"), tracked["tip.v.y"])
    assert data["error"].attrs["units"] == "rad"
    assert "desired" not in simulate("five_bar/swing", {"t_end": 0.01}).to_xarray()


# --- inverse dynamics --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def forces() -> ckc_pin.MotionForces:
    return ckc_pin.inverse_dynamics("five_bar/tracking", {"t_end": 0.2})


def test_names_of_inverse_dynamics(forces: ckc_pin.MotionForces) -> None:
    t = forces.t
    assert_close(forces["theta_1"], AMPLITUDE_1 * np.sin(t), 1e-14)
    assert_close(forces["v.theta_3"], AMPLITUDE_3 * np.sin(t), 1e-14)
    assert_close(forces["a.theta_1"], -AMPLITUDE_1 * np.sin(t), 1e-14)
    states = list(zip(forces.q_tree, forces.v_tree, forces.a_tree, forces.tau, strict=True))
    for k, (q, v, a, tau) in enumerate(states):
        solution = FIVE_BAR.acceleration_and_multipliers(q, v, tau)
        assert_close(solution[0], a, 1e-9)
        assert_close([forces["loop.elbow.x"][k], forces["loop.elbow.y"][k]], solution[1], 1e-10)
        assert_close([forces["tau.theta_1"][k], forces["tau.theta_3"][k]], tau, 0.0)
        assert_close(forces["energy.total"][k], FIVE_BAR.energy(q, v), 1e-12)
    for k, component in enumerate(("fx", "fy", "fz", "mx", "my", "mz")):
        assert np.array_equal(forces[f"joint.theta_4.{component}"], forces.joint_forces["theta_4"][:, k])
    with pytest.raises(InputError, match=r"forces\['joint\.theta_5\.fx'\]: no such .* are 'joint\.theta_1\.fx'"):
        forces["joint.theta_5.fx"]
    with pytest.raises(InputError, match=r"forces\['u\.theta_1'\]: inverse dynamics has no such quantity"):
        forces["u.theta_1"]


def test_wrenches_along_a_run_are_those_of_inverse_dynamics(tracked: Run) -> None:
    forces = ckc_pin.inverse_dynamics(tracked)
    for name in ("loop.elbow.y", "joint.theta_3.fx", "joint.theta_1.mz", "a.theta_4"):
        assert_close(tracked[name], forces[name], 1e-9)


def test_tables_and_figure_of_inverse_dynamics(forces: ckc_pin.MotionForces, tmp_path: Path) -> None:
    wrenches = [f"joint.{joint}.{x}" for joint in JOINTS for x in ("fx", "fy", "fz", "mx", "my", "mz")]
    columns = [*JOINTS, *(f"v.{x}" for x in JOINTS), *(f"a.{x}" for x in JOINTS), "tau.theta_1", "tau.theta_3",
               "loop.elbow.x", "loop.elbow.y", *wrenches]  # fmt: skip
    assert list(forces.to_pandas().columns) == columns
    with forces.to_csv(tmp_path / "forces.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["t", *columns]
    values = np.array(rows, dtype=float)
    assert np.array_equal(values, np.column_stack([forces.t, *(forces[name] for name in columns)]))
    assert list(forces.to_pandas(["tip.v.x", "tau.theta_3"]).columns) == ["tip.v.x", "tau.theta_3"]
    figures = forces.plot()
    assert repr(figures) == "Figures(inverse)"
    assert figures._repr_html_().count('<img src="data:image/png;base64,iVBOR') == 1
    with pytest.raises(InputError, match="only runs can be drawn together"):
        ckc_pin.plot(forces, forces)


@pytest.mark.parametrize(("command", "column"), [("run", "error.theta_1"), ("inverse", "joint.theta_2.mz")])
def test_commands_write_csv(command: str, column: str, tmp_path: Path) -> None:
    path = tmp_path / "new" / "table.csv"
    arguments = (command, "five_bar/tracking", "--set", "t_end=0.1", "--csv", str(path))
    answer = ckc(*arguments)
    assert answer.code == 0
    assert answer.out.endswith(f"written: {path}\n")
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    assert column in head.split(",")
    assert [float(row.partition(",")[0]) for row in rows] == pytest.approx(np.arange(6) * 0.02)
    path.unlink()
    assert ckc(*arguments, "--json").json["status"] == "done"
    assert path.is_file()
    refused = ckc(*arguments[:-1], str(tmp_path))
    assert (refused.code, refused.out) == (2, "")
    assert refused.err == f"error: --csv {tmp_path}: expected the name of a file, got a folder\n"


@pytest.mark.parametrize(
    ("arguments", "compute"),
    [
        (("linearize", "five_bar"), lambda: linearize("five_bar")),
        (("sensitivities", "five_bar/swing", "link.link_2.mass", "--set", "t_end=0.1"),
         lambda: sensitivities("five_bar/swing", ["link.link_2.mass"], {"t_end": 0.1})),
        (("map", "five_bar", "--cells", "20"), lambda: singularity_map("five_bar", cells=20)),
    ],
)  # fmt: skip
def test_commands_write_the_table_of_the_result(tmp_path: Path, arguments: tuple[str, ...], compute: Any) -> None:
    answer = ckc(*arguments, "--csv", str(tmp_path / "table.csv"))
    assert answer.code == 0
    assert f"written: {tmp_path / 'table.csv'}" in answer.out.replace("\n", "")
    compute().to_csv(tmp_path / "expected.csv")
    assert (tmp_path / "table.csv").read_text() == (tmp_path / "expected.csv").read_text()


@pytest.mark.parametrize(
    "arguments",
    [("linearize", "five_bar", "--period", "1"), ("map", "delta", "--space", "cartesian", "--sections", "3")],
)
def test_csv_is_refused_beside_options_that_have_no_single_table(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    answer = ckc(*arguments, "--csv", str(tmp_path / "table.csv"))
    assert answer.code == 2
    assert answer.err.startswith("error: --csv and ")
    assert not list(tmp_path.iterdir())
