"""The singularity map of one or two freedoms as an image, computed in a thread: coarse first, then with its curves."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable

import numpy as np

from ckc_pin.analysis.map.compute import singularity_map
from ckc_pin.errors import CkcError
from ckc_pin.explorer.background import NewestTask
from ckc_pin.explorer.messages import MapImage
from ckc_pin.kinematics.mapped import LABELS, SingularityMap
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view.map_figures import draw_bare_map

__all__ = ["MapPanel", "explain_no_map", "select_aspect"]

PASSES = ((40, False), (200, True))  # cells along an axis, and whether singular curves are searched for
IMAGE_PX, STRIP_PX = 480, 48  # width and height; height of the map of one freedom
LINES = {"locked": "orange dot or line", "fold": "black line", "rank loss": "pink line", "serial": "dashed green line"}


class _Outdated(Exception):
    """A newer map is wanted."""


def explain_no_map(mechanism: Mechanism) -> str:
    """Return why a mechanism has no map, or an empty text."""
    if not mechanism.dependent:
        return "without loops the mechanism is never singular"
    if mechanism.independent_root_coordinates or mechanism.splits_root:
        return "coordinates of a free root cannot be drawn over an axis"
    if not 1 <= mechanism.d <= 2:
        return f"a map shows one or two freedoms, and the mechanism has {mechanism.d}"
    return ""


class MapPanel:
    """The map of the present mechanism, with an image for each of its branches.

    Parameters
    ----------
    on_ready : callable
        Gets each new image, in the panel's thread or in that of the caller of `request` and `follow`.
    """

    def __init__(self, on_ready: Callable[[MapImage], None]) -> None:
        self.on_ready = on_ready
        self._task: NewestTask[Mechanism] | None = None
        self._map: SingularityMap | None = None
        self._images: tuple[MapImage, ...] = ()
        self._aspect = 0

    def request(self, mechanism: Mechanism, at: Kinematics) -> None:
        """Compute the map of a mechanism, beginning at a closed configuration. A map that is under way is given up."""
        self._map, self._images = None, ()
        if reason := explain_no_map(mechanism):
            self.close()
            self.on_ready(MapImage(note=reason))
            return
        copy = mechanism.copy(mechanism.sources)
        copy.q_tree = np.array(at.q_tree)  # branches are searched from the assembled configuration
        self._task = self._task or NewestTask(self._compute, "ckc_pin map")
        self._task.request(copy)

    def follow(self, at: Kinematics) -> None:
        """Show the branch of a configuration of the map's mechanism, if another one is shown."""
        finished, images = self._map, self._images
        if finished is None:
            return
        aspect = select_aspect(finished, at)
        if aspect is not None and aspect != self._aspect:
            self._aspect = aspect
            self.on_ready(images[aspect])

    def close(self) -> None:
        """Give up the computation and end the thread."""
        if self._task is not None:
            self._task.close()
        self._task = None

    def _compute(self, mechanism: Mechanism, is_outdated: Callable[[], bool]) -> None:
        """Compute the map in steps, in the thread."""

        def stop_if_outdated(_: float = 0.0) -> None:
            if is_outdated():
                raise _Outdated

        try:
            for cells, loci in PASSES:
                result = singularity_map(mechanism, cells=cells, loci=loci, progress=stop_if_outdated)
                images = tuple(_create_image(result, k, is_final=loci) for k in range(len(result.aspects)))
                stop_if_outdated()
                self._map, self._images, self._aspect = result, images, 0
                self.on_ready(images[0])
        except _Outdated:
            return
        except CkcError as error:
            self.on_ready(MapImage(note=str(error)))


def select_aspect(result: SingularityMap, at: Kinematics) -> int | None:
    """Return the aspect of a joint-space map whose configurations are nearest to one; None outside all of them."""
    numbers = at.tree.to_coordinates(at.q_tree)
    cell = []
    for axis in result.axes:
        value, count = numbers[at.tree.index[axis.name]], len(axis.values)
        place = int(np.floor((value - axis.low) / (axis.high - axis.low) * count))
        cell.append(place % count if axis.turns else min(max(place, 0), count - 1))
    i, j = (*cell, 0)[:2]
    gaps = [aspect.coordinates[i, j] - numbers for aspect in result.aspects]
    angles = ~at.tree.in_metres
    sizes = []
    for gap in gaps:
        gap[angles] = np.remainder(gap[angles] + np.pi, 2 * np.pi) - np.pi
        sizes.append(float(np.linalg.norm(gap / at.tree.step_scale)))
    return None if np.all(np.isnan(sizes)) else int(np.nanargmin(sizes))


def _create_image(result: SingularityMap, aspect: int, *, is_final: bool) -> MapImage:
    first, *others = result.axes
    png = draw_bare_map(result, aspect, IMAGE_PX, IMAGE_PX if others else STRIP_PX)
    notes = ["dark: far from singular, pale: near, hatched: not reached on this branch"]
    kinds = dict.fromkeys(locus.kind for locus in result.loci if locus.on[aspect].any())
    notes += [f"{LINES[kind]}: {LABELS[kind]}" for kind in kinds]
    notes += [] if is_final else ["a finer map is being computed"]
    second = others[0] if others else None
    return MapImage(
        x=first.name,
        y="" if second is None else second.name,
        x_range=[first.low, first.high],
        y_range=[] if second is None else [second.low, second.high],
        x_turns=first.turns,
        y_turns=second is not None and second.turns,
        image=b64encode(png).decode(),
        note="; ".join(notes),
    )
