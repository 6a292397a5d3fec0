"""Evaluate the benchmark's tables: fastest run to each accuracy, recommended setting, growth of cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from scripts.experiments.benchmark.growth import FAMILIES, FORMULATIONS, exponent
from scripts.experiments.benchmark.left_out import MISSING, MODULES, TERMS
from scripts.experiments.benchmark.ours import PROGRAM

__all__ = ["KINDS", "NAMES", "TARGETS", "Analysis", "analyse", "compared", "eq_8", "families", "fastest"]

TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
KINDS = {"packaged": "the best packaged program", "by hand": "the best loop written by hand"}
NAMES = {"dae": "DAE", "reduced": "reduced model", "spf, w": "SPF eq. 17", "spf, z": "SPF eq. 8 as printed"}
EQUAL_TIME_RATIO = 1.1  # ratio of times below which two settings count as equally fast
UNREACHED = 10.0  # ratio to the fastest time that counts for an accuracy which a setting does not reach
QUANTILE = 0.9  # share of the runs whose error over rtol is reported


@dataclass(frozen=True)
class Analysis:
    """Data of the figures and the page.

    Attributes
    ----------
    rows : DataFrame
        One row per run, with `kind` ("own", "packaged", "by hand") and `accuracy` of the work's reference. Runs of
        ckc_pin also have `formulation`, `method`, `rtol`, and `family`, which joins formulation and method.
    works, checks, growth, left_out : DataFrame
        The other tables; `works` is indexed by work.
    """

    rows: pd.DataFrame
    works: pd.DataFrame
    checks: pd.DataFrame
    growth: pd.DataFrame
    left_out: pd.DataFrame

    @property
    def programs(self) -> list[str]:
        """Names of all other programs, in an order that fixes their colours in all figures."""
        return list(self.checks.program.unique())

    def best(self, work: str) -> pd.DataFrame:
        """Return each program's fastest run to each accuracy of a work, ckc_pin's first."""
        runs = fastest(self.rows[self.rows.work == work], ["program"])
        return runs.assign(other=runs.program != PROGRAM).sort_values(["target", "other"], ascending=[False, True])

    def against(self, kind: str) -> pd.DataFrame:
        """Return the time of the best program of a kind over ckc_pin's, by work and accuracy."""
        return compared(self.rows, kind)

    @property
    def families(self) -> pd.DataFrame:
        """Formulations with their methods, the recommended one first."""
        return families(self.rows)

    @property
    def over_rtol(self) -> pd.Series:
        """Median and 90 % quantile of the largest error over rtol, for the recommended family."""
        done = self.rows[(self.rows.family == self.families.index[0]) & (self.rows.status == "done")]
        return (done.error_max / done.rtol).quantile([0.5, QUANTILE], interpolation="higher")

    @property
    def eq_8(self) -> pd.DataFrame:
        """Time of eq. 8 as printed over that of the reduced model, by work and accuracy."""
        return eq_8(self.rows).reindex(self.works.index)

    @property
    def exponents(self) -> pd.DataFrame:
        """Exponents with which time and number of right-hand sides grow, by family and formulation."""
        grown = [
            {
                "along": family.says, "model": NAMES[formulation],
                "time": exponent(cases.rhs_s.dropna().to_dict()),
                "number": exponent(cases.rhs.dropna().to_dict(), whole=True),
            }
            for family in FAMILIES
            for formulation in FORMULATIONS
            for cases in [_of(self.growth, family=family.key, formulation=formulation).set_index("x")]
        ]  # fmt: skip
        return pd.DataFrame(grown)

    @property
    def modules(self) -> pd.DataFrame:
        """Cost of each module, and the scenes that load it."""
        costs = self.left_out[self.left_out.scene.isna()].set_index("what")
        runs = self.left_out[self.left_out.scene.notna() & self.left_out.what.isin(MODULES)]
        users = runs[runs.used == True].groupby("what").scene.agg(list)  # noqa: E712, an object column
        table = costs.reindex(list(MODULES))[["seconds", "bytes", "reason"]]
        table["purpose"] = [purpose for _, purpose in MODULES.values()]
        table["users"] = [list(users.get(name, [])) for name in MODULES]
        table["scenes"] = runs.scene.nunique()
        return table

    @property
    def terms(self) -> pd.DataFrame:
        """Relative time that each term would add to a right-hand side, by scene; NaN for terms in use."""
        rows = self.left_out[self.left_out.what.isin(TERMS)]
        share = rows.assign(share=rows.seconds / rows.rhs_s)
        return share.pivot(index="scene", columns="what", values="share").reindex(columns=list(TERMS))

    @property
    def missing(self) -> pd.DataFrame:
        """Scenes that cannot be loaded here."""
        return self.left_out[self.left_out.what == MISSING]


def analyse(
    report: pd.DataFrame, works: pd.DataFrame, checks: pd.DataFrame, growth: pd.DataFrame, left_out: pd.DataFrame
) -> Analysis:
    """Combine the tables."""
    packaged = checks.groupby("program").packaged.first()
    parts = report.setting.where(report.program == PROGRAM).str.extract(
        r"^(?P<family>(?P<formulation>.*), (?P<method>[^,]*)), rtol (?P<rtol>.*)$"
    )
    rows = report.join(parts.astype({"rtol": float})).merge(works[["work", "accuracy"]], on="work")
    kinds = {PROGRAM: "own", **packaged.map({True: "packaged", False: "by hand"})}
    return Analysis(rows.assign(kind=rows.program.map(kinds)), works.set_index("work"), checks, growth, left_out)


def fastest(rows: pd.DataFrame, by: Sequence[str], targets: Sequence[float] = TARGETS) -> pd.DataFrame:
    """Return the fastest run of each group whose error stays within an accuracy, for each that the reference tells.

    Parameters
    ----------
    rows : DataFrame
    by : sequence of str
        Columns that define the groups.
    targets : sequence of float
    """
    done = rows[(rows.status == "done") & rows.error_max.notna()].merge(pd.DataFrame({"target": targets}), how="cross")
    good = done[(done.error_max <= done.target) & (done.accuracy <= done.target)]
    return good.loc[good.groupby([*by, "target"], sort=False).wall_s.idxmin()]


def compared(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Compare the fastest program of a kind with ckc_pin, one row per work and accuracy, with the ratio of times.

    The ratio is NaN if no setting of ckc_pin reaches the accuracy.
    """
    ours, theirs = (
        fastest(rows[rows.kind == which], ["work"]).set_index(["work", "target"])[["program", "setting", "wall_s"]]
        for which in ("own", kind)
    )
    both = theirs.join(ours.add_suffix("_own"))
    return both.assign(ratio=both.wall_s / both.wall_s_own).reset_index()


def eq_8(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the time of eq. 8 as printed over that of the reduced model, by work (rows) and accuracy (columns)."""
    printed, reduced = (
        fastest(rows[rows.formulation == name], ["work"]).set_index(["work", "target"]).wall_s
        for name in ("spf, z", "reduced")
    )
    return (printed / reduced).unstack("target").reindex(columns=list(TARGETS))


def families(rows: pd.DataFrame) -> pd.DataFrame:
    """Rank formulations with their methods by time relative to the fastest setting, the recommended one first.

    An accuracy that is not reached counts as slow. Among families of equal score the reduced model is recommended: on
    the manifold eq. 17 is the same system, so that only noise decides between them.

    Returns
    -------
    DataFrame
        By family: number of accuracies `reached` out of `of`, `mean` and `worst` ratio, `score`.
    """
    ours = rows[rows.kind == "own"]
    best = fastest(ours, ["work"]).set_index(["work", "target"]).wall_s
    each = fastest(ours, ["family", "work"]).set_index(["work", "target"])
    logs = np.log(each.wall_s / best.reindex(each.index)).groupby(each.family.to_numpy(), sort=False)
    table = pd.DataFrame({"reached": logs.size(), "mean": np.exp(logs.mean()), "worst": np.exp(logs.max())})
    table["of"] = len(best)
    table["score"] = np.exp((logs.sum() + (len(best) - table.reached) * np.log(UNREACHED)) / len(best))
    equal = table.score <= EQUAL_TIME_RATIO * table.score.min()
    order = pd.DataFrame({"alike": ~equal, "other": ~(equal & table.index.str.startswith("reduced"))})
    return table.loc[order.assign(score=table.score).sort_values(["alike", "other", "score"]).index]


def _of(rows: pd.DataFrame, **values: str) -> pd.DataFrame:
    """Return the rows with the given values."""
    for column, value in values.items():
        rows = rows[rows[column] == value]
    return rows
