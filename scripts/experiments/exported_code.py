"""Check exported C code and FMUs with compilers, sanitizers and cppcheck, on an ARM processor too; time controllers.

Everything runs on sources that are exported to a temporary folder. Debian's packages are named in `TOOLS`.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from zipfile import ZipFile

import numpy as np

from ckc_pin import Mechanism, Scene, load
from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.c.writer import fill_templates, make_prefix
from ckc_pin.formats.exporting import export, write
from ckc_pin.formats.fmu.writer import FMI_VERSIONS

__all__ = ["MECHANISMS", "main"]

MECHANISMS = ("five_bar", "delta", "stewart", "three_rrr", "andrews")
TOOLS = {
    "gcc": "gcc", "clang": "clang", "cppcheck": "cppcheck", "aarch64-linux-gnu-gcc": "gcc-aarch64-linux-gnu",
    "qemu-aarch64": "qemu-user",
}  # fmt: skip
HARNESS = Path(__file__).with_suffix(".c")
COMPILERS = ("gcc", "clang")
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-pedantic")
SANITIZERS = ("-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
POSIX = ("-std=c99", "-D_POSIX_C_SOURCE=199309L")  # has the clock of the harness
# fmi2.c has a struct of callbacks with members that FMI 2.0 prescribes and that this FMU does not use.
CPPCHECK = (
    "cppcheck", "-q", "--enable=warning,style,performance,portability", "--std=c99", "--error-exitcode=1",
    "--suppress=unusedStructMember:fmi2.c",
)  # fmt: skip
# One configuration of the preprocessor of five: the others differ in declarations, and each takes the time again.
FMU_CONFIGURATION = ("-UFMI_HEADERS", "-D__GNUC__")
TINY = 1e-300  # in place of a largest number that is zero
MAX_DIFFERENCE = 1e-12  # between two processors, relative to the largest number of a result


def main(names: Sequence[str]) -> int:
    """Print the results of each mechanism; return 1 if a check fails."""
    missing = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if missing:
        raise InputError(f"exported_code: tools are missing; sudo apt-get install {' '.join(missing)}")
    failures = 0
    for name in names:
        with TemporaryDirectory() as folder:
            for check, function in _checks(name, Path(folder)).items():
                start = perf_counter()
                try:
                    result = function()
                except subprocess.CalledProcessError as error:
                    failures += 1
                    result = f"FAILED: {' '.join(map(str, error.cmd))}\n{error.stdout}{error.stderr}"
                print(f"{name:10} {check:32} {result}  ({perf_counter() - start:.0f} s)", flush=True)
    return int(failures > 0)


def _checks(name: str, folder: Path) -> dict[str, Callable[[], str]]:
    """Export a mechanism as C, and return the checks by their names."""
    mechanism, prefix = load(name), make_prefix(name)
    write(export(mechanism, "c"), folder)
    texts = fill_templates(mechanism, prefix, {HARNESS.name: HARNESS.read_text(encoding="ascii")})
    (folder / HARNESS.name).write_text(texts[HARNESS.name], encoding="ascii")
    programs = {"test": f"{prefix}_test.c", "main": "main.c"}
    checks: dict[str, Callable[[], str]] = {}
    for compiler in COMPILERS:
        checks[f"{compiler}, warnings"] = partial(_run_programs, folder, prefix, programs, (compiler, "-O2", *WARNINGS))
        command = (compiler, "-std=c99", *SANITIZERS)
        checks[f"{compiler}, sanitizers"] = partial(_run_programs, folder, prefix, programs, command)
    checks["controlled step, memory"] = partial(_measure_step, folder, prefix)
    checks["aarch64 under qemu"] = partial(_compare_processors, folder, prefix)
    checks["cppcheck"] = partial(_run_cppcheck, folder, f"-U{prefix.upper()}_CHARTS", f"{prefix}.c", *programs.values())
    for fmi in FMI_VERSIONS:
        sources, file = folder / fmi / "sources", f"fmi{fmi[0]}.c"
        checks[f"FMU {fmi}, warnings"] = partial(_compile_fmu, mechanism, fmi, folder / fmi, sources / file)
        checks[f"FMU {fmi}, cppcheck"] = partial(_run_cppcheck, sources, *FMU_CONFIGURATION, file)
    return checks


def _run(*command: object, cwd: Path) -> str:
    """Run a command and return what it prints.

    Raises
    ------
    subprocess.CalledProcessError
        The exit status is not zero.
    """
    words = [str(x) for x in command]
    return subprocess.run(words, cwd=cwd, check=True, capture_output=True, text=True).stdout


def _run_programs(folder: Path, prefix: str, programs: Mapping[str, str], command: Sequence[str]) -> str:
    """Compile and run the exported programs, and return the last line of the runner of test vectors."""
    outputs = {}
    for program, source in programs.items():
        _run(*command, f"{prefix}.c", source, "-lm", "-o", program, cwd=folder)
        outputs[program] = _run(f"./{program}", cwd=folder)
    return outputs["test"].splitlines()[-1]


def _measure_step(folder: Path, prefix: str) -> str:
    _run("gcc", "-std=c99", "-O2", "-c", f"{prefix}.c", "-o", "library.o", cwd=folder)
    _run("gcc", *POSIX, "-O2", HARNESS.name, "library.o", "-lm", "-o", "measure", cwd=folder)
    median, high, largest, variables = _run("./measure", "times", cwd=folder).split()
    constants = sum(map(int, _run("size", "library.o", cwd=folder).splitlines()[1].split()[:3]))
    return (
        f"median {float(median):.0f} ns, 99 % {float(high):.0f} ns, maximum {float(largest):.0f} ns; "
        f"code and constants {constants} bytes, variables {variables} bytes"
    )


def _compare_processors(folder: Path, prefix: str) -> str:
    """Return the largest difference of results on an emulated ARM processor, relative to the largest of a quantity.

    Raises
    ------
    subprocess.CalledProcessError
        A program fails, or the difference is too large.
    """
    sources = (HARNESS.name, f"{prefix}.c", "-lm", "-o")
    _run("gcc", *POSIX, "-O2", *sources, "native", cwd=folder)
    _run("aarch64-linux-gnu-gcc", *POSIX, "-O2", "-static", *sources, "emulated", cwd=folder)
    native, emulated = _run("./native", cwd=folder), _run("qemu-aarch64", "emulated", cwd=folder)
    pairs = list(zip(native.splitlines(), emulated.splitlines(), strict=True))
    difference = max(_relative_difference(*(np.array(line.split(), float) for line in pair)) for pair in pairs)
    if not difference <= MAX_DIFFERENCE:
        raise subprocess.CalledProcessError(1, ["qemu-aarch64", "emulated"], f"difference {difference:.1e}", "")
    return f"difference {difference:.1e} in {len(pairs)} results"


def _relative_difference(a: Array, b: Array) -> float:
    return float(np.abs(a - b).max(initial=0.0) / max(np.abs(a).max(initial=0.0), TINY))


def _run_cppcheck(folder: Path, *arguments: str) -> str:
    _run(*CPPCHECK, *arguments, cwd=folder)
    return "no warnings"


def _compile_fmu(mechanism: Mechanism, fmi: str, folder: Path, source: Path) -> str:
    """Export the mechanism's FMU, and compile its sources with the compilers' warnings."""
    (file,) = write(export(Scene(mechanism, t_end=1.0, formulation="reduced"), "fmu", fmi=fmi), folder)
    with ZipFile(file) as archive:
        archive.extractall(folder)
    for compiler in COMPILERS:
        _run(compiler, "-O1", *WARNINGS, "-c", source.name, "-o", "library.o", cwd=source.parent)
    return "no warnings"
