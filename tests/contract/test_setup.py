"""`./scripts/setup` makes `.venv` in two levels from one lock, and recognizes what an interrupted start left behind."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import distribution
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "setup_venv.py"
LARGE = {
    "drake",
    "exudyn",
    "playwright",
    "sphinx",
    "mypy",
    "casadi",
    "mujoco",
    "pandas",
    "pytest",
    "example-robot-data",
}


def load_setup() -> ModuleType:
    spec = spec_from_file_location("setup_venv", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Setup:
    """The script in a folder of its own, with commands recorded instead of run."""

    def __init__(self, root: Path) -> None:
        self.module = load_setup()
        (root / "native").mkdir()
        (root / "native" / "core.cpp").write_text("int version = 1;\n")
        self.native = root / "native" / "core.cpp"
        self.constraints = root / "constraints.txt"
        self.constraints.write_text((ROOT / "constraints.txt").read_text())
        self.venv = root / ".venv"
        self.stamp = self.venv / "ckc_pin-setup"
        places = {"ROOT": root, "VENV": self.venv, "STAMP": self.stamp, "NATIVE": root / "native"}
        for name, place in {**places, "CONSTRAINTS": self.constraints, "PACKAGE": root / "ckc_pin"}.items():
            setattr(self.module, name, place)
        self.module.run_quietly = self._record
        self.commands: list[str] = []
        self.fail_at = ""
        self.failure: Callable[[], BaseException] = KeyboardInterrupt

    def _record(self, lock: int, what: str, command: list[str], on_line: object = None) -> None:
        if what == "venv":
            (self.venv / "bin").mkdir(parents=True)
            (self.venv / "bin" / "python").touch()
        file = next((Path(argument).stem for argument in command if argument.endswith(".txt")), "")
        self.commands.append(file.removeprefix("ckc_pin-") or ("native" if "--editable" in command else what))
        if self.commands[-1] == self.fail_at:
            raise self.failure()

    def start(self, level: str) -> list[str]:
        """Return the steps of one start: venv, native, compileall, and the levels that are installed."""
        self.commands.clear()
        if not self.module.up_to_date(level):
            self.module.make(level, 0)
        return self.commands.copy()


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return Setup(tmp_path)


MADE = ["venv", "demo", "native", "compileall"]


def test_levels_divide_the_lock() -> None:
    module = load_setup()
    demo, rest = (module.locked_packages(level) for level in module.LEVELS)
    lock = (ROOT / "constraints.txt").read_text()
    pinned = re.findall(r"^[^ #].*?(?===)", lock, re.MULTILINE)
    assert len(pinned) > 150
    assert sorted([*demo, *rest]) == sorted(pinned)
    assert "".join([*demo.values(), *rest.values()]).count("--hash=") == lock.count("--hash=")


def test_demo_has_what_it_imports_and_none_of_the_large_packages() -> None:
    demo = set(load_setup().locked_packages("demo"))
    assert {"pin", "numpy", "scipy", "matplotlib", "meshcat", "cmake", "nanobind"} <= demo
    assert not demo & LARGE


def test_demo_has_every_dependency_that_its_packages_declare() -> None:
    demo = set(load_setup().locked_packages("demo"))
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = declared["project"]
    queue = [*project["dependencies"], *project["optional-dependencies"]["demo"], *declared["build-system"]["requires"]]
    seen = set()
    while queue:
        requirement = Requirement(queue.pop())
        name = canonicalize_name(requirement.name)
        if name in seen or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        seen.add(name)
        assert name in demo
        queue += distribution(name).requires or []
    assert len(seen) > 50


def test_package_of_pyproject_that_the_lock_lacks_is_named(setup: Setup) -> None:
    lock = setup.constraints.read_text()
    setup.constraints.write_text(re.sub(r"^meshcat==.*\n(?: .*\n)*", "", lock, flags=re.MULTILINE))
    with pytest.raises(setup.module.SetupError, match=r"meshcat .* missing: run ./scripts/lock"):
        setup.start("demo")


def test_second_level_adds_to_the_first(setup: Setup) -> None:
    assert setup.start("demo") == MADE
    assert setup.start("demo") == []
    assert setup.start("test") == ["test"]
    assert setup.start("test") == []
    assert setup.start("demo") == []


def test_second_level_from_nothing(setup: Setup) -> None:
    assert setup.start("test") == [*MADE, "test"]
    assert setup.start("demo") == []


def test_changed_core_alone_is_compiled_at_both_levels(setup: Setup) -> None:
    for level in ("demo", "test"):
        setup.start(level)
        setup.native.write_text(f"int version = {level!r};\n")
        assert setup.start("demo") == ["native", "compileall"]
        assert setup.start(level) == []


def test_changed_lock_remakes(setup: Setup) -> None:
    setup.start("test")
    setup.constraints.write_text(setup.constraints.read_text() + "# changed\n")
    assert setup.start("demo") == MADE
    assert setup.start("test") == ["test"]


@pytest.mark.parametrize("step", MADE)
def test_interrupted_first_level_is_removed(setup: Setup, step: str) -> None:
    setup.fail_at = step
    with pytest.raises(KeyboardInterrupt):
        setup.start("test")
    assert not setup.venv.exists()
    setup.fail_at = ""
    assert setup.start("demo") == MADE


def test_first_level_that_was_killed_is_remade(setup: Setup) -> None:
    setup.start("demo")
    setup.stamp.write_text(setup.module.UNFINISHED)
    assert setup.start("demo") == MADE


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
def test_interrupted_second_level_leaves_the_first(setup: Setup, failure: Callable[[], BaseException]) -> None:
    setup.start("demo")
    setup.fail_at, setup.failure = "test", failure
    with pytest.raises(failure):  # type: ignore[call-overload]
        setup.start("test")
    assert setup.start("demo") == []
    setup.fail_at = ""
    assert setup.start("test") == ["test"]


def test_environment_of_another_program_is_not_touched(setup: Setup) -> None:
    setup.venv.mkdir()
    (setup.venv / "pyvenv.cfg").touch()
    with pytest.raises(setup.module.SetupError, match="was not made by this script"):
        setup.start("demo")
    assert [path.name for path in setup.venv.iterdir()] == ["pyvenv.cfg"]


def test_unknown_level_is_refused() -> None:
    run = subprocess.run([sys.executable, "-I", str(SCRIPT), "dmeo"], capture_output=True, text=True)
    assert run.returncode == 1
    assert run.stderr == "setup: level 'dmeo': expected demo or test\n"
