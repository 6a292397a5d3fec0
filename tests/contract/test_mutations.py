"""Randomly mutated files, from fixed seeds: each is accepted or rejected with one line."""

from __future__ import annotations

import json
import random
import tomllib
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ckc_pin import CkcError, Run, check, load, simulate
from ckc_pin.base.sources import Sources
from ckc_pin.base.summary import to_json
from ckc_pin.base.toml import convert, join_dotted_keys
from ckc_pin.cli.runs import format_profile
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism.library import library
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.run.run_file import RunMeta, hashes_of
from ckc_pin.scene.scene import make_scene

NUMBERS = [float("nan"), float("inf"), -float("inf"), 0, -1, 5e-324, 1e-300, 1e300, 1.7e308, 1e12, 1e-12, 1e9, 2**63,
           10**40, True]  # fmt: skip
OTHERS = [*NUMBERS, "", "x", "$", "\\", "a" * 300, "é\u202e", "\x00", "<b>", "../x", "/dev/zero", [], [[0]], {},
          {"x": 1}, [1, 2, 3], [0.0, 0.0, 0.0], ["a", "b"], None, "world", "joint:"]  # fmt: skip
BYTES = b"<>&\"'/\x00\n ;[]=!-\xff"


def _places(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    for key in data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ():
        yield (*at, key)
        yield from _places(data[key], (*at, key))


def mutated(r: random.Random, data: Any) -> Any:
    """Change, scale, remove, duplicate or rename one value."""
    changed = deepcopy(data)
    *way, last = r.choice(list(_places(changed)))
    at = changed
    for key in way:
        at = at[key]
    value, what = at[last], r.random()
    if isinstance(value, int | float) and what < 0.7:
        at[last] = r.choice([*NUMBERS, value * 10.0 ** r.randint(-12, 12), -value])
    elif what > 0.95:
        del at[last]
    elif what > 0.9 and isinstance(at, dict):
        at[r.choice(["", "$x", "a\nb", "é", "a" * 300, "x.y"])] = at.pop(last)
    elif what > 0.85 and isinstance(at, list):
        at.append(value)
    else:
        at[last] = deepcopy(r.choice(OTHERS))
    return changed


def used_or_refused(use: Callable[..., Any], *arguments: Any) -> None:
    """Any other exception fails the test, with the input in its traceback."""
    said = ""
    try:
        use(*arguments)
    except CkcError as error:
        said = str(error)
    assert said.isprintable()


SCENES = ["five_bar/tracking", "five_bar/swing", "slider_crank/default", "delta/circle"]


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_scenes(name: str) -> None:
    r, (folder, scene) = random.Random(1), name.split("/")
    content = tomllib.loads((library() / folder / f"{scene}.scene.toml").read_text(encoding="utf-8"))
    content |= {"t_end": 0.02, "event": [{"of": "sigma_min_J", "value": 1e-3}]}
    solver = {"rtol": 1e-6, "atol": 1e-8, "max_rhs": 1000, "max_wall_s": 1.0, "output_dt": 0.001, "max_step": 0.01}
    for _ in range(150):
        chosen = {"formulation": r.choice(["dae", "reduced", "spf"]), "solver": dict(solver)}
        data = mutated(r, content | chosen)
        used_or_refused(_simulate, data, name, library() / folder)


def _simulate(data: Any, name: str, folder: Path) -> None:
    simulate(make_scene(data, name, Sources(name, folder)))


@pytest.mark.parametrize("name", ["five_bar", "slider_crank", "flyball"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_mechanisms(name: str) -> None:
    r, folder = random.Random(2), library() / name
    content = tomllib.loads((folder / "mechanism.toml").read_text(encoding="utf-8"))
    for _ in range(60):
        used_or_refused(_check, mutated(r, content), name, folder)


def _check(data: Any, name: str, folder: Path) -> None:
    join_dotted_keys(data, "q_guess")
    check(assemble_mechanism(convert(data, MechanismSpec, name), Sources(name, folder)))


@pytest.mark.parametrize("file", ["five_bar.urdf", "mechanism.toml", "swing.scene.toml"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_bytes(file: str, bar: Path, capfd: pytest.CaptureFixture[str]) -> None:
    r, whole = random.Random(3), (bar / file).read_bytes()
    overrides = {"t_end": 0.01, "solver.max_rhs": 200, "solver.output_dt": 0.005}
    for _ in range(100):
        content = bytearray(whole)
        for _ in range(r.choice([1, 1, 3])):
            k = r.randrange(len(content))
            content[k : k + r.choice([0, 1, 1, 30])] = bytes([r.choice(BYTES)]) * r.choice([0, 1, 2])
        (bar / file).write_bytes(content)
        used_or_refused(simulate, bar / "swing.scene.toml", overrides)
        used_or_refused(load, bar)
    assert capfd.readouterr() == ("", "")


def test_run_files(tmp_path: Path) -> None:
    """Mutate metadata and correct the hashes, so that only the checks of the content can reject them."""
    r, path = random.Random(4), tmp_path / "run.npz"
    event = [{"coordinate": "theta_1", "of": "q_dot"}]
    simulate("five_bar/set_point", {"t_end": 0.03, "event": event}, profile=True).save(path)
    with np.load(path) as data:
        content = {name: data[name] for name in data.files}
    original = json.loads(content["meta"].tobytes())
    del original["hashes"]
    for _ in range(250):
        meta = mutated(r, original)
        try:
            hashes = hashes_of(msgspec.convert(meta, RunMeta))
        except (msgspec.ValidationError, OverflowError):
            hashes = {}
        content["meta"] = np.frombuffer(json.dumps(meta | {"hashes": hashes}).encode(), dtype=np.uint8)
        np.savez(path, **content)
        used_or_refused(_read, path)


def _read(path: Path) -> None:
    run = Run.load(path)
    to_json(run.to_dict()), run.summary().text(), format_profile(run), run.loop_forces(), run.points
