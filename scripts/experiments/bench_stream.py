"""Benchmark of live views: right-hand sides per second without a view and with several viewers, best of several runs.

Wall time and processor time are both printed. Processor time is that of the whole process, including the view's
threads; on a busy machine it varies less. A viewer is a separate process that speaks the browser's protocol. A fast
viewer answers each frame at once, a slow one twice a second, and one that hangs reads nothing.
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import ExitStack

import pandas as pd

import ckc_pin
from ckc_pin.view.live import live_view

SCENE = "five_bar/tracking"
OVERRIDES = {"formulation": "reduced", "solver.rtol": 1e-11, "solver.output_dt": 1e-3, "t_end": 3.0}
VIEWERS: dict[str, float | None] = {  # s from a frame to its answer
    "no view": None,
    "no viewer": None,
    "a fast viewer": 0.0,
    "a slow viewer": 0.5,
    "a viewer that hangs": -1.0,
}

VIEWER = """
import asyncio, sys, time
from tornado.websocket import WebSocketClosedError, websocket_connect

async def look(url, pause):
    connection = await websocket_connect(url, max_message_size=2**26)
    frames = 0
    print("here", flush=True)
    if pause < 0:
        time.sleep(3600)
    try:
        while (message := await connection.read_message()) is not None:
            if b"several" in message[:40]:
                frames += 1
                await asyncio.sleep(pause)
                await connection.write_message("shown")
    except WebSocketClosedError:
        pass
    print(frames)

asyncio.run(look(sys.argv[1], float(sys.argv[2])))
"""


def measure(name: str) -> tuple[float, float, str]:
    """Return right-hand sides per second of one run, by wall time and processor time, and a text on frames sent."""
    scene = ckc_pin.load_scene(SCENE, OVERRIDES)
    viewer, pause = None, VIEWERS[name]
    with ExitStack() as stack:
        view = None if name == "no view" else stack.enter_context(live_view(scene, None))
        if view is not None and pause is not None:
            command = [sys.executable, "-c", VIEWER, view.server.url.replace("http", "ws"), str(pause)]
            viewer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            assert viewer.stdout is not None
            viewer.stdout.readline()
            time.sleep(0.5)
        spent = time.process_time()
        run = ckc_pin.simulate(scene, on_output=None if view is None else view.on_output)
        spent = time.process_time() - spent
    frames = "-"
    if viewer is not None and pause is not None:
        if pause < 0:
            viewer.kill()
        frames = viewer.communicate()[0].strip() or "-"
    return run.stats["rhs"] / run.stats["wall_s"], run.stats["rhs"] / spent, frames


def main(runs: int) -> None:
    """Run every viewer `runs` times and print a Markdown table."""
    print(f"{SCENE}, {OVERRIDES}\n")
    print("| viewer | per second of the clock | of the processor | share | frames |\n|---|---|---|---|---|")
    columns = ["viewer", "clock", "processor", "frames"]
    rounds = pd.DataFrame([(name, *measure(name)) for _ in range(runs) for name in VIEWERS], columns=columns)
    # Take the viewers in turn, so that other work on the machine affects all of them.
    best = rounds.groupby("viewer", sort=False).agg({"clock": "max", "processor": "max", "frames": "last"})
    best["share"] = 100 * best.processor / best.processor["no view"]
    for row in best.itertuples():
        print(f"| {row.Index} | {row.clock:,.0f} | {row.processor:,.0f} | {row.share:.1f} % | {row.frames} |")
