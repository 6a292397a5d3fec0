"""Priors of parameters, and the advice for parameters without a value."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, identify
from tests.identification.test_motions import DISSIPATION, measure, run_five_bar
from tests.identification.test_torques import ROD, record

LINK = ["link.rod.inertial"]
COMBINED_MOMENT = 1.5 * 0.4 + 0.7 * 0.82  # kg m, of rod and weight


def swing(amplitude, frequency, noise=0.0):
    """Return a motion of the rod with its weight welded on, and its torques by hand."""
    t = np.linspace(0, 10, 2001)
    q, a = (sign * amplitude * np.sin(frequency * t) for sign in (1.0, -(frequency**2)))
    about = 0.03 + 1.5 * 0.4**2 + 0.002 + 0.7 * (0.82**2 + (0.01 * np.cos(0.3)) ** 2)
    height = 0.7 * 0.01 * np.cos(0.3)
    tau = about * a - 9.81 * (COMBINED_MOMENT * np.cos(q) + height * np.sin(q))
    return {"t": t, "hinge": q, "tau.hinge": tau + noise * np.random.default_rng(0).normal(size=len(t))}


def test_prior_gives_what_data_leave_open_and_says_so():
    """The torques of a slow swing depend on the first moment only; by hand, mass and centre share its error."""
    data = swing(0.8, 0.3, 0.5)
    prior = {"link.rod.mass": "5 %", "link.rod.com.x": 0.02, "link.rod.inertia.iyy": 0.01}
    result = identify(Mechanism.from_urdf(ROD), data, LINK, prior=prior, physical=False)
    mass, centre, inertia = (result.parameters[f"link.rod.{key}"] for key in ("mass", "com.x", "inertia.iyy"))
    assert (mass.verdict, inertia.verdict) == ("identified with a prior", "prior only")
    # m c is known exactly, and m and c have prior deviations of 0.075 kg and 0.02 m.
    shared = (0.4**2 / 0.075**2**1 * 0.0 + 1 / 0.075**2 + (0.4 / 1.5) ** 2 / 0.02**2) ** -0.5
    assert mass.std == pytest.approx(shared, rel=0.02)
    assert centre.std == pytest.approx(shared * 0.4 / 1.5, rel=0.02)
    assert inertia.std == pytest.approx(0.01, rel=0.01)
    assert inertia.value == pytest.approx(0.03, abs=1e-4)
    assert result.parameters["link.rod.inertia.ixy"].value is None
    without = identify(Mechanism.from_urdf(ROD), data, LINK, physical=False)
    assert [str(x) for x in without.base] == [str(x) for x in result.base]
    assert without.parameters["link.rod.mass"].value is None


def test_prior_does_not_move_what_data_determine():
    data = record("five_bar", 1e-4, 0.01)
    names = ["joint.*.friction", "joint.*.damping"]
    free, bound = (identify("five_bar", data, names, prior=prior) for prior in ({}, {"joint.*.friction": 1.0}))
    for name, x in free.parameters.items():
        assert bound.parameters[name].verdict == x.verdict == "identified"
        assert bound.parameters[name].value == pytest.approx(x.value, abs=1e-3 * x.std)
    strong = identify("five_bar", data, names, prior={"joint.theta_1.friction": 1e-6})
    assert strong.parameters["joint.theta_1.friction"].value == pytest.approx(0.0, abs=1e-5)


def test_prior_in_a_fit_of_motion_sets_the_scale_of_masses():
    """A free swing tells ratios of masses and friction only."""
    names = ["link.link_1.mass", "link.link_2.mass", *DISSIPATION]
    data = measure(run_five_bar(), noise=1e-4)
    everything = ["link.link_3.mass", "link.link_4.mass", *names]
    free = identify("five_bar", data, everything, method="motion")
    assert {x.missing for x in free.parameters.values()} == {
        "motor torques would tell it; without them only ratios of masses and friction are known"
    }
    result = identify("five_bar", data, everything, method="motion", prior={"link.link_3.mass": "1 %"})
    for name, estimate in result.parameters.items():
        assert estimate.verdict == ("prior only" if name == "link.link_3.mass" else "identified with a prior")
    assert result.parameters["link.link_3.mass"].std == pytest.approx(0.01 * 0.2451, rel=0.05)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"link.rod.mass": 0.0}, r"prior: link.rod.mass: expected a number above zero or a part as \"5 %\", got 0.0"),
        ({"link.rod.mass": "5"}, r"expected a number above zero or a part as \"5 %\", got '5'"),
        ({"link.rod.com.y": "5 %"}, r"link.rod.com.y: its start value is 0, of which 5 % is nothing; give a number"),
        ({"link.arm.mass": 1.0}, r"prior: nothing is called 'link.arm.mass'; there are link.\*.mass"),
    ],
)
def test_bad_priors_have_one_message(prior, message):
    with pytest.raises(InputError, match=message):
        identify(Mechanism.from_urdf(ROD), swing(0.8, 0.3), LINK, prior=prior)


def test_missing_motion_is_named():
    slow = identify(Mechanism.from_urdf(ROD), swing(0.8, 0.3, 0.05), LINK, physical=False)
    assert slow.missing == ("larger accelerations of hinge would tell it",)
    fast = identify(Mechanism.from_urdf(ROD), swing(0.8, 5.0, 0.05), LINK, physical=False)
    assert fast.missing == ()
    for name, missing in (("mass", "no motion of this mechanism determines it"),
                          ("com.x", "no motion of this mechanism determines it alone")):  # fmt: skip
        assert slow.parameters[f"link.rod.{name}"].missing == missing


def test_joint_at_rest_has_to_move():
    t = np.linspace(0, 5, 500)
    tau = -9.81 * COMBINED_MOMENT * np.cos(0.3) + 0.01 * np.random.default_rng(0).normal(size=len(t))
    data = {"t": t, "hinge": np.full_like(t, 0.3), "tau.hinge": tau}
    result = identify(Mechanism.from_urdf(ROD), data, ["joint.hinge.damping"])
    assert result.parameters["joint.hinge.damping"].verdict == "not identifiable"
    assert result.parameters["joint.hinge.damping"].missing == "a faster motion of hinge would tell it"
