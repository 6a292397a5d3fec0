"""Pictures of the site are compressed without a visible difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scripts.experiments.chart import shrink
from scripts.site.gallery import ROOT

PICTURES = sorted((ROOT / "docs").rglob("*.png"))


def test_every_picture_is_shrunk(tmp_path: Path) -> None:
    copy = tmp_path / "copy.png"
    for path in PICTURES:
        copy.write_bytes(path.read_bytes())
        shrink(copy)
        assert copy.stat().st_size >= path.stat().st_size, (
            f"{path}: scripts.experiments.chart.shrink makes it smaller; run it on the file"
        )


@pytest.mark.parametrize("colours", [3, 20000])
def test_shrinking_changes_no_visible_colour(colours: int, tmp_path: Path) -> None:
    """Few colours become a palette. Noise in all colours has no good palette and stays RGB."""
    values = np.random.default_rng(1).integers(0, 256, (colours, 3))
    drawn = values[np.random.default_rng(2).integers(0, colours, (200, 200))].astype(np.uint8)
    path = tmp_path / "drawn.png"
    Image.fromarray(drawn).convert("RGBA").save(path)
    before = path.stat().st_size
    shrink(path)
    with Image.open(path) as shrunk:
        assert shrunk.mode == ("P" if colours == 3 else "RGB")
        assert np.abs(np.asarray(shrunk.convert("RGB"), dtype=int) - drawn).max() <= (1 if colours == 3 else 0)
    assert path.stat().st_size < before
