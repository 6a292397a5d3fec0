"""Invalid events are rejected with one message."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import Event, InputError, Terms, simulate
from tests.contract.helpers.bad import Bad, expect


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((3,), "Event: function must be a function"),
        ((max, 2), "direction = 2; valid: -1, 0, 1"),
        ((max, True), "direction = True"),
        ((max, 0, 1), "stop = 1: expected True or False"),
        ((max, 0, True, 5), "name = 5: expected a string"),
        ((lambda t: t - 0.5,), r"Event: expected a function of \(t, terms\), got <lambda>\(t\)"),
    ],
)
def test_invalid_event_is_rejected(arguments: tuple[Any, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Event(*arguments)


@pytest.mark.parametrize("value", [None, "0.3", np.zeros(2), [0.1], 1j])
def test_event_function_must_return_a_number(value: Any) -> None:
    with pytest.raises(InputError, match=r"the event 'odd' gave .*; a number is needed"):
        simulate("five_bar/swing", {"t_end": 0.1}, events=[Event(lambda t, terms: value, name="odd")])


@pytest.mark.parametrize("kind", [bool, np.bool_], ids=["Python's", "NumPy's"])
def test_event_function_must_not_return_a_bool(kind: Any) -> None:
    """A bool has no sign change, so the event would never occur."""
    with pytest.raises(InputError, match=r"the event 'late' gave False; a number that changes sign .* t - 0\.5"):
        simulate("five_bar/swing", {"t_end": 0.1}, events=[Event(lambda t, terms: kind(t > 0.5), name="late")])


def test_bare_function_is_rejected_as_event() -> None:
    with pytest.raises(
        InputError, match=r"events\[0\]: .* is no Event; write Event\(function, direction, stop, name\)"
    ):
        simulate("five_bar/swing", events=[lambda t, terms: t])  # type: ignore[list-item]


def test_nan_of_an_event_function_stops_the_run() -> None:
    def lost(t: float, terms: Terms) -> float:
        return float("nan") if t > 0.2 else 1.0

    run = simulate("five_bar/swing", {"t_end": 1.0}, events=[Event(lost)])
    assert run.status == "stopped"
    assert run.message.endswith("the event 'lost' is nan")
    assert 0.05 < run.t[-1] <= 0.3


SCENE = ("run", "bar/swing.scene.toml", "--set")
BAD = [
    ("{}", "event[0]: the key 'coordinate' is missing; of = 'q' needs one"),
    ('{of="q_dot"}', "event[0]: the key 'coordinate' is missing; of = 'q_dot' needs one"),
    ('{of="limit", value=1.0}', "event[0]: of = 'limit' takes the limits of the URDF; remove the key 'value'"),
    ('{of="limit"}', "event[0]: no joint of five_bar has limits in its URDF"),
    (
        '{of="sigma_min_J", coordinate="theta_1", value=1.0}',
        "event[0]: of = 'sigma_min_J' belongs to the whole",
    ),
    ('{of="sigma_min_phi_z"}', "event[0]: of = 'sigma_min_phi_z' needs a value greater than 0"),
    ('{of="sigma_min_phi_z", value=-1.0}', "event[0]: of = 'sigma_min_phi_z' needs a value greater than 0"),
    ('{coordinate="x", of="limit"}', "event[0].coordinate: no coordinate 'x'; there are theta_1, theta_2"),
    ('{coordinate="theta_1", value=nan}', "event[0].value = nan: expected a finite number"),
]


@pytest.mark.parametrize(("event", "says"), BAD, ids=[event for event, _ in BAD])
def test_invalid_scene_event_is_rejected(event: str, says: str, bar: Path) -> None:
    expect(Bad(event, (*SCENE, f"event=[{event}]"), [says]), bar)


def test_open_chain_has_no_singular_value_event(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no closed loop, so there is no sigma_min_J"):
        simulate(_pendulum(tmp_path), {"event": [{"of": "sigma_min_J", "value": 0.1}]})


def _pendulum(folder: Path) -> Path:
    (folder / "p.urdf").write_text(
        '<robot name="p"><link name="a"/><link name="b"><inertial><mass value="1"/><origin xyz="1 0 0"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="swing" '
        'type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>',
        encoding="utf-8",
    )
    (folder / "mechanism.toml").write_text('name = "pendulum"\nurdf = "p.urdf"\n', encoding="utf-8")
    scene = folder / "s.scene.toml"
    scene.write_text(
        'mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 1.0\n[initial.q]\nswing = 0.1\n',
        encoding="utf-8",
    )
    return scene
