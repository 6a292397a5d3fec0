"""Damaged files in an ensemble's store are detected by checksums, and their members are computed again."""

from __future__ import annotations

import json
import random
import warnings
from collections.abc import Callable
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import numpy as np
import pytest
import xarray as xr

import ckc_pin
from ckc_pin.ensembles.members import Members
from ckc_pin.errors import InputError
from tests.contract.helpers.command import ckc
from tests.ensembles.test_sweep import open_results, write_sweep

VARIABLES = {"initial.q.theta_1": {"uniform": [-1.9, -0.9]}}
OUTPUTS: dict[str, Any] = {"end": "q_tree", "path": {"of": "theta_1", "reduce": "trajectory"}, "drift": "energy_drift"}
OVERRIDES = {"t_end": 0.02, "solver.terms": "pinocchio", "solver.output_dt": 0.01}
DAMAGES = 40


def ensemble(out: Path) -> xr.Dataset:
    return ckc_pin.ensemble(
        "five_bar/swing", VARIABLES, OUTPUTS, members=13, seed=3, overrides=OVERRIDES, progress=False, chunk=5,
        threads=1, out=out,
    )  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with finished results, for tests to copy."""
    folder = tmp_path_factory.mktemp("finished")
    ensemble(folder)
    return folder


def convert_to_format_1(store: Path) -> None:
    """Convert a store to the format of an earlier version, without checksums."""
    rmtree(store / "checksums")
    document = json.loads((store / "zarr.json").read_text())
    del document["attributes"]["checksum"]
    document["attributes"]["format"] = 1
    (store / "zarr.json").write_text(json.dumps(document))


def delete(file: Path) -> None:
    file.unlink()


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def empty(file: Path) -> None:
    file.write_bytes(b"")


def flip_a_bit(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))


@pytest.mark.parametrize("damage", [delete, truncate, empty, flip_a_bit])
@pytest.mark.parametrize("name", ["end/c/1/0", "path/c/1/0", "drift/c/1", "initial.q.theta_1/c/1", "status/c/1"])
def test_members_of_a_damaged_chunk_are_computed_again(
    finished: Path, tmp_path: Path, name: str, damage: Callable[[Path], None]
) -> None:
    expected = open_results(finished)
    store = copytree(finished, tmp_path / "o") / "results.zarr"
    damage(store / name)
    verb = "missing" if damage is delete else "damaged"
    with pytest.warns(UserWarning, match="computed again") as caught:
        reopened = ensemble(tmp_path / "o").load()
    assert [str(each.message) for each in caught] == [f"{store}: computed again: members 5 to 9 ({name} is {verb})"]
    assert reopened.identical(expected)
    assert ensemble(tmp_path / "o").load().identical(expected), "a repaired store gives no warning"


@pytest.mark.parametrize("damage", [delete, truncate, empty, flip_a_bit])
@pytest.mark.parametrize("name", ["end/zarr.json", "status/zarr.json", "checksums/chunks/zarr.json", "coordinate/c/0"])
def test_damaged_files_that_follow_from_the_sweep_are_written_again(
    finished: Path, tmp_path: Path, name: str, damage: Callable[[Path], None]
) -> None:
    store = copytree(finished, tmp_path / "o") / "results.zarr"
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    damage(store / name)
    verb = "missing" if damage is delete else "damaged"
    with pytest.warns(UserWarning, match="written again") as caught:
        ensemble(tmp_path / "o")
    assert [str(each.message) for each in caught] == [f"{store}: written again: {name} is {verb}"]
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("damage", [delete, truncate, empty, flip_a_bit])
@pytest.mark.parametrize("name", ["zarr.json", "checksums/zarr.json"])
def test_a_store_with_damaged_attributes_is_rejected(
    finished: Path, tmp_path: Path, name: str, damage: Callable[[Path], None]
) -> None:
    store = copytree(finished, tmp_path / "o") / "results.zarr"
    damage(store / name)
    with pytest.raises(InputError) as error:
        ensemble(tmp_path / "o")
    assert str(error.value).startswith(f"{store / name}: ")
    assert str(error.value).endswith(f"; remove {store}, or choose another DIR")


def test_random_damages_never_change_results(finished: Path, tmp_path: Path) -> None:
    expected = open_results(finished)
    files = sorted(path.relative_to(finished) for path in finished.rglob("*") if path.is_file())
    draw, refusals = random.Random(7), []
    for _ in range(DAMAGES):
        folder = copytree(finished, tmp_path / "o", dirs_exist_ok=True)
        damages = [damage_at_random(folder, files, draw) for _ in range(draw.choice([1, 1, 2]))]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                assert ensemble(folder).load().identical(expected), damages
            except InputError as error:
                refusals.append(str(error))
        rmtree(folder)
    assert all("zarr.json: " in refusal for refusal in refusals), (
        "only the two documents with attributes cannot be repaired"
    )
    assert len(refusals) < DAMAGES / 4


def damage_at_random(folder: Path, files: list[Path], draw: random.Random) -> str:
    """Damage a file and return what was done to it."""
    name, other = draw.choice(files), draw.choice(files)
    file, kind = folder / name, draw.choice(["delete", "truncate", "empty", "flip", "swap"])
    data = bytearray(file.read_bytes()) if file.exists() else bytearray()
    if kind == "delete":
        file.unlink(missing_ok=True)
    elif kind == "swap" and file.exists() and (folder / other).exists():
        file.write_bytes((folder / other).read_bytes())
        (folder / other).write_bytes(data)
        return f"swap {name} and {other}"
    elif kind == "flip" and data:
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        file.write_bytes(data)
    else:
        file.write_bytes(data[: draw.randrange(len(data))] if kind == "truncate" and data else b"")
    return f"{kind} {name}"


def test_damage_after_the_ensemble_is_an_input_error_when_values_are_read(finished: Path, tmp_path: Path) -> None:
    for k, damage in enumerate((delete, truncate, empty, flip_a_bit)):
        store = copytree(finished, tmp_path / str(k)) / "results.zarr"
        reopened = ensemble(tmp_path / str(k))
        damage(store / "end/c/1/0")
        with pytest.raises(InputError, match=r"end/c/1/0 is (missing|damaged); run the same sweep again"):
            reopened.load()
        assert np.isfinite(reopened["drift"].to_numpy()).all()


def test_a_store_that_cannot_be_repaired_is_rejected(finished: Path, tmp_path: Path) -> None:
    store = copytree(finished, tmp_path / "o") / "results.zarr"
    delete(store / "end/c/1/0")
    (store / "end/c/1/0").mkdir()
    with pytest.raises(InputError, match=r"results.zarr: cannot be repaired or converted: "):
        ensemble(tmp_path / "o")


def test_damaged_members_are_pending_until_they_are_computed(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = copytree(finished, tmp_path / "o") / "results.zarr"
    delete(store / "end/c/1/0")

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Members, "run", interrupt)
    with pytest.warns(UserWarning, match="members 5 to 9"), pytest.raises(KeyboardInterrupt):
        ensemble(tmp_path / "o")
    assert open_results(tmp_path / "o")["status"].to_numpy().tolist() == [1] * 5 + [0] * 5 + [1] * 3


def test_results_of_an_earlier_version_get_checksums(finished: Path, tmp_path: Path) -> None:
    expected = open_results(finished)
    store = copytree(finished, tmp_path / "o") / "results.zarr"
    convert_to_format_1(store)
    assert ensemble(tmp_path / "o").load().identical(expected), "all members are kept, without a warning"
    convert_to_format_1(store)
    delete(store / "end/c/0/0")
    truncate(store / "status/c/1")
    delete(store / "drift/zarr.json")
    with pytest.warns(UserWarning, match=r"members 0 to 4 \(end/c/0/0 is missing\)$"):
        assert ensemble(tmp_path / "o").load().identical(expected)
    assert ensemble(tmp_path / "o").load().identical(expected)


def test_sweep_prints_in_one_line_which_members_it_computes_again(tmp_path: Path) -> None:
    path, out = write_sweep(tmp_path, 30), tmp_path / "o"
    command = ("sweep", str(path), "--out", str(out), "--chunk", "5", "--no-figures", "--json")
    assert ckc(*command).err == ""
    expected = open_results(out)
    for k in range(5):
        delete(out / f"results.zarr/end/c/{k}/0")
    done = ckc(*command)
    assert done.code == 0
    assert done.err.splitlines() == [
        f"{out / 'results.zarr'}: computed again: members 0 to 4 (end/c/0/0 is missing), members 5 to 9 (end/c/1/0 is "
        "missing), members 10 to 14 (end/c/2/0 is missing) and 2 more"
    ]
    assert done.json["done"] == 30
    assert open_results(out).identical(expected)
