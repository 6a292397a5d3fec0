"""Pages on the paper: keys, verdicts, commands. Other modules test the studies themselves."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from jinja2 import meta

from scripts.experiments.pages import environment
from scripts.experiments.paper import page
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.contents import KEYS, SECTIONS, STUDIES
from scripts.experiments.paper.errata import ERRATA

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
VERDICT = r"\[(holds|holds with a condition|does not hold)\]\(#([a-z0-9-]+)\) \|$"


def claim(key: str) -> Claim:
    return Claim(
        key=key,
        where="section II, eq. 3",
        says=f"What {key} says: |x| < y.",
        measured="`a | b` is 3 < 4.",
        verdict="holds with a condition",
        commands=("ckc list",),
        figures=(f"{key}.png",),
        table=(("a", "|b|"), (("1", "2"),)),
    )


def test_each_claim_has_one_section_and_one_study() -> None:
    assert sorted(KEYS) == sorted(key for keys in STUDIES.values() for key in keys)
    assert len(set(KEYS)) == len(KEYS) == sum(map(len, SECTIONS.values()))
    assert all(callable(importlib.import_module(f"scripts.experiments.paper.{study}").claims) for study in STUDIES)


def test_page_lists_claims_in_order_of_paper() -> None:
    text = page.page(page.as_frame(claim(key) for key in KEYS))
    assert re.findall(r"^### (.+)$", text, re.MULTILINE) == list(KEYS)
    assert re.findall(VERDICT, text, re.MULTILINE) == [("holds with a condition", key) for key in KEYS]
    assert re.findall(r"^!\[.*\]\((.*)\)$", text, re.MULTILINE) == [f"paper/{key}.png" for key in KEYS]
    assert len(re.findall(r"^\| a \| \\\|b\\\| \|$", text, re.MULTILINE)) == len(KEYS)


def test_committed_page_matches_committed_verdicts() -> None:
    """Of 26 statements 10 hold, 12 hold with a condition and 4 do not. A changed verdict needs an explanation."""
    claims = pd.read_csv(DOCS / "paper" / "claims.csv")
    assert claims.key.tolist() == list(KEYS)
    counts = claims.verdict.value_counts().to_dict()
    assert counts == {"holds": 10, "holds with a condition": 12, "does not hold": 4}
    verdicts = re.findall(VERDICT, (DOCS / "paper.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert verdicts == list(claims[["verdict", "key"]].itertuples(index=False, name=None))


def test_template_variables_match_values_of_studies() -> None:
    """Most studies take minutes, so that a missing value or variable would otherwise show late."""
    jinja, named = environment(), set()
    for module in (ROOT / "scripts" / "experiments" / "paper").glob("*.py"):
        for call in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if not isinstance(call, ast.Call) or getattr(call.func, "id", "") != "render_blocks":
                continue
            name = ast.literal_eval(call.args[0])
            template = jinja.parse(jinja.loader.get_source(jinja, f"{name}.md.j2")[0])
            assert meta.find_undeclared_variables(template) == {keyword.arg for keyword in call.keywords}, name
            named.add(name)
    assert named >= {*(f"claims/{key}" for key in KEYS), *(f"errata/{key}" for key in ERRATA)}


def test_quick_studies_reproduce_committed_verdicts(tmp_path: Path) -> None:
    keys = [*STUDIES["domain"], *STUDIES["singular_claims"]]
    committed = pd.read_csv(DOCS / "paper" / "claims.csv").set_index("key").verdict
    claims = page.as_frame(page.collect(keys, tmp_path)).set_index("key")
    assert claims.verdict.to_dict() == committed[claims.index].to_dict()
    assert set(claims.index) == set(keys)
    assert all((tmp_path / name).stat().st_size > 1000 for name in claims.figures.explode().dropna())


@pytest.mark.parametrize("name", ["paper.md", "errata.md"])
def test_commands_on_pages_exist(name: str) -> None:
    blocks = re.findall(r"^```sh\n(.*?)^```$", (DOCS / name).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = {line for block in blocks for line in block.splitlines()}
    keys = {"paper": set(KEYS), "errata": set(ERRATA)}
    page_name = name.removesuffix(".md")
    render_blocks = {tuple(line.split()[1:]) for line in lines if line.startswith("./scripts/experiment ")}
    assert all(key in keys[experiment] for experiment, key in render_blocks)
    assert {key for experiment, key in render_blocks if experiment == page_name} == keys[page_name]
    for line in lines - {f"./scripts/experiment {' '.join(words)}" for words in render_blocks}:
        assert line == "./scripts/demo" or line.startswith("ckc ")


@pytest.mark.parametrize("line", [["paper", "nothing"], ["errata", "nothing"], ["stability", "nothing"]])
def test_unknown_key_lists_valid_keys(line: list[str]) -> None:
    command = [sys.executable, "-m", "scripts.experiments", *line]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    keys = {"paper": KEYS, "errata": ERRATA, "stability": ("gain", "long")}[line[0]]
    assert (result.returncode, result.stdout) == (2, "")
    assert all(key in result.stderr for key in keys)
