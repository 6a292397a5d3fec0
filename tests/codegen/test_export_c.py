"""`ckc export --to c`: the C code against Pinocchio's terms, the native core and a five-bar in NumPy."""

from __future__ import annotations

import ctypes
import re
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, load, load_scene
from ckc_pin.base.arrays import Array
from ckc_pin.formats.c.names import comment, identifiers
from ckc_pin.formats.c.writer import TEMPLATES as C_TEMPLATES
from ckc_pin.formats.c.writer import make_prefix
from ckc_pin.formats.exporting import export, write
from ckc_pin.formats.fmu.writer import TEMPLATES as FMU_TEMPLATES
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from ckc_pin.scene.parts import load_scene_mechanism
from tests.analytic.five_bar import FIVE_BAR
from tests.contract.helpers.command import ckc

MECHANISMS = ["five_bar", "delta", "stewart", "three_rrr", "andrews"]
REDUNDANT_OR_OPEN = ["bricard", "flyball"]  # a redundant row; no loop at all
WARNINGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-pedantic")
SANITIZERS = ("-std=c99", "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
EXACT = 1e-11  # relative
LIBM = {"sin", "cos", "sqrt", "fabs", "fmin", "fmax", "atan2", "tan", "sincos"}  # GCC joins sin and cos
OK, NOT_CLOSED, SINGULAR, NOT_FINITE = 0, 1, 2, 3


def run(*command: object, cwd: Path) -> str:
    done = subprocess.run([str(x) for x in command], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


def compile_object(name: str, folder: Path, level: str) -> Path:
    """Return the object file of a mechanism's exported code, compiled once, with the call graph beside it."""
    file = folder / f"{name}{level}.o"
    if not file.exists():
        run("gcc", *WARNINGS, level, "-fPIC", "-fcallgraph-info=su", "-c", f"{name}.c", "-o", file.name, cwd=folder)
    return file


@pytest.fixture(scope="module")
def folder_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return the folder of a shipped mechanism's exported C code, which is written once."""

    @cache
    def exported(name: str) -> Path:
        folder = tmp_path_factory.mktemp(name)
        write(export(load(name), "c"), folder)
        return folder

    return exported


class Library:
    """Exported C code as a shared library, with arrays as arguments."""

    def __init__(self, name: str, folder: Path) -> None:
        header = (folder / f"{name}.h").read_text()
        size = {x: int(n) for x, n in re.findall(rf"#define {name.upper()}_(\w+) (\d+)", header)}
        self.n, self.d, self.rows, self.nq = (size[x] for x in ("N", "D", "ROWS", "NQ"))
        z = size["Z"]

        class Configuration(ctypes.Structure):
            _fields_ = (
                ("q_tree", ctypes.c_double * self.nq), ("trig", ctypes.c_double * (2 * self.nq)),
                ("phi", ctypes.c_double * self.rows), ("J", ctypes.c_double * (self.rows * self.n)),
                ("phi_z", ctypes.c_double * (z * z)), ("pivot", ctypes.c_int * z),
                ("rho", ctypes.c_double * (self.n * self.d)),
            )  # fmt: skip

        class Motion(ctypes.Structure):
            _fields_ = (("at", Configuration), ("q_dot", ctypes.c_double * self.d))

        self.at, self.motion = Configuration(), Motion()
        run("gcc", "-shared", compile_object(name, folder, "-O2"), "-lm", "-o", "library.so", cwd=folder)
        self._library, self._name = ctypes.CDLL(str(folder / "library.so")), name
        self.model = (ctypes.c_double * size["NUMBERS"])()
        self._library[f"{name}_set_parameters"](
            self.model, (ctypes.c_double * size["PARAMETERS"]).in_dll(self._library, f"{name}_default_parameters")
        )
        self.assembled = (ctypes.c_double * self.nq).in_dll(self._library, f"{name}_assembled")
        assert self.call("configure", self.model, self.assembled, self.at) == OK

    def call(self, function: str, *arguments: Any) -> int:
        """Call a function. Arrays are passed as pointers, and are written to."""
        converted = [
            x.ctypes.data_as(ctypes.c_void_p) if isinstance(x, np.ndarray)
            else ctypes.byref(x) if isinstance(x, ctypes.Structure)
            else ctypes.c_double(x) if isinstance(x, float)
            else x
            for x in arguments
        ]  # fmt: skip
        return int(self._library[f"{self._name}_{function}"](*converted))

    @property
    def q_tree(self) -> Array:
        return np.array(self.at.q_tree)

    @property
    def rho(self) -> Array:
        return np.array(self.at.rho).reshape(self.n, self.d, order="F")

    def acceleration(self, v: Array, u: Array) -> Array:
        result, multipliers = np.zeros(self.n), np.zeros(max(self.rows, 1))
        assert self.call("acceleration", self.model, self.at, v, u, result, multipliers) == OK
        return result


@pytest.mark.parametrize("name", [*MECHANISMS, *REDUNDANT_OR_OPEN])
def test_exported_c_compiles_without_warnings_and_agrees_with_pinocchio(
    name: str, folder_of: Callable[[str], Path]
) -> None:
    folder = folder_of(name)
    compiled = compile_object(name, folder, "-O2")
    run("gcc", *WARNINGS, compiled, f"{name}_test.c", "-lm", "-o", "vectors", cwd=folder)
    report = run("./vectors", cwd=folder)
    ((count, largest),) = re.findall(r"difference at (\d+) states: (\S+)", report)
    assert int(count) >= 20
    assert float(largest) <= EXACT
    run("gcc", *WARNINGS, compiled, "main.c", "-lm", "-o", "main", cwd=folder)
    assert run("./main", cwd=folder).count("desired") == load(name).d


def test_exported_c_does_not_convert_numbers_to_truth_values(folder_of: Callable[[str], Path]) -> None:
    """Clang's -Wconversion warns of it, and GCC does not. The springs of andrews have conditions."""
    text = (folder_of("andrews") / "andrews.c").read_text()
    assert text.count("!=0?") > 2
    assert not re.search(r"[=(&|]a\d+(\?|&&|\|\|)|!a\d", text)


@pytest.mark.parametrize("name", ["five_bar", "delta", "bricard"])
def test_exported_c_has_no_undefined_behaviour(name: str, folder_of: Callable[[str], Path]) -> None:
    folder = folder_of(name)
    run("gcc", *SANITIZERS, f"{name}.c", f"{name}_test.c", "-lm", "-o", "checked", cwd=folder)
    run("./checked", cwd=folder)


def test_runner_detects_a_wrong_parameter(folder_of: Callable[[str], Path], tmp_path: Path) -> None:
    folder = folder_of("five_bar")
    runner = (folder / "five_bar_test.c").read_text()
    call = "five_bar_set_parameters(&model, &five_bar_default_parameters);"
    assert call in runner
    changed = f"five_bar_parameters p = five_bar_default_parameters; p.link_link_2_mass *= 1.0 + 1e-9; {call}"
    (tmp_path / "wrong.c").write_text(runner.replace(call, changed.replace("&five_bar_default_parameters", "&p")))
    compiled = compile_object("five_bar", folder, "-O2")
    run("gcc", f"-I{folder}", compiled, "wrong.c", "-lm", "-o", "wrong", cwd=tmp_path)
    done = subprocess.run(["./wrong"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert float(done.stdout.split()[-1]) > 1e-10


@pytest.mark.parametrize("name", MECHANISMS)
def test_exported_acceleration_is_the_native_loops(name: str, folder_of: Callable[[str], Path]) -> None:
    """The native core evaluates eq. 1 from Pinocchio's terms, without compiled code, at 1,000 states."""
    mechanism, c = load(name), Library(name, folder_of(name))
    core, random = _core.Core(core_table(mechanism)), np.random.default_rng(1)
    scale, none, worst = mechanism.tree.step_scale, np.zeros(mechanism.closure.rows), 0.0
    middle = mechanism.independent_part(mechanism.q_tree)
    for _ in range(1000):
        q = middle + 0.1 * random.uniform(-1, 1, c.d) * scale[mechanism.partition.q]
        assert c.call("move", c.model, q, c.at) == OK
        v = c.rho @ (random.uniform(-2, 2, c.d) * scale[mechanism.partition.q])
        u = random.uniform(-1, 1, c.n)
        expected = core.dae_acceleration(c.q_tree, v, u, none)
        ours = c.acceleration(v, u)
        worst = max(worst, float(np.abs(ours - expected).max() / np.abs(expected).max()))
        tau, q_ddot = random.uniform(-1, 1, len(mechanism.motors.names)), np.zeros(c.d)
        c.call("motor_force", tau, u)
        assert c.call("forward_dynamics", c.model, c.at, v[mechanism.partition.q].copy(), u, q_ddot) == OK
        expected = core.dae_acceleration(c.q_tree, v, mechanism.motors.force(tau), none)
        worst = max(worst, float(np.abs(q_ddot - expected[mechanism.partition.q]).max() / np.abs(expected).max()))
    assert worst <= EXACT


def test_exported_five_bar_is_that_of_the_appendix(folder_of: Callable[[str], Path]) -> None:
    """The reference is the five-bar in NumPy, which imports nothing of the package."""
    c, random = Library("five_bar", folder_of("five_bar")), np.random.default_rng(3)
    for _ in range(50):
        q, q_dot = np.array([-1.4, -1.7]) + random.uniform(-0.3, 0.3, 2), random.uniform(-3, 3, 2)
        assert c.call("move", c.model, q, c.at) == OK
        expected = FIVE_BAR.sigma(q)
        assert np.abs(c.q_tree - expected).max() < 1e-12
        theirs = FIVE_BAR.acceleration(expected, q_dot, np.zeros(2))
        ours = c.acceleration(c.rho @ q_dot, np.zeros(4))
        assert np.abs(ours[[0, 2]] - theirs).max() < 1e-10 * np.abs(theirs).max()


def test_integrator_is_of_order_four(folder_of: Callable[[str], Path]) -> None:
    """The error against 16 times smaller steps falls by 2^4 as the step is halved."""
    c = Library("five_bar", folder_of("five_bar"))

    def end(steps: int) -> Array:
        c.motion.at, c.motion.q_dot = c.at, (ctypes.c_double * 2)(1.0, -2.0)
        for _ in range(steps):
            assert c.call("advance", c.model, c.motion, np.array([0.3, -0.2]), 0.2 / steps) == OK
        return np.array([*c.motion.at.q_tree, *c.motion.q_dot])

    exact = end(640)
    coarse, fine = (np.abs(end(steps) - exact).max() for steps in (20, 40))
    assert 12 < coarse / fine < 20


def test_sigma_reports_what_it_cannot_close(folder_of: Callable[[str], Path]) -> None:
    c = Library("five_bar", folder_of("five_bar"))
    assert c.call("sigma", c.model, np.array([np.nan, 0.0]), c.at) == NOT_FINITE
    assert c.call("move", c.model, np.array([-3.0, 0.0]), c.at) in (NOT_CLOSED, SINGULAR)


@dataclass(frozen=True)
class CallGraph:
    """Functions of GCC's -fcallgraph-info=su: stack of each in bytes, and whom it calls."""

    stack: dict[str, int]
    calls: dict[str, set[str]]

    @classmethod
    def of(cls, name: str, folder: Path, level: str) -> CallGraph:
        text = compile_object(name, folder, level).with_suffix(".ci").read_text()
        nodes = re.findall(r'node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes \((\w+)\)', text)
        assert {kind for _, _, kind in nodes} == {"static"}
        calls: dict[str, set[str]] = {}
        for caller, callee in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', text):
            calls.setdefault(caller, set()).add(callee)
        return cls({title: int(size) for title, size, _ in nodes}, calls)

    def depth(self, function: str, above: tuple[str, ...] = ()) -> int:
        """Return the stack of a function with all it calls; fail at a recursion."""
        assert function not in above, f"{function} is recursive"
        callees = self.calls.get(function, set())
        return self.stack.get(function, 0) + max((self.depth(x, (*above, function)) for x in callees), default=0)


@pytest.mark.parametrize("name", ["five_bar", "delta"])
@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_stack_is_within_the_headers_bound(name: str, level: str, folder_of: Callable[[str], Path]) -> None:
    folder = folder_of(name)
    (bound,) = map(int, re.findall(r"STACK_BYTES (\d+)", (folder / f"{name}.h").read_text()))
    graph = CallGraph.of(name, folder, level)
    measured = max(map(graph.depth, graph.stack))
    assert measured <= bound
    assert level != "-O0" or measured > bound / 4  # the bound says something


def test_exported_c_has_no_heap_and_no_writable_globals(folder_of: Callable[[str], Path]) -> None:
    folder = folder_of("five_bar")
    compiled = compile_object("five_bar", folder, "-O2")
    symbols = [line.split()[-2:] for line in run("nm", compiled, cwd=folder).splitlines()]
    assert {name for kind, name in symbols if kind == "U"} <= LIBM
    assert not [name for kind, name in symbols if kind in "BbDdCc"]


def make_mechanism(tmp_path: Path, old: str = "", new: str = "", extra: str = "") -> Mechanism:
    """Return the five-bar with a text of its files replaced, and text added to its mechanism file."""
    mechanism = load("five_bar")
    for file, text in mechanism.sources.texts.items():
        keyed = re.sub(rf"^{old} =", f'"{new}" =', text, flags=re.MULTILINE) if old else text
        content = keyed.replace(old, new) if old else keyed
        (tmp_path / file).write_text(content + (extra if file == "mechanism.toml" else ""))
    return load(tmp_path)


def test_coupled_joints_have_parameters_with_units(tmp_path: Path) -> None:
    coupling = '\n[[coupling]]\njoint = "theta_3"\nother = "theta_1"\nratio = 1.5\noffset = 0.3\n'
    mechanism = make_mechanism(tmp_path, 'independent = ["theta_1", "theta_3"]', 'independent = ["theta_1"]', coupling)
    folder = tmp_path / "c"
    write(export(mechanism, "c"), folder)
    assert re.search(r"offset, rad \*/", (folder / "five_bar.h").read_text(encoding="ascii"))
    run("gcc", *WARNINGS, "five_bar.c", "five_bar_test.c", "-lm", "-o", "vectors", cwd=folder)
    run("./vectors", cwd=folder)


def test_names_that_c_cannot_have_are_mapped_and_listed(tmp_path: Path) -> None:
    mechanism = make_mechanism(tmp_path, "theta_1", "théta-1 */")  # TOML needs quotes around such a key
    folder = tmp_path / "c"
    write(export(mechanism, "c"), folder)
    header = (folder / "five_bar.h").read_text(encoding="ascii")
    assert re.search(r"FIVE_BAR_V_TH_TA_1___ +th\\xe9ta-1 \* / ", header)
    run("gcc", *WARNINGS, "-c", "five_bar.c", "-o", "five_bar.o", cwd=folder)


def test_prefixes_are_not_names_of_other_sources() -> None:
    """A file of the mechanism would replace a template of the same name."""
    stems = {path.stem for folder in (C_TEMPLATES, FMU_TEMPLATES) for path in folder.glob("*.c")}
    others = {stem for stem in stems if not stem.startswith("mech")}
    assert {"main", "fmu", "stops"} <= others
    assert not others & {make_prefix(stem) for stem in others}


def test_identifiers_are_valid_and_different() -> None:
    assert identifiers(["a-b", "a_b", "a.b", "c"]) == ["a_b", "a_b_2", "a_b_3", "c"]
    assert comment("a */ b /* c\n?\\") == "a * / b / * c ?"


def test_export_to_c_refuses_dry_friction(tmp_path: Path) -> None:
    mechanism = make_mechanism(tmp_path, extra='\n[[joint]]\nname = "theta_2"\nfriction = 0.1\n')
    with pytest.raises(InputError, match=r"five_bar: export to c: dry friction of theta_2 .* set friction = 0"):
        export(mechanism, "c")


def test_export_to_c_refuses_independent_coordinates_of_a_free_root(tmp_path: Path) -> None:
    make_mechanism(tmp_path)
    (tmp_path / "mechanism.toml").write_text('name = "swarm"\n[[tree]]\nfile = "five_bar.urdf"\nroot = "free"\n')
    with pytest.raises(
        InputError, match=r"swarm: export to c: independent coordinates of a free root .root.x, .* joints"
    ):
        export(load(tmp_path), "c")


def test_export_to_c_refuses_large_trees() -> None:
    with pytest.raises(InputError, match=r"export to c: .* terms are compiled for trees of up to 130 coordinates"):
        export(load_scene_mechanism(load_scene("n_four_bar", {"mechanism.N": 70})), "c")


def test_export_to_c_needs_a_folder_that_can_be_written_to(tmp_path: Path) -> None:
    result = ckc("export", "five_bar", "--to", "c")
    assert result.code == 2
    assert "--out DIR" in result.err
    (tmp_path / "file").write_text("")
    result = ckc("export", "five_bar", "--to", "c", "--out", str(tmp_path / "file"))
    assert result.code == 2
    assert "file: cannot be written" in result.err
