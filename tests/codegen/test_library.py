"""Where compiled terms are kept, and what is said when they cannot be made."""

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
from ckc_pin.scene.parts import scene_mechanism
from scripts.experiments.benchmark.growth import Case, written
from scripts.experiments.generated_sizes import ring
from tests.contract.helpers.command import ckc

NAME = "slider_crank"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "ckc_pin" / "terms"


def fake_compiler(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A `cc` that runs a script, before the real one on PATH."""
    folder.mkdir()
    (folder / "cc").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "cc").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_what_was_compiled_is_found_again(folder: Path) -> None:
    mechanism = load(NAME)
    assert library.find(mechanism) is None
    assert check(mechanism).terms == "pinocchio"
    made = library.compiled(mechanism)
    assert Path(made.path).parent == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    found = library.find(mechanism)
    assert found is not None
    assert found.path == made.path == library.compiled(load(NAME)).path
    assert check(mechanism).terms == "generated"
    assert simulate(NAME, {"t_end": 0.01}).stats["terms"] == "generated"
    assert simulate(NAME, {"t_end": 0.01, "solver.terms": "pinocchio"}).stats["terms"] == "pinocchio"
    assert library.find(load("four_bar")) is None


def test_other_masses_are_arguments_of_the_same_code(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    for name, text in load(NAME).sources.texts.items():
        (mine / name).write_text(text.replace('<mass value="', '<mass value="1'))
    heavy = load(mine)
    assert heavy.tree.model.inertias[1].mass != load(NAME).tree.model.inertias[1].mass
    assert library.compiled(heavy).path == library.compiled(load(NAME)).path


@pytest.mark.parametrize("harm", [b"", b"\x7fELF", None], ids=["empty", "cut off", "one byte"])
def test_a_damaged_file_is_not_loaded_but_made_again(folder: Path, harm: bytes | None) -> None:
    path = Path(library.compiled(load(NAME)).path)
    content = path.read_bytes()
    path.write_bytes(content[:5000] + bytes([content[5000] ^ 1]) + content[5001:] if harm is None else harm)
    assert library.find(load(NAME)) is None
    assert Path(library.compiled(load(NAME)).path).read_bytes() == content


def test_a_folder_that_others_write_to_is_not_read(folder: Path) -> None:
    library.compiled(load(NAME))
    folder.chmod(0o777)
    assert library.find(load(NAME)) is None
    assert Path(library.compiled(load(NAME)).path).parent != folder


def test_where_nothing_can_be_written_the_process_keeps_its_own(folder: Path) -> None:
    folder.parent.mkdir()
    folder.write_text("no folder")
    assert library.find(load(NAME)) is None
    assert simulate(NAME, {"t_end": 0.01, "solver.terms": "generated"}).stats["terms"] == "generated"


def mounted_noexec(parts: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Report those folders as mounted without programs."""
    statvfs = os.statvfs

    def report(folder: Path) -> SimpleNamespace:
        flags = statvfs(folder).f_flag
        return SimpleNamespace(f_flag=flags | os.ST_NOEXEC if Path(folder) in parts else flags)

    monkeypatch.setattr(os, "statvfs", report)


def test_programs_are_loaded_from_where_that_is_allowed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library.compiled(load(NAME))
    with monkeypatch.context() as patch:
        mounted_noexec((folder,), patch)
        assert library.find(load(NAME)) is None
        assert Path(library.compiled(load(NAME)).path).parent != folder
    mounted_noexec((folder, Path(tempfile.gettempdir())), monkeypatch)
    answer = ckc("compile", NAME)
    assert answer.code == 2
    assert "allows programs" in answer.err


@pytest.mark.parametrize(
    ("asked", "terms"), [("pinocchio", "pinocchio"), ("generated", "generated"), ("auto", "pinocchio")]
)
def test_a_check_of_a_scene_says_what_the_scene_asks_for(asked: str, terms: str, folder: Path, tmp_path: Path) -> None:
    scene = tmp_path / "mine.scene.toml"
    plain = f'mechanism = "{NAME}"\nformulation = "dae"\nt_end = 1.0\ninitial.at = "assembled"\n'
    scene.write_text(f'{plain}solver.terms = "{asked}"\n')
    assert check(scene).terms == terms


def test_without_a_compiler_there_is_the_general_core(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert simulate(NAME, {"t_end": 0.01}).stats["terms"] == "pinocchio"
    assert check(NAME).terms == "pinocchio"
    with pytest.raises(InputError, match="no C compiler"):
        simulate(NAME, {"t_end": 0.01, "solver.terms": "generated"})


def test_what_is_there_is_taken_without_a_compiler(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = library.compiled(load(NAME))
    monkeypatch.setenv("PATH", "")
    assert library.compiled(load(NAME)).path == made.path


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("echo 'terms.c:1: no space' >&2; exit 1", "the C compiler fails: terms.c:1: no space"),
        ("exit 0", "the C compiler fails: exit code 0"),
        (
            'for file; do case "$file" in *.c) sed -i "s/(-a/(a/" "$file";; esac; done; /usr/bin/cc "$@"',
            "as compiled is not what Pinocchio gives",
        ),
    ],
    ids=["fails", "makes nothing", "makes other code"],
)
def test_a_compiler_that_is_none(
    script: str, says: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_compiler(tmp_path / "bin", script, monkeypatch)
    answer = ckc("compile", NAME, "--json")
    assert answer.code == 2
    assert says in answer.json["message"]
    assert library.find(load(NAME)) is None


def test_two_processes_at_once(folder: Path) -> None:
    with ProcessPoolExecutor(2) as pool:
        paths = set(pool.map(_make, [NAME, NAME]))
    assert len({Path(path).name.rpartition("-")[0] for path in paths}) == 1
    assert all(Path(path).parent == folder for path in paths)
    assert library.find(load(NAME)) is not None


def _make(name: str) -> str:
    return library.compiled(load(name)).path


def test_the_command_tells_what_it_did(folder: Path, tmp_path: Path) -> None:
    first, again = ckc("compile", NAME, "--json"), ckc("compile", NAME, "--json")
    assert (first.code, first.json["compiled"], again.json["compiled"]) == (0, True, False)
    assert first.json["file"] == again.json["file"]
    written(Case(80, 80), tmp_path)
    too_large = ckc("compile", str(tmp_path / "mechanism.toml"))
    assert too_large.code == 2
    assert "161 coordinates, which move 241 joints" in too_large.err
    assert "terms are written out for trees of up to 130 coordinates that move up to 820" in too_large.err


def test_the_command_tells_what_it_could_not_keep(folder: Path) -> None:
    """As in a container whose home is read-only: what it compiled goes with it, and there is no file to name."""
    folder.parent.parent.mkdir(exist_ok=True)
    folder.parent.write_text("no folder")
    answer = ckc("compile", NAME, "--json")
    assert answer.code == 0
    assert answer.json["file"] is None
    assert answer.json["compiled"] is True
    assert f"not kept: {folder} cannot be written to" in answer.err


def test_one_long_branch_is_too_large_where_many_short_ones_are_not(folder: Path, tmp_path: Path) -> None:
    """Joints of one branch have all to do with each other: so does the text that the compiler gets."""
    ring_41 = load(ring(41, tmp_path).parent / "mechanism.toml")
    with pytest.raises(InputError, match="41 coordinates, which move 861 joints"):
        library.compiled(ring_41)
    squares = load_scene("n_four_bar", {"mechanism.N": 64})
    assert not library.too_large(scene_mechanism(squares))  # 129 coordinates
    with pytest.raises(InputError, match="41 coordinates, which move 861 joints"):
        simulate(tmp_path / "ring.scene.toml", {"solver.terms": "generated", "t_end": 0.01})


def test_a_library_that_is_given_is_taken(folder: Path) -> None:
    made = library.compiled(load(NAME))
    ready = prepare(load_scene(NAME, {"solver.terms": "pinocchio"}), library=made)
    assert run_prepared(ready).stats["terms"] == "generated"
