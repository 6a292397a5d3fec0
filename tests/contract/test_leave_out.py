"""Modules that a command does not need are not imported."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import ckc_pin

VIEW = {"meshcat", "matplotlib", "yourdfpy"}

LIST = "import sys, json; print(json.dumps(sorted(sys.modules)), file=sys.stderr)"
RUN = f"""
import sys
from ckc_pin.cli.app import main
sys.argv = ["ckc", *sys.argv[1:]]
try:
    main()
finally:
    {LIST}
"""


def _modules(code: str, *words: str) -> tuple[set[str], str]:
    """Return the names of the modules that code leaves loaded, and what it printed."""
    here = str(Path(ckc_pin.__file__).parent.parent)
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": here},
    )
    return set(json.loads(done.stderr.splitlines()[-1])), done.stdout


def test_import_of_the_command_line_is_small() -> None:
    """The command `ckc` imports the package before it can handle signals."""
    modules, _ = _modules(f"import ckc_pin.cli; {LIST}")
    assert {name for name in modules if name.startswith("ckc_pin.")} == {
        "ckc_pin.cli", "ckc_pin.cli.signals", "ckc_pin.base", "ckc_pin.base.interrupt",
    }  # fmt: skip
    assert not modules & (VIEW | {"click", "numpy", "pinocchio", "scipy", "typing"})


def test_lazily_loaded_names_are_available() -> None:
    code = "import ckc_pin; assert set(ckc_pin.__all__) <= set(dir(ckc_pin)); from ckc_pin import *; simulate; "
    modules, _ = _modules(f"{code} assert not hasattr(ckc_pin, 'simulated'); {LIST}")
    assert "ckc_pin.run.simulate" in modules


def test_terms_do_not_import_scipy() -> None:
    modules, _ = _modules(
        'import ckc_pin; ckc_pin.terms(ckc_pin.load("five_bar"), {"theta_1": -1.2, "theta_3": -1.9}).C; ' + LIST
    )
    assert not modules & (VIEW | {"click", "scipy"})


def test_run_in_json_does_not_import_graphics() -> None:
    modules, out = _modules(RUN, "run", "five_bar/swing", "--set", "t_end=0.01", "--json")
    assert json.loads(out)["status"] == "done"
    assert "ckc_pin.native._core" in modules
    assert not modules & (VIEW | {"PIL", "tornado", "zmq", "scipy", "rich.console"})


def test_only_large_matrices_are_kept_on_one_thread() -> None:
    """For small ones BLAS takes one thread without being told."""
    small, _ = _modules(f'import ckc_pin; ckc_pin.load("slider_crank"); {LIST}')
    large, _ = _modules(f'import ckc_pin; ckc_pin.load("talos"); {LIST}')
    assert "threadpoolctl" in large - small


def test_command_imports_no_other_command() -> None:
    modules, _ = _modules(RUN, "run", "five_bar/swing", "--set", "t_end=0.01", "--json")
    expected = {f"ckc_pin.cli.{name}" for name in ("app", "options", "output", "runs", "signals")}
    assert {name for name in modules if name.startswith("ckc_pin.cli.")} == expected
    assert not {name for name in modules if name.startswith(("ckc_pin.formats", "ckc_pin.analysis", "ckc_pin.view"))}


def test_check_does_not_import_graphics() -> None:
    modules, out = _modules(RUN, "check", "five_bar", "--json")
    assert json.loads(out)["d"] == 2
    assert not modules & (VIEW | {"scipy"})
