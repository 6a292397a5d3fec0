"""Other programs on slides, many turns, springs, forces and bushings."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from ckc_pin.analysis.precision.mujoco import load_model
from ckc_pin.formats.exporting import export
from ckc_pin.run.simulate import simulate
from scripts.experiments.benchmark.peers import Peer, peers
from scripts.experiments.benchmark.peers.environments import SOURCES, program_peers
from scripts.experiments.benchmark.peers.exudyn_plane import in_plane
from scripts.experiments.benchmark.peers.protocol import ProgramPeer
from scripts.experiments.benchmark.work import WORKS, Work

BY_KEY = {work.key: work for work in WORKS}
EXUDYN = next(peer for peer in peers() if peer.name == "Exudyn")
MUJOCO = next(peer for peer in peers() if peer.name == "MuJoCo")
# The programs that have environments of their own, here with the versions of the main environment.
DRAKE, MUJOCO_PROGRAM = (ProgramPeer(f"{sys.executable} {SOURCES / x}") for x in ("drake_peer.py", "mujoco_peer.py"))
# Where its environment was made: CENIC of the main environment's version takes no single plant.
NEW_DRAKE = [peer for peer in program_peers() if peer.name == "Drake" and peer.version()]
SWING = Work("swing", "five-bar, free swing, 0.3 s", "five_bar/swing", 0.3)
TURNS = Work("turns", "slider-crank, 1 s, some three turns", "slider_crank", 1.0)
SPRING = Work("spring", "Andrews' squeezer, 2 ms", "andrews", 0.002)
HINGE = Work("hinge", "Bricard's six-bar, 0.2 s", "bricard", 0.2)
FREE = Work("free", "two UR5 on one bar, 0.1 s", "two_ur5", 0.1)


@pytest.mark.parametrize(
    ("peer", "work", "setting", "allowed"),
    [
        (EXUDYN, TURNS, "GeneralizedAlpha, spectral radius 0.9, dt 0.0003", 1e-2),
        (EXUDYN, TURNS, "TrapezoidalIndex2, spectral radius 1, dt 0.0003", 1e-2),
        (EXUDYN, SPRING, "GeneralizedAlpha, spectral radius 0.9, dt 1e-05", 1e-4),
        (DRAKE, SWING, "RungeKutta3, bushings, rtol 1e-04", 1e-3),
        (DRAKE, SPRING, "RungeKutta3, bushings, rtol 1e-06", 1e-2),
        (DRAKE, SWING, "SAP, rtol 1e-07", 1e-3),
        (DRAKE, FREE, "SAP, rtol 1e-07", 1e-3),
        *((drake, TURNS, "CENIC, rtol 1e-07", 2e-2) for drake in NEW_DRAKE),
        *((drake, HINGE, "CENIC, rtol 1e-05", 1e-3) for drake in NEW_DRAKE),
        *((drake, FREE, "CENIC, rtol 1e-05", 2e-3) for drake in NEW_DRAKE),
        *((drake, SWING, "CENIC, loop joints, rtol 1e-05", 2e-3) for drake in NEW_DRAKE),
        *((drake, HINGE, "CENIC, loop joints, rtol 1e-05", 2e-3) for drake in NEW_DRAKE),
        *((drake, FREE, "CENIC, loop joints, rtol 1e-05", 2e-3) for drake in NEW_DRAKE),
        (MUJOCO_PROGRAM, TURNS, "RK4, solref 2 dt, rtol 1e-06", 1e-3),
        (MUJOCO_PROGRAM, SPRING, "RK4, solref 4 dt, rtol 1e-07", 1e-3),
        (MUJOCO_PROGRAM, HINGE, "RK4, solref 4 dt, rtol 1e-06", 1e-5),
        (MUJOCO_PROGRAM, FREE, "RK4, solref 4 dt, rtol 1e-06", 1e-5),
        (MUJOCO, TURNS, "RK4, solref 2 dt, dt 0.0003", 1e-3),
        (MUJOCO, TURNS, "discrete, solref 2 dt, dt 2.5e-05", 1e-2),
        (MUJOCO, SPRING, "RK4, solref 4 dt, dt 1e-05", 1e-3),
    ],
)
def test_program_computes_the_same_motion(peer: Peer, work: Work, setting: str, allowed: float) -> None:
    run = simulate(work.load(formulation="dae", solver__rtol=1e-10))
    motion = peer.compute(work, setting, 60.0)
    assert motion.status == "done", motion.reason
    assert np.abs(motion.q_tree - run.q_tree).max() < allowed
    assert np.abs(motion.v_tree - run.v_tree).max() < allowed * max(1.0, float(np.abs(run.v_tree).max()))


@pytest.mark.parametrize("key", ["andrews", "bricard", "chains_5_5", "pendulum", "swing", "two_ur5"])
def test_programs_with_environments_have_the_same_mechanism(key: str) -> None:
    """The soft constraints of MuJoCo do not see J_dot v exactly; Drake's plant gives its terms to the last digits."""
    for peer, allowed in ((DRAKE, 1e-9), (MUJOCO_PROGRAM, 2e-3)):
        assert peer.missing(BY_KEY[key]) is None
        assert float(peer.check(BY_KEY[key]).rpartition(" ")[2]) < allowed


def test_program_refuses_what_it_does_not_model_and_long_runs() -> None:
    without_loops = DRAKE.compute(BY_KEY["pendulum"], "RungeKutta3, bushings, rtol 1e-03", 10.0)
    assert (without_loops.status, without_loops.reason) == ("refused", "it has no loops")
    refused = MUJOCO_PROGRAM.compute(SWING, "RK4, solref 2 dt, rtol 1e-13", 0.1)
    assert refused.status == "refused"
    assert "the budget is 0 s" in refused.reason


def test_large_models_of_mujoco_have_a_dense_constraint_jacobian_where_its_sparse_factor_is_wrong() -> None:
    """Above 60 coordinates MuJoCo chooses a sparse one by itself."""
    import mujoco

    mechanism = BY_KEY["n_four_bar_40"].mechanism
    model = load_model(export(mechanism, "mjcf").text)
    assert model.nv == mechanism.tree.n > 60
    assert mujoco.mj_isSparse(model) == (mujoco.__version__ != "4.0.0")


def test_state_round_trips_through_program() -> None:
    for work in (TURNS, SPRING):
        assert in_plane(work)
        motion = EXUDYN.compute(work, f"GeneralizedAlpha, spectral radius 0.9, dt {work.t_end / 1000}", 60.0)
        start = simulate(work.load(formulation="dae"))
        assert np.abs(motion.q_tree[0] - start.q_tree[0]).max() < 1e-12
        assert np.abs(motion.v_tree[0] - start.v_tree[0]).max() < 1e-12


@pytest.mark.parametrize("key", ["bricard", "delta", "two_ur5"])
def test_spatial_mechanisms_are_not_planar(key: str) -> None:
    assert not in_plane(BY_KEY[key])
