"""Units of variables and outputs in an ensemble's results and on the axes of figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import ckc_pin
from ckc_pin.cli.key_tables import tables
from ckc_pin.mechanism.parameters import values_of, with_components
from ckc_pin.run.columns import key_unit
from ckc_pin.view import ensemble_figures
from tests.ensembles.test_damaged_results import convert_to_format_1

URDF = Path(__file__).parents[2] / "urdf" / "slider_crank" / "slider_crank.urdf"
MECHANISM = """
name = "pressed"
urdf = "pressed.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["crank"]
[q_guess]
crank = 1.57
rod = -1.9
slider = 0.28
[[loop]]
name = "slider_pin"
type = "point_2d"
frame_a = {link = "rod_link", xyz = [0.3, 0.0, 0.0]}
frame_b = "slider_link"
rows_in = "world"
[[joint]]
name = "slider"
damping = 1.0
[[spring]]
joint = "slider"
stiffness = 1.0
[[spring]]
joint = "crank"
stiffness = 1.0
[[spring]]
frame_a = "rod_link"
frame_b = "world"
stiffness = 1.0
[[force]]
joint = "slider"
value = 1.0
[[motor]]
joint = "crank"
rotor_inertia = 1e-5
torque_limit = 100.0
[[motor]]
name = "push"
joint = "slider"
speed_limit = 1.0
"""
SCENE = """
mechanism = "mechanism.toml"
formulation = "reduced"
t_end = 0.02
[initial.q]
crank = 1.5
[initial.q_dot]
crank = 1.0
[controller]
type = "set_point"
K_P = 10.0
K_V = 1.0
q_d = {crank = 1.0}
"""
PARAMETERS = {
    "gravity.y": "m/s²", "link.rod_link.mass": "kg", "link.rod_link.com.x": "m", "link.rod_link.inertia.izz": "kg m²",
    "joint.crank.xyz.x": "m", "joint.crank.rpy.z": "rad", "joint.crank.damping": "N m s/rad",
    "joint.slider.damping": "N s/m", "joint.crank.armature": "kg m²", "joint.slider.armature": "kg",
    "joint.crank.friction": "N m", "joint.slider.friction": "N", "loop.slider_pin.frame_a.xyz.x": "m",
    "loop.slider_pin.frame_b.rpy.y": "rad", "spring.0.stiffness": "N/m", "spring.0.damping": "N s/m",
    "spring.0.rest": "m", "spring.1.stiffness": "N m/rad", "spring.1.damping": "N m s/rad", "spring.1.rest": "rad",
    "spring.2.stiffness": "N/m", "spring.2.rest_length": "m", "spring.2.frame_a.xyz.x": "m", "force.0.value": "N",
    "motor.crank.ratio": "", "motor.crank.rotor_inertia": "kg m²", "motor.crank.torque_limit": "N m",
    "motor.push.rotor_inertia": "kg", "motor.push.speed_limit": "m/s",
}  # fmt: skip
KEYS = {
    "initial.q.crank": "rad", "initial.q_dot.slider": "m/s", "t_end": "s", "solver.output_dt": "s", "solver.rtol": "",
    "controller.K_P": "N m/rad", "controller.K_V.crank": "N m s/rad", "controller.q_d.crank": "rad",
    "controller.Lambda": "1/s", "controller.torque_limit.push": "N", "controller.sensor.q_dot_noise.crank": "rad/s",
    "controller.sensor.filter": "s", "controller.desired.crank.offset": "rad", "controller.drive.torque_rate": "N m/s",
    "controller.desired.crank.rate": "rad/s", "controller.desired.crank.max_acceleration": "rad/s²",
    "controller.desired.max_rate": "m/s",
}  # fmt: skip
VARIABLES: dict[str, Any] = {"link.rod_link.mass": [0.2, 0.3], "spring.0.stiffness": [1.0, 2.0]}
OUTPUTS: dict[str, Any] = {
    "end": "q_tree", "path": {"of": "v_tree", "reduce": "trajectory"}, "tau": "tau", "u": "u", "worst": "max_abs_tau",
    "mean": {"of": "error", "reduce": "integral"}, "way": {"of": "slider", "reduce": "max_abs"},
    "drift": "energy_drift", "function": lambda run: run.t[-1],
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pressed")
    (folder / "pressed.urdf").write_text(URDF.read_text())
    (folder / "mechanism.toml").write_text(MECHANISM)
    (folder / "default.scene.toml").write_text(SCENE)
    return folder / "default.scene.toml"


def ensemble(scene: Path, **rest: Any) -> xr.Dataset:
    return ckc_pin.ensemble(scene, VARIABLES, OUTPUTS, progress=False, **rest)


def test_every_named_parameter_has_a_unit(scene: Path) -> None:
    mechanism = ckc_pin.load(scene.parent / "mechanism.toml")
    present = with_components(values_of(mechanism.spec, mechanism.urdf))
    assert set(PARAMETERS) <= set(present)
    units = {name: key_unit(mechanism, name) for name in [*PARAMETERS, *KEYS]}
    # one motor drives a hinge and the other one a slide, so the rate has two units
    assert units == {**PARAMETERS, **KEYS, "controller.drive.torque_rate": "N m/s or N/s"}
    assert [name for name in present if not key_unit(mechanism, name) and not name.endswith(".ratio")] == []


def test_units_match_the_reference(scene: Path) -> None:
    mechanism = ckc_pin.load(scene.parent / "mechanism.toml")
    entries = {"joint": "joint.crank", "spring": "spring.1", "force": "force.0", "motor": "motor.crank"}
    compared = 0
    for file in ("mechanism", "scene"):
        for table in tables(file):
            if file == "scene" and table.path.startswith("force"):  # entries of its list are no variables
                continue
            path = entries.get(table.path, "" if file == "mechanism" else table.path)
            for key in table.keys:
                if key.unit and (path or file == "scene"):
                    unit = key_unit(mechanism, f"{path}.{key.name}".lstrip("."))
                    assert set(unit.split(" or ")) <= {*key.unit.split(", "), ""}, key.name
                    compared += bool(unit)
    assert compared > 25


def test_variables_and_outputs_have_units_of_their_components(scene: Path, tmp_path: Path) -> None:
    ensemble(scene, out=tmp_path)
    results = xr.open_zarr(tmp_path / "results.zarr", consolidated=False).load()
    assert {name: x.attrs.get("units") for name, x in results.data_vars.items()} == {
        "link.rod_link.mass": "kg", "spring.0.stiffness": "N/m", "end": "rad or m", "path": "rad/s or m/s",
        "tau": "N m or N", "u": "N m", "worst": "N m or N", "mean": "rad s", "way": "m", "drift": "J", "function": None,
        "status": None, "message": None,
    }  # fmt: skip
    assert results["time"].attrs["units"] == "s"
    assert results["end"].end_unit.to_series().to_dict() == {"crank": "rad", "rod": "rad", "slider": "m"}
    assert results["path"].sel(coordinate="slider").path_unit.item() == "m/s"
    assert results["tau"].tau_unit.to_series().to_dict() == {"crank": "N m", "push": "N"}
    assert "u_unit" not in results.coords


def test_a_store_without_units_is_resumed(scene: Path, tmp_path: Path) -> None:
    expected = ensemble(scene, out=tmp_path).load()
    store = tmp_path / "results.zarr"
    convert_to_format_1(store)
    for file in store.rglob("zarr.json"):
        data = json.loads(file.read_text())
        if file.parent.name not in ("time", store.name):  # these always had units
            data["attributes"].pop("units", None)
        data["attributes"].pop("coordinates", None)
        file.write_text(json.dumps(data))
    for name in ("end_unit", "path_unit", "tau_unit"):
        for file in sorted((store / name).rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        (store / name).rmdir()
    (store / "status" / "c" / "0").unlink()
    bare = xr.open_zarr(store, consolidated=False).load()
    assert bare["status"].to_numpy().tolist() == [0] * 4
    assert "units" not in bare["end"].attrs
    resumed = ensemble(scene, out=tmp_path).load()
    assert resumed.identical(expected)


def test_an_output_with_the_name_of_a_unit_coordinate_is_rejected(scene: Path) -> None:
    with pytest.raises(ckc_pin.InputError, match="'end_unit' is taken"):
        ckc_pin.ensemble(scene, VARIABLES, {"end": "q_tree", "end_unit": "u"}, progress=False)


def test_figures_have_units_on_their_axes(scene: Path) -> None:
    figures = ensemble_figures.draw_ensemble(ensemble(scene))
    fan, over = figures["path"], figures["way"]
    assert [ax.get_ylabel() for ax in fan.axes] == ["crank (rad/s)", "rod (rad/s)", "slider (m/s)"]
    assert [over.axes[0].get_xlabel(), over.axes[0].get_ylabel()] == [
        "link.rod_link.mass (kg)",
        "spring.0.stiffness (N/m)",
    ]
    assert over.axes[1].get_ylabel() == "way (m)"
    reversed_results = ckc_pin.ensemble(
        scene, dict(reversed(VARIABLES.items())), {"way": OUTPUTS["way"]}, progress=False
    )
    assert ckc_pin.plot(reversed_results)["way"].axes[0].get_xlabel() == "spring.0.stiffness (N/m)", (
        "the first variable is on the x axis"
    )
    assert np.all(np.isfinite(over.axes[0].collections[0].get_array()))
