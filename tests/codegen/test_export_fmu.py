"""`ckc export --to fmu`: FMPy validates and simulates the FMUs, and `simulate` gives the motion that is expected."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from ckc_pin import InputError, Mechanism, Run, Scene, Simulator, load, load_scene, simulate
from ckc_pin.codegen.arguments import argument_names, present, values
from ckc_pin.formats.exporting import export, write
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.scene.parts import load_scene_mechanism
from tests.codegen.fmu_instance import Instance, optimization, write_fmu
from tests.codegen.test_export_c import WARNINGS, make_mechanism, run
from tests.contract.helpers.command import ckc

EXACT = 1e-9  # relative to the largest value of a kind of quantities: co-simulation against `simulate`
RTOL, SOLVER_TOLERANCE = 1e-11, 1e-9  # of our runs and of co-simulation; of FMPy's solver in model exchange
# CVode controls the error of each step, and these errors grow over a second of an undamped swing.
MAX_MODEL_EXCHANGE_ERROR = 1e4 * SOLVER_TOLERANCE
SCENES = {
    "five_bar": ("five_bar/swing", {}),
    "five_bar_spf": ("five_bar/swing", {"formulation": "spf", "epsilon": 1e-3}),
    "delta": ("delta", {}),
}
# The five-bar's FMUs are compiled as exports are. Others have more terms of the same kinds, which take GCC long.
LEVELS = {"five_bar": "-O2", "five_bar_spf": "-O2"}
OUTPUT_DT, T_END = 0.01, 1.0
FMI = ["2.0", "3.0"]


def scene_of(name: str) -> Scene:
    shipped, overrides = SCENES[name]
    solver = {"t_end": T_END, "solver.rtol": RTOL, "solver.output_dt": OUTPUT_DT}
    return load_scene(shipped, {**overrides, **solver})


@cache
def run_of(name: str) -> Run:
    return simulate(scene_of(name))


@pytest.fixture(scope="module")
def fmu_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """Return the file of a scene's FMU, which is written once."""

    @cache
    def exported(name: str, fmi: str) -> Path:
        return write_fmu(scene_of(name), tmp_path_factory.mktemp("fmu"), fmi, LEVELS.get(name, "-O0"))

    return exported


def simulate_fmu(path: Path, kind: str, outputs: list[str], **options: Any) -> Any:
    tolerance = {"relative_tolerance": RTOL} if kind == "CoSimulation" else {"relative_tolerance": SOLVER_TOLERANCE}
    times = {"stop_time": T_END, "output_interval": OUTPUT_DT}
    return fmpy.simulate_fmu(str(path), fmi_type=kind, output=outputs, **{**times, **tolerance, **options})


def kinds_of_outputs(mechanism: Mechanism) -> dict[str, list[str]]:
    """Return names of quantities that are compared relative to their largest value."""
    units = mechanism.tree.units()
    result: dict[str, list[str]] = {}
    for prefix in ("", "v.", "a."):
        for name, unit in zip(mechanism.coordinates, units, strict=True):
            result.setdefault(f"{prefix}{unit}", []).append(f"{prefix}{name}")
    result["loop"] = [f"loop.{'.'.join(row)}" for row in mechanism.closure.names]
    for infix in ("", "v."):
        result[f"point {infix}"] = [f"{point}.{infix}{axis}" for point in mechanism.points for axis in "xyz"]
    return result | {"energy": ["energy.kinetic", "energy.potential", "energy.total"]}


def largest_difference(mechanism: Mechanism, ours: Run, theirs: Any) -> float:
    np.testing.assert_allclose(theirs["time"], ours.t, atol=1e-9)
    differences = []
    for names in kinds_of_outputs(mechanism).values():
        expected = np.array([ours[name] for name in names])
        actual = np.array([theirs[name] for name in names])
        differences.append(np.abs(actual - expected).max() / np.abs(expected).max())
    return float(max(differences))


@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize("name", SCENES)
def test_fmu_is_valid(name: str, fmi: str, fmu_of: Callable[[str, str], Path]) -> None:
    assert validate_fmu(str(fmu_of(name, fmi))) == []


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize("name", SCENES)
def test_fmu_moves_as_the_run_does(name: str, fmi: str, kind: str, fmu_of: Callable[[str, str], Path]) -> None:
    mechanism, ours = load_scene_mechanism(scene_of(name)), run_of(name)
    outputs = [name for names in kinds_of_outputs(mechanism).values() for name in names]
    theirs = simulate_fmu(fmu_of(name, fmi), kind, [*outputs, "phi.max"])
    limit = EXACT if kind == "CoSimulation" else MAX_MODEL_EXCHANGE_ERROR
    assert largest_difference(mechanism, ours, theirs) <= limit
    is_spf = name.endswith("spf") and kind == "ModelExchange"
    assert theirs["phi.max"].max() <= (10 * SOLVER_TOLERANCE if is_spf else 1e-12)


@pytest.mark.parametrize(("name", "t_end"), [("andrews", 0.03), ("stewart", 0.5), ("three_rrr", 5.0)])
def test_larger_fmus_move_as_the_runs_do(name: str, t_end: float, tmp_path: Path) -> None:
    """The run of three_rrr changes its independent coordinates, and the FMU does so too."""
    keys = {"t_end": t_end, "solver.rtol": RTOL, "solver.output_dt": t_end / 50, "formulation": "reduced"}
    scene = load_scene(name, keys | {"controller": None})
    path = write_fmu(scene, tmp_path, "3.0")
    mechanism, ours = load_scene_mechanism(scene), simulate(scene)
    outputs = [name for names in kinds_of_outputs(mechanism).values() for name in names]
    theirs = simulate_fmu(path, "CoSimulation", outputs, stop_time=t_end, output_interval=t_end / 50)
    assert largest_difference(mechanism, ours, theirs) <= EXACT


@pytest.mark.parametrize("name", SCENES)
def test_derivatives_of_model_exchange_are_those_of_the_run(name: str, fmu_of: Callable[[str, str], Path]) -> None:
    """SciPy integrates the FMU's derivatives more accurately than CVode does."""
    fmu, ours = Instance(fmu_of(name, "2.0"), "ModelExchange"), run_of(name)
    solution = solve_ivp(fmu.rates, (0.0, T_END), fmu.get_states(), "DOP853", t_eval=ours.t, rtol=1e-12, atol=1e-13)
    for state, actual in zip(fmu.states, solution.y, strict=True):
        expected = ours[state]
        assert np.abs(actual - expected).max() <= EXACT * max(1.0, np.abs(expected).max())


def test_motor_torques_are_inputs(fmu_of: Callable[[str, str], Path]) -> None:
    """The reference is a simulator that gets the same torques, constant in each step."""
    simulator, count = Simulator(scene_of("five_bar")), round(T_END / OUTPUT_DT)
    t = OUTPUT_DT * np.arange(count)
    tau = np.array([0.5 * np.sin(3 * t), -0.3 * np.cos(5 * t)])
    states = [simulator.step(tau=tau[:, k], dt=OUTPUT_DT) for k in range(count)]
    fmu = Instance(fmu_of("five_bar", "2.0"), "CoSimulation")
    for k in range(count):
        fmu.set({"tau.theta_1": float(tau[0, k]), "tau.theta_3": float(tau[1, k])})
        fmu.fmu.doStep(OUTPUT_DT * k, OUTPUT_DT)
        actual = fmu.get(["theta_1", "theta_2", "v.theta_1", "v.theta_3"])
        expected = [*states[k].q_tree[:2], *states[k].q_dot]
        np.testing.assert_allclose(actual, expected, rtol=0, atol=EXACT * 5)


@pytest.mark.parametrize("fmi", FMI)
def test_parameters_and_start_values_can_be_set(fmi: str, fmu_of: Callable[[str, str], Path]) -> None:
    """A shorter link moves the start: the loops are assembled again."""
    start = {"theta_1": -1.2, "theta_3": -1.6}
    overrides = {"link.link_2.mass": 0.35, "joint.theta_2.xyz": [0.19, 0.0, 0.0]}
    scene = scene_of("five_bar").with_overrides(
        {"parameters": overrides, "initial": {"q": start, "q_dot": {"theta_1": 0.5}}}
    )
    changed = {"joint.theta_2.xyz.x": 0.19, **start, "v.theta_1": 0.5, **link_numbers(scene)}
    ours = simulate(scene)
    theirs = simulate_fmu(fmu_of("five_bar", fmi), "CoSimulation", ["theta_2", "theta_3"], start_values=changed)
    for name in ("theta_2", "theta_3"):
        assert np.abs(theirs[name] - ours[name]).max() <= EXACT


def link_numbers(scene: Scene) -> dict[str, float]:
    """Return the parameters of exported code that belong to a link."""
    mechanism = load_scene_mechanism(scene)
    numbers = model_numbers(mechanism)
    which = present(numbers)
    named = zip(argument_names(mechanism, which), values(numbers, which), strict=True)
    return {name: float(x) for name, x in named if name.startswith("link.link_2.")}


def test_state_can_be_saved_and_restored(fmu_of: Callable[[str, str], Path]) -> None:
    instance = Instance(fmu_of("five_bar", "2.0"), "CoSimulation")
    fmu, everything = instance.fmu, list(instance.reference)
    fmu.doStep(0.0, 0.1)
    saved = fmu.getFMUstate()
    content = fmu.serializeFMUstate(saved)
    fmu.doStep(0.1, 0.3)
    expected = instance.get(everything)
    for state in (saved, fmu.deSerializeFMUstate(content)):
        fmu.setFMUstate(state)
        fmu.doStep(0.1, 0.3)
        np.testing.assert_array_equal(instance.get(everything), expected)
        fmu.freeFMUstate(state)
    fmu.reset()
    fmu.freeInstance()


BAD_VALUES = {
    "start out of reach": ("five_bar", {"theta_1": -3.0, "theta_3": 0.0}, "the loops cannot be closed: coordinates or"),
    "link too long": (
        "five_bar",
        {"joint.theta_2.xyz.x": 5.0},
        "the loops cannot be closed: coordinates or parameters",
    ),
    "NaN": ("five_bar", {"joint.theta_2.xyz.x": float("nan")}, "a value is not a finite number"),
    "infinite": ("delta", {"gravity.z": float("inf")}, "a value is not a finite number"),
    "epsilon": ("five_bar_spf", {"epsilon": 0.0}, "epsilon must be positive"),
    "dependent": ("five_bar", {"theta_2": 0.1}, "only inputs, parameters and start values can be set"),
}


@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize("case", BAD_VALUES)
def test_bad_values_are_errors_with_a_message(case: str, fmi: str, fmu_of: Callable[[str, str], Path]) -> None:
    name, values, expected = BAD_VALUES[case]
    messages: list[str] = []
    with pytest.raises(FMICallException):
        Instance(fmu_of(name, fmi), "ModelExchange", values, messages=messages)
    assert len(messages) == 1
    assert messages[0].startswith(expected)


@pytest.mark.parametrize("fmi", FMI)
def test_singular_phi_z_is_an_error_in_model_exchange(fmi: str, tmp_path: Path) -> None:
    """Its states are the coordinates that the model description names. Co-simulation changes them on the way."""
    scene = load_scene("three_rrr", {"formulation": "reduced"})
    path = write_fmu(scene, tmp_path, fmi)
    fmu = Instance(path, "ModelExchange")
    with pytest.raises(FMICallException, match=r"Derivatives failed with status 2 .discard"):
        solve_ivp(fmu.rates, (0.0, 1.0), fmu.get_states(), "DOP853", rtol=1e-9, atol=1e-9)
    (message,) = fmu.messages
    assert re.match(
        "phi_z is singular: the independent coordinates do not determine|the loops cannot be closed", message
    )


@pytest.mark.parametrize(("fmi", "word"), [("2.0", "GUID"), ("3.0", "instantiation token")])
def test_other_model_descriptions_are_refused(fmi: str, word: str, fmu_of: Callable[[str, str], Path]) -> None:
    messages: list[str] = []
    with pytest.raises(Exception, match=r"instantiate|Instantiate"):
        Instance(fmu_of("five_bar", fmi), "CoSimulation", messages=messages, guid="{0}")
    assert messages == [f"the {word} is not that of the model description"]


@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize("name", SCENES)
def test_sources_compile_with_the_standards_headers(
    name: str, fmi: str, fmu_of: Callable[[str, str], Path], tmp_path: Path
) -> None:
    """The headers check the type of each function, and say which functions there must be."""
    with ZipFile(fmu_of(name, fmi)) as archive:
        archive.extractall(tmp_path)
    headers = Path(fmpy.__file__).parent / "c-code"
    source = f"fmi{fmi[0]}.c"
    run("gcc", *WARNINGS, "-Wno-strict-prototypes", f"-isystem{headers}", "-DFMI_HEADERS", "-fsyntax-only", source,
        cwd=tmp_path / "sources")  # fmt: skip
    level = LEVELS.get(name, "-O0")
    run("gcc", *WARNINGS, level, "-fPIC", "-shared", source, "-lm", "-o", "alone.so", cwd=tmp_path / "sources")
    names = run("nm", "-D", "--defined-only", "alone.so", cwd=tmp_path / "sources")
    declared = (headers / f"fmi{fmi[0]}Functions.h").read_text()
    missing = [x for x in set(fmi_functions(declared, fmi)) if f" {x}\n" not in names]
    assert not missing


def fmi_functions(header: str, fmi: str) -> list[str]:
    """Return the functions that a header declares."""
    return re.findall(rf"FMI{fmi[0]}_Export fmi{fmi[0]}\w+TYPE\s+(fmi{fmi[0]}\w+);", header)


def test_the_same_scene_gives_the_same_file() -> None:
    with optimization("-O0"):
        first, second = (dict(export(scene_of("five_bar"), "fmu").files) for _ in range(2))
    assert first == second


def test_names_that_are_no_identifiers_are_kept_in_flat_names(tmp_path: Path) -> None:
    make_mechanism(tmp_path, "theta_1", "théta-1 (links)")
    scene = Scene(tmp_path, t_end=1.0)
    path = write_fmu(scene, tmp_path / "fmu", "2.0")
    assert validate_fmu(str(path)) == []
    assert "v.théta-1 (links)" in [x.name for x in fmpy.read_model_description(str(path)).modelVariables]


@pytest.mark.parametrize("fmi", FMI)
def test_characters_that_xml_cannot_have_are_replaced_and_listed(fmi: str, tmp_path: Path) -> None:
    make_mechanism(tmp_path)
    file = tmp_path / "mechanism.toml"
    more = '\n[[point]]\nname = "t_p"\nframe = "tip_left"\n'
    file.write_text(file.read_text().replace('name = "tip"', r'name = "t\u0001p"') + more)
    with optimization("-O0"):
        exported = export(Scene(tmp_path, t_end=1.0), "fmu", fmi=fmi)
    (path,) = write(exported, tmp_path / "fmu")
    assert validate_fmu(str(path)) == []
    assert {"t_p.x", "t_p.x_2"} <= {x.name for x in fmpy.read_model_description(str(path)).modelVariables}
    assert r"the variable 't\x01p.x' is called t_p.x_2" in exported.differences


def test_without_a_compiler_the_fmu_has_sources_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    exported = export(scene_of("five_bar"), "fmu")
    (path,) = write(exported, tmp_path)
    assert any("no compiler `cc`" in x for x in exported.differences)
    assert not [name for name in ZipFile(path).namelist() if name.startswith("binaries")]
    assert validate_fmu(str(path)) == []


REFUSED = {
    "controller": ("five_bar", {}, "a controller is not exported.*--unset controller"),
    "sampled": ("five_bar", {"controller.sample_time": 0.01}, "a sampled controller is not exported"),
    "friction": ("five_bar/friction", {"controller": None}, "dry friction of theta_1, .* is not supported"),
    "forces": (
        "five_bar/swing",
        {"force": [{"frame": "link_2", "force": [1.0, 0.0, 0.0]}]},
        "forces on links .link_2. are not",
    ),
    "w": ("five_bar/swing", {"formulation": "spf", "initial.w": [1e-3, 0.0]}, "initial.w: an FMU starts with closed"),
    "free root": ("delta", {"formulation": "spf"}, 'not supported for free roots.*set formulation = "reduced"'),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_export_refuses_what_an_fmu_cannot_be(case: str) -> None:
    name, overrides, message = REFUSED[case]
    with pytest.raises(InputError, match=f"export to fmu: .*{message}"):
        export(load_scene(name, overrides), "fmu")


def test_export_refuses_friction_prescribed_joints_and_other_versions(tmp_path: Path) -> None:
    rough = make_mechanism(tmp_path, extra='\n[[joint]]\nname = "theta_2"\nfriction = 0.1\n')
    with pytest.raises(InputError, match=r"export to fmu: dry friction of theta_2 .* set friction = 0"):
        export(Scene(rough, t_end=1.0), "fmu")
    moved = Scene("four_bar", t_end=1.0, prescribed=[{"joint": load("four_bar").independent[0], "rate": 1.0}])
    with pytest.raises(InputError, match="prescribed joints are not supported"):
        export(moved, "fmu")
    with pytest.raises(InputError, match=r"fmi = '1.0': expected one of 2.0, 3.0"):
        export(scene_of("five_bar"), "fmu", fmi="1.0")


def test_file_of_a_scene_given_by_path_is_named_after_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "my robot"
    scene = load_scene("five_bar/swing").save(folder, "fall")
    with optimization("-O0"):
        (file,) = export(load_scene(scene), "fmu").files
    assert file == "my_robot_fall.fmu"


@pytest.mark.parametrize(("stop", "note"), [(False, ""), (True, ": the FMU goes on where a run stops")])
def test_events_of_a_scene_are_reported_as_left_out(stop: bool, note: str) -> None:
    event = {"coordinate": "theta_1", "of": "q", "value": -1.0, "stop": stop}
    with optimization("-O0"):
        exported = export(scene_of("five_bar").with_overrides({"event": [event]}), "fmu")
    assert exported.differences == [f"the scene's events are left out{note}"]


def test_command_writes_an_fmu(tmp_path: Path) -> None:
    result = ckc("export", "five_bar", "--to", "fmu", "--fmi", "3.0", "--unset", "controller", "--out", str(tmp_path))
    assert result.code == 0
    assert "differs: model exchange integrates eq. 8 with epsilon = 0.0001 s" in result.out
    assert fmpy.read_model_description(str(tmp_path / "five_bar.fmu")).fmiVersion == "3.0"
    for arguments, message in {
        ("--to", "fmu"): "give a folder as --out DIR",
        ("--to", "urdf", "--fmi", "3.0"): "--fmi is an option of --to fmu",
    }.items():
        refused = ckc("export", "five_bar", *arguments)
        assert refused.code == 2
        assert message in refused.err
