"""Tracking and set-point control compared with an independent integration, with correct and wrong controller models."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Run, check, simulate
from ckc_pin.mechanism.library import library
from tests.analytic.five_bar import FIVE_BAR, Q, desired
from tests.conftest import REFERENCES, assert_close
from tests.regression.reference import FORMULATIONS, Trajectory, trajectory

formulations = pytest.mark.parametrize("formulation", FORMULATIONS)


TIGHT = 1e-10  # so that errors stay below the tolerance of `assert_follows`


def assert_follows(ours: Run, reference: Trajectory) -> None:
    rows = reference.rows(ours)
    assert_close(ours.q_tree[rows], reference.q_tree, 1e-9)
    assert_close(ours.v_tree[rows], reference.v_tree, 1e-7)
    assert_close(ours.u[rows], reference.u, 1e-7)
    assert_close(ours.tau, ours.u, 0)
    model = REFERENCES[reference.mechanism]
    assert_close([model.phi(q) for q in ours.q_tree], 0, 1e-12)
    assert ours.max_phi <= 1e-12


@formulations
def test_tracking(run: Callable[..., Run], formulation: str) -> None:
    assert_follows(run("five_bar/tracking", formulation=formulation, solver__rtol=TIGHT), trajectory("tracking"))


@formulations
def test_shipped_tracking_scene_matches_the_reference(run: Callable[..., Run], formulation: str) -> None:
    """With the scene's rtol, 1e-8."""
    ours, reference = run("five_bar/tracking", formulation=formulation), trajectory("tracking")
    rows = reference.rows(ours)
    assert_close(ours.q_tree[rows], reference.q_tree, 1.1e-8)
    assert_close(ours.u[rows], reference.u, 1e-7)


@formulations
def test_tracking_error_decays_exponentially(run: Callable[..., Run], formulation: str) -> None:
    """The error is e^-t times the initial one, as in the notes."""
    ours = run("five_bar/tracking", formulation=formulation)
    assert ours.t[-1] == 9.5
    assert_close(ours.q_tree[-1, Q] - desired(9.5)[0], [-1.0775e-4, -1.281e-4], 6e-9)


def test_tracking_from_consistent_start_does_not_depend_on_epsilon(run: Callable[..., Run]) -> None:
    """From a consistent start the SPF equals the reduced model for every epsilon."""
    assert_follows(
        run("five_bar/tracking", formulation="spf", epsilon=1e-3, solver__rtol=TIGHT), trajectory("tracking")
    )


@formulations
def test_tracking_torques_match_the_papers_maxima(run: Callable[..., Run], formulation: str) -> None:
    """24.84 N m at the start (the paper's 30), 1.35 N m after 4 s (the paper's 5)."""
    ours = run("five_bar/tracking", formulation=formulation)
    largest = np.abs(ours.u).max(axis=1)
    assert np.argmax(largest) == 0
    assert_close(largest[0], 24.84, 5e-3)
    assert_close(largest[ours.t >= 4].max(), 1.35, 5e-3)


@pytest.mark.parametrize("file", ["set_point", "set_point_as_printed"])
@formulations
def test_set_point(run: Callable[..., Run], file: str, formulation: str) -> None:
    reference = trajectory(file)
    assert_follows(run(reference.name, formulation=formulation, solver__rtol=TIGHT), reference)


@pytest.mark.parametrize("scene", ["five_bar/set_point", "five_bar/tracking"])
def test_lyapunov_function_decreases_along_the_closed_loop(run: Callable[..., Run], scene: str) -> None:
    """The functions of eqs. 15 and 18 decrease to rounding."""
    lyapunov = run(scene, formulation="reduced").lyapunov
    assert lyapunov is not None
    assert np.all(lyapunov > -1e-12)
    assert np.diff(lyapunov).max() < 1e-10 * lyapunov[0]


def heavy_model(folder: Path, attributes: str) -> str:
    """The shipped mechanism with these attributes of each <inertial> increased by 20 %."""
    shipped = library() / "five_bar"

    def heavier(match: re.Match[str]) -> str:
        return f'{match[1]}="{1.2 * float(match[2])!r}"'

    urdf, scaled = re.subn(rf'\b({attributes})="([^"]*)"', heavier, (shipped / "five_bar.urdf").read_text("utf-8"))
    assert scaled == 4 * (7 if "|" in attributes else 1)
    (folder / "five_bar.urdf").write_text(urdf, "utf-8")
    (folder / "mechanism.toml").write_text((shipped / "mechanism.toml").read_text("utf-8"), "utf-8")
    return str(folder / "mechanism.toml")


@formulations
def test_tracking_with_too_heavy_model_matches_the_reference(
    run: Callable[..., Run], tmp_path: Path, formulation: str
) -> None:
    model = heavy_model(tmp_path, "value|i[xyz][xyz]")
    ours = run("five_bar/tracking", formulation=formulation, controller__model=model, solver__rtol=TIGHT)
    assert_follows(ours, trajectory("tracking_heavy_links"))


def test_tracking_with_too_large_masses_matches_the_reference(run: Callable[..., Run], tmp_path: Path) -> None:
    ours = run(
        "five_bar/tracking", formulation="dae", controller__model=heavy_model(tmp_path, "value"), solver__rtol=TIGHT
    )
    assert_follows(ours, trajectory("tracking_heavy_masses"))


def test_printed_trajectory_leaves_the_workspace() -> None:
    result = check("five_bar_as_printed/tracking")
    assert result.desired is not None
    assert_close(result.desired.leaves_at, 4.39313, 5.1e-6)
    assert "leaves the workspace at t = 4.39313 s" in " ".join(result.warnings)


def test_default_trajectory_stays_in_the_workspace() -> None:
    result = check("five_bar/tracking")
    assert result.desired is not None
    assert result.desired.leaves_at is None
    assert not [warning for warning in result.warnings if "desired" in warning]


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_printed_trajectory_stops_at_the_singular_configuration(run: Callable[..., Run], formulation: str) -> None:
    """The DAE stops too, because eq. 16's D grows without bound there."""
    ours = run("five_bar_as_printed/tracking", formulation=formulation, solver__rtol=1e-6)
    assert ours.status == "stopped"
    assert_close(ours.t[-1], 4.341, 1e-3)
    assert "phi_z is singular" in ours.message
    assert "t = 4.341" in ours.message
    model = REFERENCES["five_bar_as_printed"]
    assert abs(model.s(ours.q_tree[-1])) < 1e-3
    assert_close([model.phi(q) for q in ours.q_tree], 0, 1e-12)


@pytest.mark.parametrize("sampled", [{}, {"sample_time": 0.05, "delay": 0.02}], ids=["continuous", "sampled"])
def test_set_point_control_changes_coordinates_where_phi_z_is_singular(sampled: dict[str, float]) -> None:
    """The control law uses q and q_dot only, so the run agrees with the DAE, which needs no q."""
    names = ("theta_1", "theta_3")
    overrides = {
        "t_end": 1.0,
        "solver.rtol": 1e-10,
        "initial": {"q": dict(zip(names, (-0.93414013, -0.41820761), strict=True)),
                    "q_dot": dict(zip(names, (7.45699329, 0.99570948), strict=True))},
        "controller": {"type": "set_point", "K_P": 0.1, "K_V": 0.01,
                       "q_d": {"theta_1": -1.2, "theta_3": 1.9}, **sampled},
    }  # fmt: skip
    reduced, spf, dae = (simulate("five_bar/swing", {**overrides, "formulation": x}) for x in ("reduced", "spf", "dae"))
    assert min(abs(FIVE_BAR.s(q_tree)) for q_tree in dae.q_tree) < 0.05
    assert dae.status == "done"
    for run in (reduced, spf):
        assert (run.status, run.stats["switches"] > 0) == ("done", True)
        assert_close(run.q_tree, dae.q_tree, 1e-6)
        assert_close(run.u, dae.u, 1e-6)
        assert_close(run.lyapunov, dae.lyapunov, 1e-5)
