"""Pack the report's data for an archive: tables, versions of all programs, the protocol, IFToMM's files, checksums."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from ckc_pin.errors import InputError
from scripts.experiments.benchmark.iftomm import write_solutions
from scripts.experiments.benchmark.make import TABLES

__all__ = ["pack"]

DATE = (1980, 1, 1, 0, 0, 0)  # of all entries, so that equal data give an equal file
README = """\
Error against run time of multibody programs on mechanisms with loops: data of ckc_pin's benchmark.

report.csv.gz    every run: error in m or rad, time in s, settings, and the reasons of runs without a result
works.csv.gz     the motions, and how their references were computed
checks.csv.gz    agreement of each program's model with ckc_pin's
growth.csv.gz, left_out.csv.gz    cost by size of the mechanism, and what a scene leaves out
about.json       machine, budgets, and the versions of all programs
report.md, peers.md    the page, and the protocol by which a program takes part
iftomm/          problems A01 to A05 in the result format of IFToMM's library
SHA256SUMS       checksums; `sha256sum -c SHA256SUMS` compares them
"""


def pack(report: Path, out: Path) -> Path:
    """Write the archive of a report's folder, and return its path.

    Raises
    ------
    InputError
        The folder has no tables.
    """
    names = [*(f"{name}.csv.gz" for name in TABLES), "report.md"]
    try:
        files = {name: (report / name).read_bytes() for name in names}
        about = json.loads((report / "about.json").read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{error.filename}: not found; run the benchmark without --archive to write it") from None
    checks = pd.read_csv(report / "checks.csv.gz").dropna(subset=["version"])
    about["programs"] = checks.groupby("program").version.first().to_dict()
    files["about.json"] = (json.dumps(about, indent=1, ensure_ascii=False) + "\n").encode()
    files["peers.md"] = (Path(__file__).resolve().parents[3] / "docs" / "report" / "peers.md").read_bytes()
    files["README.txt"] = README.encode()
    with TemporaryDirectory() as folder:
        files |= {f"iftomm/{path.name}": path.read_bytes() for path in write_solutions(Path(folder))}
    sums = [f"{hashlib.sha256(content).hexdigest()}  {name}" for name, content in sorted(files.items())]
    files["SHA256SUMS"] = "\n".join([*sums, ""]).encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, DATE), content, zipfile.ZIP_DEFLATED)
    return out
