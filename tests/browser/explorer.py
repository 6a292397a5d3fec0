"""A stand-in for the explorer's program, which draws a mechanism, sends reports and records the page's requests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin.explorer import messages
from ckc_pin.explorer.server import ExploreServer
from ckc_pin.view import bodies, commands
from ckc_pin.view.drawing import WORLD, estimate_reach, set_camera
from ckc_pin.view.geometry import compute_placements, homogeneous
from tests.browser.pages import Visit

__all__ = ["PARAMETERS", "QUANTITIES", "ROOT", "StandIn", "five_bar", "open_explorer", "program"]

PATIENCE = 20.0  # s
ROOT = f"{WORLD}/explored"
# The last message of the start has been shown, and the picture has been drawn.
READY = "document.getElementById('closure').textContent && !viewer.needs_render"
QUANTITIES = [
    messages.QuantityInfo(name="values", label="Coordinates", on=True),
    messages.QuantityInfo(name="forces", label="Forces", on=False),
    messages.QuantityInfo(name="reach", label="Ellipsoids", on=False, unavailable="no named points"),
]
PARAMETERS = [
    messages.ParameterInfo(name=f"link.{link}.{kind}", group=f"link.{link}", unit=unit, value=value, default=1.0,
                           lower=0.0, upper=2.0)
    for link in ("crank", "rod") for kind, unit, value in (("mass", "kg", 1.0), ("angle", "rad", 1.5))
]  # fmt: skip


class StandIn:
    """A mechanism in a page. It does not move by itself: tests send its poses and reports."""

    def __init__(self, name: str, port: int = 0, token: str = "", **overrides: Any) -> None:
        self.requests: list[messages.Request] = []
        self.mechanism = ckc_pin.load(name)
        self.server = ExploreServer(name, self.requests.append, port, token)
        tree = self.mechanism.tree
        self.names = list(tree.model.names[1:])
        placements = compute_placements(self.mechanism, self.mechanism.q_tree[None])
        self.placements = {
            name: homogeneous(placements.rotation[0, k + 1], placements.translation[0, k + 1])
            for k, name in enumerate(self.names)
        }
        for command in [
            *set_camera(self.mechanism, estimate_reach(self.mechanism, placements)),
            *bodies.draw_bodies(self.mechanism, ROOT, placements, bodies.SOLID),
            *bodies.draw_loop_frames(self.mechanism, ROOT, bodies.SOLID),
        ]:
            self.server.send(command)
        self.setup = self.describe(**overrides)
        coordinates = tree.to_coordinates(self.mechanism.q_tree).tolist()
        self.values = dict(zip(self.mechanism.coordinates, coordinates, strict=True))
        self.report(self.setup)
        self.report(messages.RunReport())
        self.move()

    def describe(self, **overrides: Any) -> messages.Setup:
        """Return the setup of this mechanism."""
        independent = self.mechanism.independent
        keys: dict[str, Any] = {
            "title": self.mechanism.name,
            "summary": f"{len(self.mechanism.coordinates)} coordinates, {len(independent)} freedoms",
            "coordinates": [
                messages.CoordinateInfo(name=name, unit="rad", lower=-np.pi, upper=np.pi, has_stops=False,
                                        is_independent=name in independent)
                for name in self.mechanism.coordinates
            ],
            "motors": [messages.MotorInfo(name=name, unit="N m", limit=5.0) for name in independent],
            "parameters": [],
            "quantities": [],
            "bodies": {n: bodies.body_path(self.mechanism, ROOT, k + 1) for k, n in enumerate(self.names)},
            "points": {},
            "normal": None,
            "modes": ["free", "hold"],
            "formulation": "reduced",
            "can_map": True,
            "can_branch": True,
            "warnings": [],
            "can_save": True,
        }  # fmt: skip
        return messages.Setup(**(keys | overrides))

    def report(self, report: messages.Report) -> None:
        """Send a report."""
        self.server.send(report.to_command())

    def move(self, **fields: Any) -> None:
        """Send a frame with the present placements and a pose report."""
        pose = messages.PoseReport(**({"values": self.values, "closure": 2e-15} | fields))
        transforms = [
            commands.set_transform(bodies.body_path(self.mechanism, ROOT, k + 1), self.placements[name])
            for k, name in enumerate(self.names)
        ]
        self.server.send(commands.group_commands([*transforms, pose.to_command()]))

    def take_through(self, last: messages.Request) -> list[messages.Request]:
        """Wait for a request, and return and forget it with those before it. It must be the last one."""
        deadline = time.monotonic() + PATIENCE
        while last not in self.requests:
            assert time.monotonic() < deadline, self.requests
            time.sleep(0.01)
        taken = self.take(len(self.requests))
        assert taken[-1] == last, taken
        return taken

    def take(self, count: int) -> list[messages.Request]:
        """Wait for requests, and return and forget them. There must not be more of them."""
        deadline = time.monotonic() + PATIENCE
        while len(self.requests) < count:
            assert time.monotonic() < deadline, self.requests
            time.sleep(0.01)
        time.sleep(0.1)
        taken = list(self.requests)
        self.requests.clear()
        assert len(taken) == count, taken
        return taken


@pytest.fixture
def program() -> Iterator[Callable[..., StandIn]]:
    """Start stand-ins for the program, which are stopped at the end of the test."""
    started: list[StandIn] = []

    def start(name: str = "five_bar", **options: Any) -> StandIn:
        started.append(StandIn(name, **options))
        return started[-1]

    yield start
    for one in started:
        one.server.stop()


@pytest.fixture
def five_bar(program) -> StandIn:
    return program(quantities=QUANTITIES, parameters=PARAMETERS)


def open_explorer(look_at: Callable[..., Visit], program: StandIn, **options: Any) -> Visit:
    visit = look_at(program.server.url, READY, **options)
    program.requests.clear()
    return visit
