"""Figures and playback as values that a notebook displays; they can also be saved."""

from __future__ import annotations

import sys
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ckc_pin.errors import InputError
from ckc_pin.identification.excitation import Excitation
from ckc_pin.identification.result import Identification
from ckc_pin.kinematics.mapped import SingularityMap
from ckc_pin.linear.linear_model import LinearModel
from ckc_pin.linear.locus import GainLocus
from ckc_pin.optimization.plan import Plan
from ckc_pin.run.motion_forces import MotionForces
from ckc_pin.run.run import Run
from ckc_pin.sensitivity.sensitivities import Sensitivities
from ckc_pin.view.ensemble_figures import draw_ensemble
from ckc_pin.view.figures import draw_runs, write_figures
from ckc_pin.view.gif import FRAMES_PER_SECOND, save_gif
from ckc_pin.view.identification_figures import draw_identification
from ckc_pin.view.linear_figures import draw_linear
from ckc_pin.view.map_figures import draw_map
from ckc_pin.view.player import render_html, write_page
from ckc_pin.view.result_figures import draw_excitation, draw_motion_forces, draw_plan, draw_sensitivities

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

    Drawable = (
        Run
        | LinearModel
        | GainLocus
        | Sensitivities
        | MotionForces
        | Excitation
        | Plan
        | SingularityMap
        | Identification
        | xarray.Dataset
    )

__all__ = ["Figures", "Playback", "render_image"]

PLAYBACK_HEIGHT_PX = 480
FIGURE_DPI = 100
DRAWN_ALONE = (LinearModel, GainLocus, Sensitivities, MotionForces, Excitation, Plan, SingularityMap, Identification)


class Figures(Mapping[str, "Figure"]):
    """Figures of runs or of another result by name. A notebook displays them, `save` writes them.

    Parameters
    ----------
    results : sequence of Run, or of one other result that `ckc_pin.plot` takes

    Raises
    ------
    InputError
        No result, another type, or a result that cannot be drawn together with others; matplotlib is not installed.
    """

    def __init__(self, results: Sequence[Drawable]) -> None:
        match results:
            case [LinearModel() | GainLocus() as result]:
                self._figures = draw_linear(result)
            case [Sensitivities() as result]:
                self._figures = {"sensitivities": draw_sensitivities(result)}
            case [MotionForces() as result]:
                self._figures = {"inverse": draw_motion_forces(result)}
            case [Identification() as result]:
                self._figures = draw_identification(result)
            case [Excitation() as result]:
                self._figures = {"excite": draw_excitation(result)}
            case [Plan() as result]:
                self._figures = {"plan": draw_plan(result)}
            case [SingularityMap() as result]:
                self._figures = {f"map_{result.space}": draw_map(result)}
            case [result] if _is_dataset(result):
                self._figures = draw_ensemble(result)  # type: ignore[arg-type]
                if not self._figures:
                    raise InputError(
                        "plot: nothing to draw: outputs over time, and outputs of sweeps of one or two variables have "
                        "figures; draw others with xarray"
                    )
            case _ if any(isinstance(x, DRAWN_ALONE) or _is_dataset(x) for x in results):
                raise InputError("plot: only runs can be drawn together; give each other result alone")
            case _:
                self._figures = draw_runs(results)  # type: ignore[arg-type]

    def __getitem__(self, name: str) -> Figure:
        """Return the matplotlib figure of a name; it can be modified."""
        return self._figures[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._figures)

    def __len__(self) -> int:
        return len(self._figures)

    def __repr__(self) -> str:
        return f"Figures({', '.join(self)})"

    def _repr_html_(self) -> str:
        return "\n".join(render_image(name, figure) for name, figure in self._figures.items())

    def save(self, out_dir: str | Path, formats: Sequence[str] = ("png",)) -> list[Path]:
        """Write the figures to a folder, which is created if missing; formats are "png", "svg" and "pdf".

        Raises
        ------
        InputError
            Unknown format; the folder cannot be written.
        """
        return write_figures(self._figures, out_dir, formats)


class Playback:
    """Playback of runs as a page. A notebook displays it and saves it with the cell's output.

    Parameters
    ----------
    runs : sequence of Run
    speed, gap, meshes, forces
        As for `play`.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        *,
        speed: float = 1.0,
        gap: float = 0.0,
        meshes: str | Path | None = None,
        forces: bool = False,
    ) -> None:
        self._runs, self._speed = tuple(runs), speed
        self.html = render_html(self._runs, speed=speed, gap=gap, meshes=meshes, forces=forces)

    def __repr__(self) -> str:
        names = ", ".join(run.scene_name for run in self._runs)
        return f"Playback({names}); save(FILE) writes a page that plays, or a GIF"

    def _repr_html_(self) -> str:
        page = escape(self.html, quote=True)  # The sandbox keeps its scripts out of the notebook's page.
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" width="100%" height="{PLAYBACK_HEIGHT_PX}" '
            'style="border: 1px solid #ddd"></iframe>'
        )

    def save(self, path: str | Path, *, size: tuple[int, int] | None = None, fps: float | None = None) -> Path:
        """Write an HTML file that plays from disk without a network, or a GIF if the name ends in .gif.

        Parameters
        ----------
        path : str or Path
        size : (width, height), optional
            Of a GIF, pixels. Default: 480 wide, as high as the mechanism needs.
        fps : float, optional
            Frames per second of a GIF, 1 to 50. Default: 20.

        Raises
        ------
        InputError
            As for `save_html` and `save_gif`; a size or frame rate of an HTML file.
        """
        if str(path).lower().endswith(".gif"):
            rate = FRAMES_PER_SECOND if fps is None else fps
            return save_gif(self._runs, path, speed=self._speed, size=size, fps=rate)
        if size is not None or fps is not None:
            raise InputError("save: size and fps are those of a GIF; give a path that ends in .gif, or leave them out")
        return write_page(self.html, path)


def _is_dataset(result: Any) -> bool:
    """Return whether a result is an xarray Dataset, without importing xarray, which is optional."""
    module = sys.modules.get("xarray")
    return module is not None and isinstance(result, module.Dataset)


def render_image(name: str, figure: Figure) -> str:
    """Return a figure as an HTML element that contains its PNG."""
    file = BytesIO()
    figure.savefig(file, format="png", dpi=FIGURE_DPI)
    data = b64encode(file.getvalue()).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{escape(name, quote=True)}" style="max-width: 100%">'
