"""Fast desired motions: the five-bar's elbows move apart until the distal links are aligned."""

import numpy as np
import pytest

from ckc_pin import Tracking, load, load_scene
from ckc_pin.control import workspace
from ckc_pin.control.desired import Desired, Harmonics, Table, count_cycles
from ckc_pin.control.spec import MotionSpec
from ckc_pin.control.workspace import follow_desired
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from tests.analytic.five_bar import FIVE_BAR

EDGE = float(
    np.arcsin((FIVE_BAR.l[1] + FIVE_BAR.l[3] - FIVE_BAR.base) / (2 * FIVE_BAR.l[0]))
)  # rad: amplitude of each link at which the distal links are aligned


def opposite_swings(swing: float, frequency: float) -> Harmonics:
    waves = ([(sign * swing, frequency, 0.0)] for sign in (-1, 1))
    return Harmonics([MotionSpec(offset=-np.pi / 2, harmonics=wave) for wave in waves])


@pytest.mark.parametrize("turns", [3.3, 100.0, 1000.0])
def test_fast_desired_motions_are_seen_to_leave_the_workspace(turns: float) -> None:
    """The motion is outside for 2 % of each period; samples of a thousand periods must not have the same phase."""
    w = 2 * np.pi * turns
    result = follow_desired(load("five_bar"), opposite_swings(1.002 * EDGE, w), 1.0)
    assert result.leaves_at == pytest.approx(np.arcsin(1 / 1.002) / w, rel=1e-9)
    assert result.until == result.leaves_at


@pytest.mark.parametrize("scene", ["five_bar/tracking", "five_bar_as_printed/tracking", "delta/circle", "two_ur5/lift"])
def test_samples_computed_together_are_those_followed_one_by_one(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_scene(scene)
    mechanism = load_scene_mechanism(loaded)
    controller = build_scene_controller(loaded, mechanism)
    assert isinstance(controller, Tracking)
    together = follow_desired(mechanism, controller.desired, loaded.spec.t_end)
    monkeypatch.setattr(workspace, "_move_together", lambda *arguments: None)
    single = follow_desired(mechanism, controller.desired, loaded.spec.t_end)
    assert together.leaves_at == single.leaves_at
    assert together.until == single.until
    assert together.sigma_min == pytest.approx(single.sigma_min, rel=1e-11)


def test_check_reports_how_far_a_very_fast_motion_was_followed() -> None:
    result = follow_desired(load("five_bar"), opposite_swings(0.9 * EDGE, 2 * np.pi * 1e4), 1.0)
    assert result.leaves_at is None
    assert 100 < 1e4 * result.until < 1000


def test_highest_frequency_of_a_table_matches_its_sampled_wave() -> None:
    random, t = np.random.default_rng(0), np.linspace(0.0, 3.0, 2001)
    for _ in range(5):
        slow, fast = random.uniform(1.0, 2.0), random.uniform(10.0, 40.0)
        waves = np.column_stack([np.sin(slow * t), 0.3 * np.sin(fast * t + random.uniform(0, 6))])
        table: Desired = Table(t, waves)
        assert count_cycles(table, 3.0) == pytest.approx(3.0 * fast / (2 * np.pi), rel=1e-3)
        rounded = Table(t, np.round(waves, 7))  # rounded as in a file; the rounding must not count as a wave
        assert count_cycles(rounded, 3.0) == pytest.approx(3.0 * fast / (2 * np.pi), rel=1e-2)
    assert count_cycles(Table(t, np.ones((2001, 1))), 3.0) == 0.0
