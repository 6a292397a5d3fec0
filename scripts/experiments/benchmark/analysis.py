"""What the tables say: the fastest way to each accuracy, who has it, which setting to take, how cost grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from scripts.experiments.benchmark.growth import FAMILIES, FORMULATIONS, exponent
from scripts.experiments.benchmark.left_out import MISSING, MODULES, TERMS
from scripts.experiments.benchmark.ours import PROGRAM

__all__ = ["KINDS", "NAMES", "TARGETS", "Found", "analysed", "compared", "eq_8", "families", "fastest"]

TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
KINDS = {"packaged": "the best packaged program", "by hand": "the loop written by hand"}
NAMES = {"dae": "DAE", "reduced": "reduced model", "spf, w": "SPF eq. 17", "spf, z": "SPF eq. 8 as printed"}
ALIKE = 1.1  # ratio of times that are no difference
UNREACHED = 10.0  # times the fastest one: what an accuracy that a setting does not get to counts as
MOST = 0.9  # of the runs: what a tolerance is to be good for


@dataclass(frozen=True)
class Found:
    """All that figures and page are made from.

    Attributes
    ----------
    rows : DataFrame
        A row a run, with `kind` ("own", "packaged", "by hand"), `accuracy` of the work's reference, and of own runs
        `formulation`, `method`, `rtol` and `family`, the first two of these.
    works, checks, growth, left_out : DataFrame
        `works` by work.
    """

    rows: pd.DataFrame
    works: pd.DataFrame
    checks: pd.DataFrame
    growth: pd.DataFrame
    left_out: pd.DataFrame

    @property
    def programs(self) -> list[str]:
        """All other programs, so that each has one look on all figures."""
        return list(self.checks.program.unique())

    def best(self, work: str) -> pd.DataFrame:
        """Each program's fastest row to each accuracy of a work, this program's first."""
        found = fastest(self.rows[self.rows.work == work], ["program"], untold=True)
        return found.assign(other=found.program != PROGRAM).sort_values(["target", "other"], ascending=[False, True])

    def against(self, kind: str) -> pd.DataFrame:
        """How many times as long the best program of a kind takes, by work and accuracy."""
        return compared(self.rows, kind)

    @property
    def families(self) -> pd.DataFrame:
        """Formulations with their methods, the one to take first."""
        return families(self.rows)

    @property
    def over_rtol(self) -> pd.Series:
        """Largest error over rtol of the runs of the family to take: of half of them, and of nine in ten."""
        done = self.rows[(self.rows.family == self.families.index[0]) & (self.rows.status == "done")]
        return (done.error_max / done.rtol).quantile([0.5, MOST], interpolation="higher")

    @property
    def eq_8(self) -> pd.DataFrame:
        """Time of eq. 8 as printed over that of the reduced model, by work and accuracy."""
        return eq_8(self.rows).reindex(self.works.index)

    @property
    def exponents(self) -> pd.DataFrame:
        """With which powers a right-hand side's time and their number grow, by family and formulation."""
        grown = [
            {
                "along": family.says, "model": NAMES[formulation],
                "time": exponent(own.rhs_s.dropna().to_dict()),
                "number": exponent(own.rhs.dropna().to_dict(), whole=True),
            }
            for family in FAMILIES
            for formulation in FORMULATIONS
            for own in [_of(self.growth, family=family.key, formulation=formulation).set_index("x")]
        ]  # fmt: skip
        return pd.DataFrame(grown)

    @property
    def modules(self) -> pd.DataFrame:
        """What each module costs, and which scenes load it."""
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
        """By scene and term, how much longer a right-hand side would be with it; NaN where it is used."""
        rows = self.left_out[self.left_out.what.isin(TERMS)]
        share = rows.assign(share=rows.seconds / rows.rhs_s)
        return share.pivot(index="scene", columns="what", values="share").reindex(columns=list(TERMS))

    @property
    def missing(self) -> pd.DataFrame:
        """Scenes that cannot be loaded here."""
        return self.left_out[self.left_out.what == MISSING]


def analysed(
    report: pd.DataFrame, works: pd.DataFrame, checks: pd.DataFrame, growth: pd.DataFrame, left_out: pd.DataFrame
) -> Found:
    """Put the tables together."""
    packaged = checks.groupby("program").packaged.first()
    parts = report.setting.where(report.program == PROGRAM).str.extract(
        r"^(?P<family>(?P<formulation>.*), (?P<method>[^,]*)), rtol (?P<rtol>.*)$"
    )
    rows = report.join(parts.astype({"rtol": float})).merge(works[["work", "accuracy"]], on="work")
    kinds = {PROGRAM: "own", **packaged.map({True: "packaged", False: "by hand"})}
    return Found(rows.assign(kind=rows.program.map(kinds)), works.set_index("work"), checks, growth, left_out)


def fastest(
    rows: pd.DataFrame, by: Sequence[str], targets: Sequence[float] = TARGETS, *, untold: bool = False
) -> pd.DataFrame:
    """Return of each group and accuracy the run of least time whose error stays within it all along.

    Parameters
    ----------
    rows : DataFrame
    by : sequence of str
        Columns that make the groups.
    targets : sequence of float
    untold : bool
        Accuracies below the reference's too.
    """
    done = rows[(rows.status == "done") & rows.error_max.notna()].merge(pd.DataFrame({"target": targets}), how="cross")
    good = done[(done.error_max <= done.target) & (untold | (done.accuracy <= done.target))]
    return good.loc[good.groupby([*by, "target"], sort=False).wall_s.idxmin()]


def compared(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Return a row a work and accuracy that programs of a kind get to: theirs, ours, and the ratio of times.

    The ratio is NaN where no setting here gets there.
    """
    ours, theirs = (
        fastest(rows[rows.kind == which], ["work"]).set_index(["work", "target"])[["program", "setting", "wall_s"]]
        for which in ("own", kind)
    )
    both = theirs.join(ours.add_suffix("_own"))
    return both.assign(ratio=both.wall_s / both.wall_s_own).reset_index()


def eq_8(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the time of eq. 8 as printed over that of the reduced model, a row a work, a column an accuracy."""
    printed, reduced = (
        fastest(rows[rows.formulation == name], ["work"]).set_index(["work", "target"]).wall_s
        for name in ("spf, z", "reduced")
    )
    return (printed / reduced).unstack("target").reindex(columns=list(TARGETS))


def families(rows: pd.DataFrame) -> pd.DataFrame:
    """Return how fast each formulation with each method is, relative to the fastest setting, the one to take first.

    Of those alike in the mean, what is not got to counted as slow, the reduced model is taken: on the manifold eq. 17
    is the same, and chance decides between them.

    Returns
    -------
    DataFrame
        By family: `reached` accuracies `of` those that any setting gets to, `mean` and `worst` ratio, `score`.
    """
    own = rows[rows.kind == "own"]
    best = fastest(own, ["work"]).set_index(["work", "target"]).wall_s
    each = fastest(own, ["family", "work"]).set_index(["work", "target"])
    logs = np.log(each.wall_s / best.reindex(each.index)).groupby(each.family.to_numpy(), sort=False)
    table = pd.DataFrame({"reached": logs.size(), "mean": np.exp(logs.mean()), "worst": np.exp(logs.max())})
    table["of"] = len(best)
    table["score"] = np.exp((logs.sum() + (len(best) - table.reached) * np.log(UNREACHED)) / len(best))
    alike = table.score <= ALIKE * table.score.min()
    order = pd.DataFrame({"alike": ~alike, "other": ~(alike & table.index.str.startswith("reduced"))})
    return table.loc[order.assign(score=table.score).sort_values(["alike", "other", "score"]).index]


def _of(rows: pd.DataFrame, **values: str) -> pd.DataFrame:
    """Return the rows that have these values."""
    for column, value in values.items():
        rows = rows[rows[column] == value]
    return rows
