"""Figures do not depend on, or change, the user's matplotlib settings."""

from __future__ import annotations

import subprocess
import sys

import matplotlib as mpl
import pytest

from ckc_pin.errors import InputError
from ckc_pin.view.figures import plot_runs


def test_figure_files_do_not_depend_on_user_settings(swing, tmp_path):
    formats = ("png", "svg")
    plain = [path.read_bytes() for path in plot_runs(swing, tmp_path / "plain", formats)]
    assert plain[0].startswith(b"\x89PNG")
    with mpl.rc_context({"axes.facecolor": "red", "font.size": 30, "lines.linewidth": 9}):
        before = dict(mpl.rcParams)
        styled = [path.read_bytes() for path in plot_runs(swing, tmp_path / "styled", formats)]
        assert dict(mpl.rcParams) == before
    assert styled == plain


def test_drawing_does_not_import_pyplot(tmp_path):
    code = (
        "import sys, ckc_pin; from ckc_pin.view.figures import plot_runs\n"
        "run = ckc_pin.simulate('five_bar/swing', {'t_end': 0.05})\n"
        "assert 'matplotlib' not in sys.modules\n"
        f"plot_runs(run, {str(tmp_path)!r}, ('png', 'svg', 'pdf'))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"motion{more}.{suffix}" for more in ("", "_snapshots") for suffix in ("pdf", "png", "svg")
    ]


def test_invalid_arguments_are_rejected(swing, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="no run given"):
        plot_runs([], tmp_path)
    with pytest.raises(InputError, match="format 'gif'; valid: png, svg, pdf"):
        plot_runs(swing, tmp_path, ("png", "gif"))
    with pytest.raises(InputError, match="format 'missing'"):
        plot_runs(swing, tmp_path, ())
    with pytest.raises(InputError, match=r"file.*cannot be written"):
        plot_runs(swing, tmp_path / "file")
