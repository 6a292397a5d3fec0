"""What figures and playback are in a notebook: values that show themselves in the page, and do nothing else."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from ckc_pin.errors import InputError
from ckc_pin.linear.linear_model import LinearModel
from ckc_pin.linear.locus import GainLocus
from ckc_pin.run.run import Run
from ckc_pin.sensitivity.sensitivities import Sensitivities
from ckc_pin.view.figures import draw, write_figures
from ckc_pin.view.gif import save_gif
from ckc_pin.view.linear_figure import draw_linear
from ckc_pin.view.player import html, write_page
from ckc_pin.view.sensitivity_figure import draw_sensitivities

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Figures", "Playback"]

HEIGHT = 480  # of a playback in a page, in its pixels
RESOLUTION = 100  # of a figure in a page


class Figures(Mapping[str, "Figure"]):
    """Figures by name, as `view.figures.draw` and its like draw them; shown by a notebook.

    Parameters
    ----------
    shown : sequence of Run, or of one LinearModel, GainLocus or Sensitivities

    Raises
    ------
    InputError
        Nothing, something else, several linear models; matplotlib missing.
    """

    def __init__(self, shown: Sequence[Run | LinearModel | GainLocus | Sensitivities]) -> None:
        match shown:
            case [LinearModel() | GainLocus() as one]:
                self._figures = draw_linear(one)
            case [Sensitivities() as one]:
                self._figures = {"sensitivities": draw_sensitivities(one)}
            case _ if any(isinstance(x, LinearModel | GainLocus | Sensitivities) for x in shown):
                raise InputError("plot: what is no run is drawn by itself; give it alone")
            case _:
                self._figures = draw(shown)  # type: ignore[arg-type]

    def __getitem__(self, name: str) -> Figure:
        """Return matplotlib's figure, to be changed as any."""
        return self._figures[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._figures)

    def __len__(self) -> int:
        return len(self._figures)

    def __repr__(self) -> str:
        return f"Figures({', '.join(self)})"

    def _repr_html_(self) -> str:
        return "\n".join(_image(name, figure) for name, figure in self._figures.items())

    def save(self, out_dir: str | Path, formats: Sequence[str] = ("png",)) -> list[Path]:
        """Write the figures to a folder, which is made when missing; formats are "png", "svg" and "pdf".

        Raises
        ------
        InputError
            An unknown format, a folder that cannot be written.
        """
        return write_figures(self._figures, out_dir, formats)


class Playback:
    """Playback of runs as a page of its own; shown inline by a notebook, and kept with it.

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
        self.html = html(self._runs, speed=speed, gap=gap, meshes=meshes, forces=forces)

    def __repr__(self) -> str:
        names = ", ".join(run.scene_name for run in self._runs)
        return f"Playback({names}); save(FILE) writes a page that plays, or a GIF"

    def _repr_html_(self) -> str:
        page = escape(self.html, quote=True)  # a page within the page; its scripts can reach nothing of ours
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" width="100%" height="{HEIGHT}" '
            'style="border: 1px solid #ddd"></iframe>'
        )

    def save(self, path: str | Path) -> Path:
        """Write one HTML file that plays from disk, without a network, or where its name ends in .gif a moving picture.

        Raises
        ------
        InputError
            As of `save_html` and `save_gif`.
        """
        if str(path).lower().endswith(".gif"):
            return save_gif(self._runs, path, speed=self._speed)
        return write_page(self.html, path)


def _image(name: str, figure: Figure) -> str:
    file = BytesIO()
    figure.savefig(file, format="png", dpi=RESOLUTION)
    data = b64encode(file.getvalue()).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{escape(name, quote=True)}" style="max-width: 100%">'
