"""Playback of meshes and of loop gaps."""

from __future__ import annotations

import base64
import gzip
import struct
from pathlib import Path

import msgspec
import numpy as np
import pytest

import ckc_pin
from ckc_pin.view.drawing import draw_runs_3d
from ckc_pin.view.geometry import compute_loop_gaps, pinocchio_configurations
from ckc_pin.view.player import play_runs, save_html
from tests.contract.helpers.command import ckc
from tests.contract.sketches import (
    ARM,
    FACES,
    FOUR_BAR,
    FOUR_BAR_LOOP,
    INERTIAL,
    START_OF_FOUR_BAR,
    TETRAHEDRON,
    tetrahedron,
    write_scene,
)


def objects(drawing: list[dict]) -> dict[str, dict]:
    return {c["path"]: c["object"] for c in drawing if c["type"] == "set_object"}


def crank_with(mesh: str) -> str:
    visual = f'<visual><origin xyz="0 0 0.3"/><geometry>{mesh}</geometry></visual>'
    return FOUR_BAR.replace('<link name="crank">', f'<link name="crank">{visual}')


def bar(folder: Path, mesh: str) -> ckc_pin.Run:
    return ckc_pin.simulate(write_scene(folder, crank_with(mesh), FOUR_BAR_LOOP, START_OF_FOUR_BAR, 0.02))


def triangles(drawing: list[dict]) -> np.ndarray:
    """Corners (k, 3, 3) of the only mesh, in the axes of its body."""
    (drawn,) = [obj for path, obj in objects(drawing).items() if "/link:crank/" in path]
    (geometry,) = drawn["geometries"]
    assert geometry["type"] == "BufferGeometry"
    corners = np.frombuffer(geometry["data"]["attributes"]["position"]["array"].data, "<f4").reshape(-1, 3)
    faces = geometry["data"]["index"]
    assert faces["array"].code == 0x16
    placement = np.array(drawn["object"]["matrix"]).reshape(4, 4).T
    numbers = np.frombuffer(faces["array"].data, "<u4").reshape(-1, 3)
    return (corners @ placement[:3, :3].T + placement[:3, 3])[numbers]


def in_order(corners: np.ndarray) -> np.ndarray:
    """Triangles as sorted rows, so that the order in a file does not matter."""
    return np.array(sorted(np.sort(t.round(6), axis=0).ravel().tolist() for t in corners))


def test_mesh_is_drawn_at_its_link(tmp_path):
    run = bar(tmp_path / "m", '<mesh filename="shapes/crank.stl" scale="2 1 1"/>')
    tetrahedron(tmp_path / "m" / "shapes" / "crank.stl")
    expected = np.array([np.array(TETRAHEDRON)[list(face)] * [2, 1, 1] + [0, 0, 0.3] for face in FACES])
    np.testing.assert_allclose(in_order(triangles(draw_runs_3d([run]))), in_order(expected), atol=1e-6)


def test_saved_run_loads_meshes_from_the_given_folder(tmp_path, capsys):
    saved = bar(tmp_path / "m", '<mesh filename="package://mine/shapes/crank.stl"/>').save(tmp_path / "run.npz")
    tetrahedron(tmp_path / "m" / "shapes" / "crank.stl")
    run = ckc_pin.Run.load(saved)
    page = save_html(run, tmp_path / "sticks.html")
    assert capsys.readouterr().err == (
        "mesh files not found: package://mine/shapes/crank.stl; links are drawn as rods. "
        "--meshes DIR names their folder\n"
    )
    assert [path for path in objects(draw_runs_3d([run])) if "/joint:alpha/rod:" in path]
    drawing = draw_runs_3d([run], meshes=tmp_path / "m")
    assert not [path for path in objects(drawing) if "/joint:alpha/rod:" in path]
    expected = np.array([np.array(TETRAHEDRON)[list(face)] + [0, 0, 0.3] for face in FACES])
    np.testing.assert_allclose(in_order(triangles(drawing)), in_order(expected), atol=1e-6)
    whole = save_html(run, tmp_path / "meshes.html", meshes=tmp_path / "m")
    assert capsys.readouterr().err == ""
    assert page.read_bytes() != whole.read_bytes()
    with pytest.raises(ckc_pin.InputError, match=r"no such folder; give the folder of the mechanism\.toml"):
        save_html(run, tmp_path / "x.html", meshes=tmp_path / "nowhere")


@pytest.mark.parametrize(
    "name", ["../crank.stl", "a/../../crank.stl", "{absolute}", "file://{absolute}", "link.stl", ""]
)
def test_meshes_outside_the_folder_are_not_opened(tmp_path, name):
    tetrahedron(tmp_path / "crank.stl")
    run = bar(tmp_path / "m", f'<mesh filename="{name.format(absolute=tmp_path / "crank.stl")}"/>')
    (tmp_path / "m" / "link.stl").symlink_to(tmp_path / "crank.stl")
    drawn = objects(draw_runs_3d([run]))
    assert not [path for path in drawn if "/link:crank/" in path]
    assert [path for path in drawn if "/joint:alpha/rod:" in path]


@pytest.mark.parametrize("content", [b"", b"solid \n garbage", bytes(80) + struct.pack("<I", 2**31), b"\xff" * 200])
def test_link_with_a_damaged_mesh_is_drawn_as_a_rod(tmp_path, content):
    run = bar(tmp_path / "m", '<mesh filename="crank.stl"/>')
    (tmp_path / "m" / "crank.stl").write_bytes(content)
    drawn = objects(draw_runs_3d([run]))
    assert not [path for path in drawn if "/link:crank/" in path]
    assert [path for path in drawn if "/joint:alpha/rod:" in path]


def test_all_meshes_of_a_robot_are_drawn(tmp_path):
    run = ckc_pin.simulate("two_ur5", {"t_end": 0.01})
    drawn = objects(draw_runs_3d([run]))
    meshes = [path for path, obj in drawn.items() if obj["geometries"][0]["type"] == "BufferGeometry"]
    assert len([path for path in meshes if "/link:" in path]) == 14  # seven links each
    assert not [path for path in drawn if "/rod:" in path]


# --- gaps ----------------------------------------------------------------------------------------


def test_gaps_are_the_constrained_offsets(run):
    off = run("five_bar/swing", formulation="spf", initial__w=[2e-3, -1e-3], t_end=0.05)
    mechanism = off.mechanism
    result = compute_loop_gaps(mechanism, pinocchio_configurations(off))
    assert list(result) == ["elbow"]
    np.testing.assert_allclose(result["elbow"][:, :2], off.phi, atol=1e-15)  # its rows are x and y of the world
    assert np.abs(off.phi[0]).max() == pytest.approx(2e-3)
    assert not np.any(result["elbow"][:, 2])


def test_gap_of_a_distance_loop_is_along_its_rod(tmp_path):
    rod = """
[[loop]]
name = "rod"
type = "distance"
length = 0.55
frame_a = {link = "a", xyz = [0.1, 0.0, 0.0]}
frame_b = {link = "world", xyz = [0.0, 0.6, 0.2]}
"""
    start = '[initial.q]\nlift = 0.1\n"reach$/1" = 0.1\n'
    run = ckc_pin.simulate(write_scene(tmp_path / "m", ARM, rod, start, 0.01))
    q = np.array([[0.4, 0.1, 0.1]])
    tip, end = np.array([0.1 * np.cos(0.4), 0.1 * np.sin(0.4), 0]), np.array([0, 0.6, 0.2])
    r = tip - end
    configuration = run.mechanism.tree.from_coordinates(q[0])[None]
    expected = r * (1 - 0.55 / np.linalg.norm(r))
    np.testing.assert_allclose(compute_loop_gaps(run.mechanism, configuration)["rod"][0], expected, atol=1e-14)


def test_magnified_gaps_run_from_frame_b(run):
    off = run("five_bar/swing", formulation="spf", initial__w=[2e-3, -1e-3], t_end=0.05)
    drawing = draw_runs_3d([off], gap=50.0)
    root = next(path for path in objects(drawing) if "/gap:elbow" in path).rpartition("/gap")[0]
    rod = f"{root}/gap:elbow/way"
    assert objects(drawing)[f"{rod}/rod"]["geometries"][0]["height"] == 1.0
    (animation,) = [c for c in drawing if c["type"] == "set_animation"]
    way = {a["path"]: {t["name"]: t["values"] for t in a["clip"]["tracks"]} for a in animation["animations"]}

    def values(path: str, name: str, columns: int) -> np.ndarray:
        return np.frombuffer(way[path][name].data, "<f4").reshape(-1, columns).astype(float)

    angles = off.q_tree[:, off.column("theta_3")] + off.q_tree[:, off.column("theta_4")]
    third = off.q_tree[:, off.column("theta_3")]
    x = 0.3048 + 0.2794 * np.cos(third) + 0.3048 * np.cos(angles)
    b = np.column_stack([x, 0.2794 * np.sin(third) + 0.3048 * np.sin(angles)])
    np.testing.assert_allclose(values(rod, ".position", 3)[:, :2], b, atol=1e-6)
    end = values(f"{root}/gap:elbow/end", ".position", 3)
    np.testing.assert_allclose(end[:, :2] - b, 50 * off.phi, atol=1e-6)
    length = values(rod, ".scale", 3)
    np.testing.assert_allclose(length[:, 2], 50 * np.linalg.norm(off.phi, axis=1), atol=1e-6)
    assert not [path for path in objects(draw_runs_3d([off])) if "/gap:" in path]  # only on request


@pytest.mark.parametrize("gap", [-1.0, float("nan"), float("inf")])
def test_invalid_gap_factors_are_rejected(run, gap):
    with pytest.raises(ckc_pin.InputError, match="gap = "):
        play_runs(run("five_bar/swing"), gap=gap, block=False)


# --- one file ------------------------------------------------------------------------------------


def test_unwritable_file_is_reported(run, tmp_path):
    with pytest.raises(ckc_pin.InputError, match=r"cannot be written: .*; choose a file in a folder that exists"):
        save_html(run("five_bar/swing"), tmp_path / "nowhere" / "x.html")


def test_saved_page_contains_scene_and_names_as_text(tmp_path):
    path = write_scene(tmp_path / "m", FOUR_BAR, FOUR_BAR_LOOP, START_OF_FOUR_BAR, 0.01)
    hostile = path.rename(path.with_name("<script>alert(1)<.scene.toml"))
    run = ckc_pin.simulate(hostile)
    text = save_html(run, tmp_path / "x.html", speed=0.5).read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;" in text.split("</title>")[0]
    data = text.split('<script type="text/plain" id="scene">')[1].split("</script>")[0]
    several = msgspec.msgpack.decode(gzip.decompress(base64.b64decode(data, validate=True)))
    assert several["type"] == "several"
    arrays = several["arrays"]
    assert len({(array.code, bytes(array.data)) for array in arrays}) == len(arrays)  # each once
    result = _resolved(several["commands"], arrays)
    assert result == msgspec.msgpack.decode(msgspec.msgpack.encode(draw_runs_3d([run], speed=0.5)))


def _resolved(value, arrays):
    if isinstance(value, dict):
        return (
            arrays[value["shared"]] if set(value) == {"shared"} else {k: _resolved(v, arrays) for k, v in value.items()}
        )
    return [_resolved(one, arrays) for one in value] if isinstance(value, list) else value


def test_coincident_corners_are_merged(tmp_path):
    run = bar(tmp_path / "m", '<mesh filename="crank.stl"/>')
    tetrahedron(tmp_path / "m" / "crank.stl")  # STL has each corner once for each of its triangles
    (drawn,) = [obj for path, obj in objects(draw_runs_3d([run])).items() if "/link:crank/" in path]
    position = drawn["geometries"][0]["data"]["attributes"]["position"]["array"]
    assert len(position.data) == 4 * 3 * 4


def test_command_and_python_write_the_same_file(run, tmp_path):
    saved = run("five_bar/swing").save(tmp_path / "run.npz")
    result = ckc("play", str(saved), "--html", str(tmp_path / "x.html"), "--gap", "100", "--speed", "2")
    assert (result.code, result.out, result.err) == (0, f"written: {tmp_path / 'x.html'}\n", "")
    saved_page = save_html(ckc_pin.Run.load(saved), tmp_path / "own.html", gap=100.0, speed=2.0)
    assert saved_page.read_bytes() == (tmp_path / "x.html").read_bytes()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--speed", "0"], "--speed 0: it must be above zero, 1 is real time"),
        (["--gap", "-1"], "play: gap = -1.0; it must be a factor by which gaps are magnified, or 0 for no gaps"),
        (["--port", "70000"], "port 70000: choose one from 1 to 65535, or 0 for any free one"),
        (["--meshes", "nowhere"], "play: meshes = nowhere: no such folder; give the folder of the mechanism.toml"),
        (["--html", "no/where.html"], "no/where.html: cannot be written: No such file or directory; choose a file in"),
    ],
)
def test_invalid_play_options_are_rejected(run, tmp_path, words, says):
    result = ckc("play", str(run("five_bar/swing").save(tmp_path / "run.npz")), *words)
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith(f"error: {says}")
    assert result.err.count("\n") == 1


def test_coincident_hinges_have_one_ball(tmp_path: Path) -> None:
    """They would flicker: on the crank's end beside the coupler, and on the base beside the crank."""
    more = "".join(
        f'<link name="{name}_link">{INERTIAL}</link><joint name="{name}" type="continuous"><parent link="{on}"/>'
        f'<child link="{name}_link"/><origin xyz="{x} 0 0"/><axis xyz="0 1 0"/></joint>'
        for name, on, x in (("swing", "crank", 0.2), ("hang", "base", 0.0), ("apart", "crank", 0.1))
    )
    hanging = ("swing", "hang", "apart")
    loop = FOUR_BAR_LOOP.replace('["alpha"]', str(["alpha", *hanging]))
    start = START_OF_FOUR_BAR + "".join(f"{name} = 0.0\n" for name in hanging)
    run = ckc_pin.simulate(
        write_scene(tmp_path / "m", FOUR_BAR.replace("</robot>", f"{more}</robot>"), loop, start, 0.02)
    )
    balls = {
        path.split("joint:")[1].removesuffix("/ball") for path in objects(draw_runs_3d([run])) if path.endswith("/ball")
    }
    assert balls == {"alpha", "beta", "gamma", "apart"}
