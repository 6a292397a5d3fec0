"""Run the benchmark: measure what is not in the cache, write tables, draw figures and fill in the page."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Memory

from ckc_pin.analysis.precision.motion import motion_without_data
from ckc_pin.errors import CkcError, InputError
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from scripts.experiments.benchmark import analysis, growth, left_out, ours
from scripts.experiments.benchmark.compiled_terms import CompiledTermsCost, compiled_terms_cost
from scripts.experiments.benchmark.figure import draw, draw_growth, draw_main
from scripts.experiments.benchmark.growth import Growth
from scripts.experiments.benchmark.left_out import LeftOut
from scripts.experiments.benchmark.peers import Peer, peers
from scripts.experiments.benchmark.reference import Reference, reference
from scripts.experiments.benchmark.row import Row, compare_with_reference
from scripts.experiments.benchmark.stamp import machine, stamp, versions, work_stamp
from scripts.experiments.benchmark.work import WORKS, Budget, Work
from scripts.experiments.pages import GZIP, render

__all__ = ["BUDGET", "TABLES", "exact_of", "measure", "report", "rows_of", "save", "write"]

ROOT = Path(__file__).resolve().parents[3]
CACHE = ROOT / ".cache" / "benchmark"
BUDGET = Budget(ours=1.5, peer=2.0)
TABLES = ("report", "works", "checks", "growth", "left_out")

Tables = dict[str, pd.DataFrame]


def report(out: Path, *, quick: bool = False, from_tables: bool = False, added: Sequence[Peer] = ()) -> list[Path]:
    """Measure what is not in the cache, and write tables, figures and page; return the files.

    Parameters
    ----------
    out : Path
        Folder to write to.
    quick : bool
        Fewer motions, methods and tolerances.
    from_tables : bool
        Measure nothing and use the tables in the folder.
    added : sequence of Peer
        Programs beside those of `peers`.

    Raises
    ------
    InputError
        `from_tables`, and the folder has no tables.
    """
    out.mkdir(parents=True, exist_ok=True)
    if not from_tables:
        save(out, *measure(quick, Memory(CACHE, verbose=0), added))
    return write(out)


def save(out: Path, tables: Tables, about: dict[str, Any]) -> None:
    """Write the tables, and the data about all of them to about.json."""
    for name, table in tables.items():
        table.to_csv(out / f"{name}.csv.gz", index=False, float_format="%.6g", lineterminator="\n", compression=GZIP)
    (out / "about.json").write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def write(out: Path) -> list[Path]:
    """Write figures and page from the tables in a folder; return the files.

    Raises
    ------
    InputError
        The folder has no tables.
    """
    try:
        about = json.loads((out / "about.json").read_text(encoding="utf-8"))
        tables = {name: pd.read_csv(out / f"{name}.csv.gz", keep_default_na=True) for name in TABLES}
    except FileNotFoundError as error:
        raise InputError(f"{error.filename}: not found; run the benchmark without --page to write it") from None
    results = analysis.analyse(**tables)
    figures = [
        draw_main(results, out),
        draw_growth(results, out),
        *(draw(results, work, out) for work in results.works.index),
    ]
    text = render("report", analysis=results, about=about, kinds=analysis.KINDS, targets=analysis.TARGETS)
    (out / "report.md").write_text(text, encoding="utf-8")
    return [out / name for name in ("report.md", *(f"{name}.csv.gz" for name in TABLES), *figures)]


def measure(quick: bool, memory: Memory, added: Sequence[Peer] = ()) -> tuple[Tables, dict[str, Any]]:
    """Measure everything that is not in the cache; return the tables and the data about all of them."""
    works, unmade = _available_works(quick)
    others = [*peers(), *added]
    rows = [row for work in works for row in rows_of(work, quick, memory, others)]
    checks = [
        {"program": peer.name, "version": "" if missing else peer.version(), "packaged": peer.packaged,
         "work": work.key, "said": f"not compared, {missing}" if missing else peer.check(work)}
        for peer in others for work in works for missing in [peer.missing(work)]
    ]  # fmt: skip
    references = [(work, exact_of(work, memory)()) for work in works]
    described = [
        {"work": work.key, "says": work.says, "epsilon": work.epsilon, "controlled": work.controlled,
         "accuracy": exact.accuracy, "how": exact.how, **asdict(_compiled_terms_cost(work, memory))}
        for work, exact in references
    ]  # fmt: skip
    tables: dict[str, Iterable[Any]] = {
        "report": map(asdict, rows),
        "works": described,
        "checks": checks,
        "growth": map(asdict, _measure_growth(quick, memory)),
        "left_out": map(asdict, _left_out(works, quick, memory)),
    }
    about = {"machine": machine(), "versions": versions(), "budget": asdict(BUDGET), "quick": quick, "unmade": unmade}
    return {name: pd.DataFrame(table) for name, table in tables.items()}, about


def _available_works(quick: bool) -> tuple[list[Work], dict[str, str]]:
    """Return the works that can be measured here, and for the others the reason by their name (missing robots)."""
    works, unmade = [], {}
    for work in WORKS:
        if quick and not work.quick:
            continue
        try:
            _ = work.mechanism  # loads the mechanism, which the work caches
        except CkcError as error:
            unmade[work.says] = str(error)
        else:
            works.append(work)
    return works, unmade


def rows_of(work: Work, quick: bool, memory: Memory, others: Sequence[Peer], budget: Budget = BUDGET) -> Iterator[Row]:
    """Measure a work with ckc_pin, then with the other programs.

    A setting that exceeded its budget at one tolerance or step is not tried with a smaller one.
    """
    run = memory.cache(_run, ignore=["work", "peer", "exact"])
    key, exact = work_stamp(work), exact_of(work, memory)
    spent: dict[tuple[str, str], str] = {}
    for setting in ours.settings(quick):
        name = ours.name_of(setting)
        if setting.family in spent:
            yield compare_with_reference(
                work, ours.PROGRAM, name, motion_without_data("refused", spent[setting.family]), exact()
            )
            continue
        row = run(key, ours.PROGRAM, name, budget.ours, work, None, exact)
        if ours.used_up(row):
            spent[setting.family] = f"not tried: at rtol {setting.rtol:.0e} the {row.reason}"
        yield row
    for peer in others:
        if peer.missing(work) is not None:
            continue
        key, too_slow = work_stamp(work, peer.version()), dict[str, str]()
        for setting_name in peer.settings(work, quick):
            family = setting_name.rpartition(", ")[0]
            if family in too_slow:
                motion = motion_without_data("refused", too_slow[family])
                yield compare_with_reference(work, peer.name, setting_name, motion, exact())
                continue
            row = run(key, peer.name, setting_name, budget.peer, work, peer, exact)
            if row.status == "refused":
                too_slow[family] = f"not tried: {setting_name} {row.reason}"
            yield row


def exact_of(work: Work, memory: Memory) -> Callable[[], Reference]:
    """Return a function that computes a work's reference or takes it from the cache."""
    return partial(memory.cache(_reference, ignore=["work"]), work_stamp(work), work)


def _run(
    key: str, program: str, setting: str, budget: float, work: Work, peer: Peer | None, exact: Callable[[], Reference]
) -> Row:
    """Run one work by one program and setting, and compare it with the reference; `key` is the key of the cache."""
    _log(f"{work.key}: {program}, {setting}")
    if peer is None:
        motion = ours.compute(work, ours.setting_of(setting), budget)
    else:
        motion = peer.compute(work, setting, budget)
    return compare_with_reference(work, program, setting, motion, exact())


def _reference(key: str, work: Work) -> Reference:
    _log(f"{work.key}: reference")
    return reference(work)


def _compiled_terms_cost(work: Work, memory: Memory) -> CompiledTermsCost:
    cost: CompiledTermsCost = memory.cache(_measure_compiled_terms, ignore=["work"])(work_stamp(work), work)
    return cost


def _measure_compiled_terms(key: str, work: Work) -> CompiledTermsCost:
    _log(f"{work.key}: compiled terms")
    return compiled_terms_cost(work, BUDGET.ours)


def _measure_growth(quick: bool, memory: Memory) -> list[Growth]:
    run = memory.cache(_grow)
    return [
        run(stamp(), family.key, case.N, case.loops, formulation)
        for family, case, formulation in growth.every_case(quick)
    ]


def _grow(key: str, family: str, N: int, loops: int, formulation: str) -> Growth:
    _log(f"growth: {family}, N = {N}, {loops} loops, {formulation}")
    return growth.measure(growth.Case(N, loops), next(f for f in growth.FAMILIES if f.key == family), formulation)


def _left_out(works: list[Work], quick: bool, memory: Memory) -> list[LeftOut]:
    """Measure what scenes leave out, and the cost of each module."""
    scenes = list(dict.fromkeys(work.load().name for work in works)) if quick else left_out.every_scene()
    rows: list[LeftOut] = memory.cache(_costs)(stamp(), 1 if quick else left_out.REPEATS)
    of_scene: Callable[[str, str], list[LeftOut]] = memory.cache(_of_scene)
    for name in scenes:
        try:
            scene = load_scene(name)
            content = [scene.to_dict(), {**load_scene_mechanism(scene).sources.texts, **scene.sources.texts}]
        except CkcError as error:  # robots that are not installed
            rows.append(LeftOut(scene=name, what=left_out.MISSING, reason=str(error)))
        else:
            rows += of_scene(stamp(*content), name)
    return rows


def _costs(key: str, repeats: int) -> list[LeftOut]:
    _log("left out: modules")
    return list(left_out.module_costs(repeats))


def _of_scene(key: str, scene: str) -> list[LeftOut]:
    _log(f"left out: {scene}")
    return [*left_out.modules_of(scene), *left_out.terms_of(scene)]


def _log(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
