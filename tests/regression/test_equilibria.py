"""Equilibria reached from far configurations, and equilibria where q is no chart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import NumericalError, load
from ckc_pin.dynamics import Terms, equilibrium, stable_equilibrium
from ckc_pin.kinematics.sigma import newton, predict
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.library import library

SLIDER_CRANK = library() / "slider_crank"


@pytest.mark.parametrize(("name", "trials"), [("talos", 100), ("two_ur5", 60), ("flyball", 80)])
def test_equilibrium_search_converges_from_far_configurations(
    name: str, trials: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The path passes where q is no chart (talos, two_ur5) and has soft and stiff directions (flyball, talos)."""
    model, tried = load(name), []

    def counted(*args: Any) -> Any:
        tried.append(1)
        return newton(*args)

    monkeypatch.setattr(equilibrium, "newton", counted)
    at = stable_equilibrium(model)
    assert len(tried) <= trials
    assert np.abs(at.phi).max(initial=0.0) <= model.tolerance
    # By Pinocchio's energy, no configuration in the neighbourhood is lower.
    tree, random = model.tree, np.random.default_rng(0)
    lowest = Terms(model, at, np.zeros(model.n)).potential_energy
    best = model.choose_partition(at)
    assert best is not None
    here = Kinematics(tree, model.closure, best, at.q_tree)
    for _ in range(50):
        reference = newton(predict(here, random.normal(size=model.d) * 1e-3), 0.0, model.tolerance)
        assert reference.converged
        assert Terms(model, reference.at, np.zeros(model.n)).potential_energy >= lowest - 1e-12 * abs(lowest)
    if name == "flyball":
        q = tree.named(tree.to_coordinates(at.q_tree))
        assert [q["rod_1"], q["rod_2"]] == pytest.approx([np.pi / 2, np.pi / 2], abs=1e-9)


def test_equilibrium_where_q_is_no_chart_is_rejected(tmp_path: Path) -> None:
    """With gravity along the rail, the crank hangs in line with the rod, where the slider does not determine it."""
    text = (SLIDER_CRANK / "mechanism.toml").read_text()
    text = text.replace('["crank"]', '["slider"]').replace("[0.0, -9.81, 0.0]", "[9.81, 0.0, 0.0]")
    (tmp_path / "mechanism.toml").write_text(text)
    (tmp_path / "slider_crank.urdf").write_text((SLIDER_CRANK / "slider_crank.urdf").read_text())
    with pytest.raises(NumericalError, match=r"slider do not determine the other coordinates; take independent = "):
        stable_equilibrium(load(tmp_path / "mechanism.toml"))
