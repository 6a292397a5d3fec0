"""Standard deviations of start values, such as those of CAD, as equations of the unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ckc_pin.base.validation import is_number, match_names, require_table
from ckc_pin.errors import InputError
from ckc_pin.identification.fit import Prior
from ckc_pin.identification.unknowns import Unknowns

__all__ = ["make_prior"]


def make_prior(unknowns: Unknowns, prior: Mapping[str, float | str]) -> Prior:
    """Return the equations "parameter = start value" of parameters with a prior, divided by standard deviations.

    Centres of mass and inertias, which are not linear in the unknowns, are linearized at the start values.

    Parameters
    ----------
    prior : mapping of str to float or str
        Standard deviations by parameter, with wildcards: numbers in SI units, or parts of start values, ``"5 %"``.

    Raises
    ------
    InputError
        Names that are not estimated, or standard deviations that are not positive.
    """
    require_table(prior, "identify: prior", 'a table by parameter, as {"link.*.mass": "5 %"}')
    parameters = {x.name: x for x in unknowns.parameters_at(unknowns.start)}
    stds: dict[str, float] = {}
    for pattern, value in prior.items():
        for name in match_names(pattern, parameters, "identify: prior"):
            stds[name] = _read_std(name, value, parameters[name].start)
    rows = [parameters[name].gradient * unknowns.scale / std for name, std in stds.items()]
    return np.reshape(rows, (len(rows), len(unknowns.names))), np.zeros(len(rows))


def _read_std(name: str, value: Any, start: float) -> float:
    std, text = value, value.strip() if isinstance(value, str) else ""
    if text.endswith("%"):
        try:
            part = float(text.removesuffix("%")) / 100
        except ValueError:
            part = np.nan
        if start == 0 and part > 0:
            raise InputError(
                f"identify: prior: {name}: its start value is 0, of which {text} is nothing; give a number in SI units"
            )
        std = part * abs(start)
    if not is_number(std) or not 0 < std < np.inf:
        raise InputError(f'identify: prior: {name}: expected a number above zero or a part as "5 %", got {value!r:.40}')
    return float(std)
