"""Run files: content, loading, self-containedness, and rejection of damaged or malicious files."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, Run, load, simulate
from tests.conftest import assert_close

ARRAYS = {"t", "coordinates", "q_tree", "v_tree", "u", "tau", "phi", "energy"}


@pytest.fixture(scope="session")
def tracked() -> Run:
    """A short controlled run with a Lyapunov function, events and a profile."""
    return simulate(
        "five_bar/tracking",
        {
            "t_end": 0.1,
            "solver.output_dt": 0.01,
            "solver.rtol": 1e-6,
            "event": [{"coordinate": "theta_1", "value": -1.4}],
        },
        profile=True,
    )


@pytest.fixture
def saved(tracked: Run, tmp_path: Path) -> Path:
    return tracked.save(tmp_path / "run.npz")


def test_run_file_has_the_documented_arrays(tracked: Run, saved: Path) -> None:
    with np.load(saved, allow_pickle=False) as data:
        assert set(data.files) >= ARRAYS | {"lyapunov"}
        for name in ARRAYS - {"coordinates"}:
            assert data[name].dtype == np.float64
            assert len(data[name]) == len(tracked.t) == 11, "a row an output instant"
        assert data["coordinates"].tolist() == ["theta_1", "theta_2", "theta_3", "theta_4"]
        assert data["q_tree"].shape == data["v_tree"].shape == (11, 4)
        assert data["u"].shape == data["tau"].shape == data["phi"].shape == (11, 2)
        texts = json.loads(data["meta"].tobytes())["texts"]
    assert texts["mechanism.toml"].startswith("# The paper's five-bar")
    assert "<robot" in texts["five_bar.urdf"]


def test_uncontrolled_run_has_no_lyapunov_function(run: Callable[..., Run], tmp_path: Path) -> None:
    swing = run("five_bar/swing", t_end=0.1)
    path = swing.save(tmp_path / "run.npz")
    with np.load(path, allow_pickle=False) as data:
        assert "lyapunov" not in data.files
    assert Run.load(path).lyapunov is None


def test_saved_run_is_loaded_unchanged(tracked: Run, saved: Path) -> None:
    loaded = Run.load(saved)
    assert tracked.events
    assert tracked.profile
    for field in dataclasses.fields(Run):
        ours, theirs = getattr(tracked, field.name), getattr(loaded, field.name)
        assert type(ours) is type(theirs), field.name
        if isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype
            assert np.array_equal(ours, theirs), field.name
        else:
            assert ours == theirs, field.name
    assert loaded.to_dict() == tracked.to_dict()


def test_nonfinite_numbers_are_saved_and_loaded(tracked: Run, tmp_path: Path) -> None:
    odd = dataclasses.replace(tracked, max_phi=np.nan, energy=np.full_like(tracked.energy, np.inf))
    loaded = Run.load(odd.save(tmp_path / "run.npz"))
    assert np.isnan(loaded.max_phi)
    assert np.all(loaded.energy == np.inf)


def test_run_file_without_terms_has_a_summary(tracked: Run) -> None:
    stats = {name: value for name, value in tracked.stats.items() if name != "terms"}
    shown = dataclasses.replace(tracked, stats=stats).summary()
    assert dict(shown.rows)["terms"] == "pinocchio"


def test_load_accepts_a_folder(saved: Path) -> None:
    assert np.array_equal(Run.load(saved.parent).t, Run.load(saved).t)


def test_run_file_is_self_contained(tracked: Run, saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    monkeypatch.setattr("ckc_pin.mechanism.library.library", lambda: empty)
    mechanism = Run.load(saved).mechanism
    assert mechanism.independent == ("theta_1", "theta_3")
    monkeypatch.undo()
    assert_close(mechanism.q_tree, load("five_bar").q_tree, 0.0)
    assert_close(Run.load(saved).points["tip"], tracked.points["tip"], 0.0)


def test_run_file_contains_model_and_trajectory(bar: Path, tmp_path: Path) -> None:
    text = (bar / "five_bar.urdf").read_text(encoding="utf-8").replace('mass value="0.2451"', 'mass value="0.3"')
    (bar / "heavy.urdf").write_text(text, encoding="utf-8")
    model = (bar / "mechanism.toml").read_text(encoding="utf-8").replace("five_bar.urdf", "heavy.urdf")
    (bar / "heavy.toml").write_text(model, encoding="utf-8")
    t = np.linspace(0, 1, 21)
    rows = [f"{x},{-1.4 + 0.1 * x**3},{-1.7}" for x in t]
    (bar / "way.csv").write_text("\n".join(["t,theta_1,theta_3", *rows]), encoding="utf-8")
    overrides = {"t_end": 0.02, "controller.model": "heavy.toml", "controller.desired": {"file": "way.csv"}}
    finished = simulate(bar / "tracking.scene.toml", overrides)
    loaded = Run.load(finished.save(tmp_path / "run.npz"))
    assert loaded.texts["way.csv"].startswith("t,theta_1,theta_3")
    assert 'value="0.3"' in loaded.texts["model/heavy.urdf"]
    assert 'value="0.2451"' in loaded.texts["five_bar.urdf"]


def test_loop_forces_satisfy_eq_1(tracked: Run, saved: Path) -> None:
    """Checks D' v'_dot + C' v' + h' = u' + J^T lambda with v'_dot from finite differences."""
    fine = simulate("five_bar/swing", {"t_end": 0.02, "solver.output_dt": 1e-3, "solver.rtol": 1e-11})
    forces = fine.loop_forces()
    assert list(forces) == ["elbow"]
    assert forces["elbow"].shape == (21, 2)
    k = 10
    acceleration = (fine.v_tree[k + 1] - fine.v_tree[k - 1]) / 2e-3
    at = fine.mechanism.kinematics(fine.mechanism.tree.from_coordinates(fine.q_tree[k]))
    from ckc_pin.dynamics.terms import Terms

    terms = Terms(fine.mechanism, at, fine.v_tree[k])
    left_side = terms.D_tree @ acceleration + terms.C_tree @ fine.v_tree[k] + terms.h_tree
    right = at.J.T @ forces["elbow"][k]
    assert_close(left_side, right, 2e-5)
    assert np.abs(forces["elbow"][k]).max() > 0.1
    assert_close(Run.load(saved).loop_forces()["elbow"], tracked.loop_forces()["elbow"], 0.0)


def test_column_index_by_name(tracked: Run) -> None:
    assert tracked.column("theta_3") == 2
    with pytest.raises(InputError, match="no coordinate 'theta_9' in this run; there are theta_1, theta_2"):
        tracked.column("theta_9")


# --- atomic writes ---------------------------------------------------------------------------------


def test_failed_write_keeps_the_old_file(tracked: Run, saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()

    def half(file: io.BufferedWriter, **content: Any) -> None:
        file.write(b"half a run")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(InputError, match=r"run\.npz: cannot be written: No space left on device"):
        dataclasses.replace(tracked, message="another").save(saved)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["run.npz"]


def test_interrupted_write_keeps_the_old_file(tracked: Run, saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()

    def interrupted(handle: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dataclasses.replace(tracked, message="another").save(saved)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["run.npz"]


# --- untrusted files ------------------------------------------------------------------------------

Contents = dict[str, Any]


def _meta(**overrides: Any) -> Callable[[Contents], None]:
    """Return an edit of the file's metadata; None removes a key."""

    def change(content: Contents) -> None:
        meta = json.loads(content["meta"].tobytes()) | overrides
        content["meta"] = np.frombuffer(
            json.dumps({k: v for k, v in meta.items() if v is not None}).encode(), dtype=np.uint8
        )

    return change


def _array(name: str, value: Any) -> Callable[[Contents], None]:
    return lambda content: content.__setitem__(name, value)


def _without(name: str) -> Callable[[Contents], None]:
    def remove(content: Contents) -> None:
        del content[name]

    return remove


class Payload:
    """A pickle that would execute code on the reader's machine."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (pytest.fail, ("a pickle was executed",))


TAMPERED: dict[str, tuple[Callable[[Contents], None], str]] = {
    "another version": (_meta(format=2), "a run of format 2; this program reads format 1"),
    "no version": (_meta(format=None), "a run of format None"),
    "changed text": (_meta(texts={"mechanism.toml": "name = 'x'"}), "its texts do not match their hashes"),
    "changed scene": (_meta(scene={"formulation": "dae"}), "do not match their hashes"),
    "no texts": (_meta(texts={}, hashes={}), "do not match their hashes"),
    "unknown key": (_meta(colour="red"), "damaged"),
    "missing key": (_meta(status=None), "damaged"),
    "wrong type": (_meta(stats=3), "damaged"),
    "unknown status": (_meta(status="fine"), "damaged"),
    "meta that is not JSON": (_array("meta", np.zeros(8, dtype=np.uint8)), "damaged"),
    "missing array": (_without("q_tree"), "not a run file: it contains coordinates, energy"),
    "unknown array": (_array("extra", np.zeros(3)), "not a run file: it contains"),
    "too few rows": (_array("u", np.zeros((3, 2))), "u is (3, 2) float64, which does not fit the other arrays"),
    "too many columns": (_array("q_tree", np.zeros((11, 5))), "q_tree is (11, 5)"),
    "complex": (_array("energy", np.zeros(11, dtype=complex)), "energy is (11,) complex128"),
    "no rows": (_array("t", np.zeros(0)), "damaged"),
    "a time of two dimensions": (_array("t", np.zeros((11, 1))), "t is (11, 1)"),
    "time that stands still": (_array("t", np.zeros(11)), "t does not increase"),
    "a configuration that is no number": (
        _array("q_tree", np.full((11, 4), np.nan)),
        "q_tree contains numbers that are not",
    ),
    "an endless time": (_array("t", np.append(np.arange(10.0), np.inf)), "t contains numbers that are not finite"),
    "a pickle": (_array("energy", np.array([Payload()] * 11, dtype=object)), "damaged"),
}


@pytest.mark.parametrize("what", TAMPERED)
def test_tampered_file_is_rejected(what: str, saved: Path) -> None:
    tamper, says = TAMPERED[what]
    with np.load(saved, allow_pickle=False) as data:
        content = {name: data[name] for name in data.files}
    tamper(content)
    np.savez_compressed(saved, **content)
    with pytest.raises(InputError) as error:
        Run.load(saved)
    assert str(error.value).startswith(f"{saved}: ")
    assert says in str(error.value)
    assert str(error.value).endswith("; ckc run SCENE --out DIR writes a new one")


def test_loop_forces_are_nan_where_J_loses_rank() -> None:
    run = simulate("n_four_bar", {"mechanism.N": 1, "t_end": 0.02})
    q_tree = run.q_tree.copy()
    q_tree[1] = 0.0  # all bars in line
    (forces,) = dataclasses.replace(run, q_tree=q_tree).loop_forces().values()
    assert np.all(np.isnan(forces[1]))
    np.testing.assert_array_equal(np.delete(forces, 1, 0), np.delete(next(iter(run.loop_forces().values())), 1, 0))


@pytest.mark.parametrize("length", [0, 10, 1000, -1])
def test_truncated_file_is_rejected(length: int, saved: Path) -> None:
    saved.write_bytes(saved.read_bytes()[:length])
    with pytest.raises(InputError, match=r"run\.npz: not a run file, or damaged"):
        Run.load(saved)


def test_flipped_bytes_are_rejected_or_harmless(tracked: Run, saved: Path) -> None:
    """Almost all bytes of an npz file are covered by checksums."""
    whole = saved.read_bytes()
    refused = 0
    positions = range(0, len(whole), len(whole) // 60)
    for k in positions:
        saved.write_bytes(whole[:k] + bytes([whole[k] ^ 0xFF]) + whole[k + 1 :])
        try:
            loaded = Run.load(saved)
        except InputError:
            refused += 1
        else:
            assert np.array_equal(loaded.q_tree, tracked.q_tree)
            assert loaded.texts == tracked.texts
    assert refused > 0.5 * len(positions)


@pytest.mark.parametrize("content", [b"", b"not a run", b"PK\x03\x04", b"\x93NUMPY" + bytes(200), b"\x00" * 10000])
def test_other_file_types_are_rejected(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a run file, or damaged"):
        Run.load(path)


def test_too_large_array_is_rejected_before_allocation(saved: Path) -> None:
    """A header of a few bytes declares 8 TB."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(saved) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content["energy.npy"] = header.getvalue()
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match="an array of 8000000000000 bytes; a run has at most"):
        Run.load(saved)


def test_missing_run_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such run file"):
        Run.load(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"run\.npz: no such run file; ckc run SCENE --out DIR writes one$"):
        Run.load(tmp_path)
    (tmp_path / "mode_1.npz").touch()
    with pytest.raises(InputError, match=r"run\.npz: no such run file; .*; there is .*/mode_1\.npz$"):
        Run.load(tmp_path)
