"""The cache of compiled terms, and the messages if terms cannot be compiled."""

from __future__ import annotations

import os
import stat
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

from ckc_pin import InputError, check, load, load_scene, simulate
from ckc_pin.codegen import library
from ckc_pin.run.prepare import prepare
from ckc_pin.run.simulate import run_prepared
from ckc_pin.scene.parts import load_scene_mechanism
from scripts.experiments.benchmark.growth import Case, write_case
from scripts.experiments.generated_sizes import ring
from tests.conftest import forget_process_folder
from tests.contract.helpers.command import ckc

NAME = "slider_crank"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, in a process that has compiled nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    forget_process_folder(monkeypatch)
    return tmp_path / "ckc_pin" / "terms"


def fake_compiler(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a `cc` that runs a script before the real one on PATH."""
    folder.mkdir()
    (folder / "cc").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "cc").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_compiled_terms_are_found_in_the_cache(folder: Path) -> None:
    mechanism = load(NAME)
    assert library.find_compiled_terms(mechanism) is None
    assert check(mechanism).terms == "pinocchio"
    compiled = library.compile_terms(mechanism)
    assert Path(compiled.path).parent == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    cached = library.find_compiled_terms(mechanism)
    assert cached is not None
    assert cached.path == compiled.path == library.compile_terms(load(NAME)).path
    assert check(mechanism).terms == "generated"
    assert simulate(NAME, {"t_end": 0.01}).stats["terms"] == "generated"
    assert simulate(NAME, {"t_end": 0.01, "solver.terms": "pinocchio"}).stats["terms"] == "pinocchio"
    assert library.find_compiled_terms(load("four_bar")) is None


def test_a_mechanism_with_other_masses_has_the_same_library(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for name, text in load(NAME).sources.texts.items():
        (copy / name).write_text(text.replace('<mass value="', '<mass value="1'))
    heavy = load(copy)
    assert heavy.tree.model.inertias[1].mass != load(NAME).tree.model.inertias[1].mass
    assert library.compile_terms(heavy).path == library.compile_terms(load(NAME)).path


@pytest.mark.parametrize("damaged", [b"", b"\x7fELF", None], ids=["empty", "cut off", "one byte"])
def test_a_damaged_file_is_compiled_again(folder: Path, damaged: bytes | None) -> None:
    path = Path(library.compile_terms(load(NAME)).path)
    content = path.read_bytes()
    one_byte_changed = content[:5000] + bytes([content[5000] ^ 1]) + content[5001:]
    path.write_bytes(one_byte_changed if damaged is None else damaged)
    assert library.find_compiled_terms(load(NAME)) is None
    assert Path(library.compile_terms(load(NAME)).path).read_bytes() == content


def test_a_cache_that_others_can_write_to_is_not_used(folder: Path) -> None:
    library.compile_terms(load(NAME))
    folder.chmod(0o777)
    assert library.find_compiled_terms(load(NAME)) is None
    assert Path(library.compile_terms(load(NAME)).path).parent != folder


def test_without_a_writable_cache_the_process_keeps_its_library(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.parent.mkdir()
    folder.write_text("no folder")
    assert library.find_compiled_terms(load(NAME)) is None
    assert simulate(NAME, {"t_end": 0.01, "solver.terms": "generated"}).stats["terms"] == "generated"
    compiled = library.compile_terms(load(NAME)).path
    assert Path(compiled).parent != folder
    monkeypatch.setenv("PATH", "")  # without a compiler
    assert library.compile_terms(load(NAME)).path == compiled


def mounted_noexec(parts: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Report folders as mounted with `noexec`."""
    statvfs = os.statvfs

    def report(folder: Path) -> SimpleNamespace:
        flags = statvfs(folder).f_flag
        return SimpleNamespace(f_flag=flags | os.ST_NOEXEC if Path(folder) in parts else flags)

    monkeypatch.setattr(os, "statvfs", report)


def test_libraries_are_not_loaded_from_a_noexec_file_system(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library.compile_terms(load(NAME))
    with monkeypatch.context() as patch:
        mounted_noexec((folder,), patch)
        assert library.find_compiled_terms(load(NAME)) is None
        assert Path(library.compile_terms(load(NAME)).path).parent != folder
    mounted_noexec((folder, Path(tempfile.gettempdir()), library.process_folder()), monkeypatch)
    answer = ckc("compile", NAME)
    assert answer.code == 2
    assert "allows programs" in answer.err


@pytest.mark.parametrize(
    ("requested", "terms"), [("pinocchio", "pinocchio"), ("generated", "generated"), ("auto", "pinocchio")]
)
def test_check_of_a_scene_reports_the_requested_terms(requested: str, terms: str, folder: Path, tmp_path: Path) -> None:
    scene = tmp_path / "my.scene.toml"
    plain = f'mechanism = "{NAME}"\nformulation = "dae"\nt_end = 1.0\ninitial.at = "assembled"\n'
    scene.write_text(f'{plain}solver.terms = "{requested}"\n')
    assert check(scene).terms == terms


def test_without_a_compiler_runs_use_pinocchios_terms(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert simulate(NAME, {"t_end": 0.01}).stats["terms"] == "pinocchio"
    assert check(NAME).terms == "pinocchio"
    with pytest.raises(InputError, match="need a C compiler: `cc` was not found on PATH"):
        simulate(NAME, {"t_end": 0.01, "solver.terms": "generated"})


def test_cached_terms_need_no_compiler(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = library.compile_terms(load(NAME))
    monkeypatch.setenv("PATH", "")
    assert library.compile_terms(load(NAME)).path == compiled.path


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo 'terms.c:1: no space' >&2; exit 1", "the C compiler fails: terms.c:1: no space"),
        ("exit 0", "the C compiler fails: exit code 0"),
        (
            'for file; do case "$file" in *.c) sed -i "s/(-a/(a/" "$file";; esac; done; /usr/bin/cc "$@"',
            " differs from Pinocchio's by ",
        ),
    ],
    ids=["fails", "writes no library", "changes the code"],
)
def test_a_compiler_that_fails_is_reported(
    script: str, message: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_compiler(tmp_path / "bin", script, monkeypatch)
    answer = ckc("compile", NAME, "--json")
    assert answer.code == 2
    assert message in answer.json["message"]
    assert library.find_compiled_terms(load(NAME)) is None


def test_two_processes_can_compile_the_same_terms(folder: Path) -> None:
    with ProcessPoolExecutor(2) as pool:
        paths = set(pool.map(_compile, [NAME, NAME]))
    assert len({Path(path).name.rpartition("-")[0] for path in paths}) == 1
    assert all(Path(path).parent == folder for path in paths)
    assert library.find_compiled_terms(load(NAME)) is not None


def _compile(name: str) -> str:
    return library.compile_terms(load(name)).path


def test_compile_command_reports_whether_it_compiled(folder: Path, tmp_path: Path) -> None:
    first, again = ckc("compile", NAME, "--json"), ckc("compile", NAME, "--json")
    assert (first.code, first.json["compiled"], again.json["compiled"]) == (0, True, False)
    assert first.json["file"] == again.json["file"]
    write_case(Case(80, 80), tmp_path)
    too_large = ckc("compile", str(tmp_path / "mechanism.toml"))
    assert too_large.code == 2
    assert "161 coordinates, which move 241 joints" in too_large.err
    assert "terms are compiled for trees of up to 130 coordinates that move up to 820" in too_large.err


def test_compile_command_reports_a_read_only_cache(folder: Path) -> None:
    """In a container with a read-only home folder, compiled terms are lost when the process ends."""
    folder.parent.parent.mkdir(exist_ok=True)
    folder.parent.write_text("no folder")
    answer = ckc("compile", NAME, "--json")
    assert answer.code == 0
    assert answer.json["file"] is None
    assert answer.json["compiled"] is True
    assert f"not kept: {folder} cannot be written to" in answer.err


def test_size_limit_depends_on_the_lengths_of_branches(folder: Path, tmp_path: Path) -> None:
    """All joints of one branch are coupled, so that the size of its code grows quadratically."""
    ring_41 = load(ring(41, tmp_path).parent / "mechanism.toml")
    with pytest.raises(InputError, match="41 coordinates, which move 861 joints"):
        library.compile_terms(ring_41)
    squares = load_scene("n_four_bar", {"mechanism.N": 64})
    assert not library.explain_too_large(load_scene_mechanism(squares))  # 129 coordinates
    with pytest.raises(InputError, match="41 coordinates, which move 861 joints"):
        simulate(tmp_path / "ring.scene.toml", {"solver.terms": "generated", "t_end": 0.01})


def test_prepare_uses_the_library_it_is_passed(folder: Path) -> None:
    compiled = library.compile_terms(load(NAME))
    ready = prepare(load_scene(NAME, {"solver.terms": "pinocchio"}), library=compiled)
    assert run_prepared(ready).stats["terms"] == "generated"
