"""Shapes of links without visuals: plates, cylinders with their rods, sliders on rails, and the ground."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import ckc_pin
from ckc_pin.view.drawing import draw_runs_3d
from ckc_pin.view.geometry import compute_placements, pinocchio_configurations, projection_planes
from ckc_pin.view.hulls import compute_hull_outline
from ckc_pin.view.links import find_link_shapes
from ckc_pin.view.outlines import project_base, project_outline
from tests.contract.sketches import ARM, FOUR_BAR, FOUR_BAR_LOOP, INERTIAL, START_OF_ARM, START_OF_FOUR_BAR, write_scene

RADIUS = 0.03  # of a bar, of the mechanism's size
CORNERS = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.2]])  # of the coupler with a third point, in x and z
PLATE = FOUR_BAR_LOOP + '[[point]]\nname = "tracer"\nframe = {link = "coupler", xyz = [0.25, 0.0, 0.2]}\n'

# A hydraulic cylinder on the base that lifts an arm of 1 m; the rod's eye is 0.7 m along the arm.
LIFT = f"""
<robot name="lift">
  <link name="base"/>
  <link name="arm">{INERTIAL}</link>
  <link name="barrel">{INERTIAL}</link>
  <link name="eye">{INERTIAL}</link>
  <joint name="raise" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 -1 0"/></joint>
  <joint name="tilt" type="continuous"><parent link="base"/><child link="barrel"/>
    <origin xyz="0.3 0 -0.4"/><axis xyz="0 -1 0"/></joint>
  <joint name="stroke" type="prismatic"><parent link="barrel"/><child link="eye"/><axis xyz="1 0 0"/>
    <limit lower="-9" upper="9" effort="9" velocity="9"/></joint>
</robot>
"""
LIFT_LOOP = """
independent = ["stroke"]
[q_guess]
raise = 0.3
tilt = 1.0
stroke = 0.7
[[loop]]
name = "pin"
type = "point_2d"
axis_a = [0.0, 1.0, 0.0]
frame_a = "eye"
frame_b = {link = "arm", xyz = [0.7, 0.0, 0.0]}
"""

SLIDER = f"""
<robot name="slider">
  <link name="base"/>
  <link name="carriage">{INERTIAL}</link>
  <joint name="travel" type="prismatic"><parent link="base"/><child link="carriage"/>
    <origin xyz="0.5 0 0"/><axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="9" velocity="9"/></joint>
</robot>
"""


def simulate(folder: Path, urdf: str, mechanism: str, scene: str, t_end: float = 0.1) -> ckc_pin.Run:
    run = ckc_pin.simulate(write_scene(folder, urdf, mechanism, scene, t_end))
    assert run.status == "done"
    return run


def objects(run: ckc_pin.Run) -> dict[str, dict]:
    """Objects by the path below the run's."""
    drawn = {c["path"]: c["object"] for c in draw_runs_3d([run]) if c["type"] == "set_object"}
    return {path.split("/", 3)[3]: obj for path, obj in drawn.items()}


def corners_of(obj: dict) -> np.ndarray:
    (geometry,) = obj["geometries"]
    return np.frombuffer(geometry["data"]["attributes"]["position"]["array"].data, "<f4").reshape(-1, 3).astype(float)


def ends_of(obj: dict) -> np.ndarray:
    """Ends of a cylinder (2, 3) in the axes of its body, from its lower to its upper end."""
    placement = np.array(obj["object"]["matrix"]).reshape(4, 4).T
    height = obj["geometries"][0]["height"]
    return np.array([(placement @ [0, side * height / 2, 0, 1])[:3] for side in (-1, 1)])


def bounds(obj: dict, axis: int) -> tuple[float, float]:
    """Least and largest coordinate of a cylinder or plate of the base."""
    if obj["geometries"][0]["type"] != "CylinderGeometry":
        values = corners_of(obj)[:, axis]
        return values.min(), values.max()
    ends = ends_of(obj)
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    margin = obj["geometries"][0]["radiusBottom"] * np.sqrt(max(0.0, 1 - direction[axis] ** 2))
    return ends[:, axis].min() - margin, ends[:, axis].max() + margin


# --- plates --------------------------------------------------------------------------------------


def test_link_with_three_points_is_a_plate(tmp_path: Path) -> None:
    """The volume of a rounded plate, thickness (area + perimeter r + pi r^2), with 24 corners for each circle."""
    run = simulate(tmp_path / "m", FOUR_BAR, PLATE, START_OF_FOUR_BAR)
    drawn = objects(run)
    assert not [path for path in drawn if path.startswith("joint:beta/rod")]
    (obj,) = [obj for path, obj in drawn.items() if path.startswith("joint:beta/plate")]
    corners = corners_of(obj)
    radius, thickness = RADIUS * run.mechanism.size, np.ptp(corners[:, 1])
    edges = np.roll(CORNERS, -1, axis=0) - CORNERS
    area, perimeter = 0.05, np.linalg.norm(edges, axis=1).sum()
    expected = thickness * (area + perimeter * radius + np.pi * radius**2)
    assert ConvexHull(corners).volume == pytest.approx(expected, rel=0.01)
    assert 0.9 * radius < thickness < 2 * radius
    for corner in CORNERS:
        assert np.linalg.norm(corners[:, [0, 2]] - corner, axis=1).min() == pytest.approx(radius, rel=0.02)


def test_link_with_points_on_a_line_is_one_bar(tmp_path: Path) -> None:
    mechanism = FOUR_BAR_LOOP + '[[point]]\nname = "far"\nframe = {link = "coupler", xyz = [-0.3, 0.0, 0.0]}\n'
    drawn = objects(simulate(tmp_path / "m", FOUR_BAR, mechanism, START_OF_FOUR_BAR))
    (bar,) = [obj for path, obj in drawn.items() if path.startswith("joint:beta/") and "rod:" in path]
    np.testing.assert_allclose(sorted(ends_of(bar)[:, 0]), [-0.3, 0.5], atol=1e-12)
    assert not [path for path in drawn if "/plate:" in path]


def test_link_with_points_in_space_is_a_solid(tmp_path: Path) -> None:
    mechanism = PLATE + '[[point]]\nname = "side"\nframe = {link = "coupler", xyz = [0.25, 0.3, 0.1]}\n'
    run = simulate(tmp_path / "m", FOUR_BAR, mechanism, START_OF_FOUR_BAR)
    (obj,) = [obj for path, obj in objects(run).items() if path.startswith("joint:beta/plate")]
    assert bounds(obj, 1) == pytest.approx(
        (-0.5 * RADIUS * run.mechanism.size, 0.3 + 0.5 * RADIUS * run.mechanism.size)
    )


def test_projected_plate_has_its_corners_in_order(tmp_path: Path) -> None:
    run = simulate(tmp_path / "m", FOUR_BAR, PLATE, START_OF_FOUR_BAR)
    poses = compute_placements(run.mechanism, pinocchio_configurations(run))
    (plane,) = projection_planes(run.mechanism)
    outline = project_outline(run.mechanism, find_link_shapes(run.mechanism, poses), poses.select_row(0), plane)
    alpha, beta = run.q_tree[0, [run.column("alpha"), run.column("beta")]]
    origin = 0.2 * np.array([np.cos(alpha), -np.sin(alpha)])  # A positive angle about y turns x to -z.
    x, z = np.array([[np.cos(alpha + beta), -np.sin(alpha + beta)], [np.sin(alpha + beta), np.cos(alpha + beta)]])
    (plate,) = outline.plates
    for a, b in CORNERS:
        assert np.linalg.norm(plate - (origin + a * x + b * z), axis=1).min() < 1e-12
    assert len(plate) == 3
    assert len(outline.bars) == 2  # crank and rocker


def test_hull_outline_agrees_with_scipy() -> None:
    points = np.random.default_rng(3).normal(size=(60, 2))
    hull = ConvexHull(points)
    outline = compute_hull_outline(points)
    assert {tuple(corner) for corner in outline} == {tuple(points[k]) for k in hull.vertices}
    x, y = outline.T
    assert 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)) == pytest.approx(hull.volume)


# --- slides --------------------------------------------------------------------------------------


def test_cylinder_and_rod_are_two_links(tmp_path: Path) -> None:
    """The cylinder is fixed on the barrel, the thinner rod on the eye; they overlap at all times."""
    run = simulate(tmp_path / "m", LIFT, LIFT_LOOP, '[initial]\nat = "assembled"\n', 0.2)
    drawn = objects(run)
    cylinder, rod = drawn["joint:tilt/cylinder:0"], drawn["joint:stroke/piston:0"]
    assert cylinder["geometries"][0]["radiusTop"] > 1.5 * rod["geometries"][0]["radiusTop"]
    assert cylinder["materials"][0]["color"] != rod["materials"][0]["color"]
    stroke = run["stroke"]
    low, high = sorted(ends_of(cylinder)[:, 0])
    rod_low, rod_high = sorted(ends_of(rod)[:, 0])
    assert (low, rod_high) == pytest.approx((0.0, 0.0), abs=1e-12)  # pin and eye
    assert np.all(stroke + rod_low < high - 1e-3)
    assert np.all(stroke + rod_low > low)
    assert np.all(high < stroke - 1e-3), "a part of the rod is seen"
    assert not [path for path in drawn if "/rail:" in path or path == "joint:stroke/ball"]


def test_cylinder_ends_where_the_file_puts_the_slide(tmp_path: Path) -> None:
    """The forearm reaches from its hinge to the slide at 0.2 m; the hand ends at its centre of mass, 0.1 m ahead."""
    run = simulate(tmp_path / "m", ARM, "", START_OF_ARM)
    drawn = objects(run)
    np.testing.assert_allclose(sorted(ends_of(drawn["joint:lift/cylinder:0"])[:, 0]), [0.0, 0.2], atol=1e-12)
    assert ends_of(drawn["joint:reach$%2F1/piston:0"])[:, 0].max() == pytest.approx(0.1)
    assert not [path for path in drawn if path.startswith(("joint:lift/rod", "joint:reach$%2F1/rod"))]


def test_slide_on_the_base_is_a_slider_on_a_rail(tmp_path: Path) -> None:
    gravity = "gravity = [3.0, 0.0, -9.81]\n"
    run = simulate(tmp_path / "m", SLIDER, gravity, "[initial.q]\ntravel = -0.2\n[initial.q_dot]\ntravel = 1.0\n", 0.3)
    drawn = objects(run)
    assert drawn["joint:travel/slider"]["geometries"][0]["type"] == "BoxGeometry"
    margin = 0.08 * run.mechanism.size
    ends = sorted(ends_of(drawn["base/rail:0"])[:, 0])
    np.testing.assert_allclose(ends, [0.3 - margin, 0.5 + run["travel"].max() + margin], atol=1e-9)


def test_projected_cylinder_ends_before_its_rod(tmp_path: Path) -> None:
    run = simulate(tmp_path / "m", LIFT, LIFT_LOOP, '[initial]\nat = "assembled"\n', 0.2)
    poses = compute_placements(run.mechanism, pinocchio_configurations(run))
    (plane,) = projection_planes(run.mechanism)
    outline = project_outline(run.mechanism, find_link_shapes(run.mechanism, poses), poses.select_row(0), plane)
    (block,) = outline.blocks
    pin, angle = np.array([0.3, -0.4]), run["tilt"][0]
    along = (block - pin) @ [np.cos(angle), np.sin(angle)]
    assert along.min() == pytest.approx(0.0, abs=1e-12)
    assert 0.5 * run["stroke"].min() < along.max() < run["stroke"].min()


# --- ground --------------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity", ["[0.0, -9.81, 0.0]", "[0.0, 0.0, 0.0]", "[0.0, 0.0, -9.81]"])
def test_ground_of_a_planar_mechanism_is_behind_its_links(gravity: str, tmp_path: Path) -> None:
    """Seen from -y, links in the plane y = 0; the third leg makes the ground a plate."""
    leg = f"""<link name="leg">{INERTIAL}</link><joint name="third" type="continuous"><parent link="base"/>
      <child link="leg"/><origin xyz="0.2 0 -0.4"/><axis xyz="0 1 0"/></joint></robot>"""
    loop = FOUR_BAR_LOOP.replace('["alpha"]', '["alpha", "third"]')
    for name, urdf, mechanism, start in (
        ("two", FOUR_BAR, FOUR_BAR_LOOP, START_OF_FOUR_BAR),
        ("three", FOUR_BAR.replace("</robot>", leg), loop, START_OF_FOUR_BAR + "third = 0.0\n"),
    ):
        run = simulate(tmp_path / name, urdf, f"gravity = {gravity}\n{mechanism}", start, 0.05)
        view = next(c["matrix"] for c in draw_runs_3d([run]) if c["type"] == "set_transform" and c["path"] == "/world")
        away = np.array(view).reshape(4, 4).T[1, 1]  # The viewer is on the side of -y of the scene.
        drawn = objects(run)
        radius = RADIUS * run.mechanism.size
        (ground,) = [obj for path, obj in drawn.items() if path.startswith(("base/rod", "base/plate"))]
        nearest = min(away * np.array(bounds(ground, 1)))
        assert nearest > 1.4 * radius, "behind the hinges' balls"
        posts = [ends_of(obj) for path, obj in drawn.items() if path.startswith("base/post")]
        assert len(posts) == {"two": 2, "three": 3}[name]
        pins = sorted(min(post, key=lambda end: abs(end[1])).round(9).tolist() for post in posts)
        assert pins == sorted([[0, 0, 0], [0.5, 0, 0], [0.2, 0, -0.4]][: len(posts)])
        assert all(max(away * post[:, 1]) >= nearest for post in posts)


@pytest.mark.parametrize(("height", "posts"), [(0.0, 0), (0.5, 3)])
def test_ground_in_space_is_a_level_plate_or_a_floor(height: float, posts: int, tmp_path: Path) -> None:
    """Three arms on the base, two at z = 0, one higher; gravity along -z."""
    arms = "".join(
        f'<link name="link_{k}">{INERTIAL}</link><joint name="joint_{k}" type="continuous"><parent link="base"/>'
        f'<child link="link_{k}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/></joint>'
        for k, (xyz, axis) in enumerate((("0 0 0", "0 0 1"), ("1 0 0", "0 1 0"), (f"0 1 {height}", "1 0 0")))
    )
    start = "[initial.q]\njoint_0 = 0.0\njoint_1 = 0.0\njoint_2 = 0.0\n"
    run = simulate(tmp_path / "m", f'<robot name="m"><link name="base"/>{arms}</robot>', "", start, 0.02)
    drawn = objects(run)
    (plate,) = [obj for path, obj in drawn.items() if path.startswith("base/plate")]
    assert len([path for path in drawn if path.startswith("base/post")]) == posts
    low, high = bounds(plate, 2)
    assert high - low < 2 * RADIUS * run.mechanism.size, "level"
    assert high < 0 if posts else low < 0 < high


def test_camera_has_the_desired_motion_in_view(run: Callable[..., ckc_pin.Run]) -> None:
    """The desired pose begins far from the actual one, 1.4 rad; its elbow is at 0.6 m to the right, 0 m."""
    short = run("five_bar/tracking", t_end=0.02)
    drawing = draw_runs_3d([short])
    view = np.array(next(c["matrix"] for c in drawing if c.get("path") == "/world")).reshape(4, 4).T
    (position,) = [c["value"] for c in drawing if c.get("property") == "position"]
    (angle,) = [c["value"] for c in drawing if c.get("property") == "fov"]
    half = np.linalg.norm(position) * np.tan(np.radians(angle / 2))
    ghost_elbow = view @ [0.3048 + 0.2794, 0.0, 0.0, 1.0]
    assert np.abs(ghost_elbow[[0, 2]]).max() < 0.95 * half


def test_ground_of_three_points_is_projected_as_one_area() -> None:
    run = ckc_pin.simulate("three_rrr", {"t_end": 0.02})
    poses = compute_placements(run.mechanism, pinocchio_configurations(run))
    shapes = find_link_shapes(run.mechanism, poses)
    (plane,) = projection_planes(run.mechanism)
    assert project_base(shapes, plane).ground.shape == (3, 2)
    assert len(project_outline(run.mechanism, shapes, poses.select_row(0), plane).bars) == 6  # none of them the base's
