"""Domains of the formulations, and the path of eq. 21, against closed forms of the numpy five-bar."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from ckc_pin import Run, load
from ckc_pin.mechanism.configuration import Psi
from scripts.experiments.paper.along_eq21 import approach, tracking
from scripts.experiments.paper.domain import check_psi, off_manifold
from scripts.experiments.paper.five_bar import elbow_distance, links
from tests.analytic.five_bar import AS_PRINTED, FIVE_BAR, FiveBar, desired
from tests.conftest import Pair, assert_close


def elbows(model: FiveBar, t: float) -> float:
    (one, three), *_ = desired(t)
    left = model.l[0] * np.exp(1j * one)
    right = model.base + model.l[2] * np.exp(1j * three)
    return float(abs(right - left))


def test_links_equal_table_I(pair: Pair) -> None:
    mechanism, model = pair
    lengths = links(mechanism)
    assert_close([lengths.l1, lengths.l2, lengths.l3, lengths.l4, lengths.base], [*model.l, model.base], 1e-15)
    assert_close(elbow_distance(lengths, *desired(1.7)[0]), elbows(model, 1.7), 1e-15)


def test_psi_is_singular_with_phi_z(pair: Pair) -> None:
    mechanism, model = pair
    check = check_psi(mechanism, states=50)
    assert max(check.determinant, check.rho, check.singular) < 1e-10
    assert check.norm > 1.0
    # the two determinants, one from the package's Psi, one from the appendix
    q_tree = np.array([0.3, -1.1, 2.0, 0.7])
    jacobian = Psi(mechanism.kinematics(q_tree)).jacobian
    assert_close(abs(np.linalg.det(jacobian)), abs(np.linalg.det(model.phi_z(q_tree))), 1e-15)


def test_default_links_can_follow_eq_21() -> None:
    path = approach(*tracking("five_bar"))
    widest = minimize_scalar(lambda t: -elbows(FIVE_BAR, t), bounds=(4, 5), method="bounded", options={"xatol": 1e-12})
    assert path.leaves_at is None
    assert path.out is None
    assert_close([path.elbows, path.elbows_t], [-widest.fun, widest.x], 1e-6)
    assert_close(path.elbows, 0.5704, 5e-5)
    dets = [abs(np.linalg.det(FIVE_BAR.phi_z(FIVE_BAR.sigma(desired(t)[0])))) for t in np.linspace(0, 9.5, 4001)]
    assert_close(path.det, min(dets), 1e-7)
    assert_close(path.det, 0.0482, 5e-5)
    assert_close(path.reach, 0.6096, 1e-12)


def test_printed_links_leave_workspace_on_eq_21() -> None:
    path = approach(*tracking("five_bar_as_printed"))
    reach = AS_PRINTED.l[1] + AS_PRINTED.l[3]
    out = [brentq(lambda t: elbows(AS_PRINTED, t) - reach, *ends, xtol=1e-13) for ends in ((4.0, 4.65), (4.65, 5.2))]
    assert path.out is not None
    assert path.leaves_at is not None
    assert_close(path.out, out, 1e-9)
    assert_close(path.leaves_at, out[0], 1e-9)
    assert_close(out, [4.39313, 4.90338], 1e-5)
    assert_close([path.elbows, path.elbows_t], [0.5958, 4.652], 5e-4)
    assert np.isnan(path.det)


def test_run_with_printed_links_stops_at_workspace_boundary(run: Callable[..., Run]) -> None:
    stopped = run("five_bar_as_printed/tracking", solver__rtol=1e-6)
    assert stopped.status == "stopped"
    assert "phi_z is singular" in stopped.message
    assert_close(stopped.t[-1], 4.341, 1e-3)
    assert len(stopped.t) > 200  # everything up to there is kept


def test_eq_8_cannot_continue_without_closed_configuration() -> None:
    mechanism = load("five_bar")
    beyond = off_manifold(mechanism, reachable=False, count=4)
    assert beyond.sigma_min.min() > 0
    assert not beyond.arrived.any()
    assert beyond.layers.max() < 20.0
    over = off_manifold(mechanism, reachable=True, count=4)
    assert over.arrived.all()
    assert_close(over.layers, 20.0, 1e-9)
