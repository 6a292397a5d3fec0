"""The singularity map of the five-bar against closed forms of its geometry."""

import numpy as np
import pandas
import pytest

from ckc_pin import InputError, load
from ckc_pin.analysis.map import loci as curves
from ckc_pin.analysis.map import singularity_map
from ckc_pin.analysis.map.loci import LocusSystem
from ckc_pin.kinematics.extended import extend_closure
from tests.analytic.five_bar import AS_PRINTED, FIVE_BAR
from tests.conftest import CURVE_STEP, assert_close

MODELS = {"five_bar": FIVE_BAR, "five_bar_as_printed": AS_PRINTED}
CELLS = 40


@pytest.fixture(scope="module", autouse=True)
def many_points():
    """Compute as many points of curves as for users, other than in the tests of other files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curves, "CURVE_STEP", CURVE_STEP)
        yield


@pytest.fixture(scope="module", params=MODELS)
def joint(request):
    return singularity_map(request.param, cells=CELLS, scene="tracking"), MODELS[request.param]


@pytest.fixture(scope="module")
def cartesian():
    return singularity_map("five_bar", cells=32, space="cartesian"), FIVE_BAR


def elbows(model, theta_1, theta_3):
    """World positions of both elbows, as complex numbers."""
    return model.l[0] * np.exp(1j * theta_1), model.base + model.l[2] * np.exp(1j * theta_3)


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def loci_of_kind(result, kind):
    return [locus for locus in result.loci if locus.kind == kind]


def test_reached_cells_are_where_two_circles_meet(joint):
    result, model = joint
    left, right = elbows(model, *np.meshgrid(*(axis.values for axis in result.axes), indexing="ij"))
    distance, (_, l2, _, l4) = abs(left - right), model.l
    inside = (distance <= l2 + l4) & (distance >= abs(l2 - l4))
    sure = np.minimum(abs(distance - l2 - l4), abs(distance - abs(l2 - l4))) > 1e-3
    assert len(result.aspects) == 2
    for aspect in result.aspects:
        assert np.array_equal(aspect.reached[sure], inside[sure])
        assert np.mean(aspect.reached != inside) < 2e-3


def test_table_has_the_closed_configurations_and_their_measures(joint, tmp_path):
    result, model = joint
    frame = result.to_pandas()
    angles = [f"theta_{k}" for k in (1, 2, 3, 4)]
    assert list(frame.columns) == [*angles, "tip.x", "tip.y", "tip.z", "sigma_min", "det_phi_z"]
    assert frame.index.value_counts().to_dict() == {k + 1: x.reached.sum() for k, x in enumerate(result.aspects)}
    for row in frame.sample(50, random_state=1).itertuples():
        q_tree = np.array([getattr(row, name) for name in angles])
        phi_z = model.phi_z(q_tree)
        assert_close(model.phi(q_tree), 0.0, 1e-9)
        assert_close(row.det_phi_z, np.linalg.det(phi_z), 1e-9)
        assert_close(row.sigma_min, np.linalg.norm(phi_z, -2), 1e-9)
    file = pandas.read_csv(result.to_csv(tmp_path / "map.csv"), index_col="branch")
    assert file.equals(frame)
    assert repr(result.plot()) == "Figures(map_joint)"


def test_table_of_a_map_over_places_has_the_cells(cartesian):
    result, _ = cartesian
    frame = result.to_pandas().loc[1]
    first, second = np.nonzero(result.aspects[0].reached)
    assert_close(frame["tip.x"], result.axes[0].values[first], 1e-8)
    assert_close(frame["tip.y"], result.axes[1].values[second], 1e-8)
    assert repr(result.plot()) == "Figures(map_cartesian)"


def test_det_phi_z_is_twice_the_area_of_the_distal_links_triangle(joint):
    result, model = joint
    left, right = elbows(model, *np.meshgrid(*(axis.values for axis in result.axes), indexing="ij"))
    a, b, c = abs(left - right), model.l[1], model.l[3]
    heron = np.maximum((a + b + c) * (b + c - a) * (a + c - b) * (a + b - c), 0.0) ** 0.5 / 2
    signs = []
    for aspect in result.aspects:
        there = aspect.reached
        assert_close(abs(aspect.det_phi_z[there]), heron[there], 1e-8)
        signs += set(np.sign(aspect.det_phi_z[there]))
    assert sorted(signs) == [-1.0, 1.0]  # one on each branch


def test_type_1_points_exist_for_equal_links_only(joint):
    result, model = joint
    points = loci_of_kind(result, "locked")
    if model is AS_PRINTED:
        assert points == []
        return
    at = sorted(wrap(locus.at[0]).tolist() for locus in points)
    assert_close(at, [[-0.993865, -2.147728], [0.993865, 2.147728]], 5e-7)  # the paper prints six digits
    # the elbows coincide, halfway between the bases
    x = np.arccos(model.base / 2 / model.l[0])
    assert_close(at, [[-x, x - np.pi], [x, np.pi - x]], 1e-8)
    for locus in points:
        assert locus.closed
        assert_close(locus.at, np.tile(locus.at[0], (len(locus.at), 1)), 1e-8)


def test_type_2_curves_are_where_the_distal_links_are_in_line(joint):
    result, model = joint
    stretched = [
        locus
        for locus in loci_of_kind(result, "fold")
        if abs(np.subtract(*elbows(model, *locus.at[0]))) > max(model.l[1], model.l[3])
    ]
    folded = [locus for locus in loci_of_kind(result, "fold") if not any(locus is other for other in stretched)]
    assert len(stretched) == 1
    assert len(folded) == (2 if model is AS_PRINTED else 0)  # instead of the type 1 points
    for loci, expected in ((stretched, model.l[1] + model.l[3]), (folded, abs(model.l[1] - model.l[3]))):
        for locus in loci:
            assert locus.closed
            assert_close(abs(np.subtract(*elbows(model, *locus.at.T))), expected, 1e-8)
    # the curve is complete: it goes once around in the plane of theta_1 and theta_3
    angle = np.unwrap(np.angle(stretched[0].at @ [1, 1j] - stretched[0].at.mean(axis=0) @ [1, 1j]))
    assert_close(abs(angle[-1] - angle[0]), 2 * np.pi, 1e-6)


def test_serial_loci_are_stretched_or_folded_chains(joint):
    result, model = joint
    loci = loci_of_kind(result, "serial")
    seen = set()
    for locus in loci:
        assert locus.closed
        bent = abs(np.sin(locus.q_tree[:, [1, 3]])).max(axis=0)
        chain = int(np.argmin(bent))
        assert bent[chain] < 1e-8
        seen.add((chain, bool(np.cos(locus.q_tree[0, [1, 3][chain]]) > 0)))
        reach = abs(locus.point[:, 0] + 1j * locus.point[:, 1] - chain * model.base)
        l, m = model.l[2 * chain], model.l[2 * chain + 1]
        assert min(abs(reach - l - m).max(), abs(reach - abs(l - m)).max()) < 1e-8
    assert seen == {(0, False), (0, True), (1, False), (1, True)}


def test_closest_approach_of_the_trajectory_of_eq_21(joint):
    result, model = joint
    t = np.linspace(0.0, 9.5, 200001)
    q = np.array([np.pi / 3 * np.sin(t), np.pi / 4 * (1 - np.cos(t))])
    distance = abs(np.subtract(*elbows(model, *q)))
    if model is AS_PRINTED:
        first = t[np.argmax(distance > model.l[1] + model.l[3])]
        assert result.path.leaves_at == pytest.approx(first, abs=1e-4)
        assert result.path.leaves_at == pytest.approx(4.39313, abs=1e-5)
        return
    assert result.path.leaves_at is None
    # to type 2: the distance to densely sampled points of the curve's closed form
    curve = loci_of_kind(result, "fold")[0]
    number = next(k for k, locus in enumerate(result.loci) if locus is curve)
    approach = next(a for a in result.path.approaches if a.locus == number)
    theta_1 = np.linspace(-1.5, -1.0, 200001)
    theta_3 = crossing(model, theta_1)
    distance_to_curve = np.nanmin([np.nanmin(np.hypot(x - theta_1, y - theta_3)) for x, y in q[:, 90000:110000:40].T])
    assert approach.distance == pytest.approx(distance_to_curve, abs=2e-6)
    # to type 1: a point
    for number, locus in enumerate(result.loci[:2]):
        approach = next(a for a in result.path.approaches if a.locus == number)
        x = wrap(q.T - locus.at[0])
        assert approach.distance == pytest.approx(np.hypot(*x.T).min(), abs=1e-8)


def crossing(model, theta_1):
    """The upper theta_3 with elbows l2 + l4 apart, NaN where there is none."""
    way = model.l[0] * np.exp(1j * theta_1) - model.base
    cosine = (abs(way) ** 2 + model.l[2] ** 2 - (model.l[1] + model.l[3]) ** 2) / (2 * abs(way) * model.l[2])
    with np.errstate(invalid="ignore"):
        both = [wrap(np.angle(way) + sign * np.arccos(cosine)) for sign in (1, -1)]
    distance_to_curve = [np.where(abs(angle - 0.8) < 0.7, angle, np.nan) for angle in both]
    return np.where(np.isnan(distance_to_curve[0]), distance_to_curve[1], distance_to_curve[0])


def test_cartesian_workspace_is_the_intersection_of_two_rings(cartesian):
    result, model = cartesian
    x, y = np.meshgrid(*(axis.values for axis in result.axes), indexing="ij")
    inside, sure = np.ones(x.shape, bool), np.ones(x.shape, bool)
    for base, (l, m) in ((0.0, model.l[:2]), (model.base, model.l[2:])):
        reach = abs(x - base + 1j * y)
        inside &= (reach <= l + m) & (reach >= abs(l - m))
        sure &= (abs(reach - l - m) > 1e-4) & (abs(reach - abs(l - m)) > 1e-4)
    assert len(result.aspects) == 4
    modes = set()
    for aspect in result.aspects:
        assert np.array_equal(aspect.reached[sure], inside[sure])
        elbow = np.sign(np.sin(aspect.q_tree[aspect.reached][:, [1, 3]]))
        assert_close(elbow, np.tile(elbow[0], (len(elbow), 1)), 0.0)  # one working mode throughout
        modes.add(tuple(elbow[0]))
        place = aspect.point[aspect.reached]
        assert_close(place, np.column_stack([x[aspect.reached], y[aspect.reached], 0 * x[aspect.reached]]), 1e-8)
    assert len(modes) == 4


def test_cartesian_type_1_is_a_circle_around_the_elbows(cartesian):
    result, model = cartesian
    circles = loci_of_kind(result, "locked")
    assert len(circles) == 2
    height = np.sqrt(model.l[0] ** 2 - model.base**2 / 4)
    for locus in circles:
        centre = model.base / 2 + 1j * height * np.sign(locus.point[:, 1].mean())
        assert_close(abs(locus.point[:, 0] + 1j * locus.point[:, 1] - centre), model.l[1], 1e-8)


@pytest.mark.parametrize("name", ["five_bar", "three_rrr", "delta", "stewart"])
def test_jacobian_of_the_equations_equals_finite_differences(name):
    """Also for a free root, whose velocities are in rotating axes."""
    mechanism = load(name)
    extended = extend_closure(mechanism, next(iter(mechanism.points)))
    random = np.random.default_rng(5)
    fixed = extended.joints[2:]
    for serial in (False, True):
        system = LocusSystem(extended, serial, fixed, np.zeros(len(fixed)))
        step = random.uniform(-0.3, 0.3, mechanism.n)
        at = extended.kinematics(mechanism.tree.integrate(mechanism.q_tree, step))
        v, e = random.normal(size=(2, mechanism.n))
        h = 1e-6
        there = [system.residual(at.integrate(s * h * e), v) for s in (1, -1)]
        numeric = (there[0] - there[1]) / (2 * h)
        assert_close(system.jacobian(at, v)[:, : mechanism.n] @ e, numeric, 1e-7 * max(1.0, abs(numeric).max()))


def test_maps_over_one_coordinate_and_with_fixed_coordinates():
    crank = singularity_map("slider_crank", cells=32)
    assert crank.aspects[0].reached.all()
    assert sorted(round(abs(wrap(locus.at[0, 0] + 1e-9)), 6) for locus in crank.loci) == [0, 0, 3.141593, 3.141593]
    fixed = singularity_map("three_rrr", over=["a_3", "a_1"], cells=16)
    assert [axis.name for axis in fixed.axes] == ["a_3", "a_1"]
    assert fixed.fixed == {"a_2": pytest.approx(1.419)}
    mechanism = load("three_rrr")
    for locus in fixed.loci:
        assert_close(locus.q_tree[:, mechanism.coordinates.index("a_2")], 1.419, 1e-9)
        for q_tree in locus.q_tree[:: max(1, len(locus.q_tree) // 20)]:
            at = mechanism.kinematics(q_tree)
            assert abs(at.phi).max() < 1e-10
            if locus.kind == "fold":
                assert at.sigma_min() < 1e-9
    assert {locus.kind for locus in fixed.loci} == {"fold", "serial"}


def test_map_serializes_to_a_dict(joint):
    result, _ = joint
    data = result.to_dict()
    assert data["axes"][0] == {"name": "theta_1", "unit": "rad", "low": -np.pi, "high": np.pi, "cells": CELLS}
    assert data["desired"]["leaves_at"] == result.path.leaves_at
    assert [locus["kind"] for locus in data["loci"]] == [locus.kind for locus in result.loci]


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("five_bar", {"over": ["theta_2"]}, "unknown coordinate 'theta_2'; expected one or two of theta_1, theta_3"),
        ("five_bar", {"over": ["theta_1", "theta_1"]}, "one or two different names"),
        ("five_bar", {"space": "polar"}, "expected joint or cartesian"),
        ("five_bar", {"point": "elbow"}, "no point 'elbow' in five_bar; there are tip"),
        ("five_bar", {"cells": 5}, "expected 16 to 2000"),
        ("five_bar", {"scene": "swing"}, "it has no desired trajectory"),
        ("five_bar", {"scene": "three_rrr/circle"}, "its mechanism is three_rrr, the map's is five_bar"),
        ("andrews", {"space": "cartesian", "point": "nowhere"}, "no point 'nowhere' in andrews"),
        ("three_rrr", {"space": "cartesian", "over": ["x", "rz"]}, "one or two of x, y"),
        ("delta", {"cells": 2000}, "may have at most"),
    ],
)
def test_invalid_maps_are_refused_in_one_sentence(name, options, says):
    with pytest.raises(InputError, match=says) as error:
        singularity_map(name, **options)
    assert "\n" not in str(error.value)
