"""Parameters from measured coordinates and motor torques."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from ckc_pin.base.validation import describe_value
from ckc_pin.errors import InputError
from ckc_pin.identification.motions import identify_motion
from ckc_pin.identification.records import Record, read_record
from ckc_pin.identification.result import Identification
from ckc_pin.identification.spec import IdentifySpec, read_identify
from ckc_pin.identification.torques import identify_torques
from ckc_pin.kinematics.loading import as_mechanism, load_beside
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["identify", "identify_file", "load_task"]

METHODS = ("torques", "motion")


def identify(
    mechanism: str | Path | Mechanism,
    data: Any,
    parameters: Sequence[str],
    *,
    noise: Mapping[str, float] | None = None,
    validation: Any = (),
    method: str = "torques",
    physical: bool = True,
    robust: bool = False,
    prior: Mapping[str, float | str] | None = None,
) -> Identification:
    """Estimate parameters from measured coordinates and motor torques.

    With ``method="torques"``, eq. 1 along the motions that the loops allow is linear in inertias, friction, damping,
    rotor inertias, stiffnesses and offsets. The other coordinates, rates and accelerations follow from the loops and
    from smooth functions fitted to what was measured.

    With ``method="motion"``, runs with the measured torques are fitted to what was measured. Any parameter that
    `sensitivities` takes can be estimated, and the start of each record is estimated too.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
    data : path, Run, mapping of arrays or DataFrame, or a list of these
        ``t``, at least d coordinates, and ``tau.MOTOR`` of all motors, in SI units. For ``method="motion"`` also
        ``v.COORDINATE`` and points, as ``tip.x``; without any torque the motors are unpowered.
    parameters : sequence of str
        With wildcards: ``["link.*.inertial", "joint.*.friction"]``.
    noise : mapping, optional
        Standard deviations by quantity; estimated for the others.
    validation : as `data`, optional
        Motions that are not fitted, which the fit is compared with.
    method : "torques" or "motion"
    physical : bool
        Whether inertias have to be those of a body that can exist. Runs need such inertias.
    robust : bool
        Whether instants with large residuals have less weight (Huber).
    prior : mapping, optional
        Standard deviations of start values by parameter, with wildcards, in SI units or as parts:
        ``{"link.*.mass": "5 %", "joint.hip.damping": 0.01}``.

    Raises
    ------
    InputError
        Missing quantities, fewer data than unknowns, parameters in which torques are not linear or that runs have no
        derivative with respect to, or measurements that the mechanism cannot follow.
    NumericalError
        The fit of runs does not converge.
    """
    if method not in METHODS:
        raise InputError(f'identify: method: expected "torques" or "motion", got {describe_value(method)}')
    mechanism = as_mechanism(mechanism, "identify")
    records = [
        replace(x, noise={**(noise or {}), **x.noise}, validation=for_validation)
        for group, for_validation in ((data, False), (validation, True))
        for x in (read_record(part, mechanism) for part in _as_list(group))
    ]
    return _identify(method, mechanism, records, parameters, physical=physical, robust=robust, prior=prior or {})


def identify_file(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Identification:
    """Run the identification that a file describes, with values replaced by dotted key (InputError)."""
    spec, _ = read_identify(path, overrides)
    mechanism, records = load_task(spec, Path(path).parent)
    estimate = spec.estimate
    return _identify(
        estimate.method, mechanism, records, estimate.parameters, physical=estimate.physical, robust=estimate.robust,
        prior=estimate.prior,
    )  # fmt: skip


def load_task(spec: IdentifySpec, folder: Path) -> tuple[Mechanism, list[Record]]:
    """Load the mechanism and the records that a file names (InputError)."""
    mechanism = load_beside(spec.mechanism, folder, spec.parameters)
    return mechanism, [read_record(entry.file, mechanism, entry, folder) for entry in spec.data]


def _as_list(data: Any) -> list[Any]:
    return list(data) if isinstance(data, list | tuple) else [data]


def _identify(
    method: str, mechanism: Mechanism, records: Sequence[Record], parameters: Sequence[str], *, physical: bool,
    robust: bool, prior: Mapping[str, float | str],
) -> Identification:  # fmt: skip
    if all(record.validation for record in records):
        raise InputError("identify: data: every record is for validation; at least one has to be fitted")
    if method == "torques":
        return identify_torques(mechanism, records, parameters, physical=physical, robust=robust, prior=prior)
    if not physical:
        raise InputError(
            'identify: physical: method = "motion" simulates runs, which need inertias that some body can '
            "have; remove physical = false"
        )
    return identify_motion(mechanism, records, parameters, robust=robust, prior=prior)
