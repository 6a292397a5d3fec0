"""Results of an identification: what the data determine, and how well the fit predicts them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.validation import require_path
from ckc_pin.errors import InputError
from ckc_pin.identification.estimates import (
    BY_PRIOR,
    IDENTIFIED,
    IN_COMBINATION,
    NOT_IDENTIFIABLE,
    PRIOR_ONLY,
    UNCHANGED,
    VERDICTS,
    Combination,
    Estimate,
)
from ckc_pin.identification.fit import LinearFit, Prior
from ckc_pin.identification.pseudo_inertia import pseudo_inertia
from ckc_pin.identification.structure import MotionAdvice
from ckc_pin.identification.unknowns import Unknowns
from ckc_pin.mechanism.mechanism import Mechanism

if TYPE_CHECKING:
    from ckc_pin.view.inline import Figures

__all__ = ["Identification", "Prediction", "Residual", "make_result"]

MAX_MISFIT = 0.1  # of a gradient that follows from the equations of the prior, which are linearized at other values


@dataclass(frozen=True)
class Residual:
    """Difference between a measured quantity and what the fit predicts.

    Attributes
    ----------
    rms : float
    expected : float
        From the noise that was given, or estimated from the fit.
    autocorrelation : float
        Of neighbouring instants, 0 for independent residuals.
    """

    rms: float
    expected: float
    autocorrelation: float


class Prediction(Immutable, frozen=True):
    """Measured and predicted quantities along one record.

    Attributes
    ----------
    source : str
    validation : bool
    quantities : tuple of str
        Such as ``tau.MOTOR``.
    t : (m,) array
        s.
    measured, predicted : (m, quantities) arrays
        NaN marks gaps.
    variances : mapping of str to float
        Expected ones of the residuals, by quantity.
    """

    source: str
    validation: bool
    quantities: tuple[str, ...]
    t: Array
    measured: Array
    predicted: Array
    variances: Mapping[str, float]


@dataclass(frozen=True, eq=False, repr=False)
class Identification(HasSummary):
    """Parameters of a mechanism that measurements determine.

    Attributes
    ----------
    mechanism : Mechanism
        With its start values.
    parameters : mapping of str to Estimate
    base : tuple of Combination
        Independent combinations, as many as the data determine.
    condition : float
        Of the regressor, or of the sensitivities, in typical sizes of the unknowns.
    residuals, validation : mapping of str to Residual
        By quantity, of the fitted and of the other records.
    physical : bool
        Whether the inertias are those of bodies that can exist.
    values : mapping of str to float
        A complete set of parameter values: measured ones, and for the rest those closest to the start values.
    covariance : (k, k) array
        Of the k parameters with a value, in their order.
    instants : int
    warnings : tuple of str
    motions : tuple of Prediction
        Measured and predicted quantities of each record.
    method : str
        "torques" or "motion".
    missing : tuple of str
        What would tell each combination that some motion determines, but these data do not.
    """

    mechanism: Mechanism
    parameters: Mapping[str, Estimate]
    base: tuple[Combination, ...]
    condition: float
    residuals: Mapping[str, Residual]
    validation: Mapping[str, Residual]
    physical: bool
    values: Mapping[str, float]
    covariance: Array
    instants: int
    warnings: tuple[str, ...]
    motions: tuple[Prediction, ...]
    method: str
    missing: tuple[str, ...]

    @property
    def identified(self) -> list[str]:
        """Names of the parameters with a value, which the data or a prior determine."""
        return [name for name, x in self.parameters.items() if x.value is not None]

    def plot(self) -> Figures:
        """Draw measured and predicted quantities, residuals, and the correlation of the parameters."""
        import ckc_pin

        return ckc_pin.plot(self)

    def save(self, path: str | Path) -> Path:
        """Write a complete set of parameter values as the table ``[parameters]`` of a scene (TOML).

        Raises
        ------
        InputError
            The file cannot be written, or the inertias were not required to be physical.
        """
        require_path(path, "Identification.save: path")
        if not self.values:
            raise InputError(
                "Identification.save: only physical parameters are a mechanism; identify with physical = true"
            )
        lines = [
            f"# Parameters of {self.mechanism.name} from {self.instants} instants of measured {self.method}.",
            "# A line without a standard deviation is no measurement: the value is the one closest to the start value.",
            "[parameters]",
        ]
        offsets = [name for name in self.values if name.endswith(".offset")]
        for name, value in self.values.items():
            if name not in offsets:
                estimate = self.parameters[name]
                std = "" if estimate.std is None else f"std {estimate.std:.3g}"
                notes = [std, "" if estimate.verdict == IDENTIFIED else estimate.verdict]
                note = f"  # {', '.join(filter(None, notes))}"
                lines.append(f'"{name}" = {value!r}{note}')
        lines += [
            f"# {name} = {self.values[name]!r}, of the measurement, no parameter of the mechanism" for name in offsets
        ]
        write_atomic(Path(path), "\n".join(lines) + "\n")
        return Path(path)

    def summary(self) -> Summary:
        """Return what was identified, with standard deviations, and the residuals."""
        rows: list[Row] = []
        for verdict in VERDICTS:
            group = {name: x for name, x in self.parameters.items() if x.verdict == verdict}
            for missing in dict.fromkeys(x.missing for x in group.values()):
                names = [_describe(name, x) for name, x in group.items() if x.missing == missing]
                rows.append((verdict, [*([f"{missing}:"] if missing else []), *names]))
        of = f" of {len(self.base) + len(self.missing)} that some motion determines" if self.missing else ""
        rows.append(("base", f"{len(self.base)} combinations{of}, condition number {self.condition:.3g}"))
        counts = Counter(text.replace(" it", " another", 1) for text in self.missing)
        rows += [("missing", f"{text}{f' ({count} times)' if count > 1 else ''}") for text, count in counts.items()]
        for label, residuals in (("residuals", self.residuals), ("validation", self.validation)):
            texts = [f"{name}: rms {x.rms:.3g}, expected {x.expected:.3g}" for name, x in residuals.items()]
            rows += [(label, texts)] if texts else []
        rows += [("warning", warning) for warning in self.warnings]
        return Summary(f"Identification of {self.mechanism.name} from {self.instants} instants", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON-ready data."""
        return {
            "name": self.mechanism.name,
            "method": self.method,
            "parameters": {
                name: {"value": x.value, "std": x.std, "start": x.start, "verdict": x.verdict, "missing": x.missing}
                for name, x in self.parameters.items()
            },
            "base": [x.to_dict() for x in self.base],
            "missing": list(self.missing),
            "condition": self.condition,
            "residuals": {name: {"rms": x.rms, "expected": x.expected} for name, x in self.residuals.items()},
            "validation": {name: {"rms": x.rms, "expected": x.expected} for name, x in self.validation.items()},
            "physical": self.physical,
            "values": dict(self.values),
            "instants": self.instants,
            "warnings": list(self.warnings),
        }


def make_result(
    method: str, unknowns: Unknowns, fit: LinearFit, values: Array, motions: Sequence[Prediction], *, leak: float,
    complete: bool, instants: int, warnings: Sequence[str], prior: Prior, advice: MotionAdvice | None,
) -> Identification:  # fmt: skip
    """Return the result of a fit.

    Parameters
    ----------
    values : (p,) array
        Of the unknowns, in SI units.
    leak : float
        Part of a parameter's gradient that may lie in directions which are not determined, up to rounding.
    complete : bool
        Whether the values are those of a mechanism that can exist.
    prior : Prior
    advice : MotionAdvice or None
        Says which motion would determine a parameter; None if the measurements are not linear in the parameters.
    """
    covariance = fit.covariance * np.outer(unknowns.scale, unknowns.scale)
    estimates: dict[str, Estimate] = {}
    slopes: list[Array] = []
    parameters = unknowns.parameters_at(values)
    for x in parameters:
        gradient = x.gradient * unknowns.scale
        if _split(gradient, fit.determined)[1] <= leak:
            std = max(float(x.gradient @ covariance @ x.gradient), 0.0) ** 0.5
            is_measured = _split(gradient, fit.by_data)[1] <= leak
            verdict = IDENTIFIED if is_measured else _name_prior(gradient, std, prior)
            estimates[x.name] = Estimate(x.value, std, x.start, verdict)
            slopes.append(x.gradient)
            continue
        is_combined = _split(gradient, fit.by_data)[0] > leak
        if advice is not None:
            missing = advice.explain(gradient, fit.by_data)
        else:
            missing = "other parameters have the same influence" if is_combined else "it has no influence here"
        verdict = IN_COMBINATION if is_combined else NOT_IDENTIFIABLE
        estimates[x.name] = Estimate(None, None, x.start, verdict, missing)
    gradients = np.reshape(slopes, (len(slopes), len(values)))
    is_physical = all(np.linalg.eigvalsh(pseudo_inertia(values[at]))[0] > 0 for at in unknowns.bodies)
    fitted, others = ([x for x in motions if x.validation == validation] for validation in (False, True))
    return Identification(
        unknowns.mechanism, estimates, _combinations(unknowns, fit, values, leak), fit.condition,
        _residuals(fitted), _residuals(others), is_physical, {x.name: x.value for x in parameters} if complete else {},
        gradients @ covariance @ gradients.T, instants, tuple(warnings), tuple(motions), method,
        tuple(advice.explain_rest(fit.by_data)) if advice else (),
    )  # fmt: skip


def _split(gradient: Array, basis: Array) -> tuple[float, float]:
    """Return the parts of a gradient inside and outside of a space with this orthonormal basis, from 0 to 1."""
    inside, size = basis @ (basis.T @ gradient), max(float(np.linalg.norm(gradient)), 1e-300)
    return float(np.linalg.norm(inside)) / size, float(np.linalg.norm(gradient - inside)) / size


def _name_prior(gradient: Array, std: float, prior: Prior) -> str:
    """Return the verdict on a parameter that is determined with the prior: whether the data add anything."""
    rows, _ = prior
    weights = np.linalg.lstsq(rows.T, gradient, rcond=None)[0]
    is_given = np.linalg.norm(rows.T @ weights - gradient) <= MAX_MISFIT * np.linalg.norm(gradient)
    return PRIOR_ONLY if is_given and std >= UNCHANGED * np.linalg.norm(weights) else BY_PRIOR


def _residuals(motions: Sequence[Prediction]) -> dict[str, Residual]:
    residuals = {}
    for name in dict.fromkeys(name for x in motions for name in x.quantities):
        power = neighbours = expected = 0.0
        count = 0
        for x in motions:
            if name in x.quantities:
                k = x.quantities.index(name)
                part = x.measured[:, k] - x.predicted[:, k]
                size = int(np.sum(np.isfinite(part)))
                power += float(np.nansum(part**2))
                neighbours += float(np.nansum(part[1:] * part[:-1]))
                count, expected = count + size, expected + size * x.variances[name]
        correlation = neighbours / power if power > 0 else 0.0
        residuals[name] = Residual((power / count) ** 0.5, (expected / count) ** 0.5, correlation)
    return residuals


def _combinations(unknowns: Unknowns, fit: LinearFit, values: Array, tolerance: float) -> tuple[Combination, ...]:
    chosen, coefficients = fit.combinations(tolerance)
    names, scale, combinations = unknowns.names, unknowns.scale, []
    for k, row in zip(chosen, coefficients, strict=True):
        factors = row / scale * scale[k]  # in SI units, 1 for the chosen unknown
        std = float(np.sqrt(row @ fit.covariance @ row)) * scale[k]
        terms = [int(k), *(int(i) for i in np.flatnonzero(factors) if i != k)]
        value = float(factors @ values)
        combinations.append(Combination({names[i]: float(factors[i]) for i in terms}, value, std))
    return tuple(combinations)


def _describe(name: str, estimate: Estimate) -> str:
    if estimate.value is None or estimate.std is None:
        return name
    return f"{name} = {estimate.value:.5g} ± {estimate.std:.2g}"
