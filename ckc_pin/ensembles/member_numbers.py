"""The numbers of the model by member, as the batch of native loops and compiled terms take them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.codegen.arguments import present
from ckc_pin.mechanism.parameter_map import ParameterMap

__all__ = ["MemberNumbers"]

BATCHED = {
    "gravity", "offset", "mass", "centre", "inertia", "point", "end", "length", "constant", "joint_stiffness",
    "joint_rest", "joint_damping", "stiffness", "rest_length", "damping",
}  # fmt: skip
DERIVED = {"moment", "origin_inertia"}  # follow from mass, centre and inertia


class MemberNumbers:
    """Numbers of a mechanism's model as functions of the parameters that an ensemble varies.

    Parameters
    ----------
    parameters : ParameterMap
    names : sequence of str
        Parameters that vary: single numbers.

    Attributes
    ----------
    is_batched : bool
        Whether a batch can take all of them; if not, each member's mechanism is built from changed files.
    which : dict of str to bool arrays
        Numbers that are not zero for some member: the arguments of compiled terms.
    """

    def __init__(self, parameters: ParameterMap, names: Sequence[str]) -> None:
        self._map, self.names = parameters, tuple(names)
        self.which = present(parameters.numbers)
        self.is_batched = True
        if not self.names:
            return
        trial = np.random.default_rng(0).uniform(0.5, 1.0, (1, len(self.names)))
        numbers, _ = parameters.evaluate(self.names, trial)
        self.is_batched = set(numbers) <= BATCHED | DERIVED and parameters.reproduces(self.names)
        if self.is_batched:
            for key in BATCHED & set(numbers):
                self.which[key] = self.which[key] | present({key: numbers[key][0]})[key]

    def evaluate(self, members: Array) -> tuple[dict[str, Array], BoolArray]:
        """Return the numbers that differ between members, and which members are physical.

        Parameters
        ----------
        members : (members, names) array
            Values of the parameters.

        Returns
        -------
        dict of str to (members, ...) array
        (members,) array of bool
        """
        numbers, is_physical = self._map.evaluate(self.names, members)
        return {key: x for key, x in numbers.items() if key in BATCHED}, is_physical

    def arguments(self, numbers: Mapping[str, Array], members: int) -> Array:
        """Return the arguments of compiled terms, (members, arguments), from the numbers that differ."""
        columns = []
        for key, base in self._map.numbers.items():
            part = numbers[key] if key in numbers else np.broadcast_to(base, (members, *base.shape))
            columns.append(part[:, self.which[key]])
        return np.ascontiguousarray(np.concatenate(columns, axis=1))
