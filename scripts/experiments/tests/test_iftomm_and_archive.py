"""Result files of IFToMM's problems, and the archive of the report's data."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ckc_pin.errors import InputError
from scripts.experiments.benchmark import archive
from scripts.experiments.benchmark.iftomm import PROBLEMS, write_solutions

DOCS = Path(__file__).parents[3] / "docs" / "report"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("iftomm")
    write_solutions(folder)
    return folder


@pytest.mark.parametrize(
    ("key", "lines", "t", "values", "tolerance"),
    [
        # 2.2 ms after the pendulum's period, 4 K(1/2) / sqrt(g), the point mass has fallen g t^2 / 2 again.
        ("A01", 1001, 2.37, [-1.0, -9.81 / 2 * (2.37 - 2.36784194757624) ** 2], 2e-9),
        ("A02", 1001, 0.0, [0.0, 1.0], 1e-12),
        # The published angle of the crank at 0.03 s.
        ("A03", 201, 0.03, [0.007 * np.cos(15.81077119515370), 0.007 * np.sin(15.81077119515370)], 1e-11),
        ("A04", 1001, 1.0, [0.27448132, -0.88670794, -0.46233000], 1e-8),
        ("A05", 101, 10.0, [0.61962292], 1e-8),
    ],
)
def test_result_file_has_the_format_and_published_values(
    key: str, lines: int, t: float, values: list[float], tolerance: float, folder: Path
) -> None:
    text = (folder / f"{key}_results.txt").read_text(encoding="ascii")
    header, *rows = text.splitlines()
    assert header.split()[0] == "Time"
    assert {len(row) for row in (header, *rows)} == {23 * (1 + len(values))}
    data = np.loadtxt(rows)
    assert data.shape == (lines, 1 + len(values))
    assert np.ptp(np.diff(data[:, 0])) < 1e-12
    row = data[np.argmin(np.abs(data[:, 0] - t))]
    assert abs(row[0] - t) < 1e-12
    assert np.abs(row[1:] - values).max() < tolerance


def test_solutions_state_accuracy_and_time(folder: Path) -> None:
    header, *rows = (folder / "solutions.csv").read_text(encoding="utf-8").splitlines()
    assert "largest error" in header
    assert [row.split(",")[0] for row in rows] == [problem.key for problem in PROBLEMS]


def test_archive_has_versions_and_checksums(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "write_solutions", lambda folder: write_solutions(folder, PROBLEMS[:1]))
    first, second = (archive.pack(DOCS, tmp_path / name).read_bytes() for name in ("a.zip", "b.zip"))
    with zipfile.ZipFile(tmp_path / "a.zip") as packed:
        sums = dict(line.split("  ")[::-1] for line in packed.read("SHA256SUMS").decode().splitlines())
        assert {*sums, "SHA256SUMS"} == set(packed.namelist())
        for name, digest in sums.items():
            assert hashlib.sha256(packed.read(name)).hexdigest() == digest
        about = json.loads(packed.read("about.json"))
    assert {"iftomm/A01_results.txt", "peers.md", "report.csv.gz"} <= sums.keys()
    assert about["programs"]["Pinocchio constraintDynamics"] == about["versions"]["pin"]
    assert len(first) > 0.9 * len(second)


def test_archive_without_tables_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="run the benchmark without --archive"):
        archive.pack(tmp_path, tmp_path / "a.zip")
