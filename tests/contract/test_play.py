"""Playback: the drawing commands for the viewer."""

from __future__ import annotations

from urllib.request import urlopen

import numpy as np
import pytest

import ckc_pin
from ckc_pin.errors import InputError
from ckc_pin.view.drawing import MIN_KEYFRAMES, draw_runs_3d
from ckc_pin.view.player import play_runs
from tests.contract.helpers.playback import floats, matrix, messages_to, objects, placed, rotated, tracks
from tests.contract.sketches import ARM, FOUR_BAR, FOUR_BAR_LOOP, START_OF_ARM, write_scene

L_PROXIMAL, L_DISTAL, BASE = 0.2794, 0.3048, 0.3048  # of five_bar


def test_server_sends_page_and_scripts(serve, swing):
    server = serve(swing)
    with urlopen(server.url) as answer:
        page = answer.read().decode()
        policy = answer.headers["Content-Security-Policy"]
    assert "<title>five_bar/swing</title>" in page
    assert "http" not in page.replace("http-equiv", "")  # it names no other place
    assert "default-src 'none'" in policy
    assert f"ws://127.0.0.1:{server.port}" in policy
    for name, start in (("main.min.js", b"/*! For license"), ("start.js", b"// Meshcat's viewer in a page")):
        with urlopen(server.url + name) as answer:
            assert answer.read().startswith(start)
            assert answer.headers["Content-Type"].startswith("text/javascript")


def test_elbows_of_the_animation_agree_with_forward_kinematics(serve, tracking):
    server = serve(tracking)
    moved = tracks(messages_to(server, len(server.scene_state.messages())))
    for proximal, distal, foot, column in (("theta_1", "theta_2", 0.0, 0), ("theta_3", "theta_4", BASE, 2)):
        times, elbow, _ = moved[f"/world/1: reduced/joint:{distal}"]
        rows = np.searchsorted(tracking.t, times - 1e-4)
        np.testing.assert_allclose(tracking.t[rows], times, atol=1e-6)
        angle = tracking.q_tree[rows, column]
        expected = np.column_stack([foot + L_PROXIMAL * np.cos(angle), L_PROXIMAL * np.sin(angle), 0 * angle])
        np.testing.assert_allclose(elbow, expected, atol=1e-6)
        times, hinge, turn = moved[f"/world/1: reduced/joint:{proximal}"]
        np.testing.assert_allclose(hinge, np.tile([foot, 0.0, 0.0], (len(times), 1)), atol=1e-6)
        np.testing.assert_allclose(rotated(turn, np.array([L_PROXIMAL, 0, 0])) + hinge, expected, atol=1e-6)


def test_loop_frames_meet_and_follow_the_traced_point(serve, tracking):
    server = serve(tracking)
    drawing = messages_to(server, len(server.scene_state.messages()))
    drawn, moved = objects(drawing), tracks(drawing)
    root = "/world/1: reduced"
    ends = {}
    for side, joint in (("A", "theta_2"), ("B", "theta_4")):
        sphere = drawn[f"{root}/joint:{joint}/loop:elbow:{side}"]
        assert sphere["geometries"][0]["type"] == "SphereGeometry"
        local = matrix(sphere["object"]["matrix"])[:3, 3]
        times, position, quaternion = moved[f"{root}/joint:{joint}"]
        ends[side] = position + rotated(quaternion, local)
    np.testing.assert_allclose(ends["A"], ends["B"], atol=1e-6)
    trace = drawn[f"{root}/trace:tip"]
    assert trace["object"]["type"] == "Line"
    path = floats(trace["geometries"][0]["data"]["attributes"]["position"]["array"], 3)
    np.testing.assert_allclose(path, tracking.points["tip"], atol=1e-6)
    np.testing.assert_allclose(ends["A"], path[np.searchsorted(tracking.t, times - 1e-4)], atol=1e-6)


def test_links_have_their_shapes_and_differ_by_colour(tracking):
    drawn = objects(draw_runs_3d([tracking]))
    root = "/world/1: reduced/joint:theta_1/link:link_1"
    shapes = {path: obj["geometries"][0] for path, obj in drawn.items() if path.startswith(root)}
    box = next(g for g in shapes.values() if g["type"] == "BoxGeometry")
    assert (box["width"], box["height"], box["depth"]) == (0.2794, 0.018, 0.018)
    pins = [path for path, g in shapes.items() if g.get("radiusTop") == 0.005]
    (pin,) = pins
    assert shapes[pin]["height"] == 0.042
    placement = matrix(drawn[pin]["object"]["matrix"])
    np.testing.assert_allclose(placement[:3, 3], [0.2794, 0.0, -0.02], atol=1e-15)
    np.testing.assert_allclose(placement[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-15)  # three.js's axis y along URDF's z
    colours = {
        joint: next(o["materials"][0]["color"] for path, o in drawn.items() if f"joint:{joint}/link:" in path)
        for joint in ("theta_1", "theta_2", "theta_3", "theta_4")
    }
    assert colours["theta_1"] == 0x1F4C99  # the URDF's blue, 0.12 0.30 0.60
    assert len(set(colours.values())) == 4


def opacities(drawing: list[dict]) -> dict[str, float]:
    return {path: obj["materials"][0].get("opacity", 1) for path, obj in objects(drawing).items()}


def test_second_run_is_translucent_and_simultaneous(tracking, swing):
    drawing = draw_runs_3d([tracking, swing])
    opacity = {path: x for path, x in opacities(drawing).items() if "/desired/" not in path}
    first, second = "/world/1: five_bar%2Ftracking: reduced", "/world/2: five_bar%2Fswing: DAE"
    assert {opacity[path] for path in opacity if path.startswith(first)} == {1}
    assert {opacity[path] for path in opacity if path.startswith(second)} == {0.4}
    assert {path.split("/")[2] for path in opacity} == {first.split("/")[2], second.split("/")[2]}
    moved = tracks(drawing)
    assert moved[f"{first}/joint:theta_1"][0][-1] == pytest.approx(9.5)
    assert moved[f"{second}/joint:theta_1"][0][-1] == pytest.approx(2.0)


def test_spf_is_translucent_on_the_reduced_model_in_any_order(serve, run, tracking):
    server = serve(run("five_bar/tracking"), tracking)
    with urlopen(server.url) as answer:
        page = answer.read().decode()
    assert "<p>reduced</p><p>translucent: SPF, ε = 10⁻⁴</p><p>gray: desired</p>" in page
    opacity = opacities(messages_to(server, len(server.scene_state.messages())))
    assert {x for path, x in opacity.items() if path.startswith("/world/2: SPF")} == {0.4}


def test_ghost_follows_equation_21_on_the_branch_of_the_run(tracking):
    drawing = draw_runs_3d([tracking])
    root, moved = "/world/1: reduced/desired", tracks(drawing)
    assert {x for path, x in opacities(drawing).items() if path.startswith(root)} == {0.22}
    assert not [path for path in objects(drawing) if path.startswith(f"{root}/base")]
    t = tracking.t
    theta_1, theta_3 = np.pi / 3 * np.sin(t), np.pi / 4 * (1 - np.cos(t))
    left = L_PROXIMAL * np.column_stack([np.cos(theta_1), np.sin(theta_1)])
    right = [BASE, 0] + L_PROXIMAL * np.column_stack([np.cos(theta_3), np.sin(theta_3)])
    between = right - left
    gap = np.linalg.norm(between, axis=1, keepdims=True)
    below = np.column_stack([between[:, 1], -between[:, 0]]) / gap
    tip = 0.5 * (left + right) + below * np.sqrt(L_DISTAL**2 - 0.25 * gap**2)
    for joint, elbow in (("theta_2", left), ("theta_4", right)):
        times, position, quaternion = moved[f"{root}/joint:{joint}"]
        np.testing.assert_allclose(times, t, atol=1e-6)
        np.testing.assert_allclose(position[:, :2], elbow, atol=1e-6)
        np.testing.assert_allclose((position + rotated(quaternion, np.array([L_DISTAL, 0, 0])))[:, :2], tip, atol=1e-6)


def test_ghost_is_hidden_while_unreachable():
    overrides = {"controller.desired.theta_1.harmonics": [[2.2, 10.0, 0.0]], "t_end": 0.3, "formulation": "reduced"}
    drawing = draw_runs_3d([ckc_pin.simulate("five_bar/tracking", overrides)])
    (animation,) = [c for c in drawing if c["type"] == "set_animation"]
    (hidden,) = [a for a in animation["animations"] if a["path"].endswith("/desired")]
    (track,) = hidden["clip"]["tracks"]
    assert (track["name"], track["type"]) == (".visible", "bool")
    t = floats(track["times"], 1)[:, 0]
    theta_1, theta_3 = 2.2 * np.sin(10 * t), np.pi / 4 * (1 - np.cos(t))
    left = np.column_stack([np.cos(theta_1), np.sin(theta_1)])
    apart = L_PROXIMAL * (np.column_stack([np.cos(theta_3), np.sin(theta_3)]) - left) + [BASE, 0]
    reached = np.linalg.norm(apart, axis=1) < 2 * L_DISTAL
    assert track["values"] == reached.tolist()
    assert {True, False} == set(track["values"])


def test_output_times_are_keyframes_up_to_a_limit(swing):
    for speed in (0.25, 1.0, 10.0):
        drawing = draw_runs_3d([swing], speed=speed)
        times = tracks(drawing)["/world/1: DAE/joint:theta_1"][0]
        np.testing.assert_allclose(times, swing.t, atol=1e-6)
        assert drawing[-1]["options"]["timeScale"] == speed
    many = ckc_pin.simulate("five_bar/swing", {"t_end": 0.5, "solver.output_dt": 1e-4})
    times = tracks(draw_runs_3d([many]))["/world/1: DAE/joint:theta_1"][0]
    assert (times[0], times[-1]) == (0.0, 0.5)
    assert len(times) == MIN_KEYFRAMES
    assert np.diff(times).max() < 2.0 * 0.5 / MIN_KEYFRAMES


def test_quaternions_are_continuous(tmp_path):
    q = "[initial.q]\nalpha = -0.5\n[initial.q_dot]\nalpha = 40.0\n"  # several turns of the crank
    run = ckc_pin.simulate(write_scene(tmp_path / "m", FOUR_BAR, "gravity = [0, 0, 0]\n" + FOUR_BAR_LOOP, q, 1.0))
    assert np.ptp(run.q_tree[:, run.column("alpha")]) > 4 * np.pi
    for _, _, quaternions in tracks(draw_runs_3d([run])).values():
        np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
        assert np.sum(quaternions[1:] * quaternions[:-1], axis=1).min() > 0.8


# --- the side to look from -----------------------------------------------------------------------


def test_planar_mechanism_faces_the_viewer(swing, tmp_path):
    # In the viewer's scene x is right, z is up, and the camera looks along +y.
    five_bar = placed(draw_runs_3d([swing]))[:3, :3]
    np.testing.assert_allclose(five_bar @ np.eye(3), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), atol=1e-12)
    q = "[initial.q]\nalpha = -0.5\n"
    run = ckc_pin.simulate(write_scene(tmp_path / "m", FOUR_BAR, FOUR_BAR_LOOP, q, 0.1))
    np.testing.assert_allclose(
        placed(draw_runs_3d([run]))[:3, :3], np.eye(3), atol=1e-12
    )  # x-z plane, gravity along -z


def test_whole_motion_is_in_sight(tracking):
    drawing = draw_runs_3d([tracking])
    (distance,) = [c["value"][2] for c in drawing if c.get("property") == "position"]
    (angle,) = [c["value"] for c in drawing if c.get("property") == "fov"]
    world = placed(drawing)
    tip = tracking.points["tip"] @ world[:3, :3].T + world[:3, 3]
    depth = distance + tip[:, 1]
    assert np.all(np.abs(tip[:, 2]) < depth * np.tan(np.radians(angle / 2)))
    assert np.abs(tip[:, [0, 2]]).max() > 0.2 * distance * np.tan(np.radians(angle / 2))  # and not from afar


def test_spatial_mechanism_stands_upright_below_the_camera(tmp_path):
    for k, (gravity, up) in enumerate(
        [("[0, 0, -9.81]", [0, 0, 1]), ("[0, -9.81, 0]", [0, 1, 0]), ("[3, 0, 4]", None)]
    ):
        run = ckc_pin.simulate(write_scene(tmp_path / f"m{k}", ARM, f"gravity = {gravity}\n", START_OF_ARM, 0.05))
        drawing = draw_runs_3d([run])
        turn = placed(drawing)[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(turn @ (up or [-0.6, 0, -0.8]), [0, 0, 1], atol=1e-12)
        (position,) = [c["value"] for c in drawing if c.get("property") == "position"]
        assert 0.2 < position[1] / np.linalg.norm(position) < 0.6
        np.testing.assert_allclose(placed(drawing, "/Grid")[:2, 2], 0, atol=1e-12)  # the floor is level


# --- mechanisms without pictures -----------------------------------------------------------------


def test_links_without_visuals_are_drawn_as_rods(tmp_path):
    mesh = '<visual><geometry><mesh filename="missing.stl"/></geometry></visual>'
    urdf = FOUR_BAR.replace('<link name="crank">', f'<link name="crank">{mesh}')
    q = "[initial.q]\nalpha = -0.5\n"
    run = ckc_pin.simulate(write_scene(tmp_path / "m", urdf, FOUR_BAR_LOOP, q, 0.1))
    drawn = objects(draw_runs_3d([run]))
    rods = {path.split("/")[3]: obj for path, obj in drawn.items() if "/rod:" in path}
    lengths = {name: obj["geometries"][0]["height"] for name, obj in rods.items()}
    assert lengths == pytest.approx({"base": 0.5, "joint:alpha": 0.2, "joint:beta": 0.5, "joint:gamma": 0.4})
    placement = matrix(rods["joint:beta"]["object"]["matrix"])
    np.testing.assert_allclose(placement @ [0, 0.25, 0, 1], [0.5, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(placement @ [0, -0.25, 0, 1], [0, 0, 0, 1], atol=1e-12)


def test_links_of_equal_colour_get_distinct_colours(tmp_path):
    grey = '<material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>'
    ball = f'<visual><geometry><sphere radius="0.02"/></geometry>{grey}</visual>'
    urdf = ARM.replace("<inertial>", f"{ball}<inertial>")
    run = ckc_pin.simulate(write_scene(tmp_path / "m", urdf, "", START_OF_ARM, 0.05))
    drawn = {path: obj for path, obj in objects(draw_runs_3d([run])).items() if "/link:" in path}
    assert {path.split("/")[3] for path in drawn} == {"joint:turn", "joint:lift", "joint:reach$%2F1"}
    assert len({obj["materials"][0]["color"] for obj in drawn.values()}) == 3


@pytest.mark.parametrize(
    ("visual", "message"),
    [
        ('<geometry><box size="1 2"/></geometry>', "a box needs size above zero"),
        ('<geometry><sphere radius="-1"/></geometry>', "a sphere needs radius above zero"),
        ('<geometry><cylinder radius="1"/></geometry>', "a cylinder needs radius and length above zero"),
        ('<geometry><sphere radius="nan"/></geometry>', "radius='nan' must consist of finite numbers"),
        ('<origin xyz="0 0"/><geometry><sphere radius="1"/></geometry>', "needs three numbers in xyz and in rpy"),
        ('<geometry><sphere radius="1"/></geometry><material><color rgba="2 0 0 1"/></material>', "from 0 to 1"),
    ],
)
def test_invalid_visuals_are_rejected(tmp_path, visual, message):
    urdf = FOUR_BAR.replace('<link name="crank">', f'<link name="crank"><visual>{visual}</visual>')
    q = "[initial.q]\nalpha = -0.5\n"
    run = ckc_pin.simulate(write_scene(tmp_path / "m", urdf, FOUR_BAR_LOOP, q, 0.01))
    with pytest.raises(InputError, match="link 'crank'") as error:
        draw_runs_3d([run])
    assert message in str(error.value)


def test_names_are_escaped_in_the_page(tmp_path):
    path = write_scene(tmp_path / "m", FOUR_BAR, FOUR_BAR_LOOP, "[initial.q]\nalpha = -0.5\n", 0.01)
    hostile = path.rename(path.with_name("<script>alert(1)<.scene.toml"))
    with play_runs(ckc_pin.simulate(hostile), block=False) as server, urlopen(server.url) as answer:
        page = answer.read().decode()
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)&lt;" in page
