"""What a wheel brings along: the package and the shipped mechanisms, and nothing of the laboratory."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = {"__init__.py", "__main__.py", "errors.py", "py.typed", "analysis", "base", "cli", "codegen", "control",
         "dynamics", "ensembles", "explorer", "formats", "identification", "kinematics", "linear",
         "mechanism", "native", "optimization", "run", "scene", "sensitivity", "urdf", "view"}  # fmt: skip


def test_a_wheel_has_the_package_and_the_mechanisms_alone(tmp_path: Path) -> None:
    """Without its native core, which takes minutes to compile; `./scripts/check_wheel` builds the whole one."""
    settings = ("wheel.cmake=false", f"build-dir={tmp_path / 'build'}")
    build = [*(f"--config-settings={x}" for x in settings), "-w", str(tmp_path)]  # `-C` is unknown to pip 23.0
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-index", "--no-deps"]
    subprocess.run([*pip, "--no-build-isolation", *build, str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        files = [Path(name) for name in archive.namelist() if ".dist-info/" not in name]
    assert {file.parts[0] for file in files} == {"ckc_pin"}
    assert {file.parts[1] for file in files} == PARTS
    shipped = {path.parent.name for path in (ROOT / "urdf").glob("*/*.toml")}
    assert {file.parts[2] for file in files if file.parts[1] == "urdf"} == shipped
    code = {file for file in files if file.parts[1] != "urdf"}
    new = {file.name for file in code if file.parts[1:3] == ("cli", "new_files")}
    assert new == {"NAME.urdf", "mechanism.toml", "default.scene.toml"}
    code = {file for file in code if file.name not in new}
    for room in ("explorer", "view"):
        static = {file.name for file in code if file.parts[1:3] == (room, "static")}
        assert static == {path.name for path in (ROOT / "ckc_pin" / room / "static").iterdir()}
    for form in ("c", "fmu"):
        templates = {file for file in code if file.parts[1:4] == ("formats", form, "templates")}
        assert {x.name for x in templates} == {
            path.name for path in (ROOT / "ckc_pin" / "formats" / form / "templates").iterdir()
        }
        code -= templates
    assert {file.suffix for file in code} <= {".py", ".pyi", ".typed", ".html", ".js", ".css"}
