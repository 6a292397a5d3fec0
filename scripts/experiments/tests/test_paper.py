"""The page: what is on it and in which order. The studies themselves are tested elsewhere."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from scripts.experiments.markdown import escaped, table
from scripts.experiments.paper import page as paper
from scripts.experiments.paper.claim import Claim

KEYS = [key for _, keys in paper.SECTIONS for key in keys]


def claim(key: str) -> Claim:
    return Claim(
        key=key,
        where="section II, eq. 3",
        says=f"What {key} says: |x| < y.",
        command="ckc list; ckc check five_bar",
        found="`a | b` is 3 < 4.",
        verdict="holds with a condition",
        figures=(f"{key}.png",),
        table=(("a", "|b|"), (("1", "2"),)),
    )


def test_every_claim_has_its_place_and_its_study() -> None:
    assert sorted(KEYS) == sorted(key for keys in paper.STUDIES.values() for key in keys)
    assert len(set(KEYS)) == len(KEYS)


@pytest.mark.parametrize("study", paper.STUDIES)
def test_studies_name_the_claims_that_are_listed(study: str) -> None:
    module = importlib.import_module(f"scripts.experiments.paper.{study}")
    text = Path(str(module.__file__)).read_text(encoding="utf-8")
    assert callable(module.claims)
    assert sorted(re.findall(r'\bkey="([^"]+)"', text)) == sorted(paper.STUDIES[study])


def test_page_has_every_claim_in_the_papers_order() -> None:
    text = paper.page([claim(key) for key in reversed(KEYS)])
    assert re.findall(r"^### (.+)$", text, re.MULTILINE) == KEYS
    assert re.findall(r"\(#([a-z0-9-]+)\)", text) == KEYS
    assert f"of {len(KEYS)}, 0 hold, {len(KEYS)} hold with a condition, 0 do not hold" in text
    assert "![cost: cost.png](paper/cost.png)" in text
    assert "\n```sh\nckc list\nckc check five_bar\n```\n" in text
    assert "| What cost says: \\|x\\| < y. |" in text


def test_a_study_with_other_claims_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(paper.STUDIES, "domain", ("implicit-function",))
    monkeypatch.setattr("scripts.experiments.paper.domain.claims", lambda figures: [claim("spf-domain")])
    with pytest.raises(RuntimeError, match="answers spf-domain; listed are implicit-function"):
        paper._answer("domain", tmp_path)


def test_one_entry_is_printed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert paper.main(["--only", "implicit-function", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "Verdict: holds" in out
    assert "spf-domain" not in out


def test_bad_arguments_are_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        paper.main(["--only", "nothing"])
    assert ended.value.code == 2
    said = capsys.readouterr().err.split("no such entry; there are ")[1]
    assert sorted(said.replace(",", " ").split()) == sorted(KEYS)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as ended:
        paper.main(["--out", str(tmp_path / "file")])
    assert ended.value.code == 2
    assert "cannot be written" in capsys.readouterr().err


def test_sentences_do_not_become_markup() -> None:
    assert escaped("a*b <x> `c*d` q_dot < 3") == "a\\*b \\<x> `c*d` q_dot < 3"
    assert table(("a|b",), [("`|c|`",)]) == ["| a\\|b |", "|---|", "| `\\|c\\|` |"]
