"""Fuzz suite for contact: its references against closed forms, and its checks on correct and wrong runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from scripts.experiments.fuzz.contact import checks, comparisons
from scripts.experiments.fuzz.contact.cases import Case
from scripts.experiments.fuzz.contact.law import apply_impact_law
from scripts.experiments.fuzz.contact.record import Record, check_seed, draw
from scripts.experiments.fuzz.contact.slides import Slides
from scripts.experiments.fuzz.contact.stops import Contact
from scripts.experiments.fuzz.contact.table import format_table
from scripts.experiments.fuzz.contact.time_stepping import TimeStepping
from scripts.experiments.fuzz.main import main
from scripts.experiments.fuzz.read import read_model
from scripts.experiments.fuzz.reference import ReferenceIntegrator
from scripts.experiments.fuzz.spatial import Array
from tests.conftest import assert_close

G = 9.81


def stack(masses: list[float], gravity: float = 0.0) -> dict[str, str]:
    """Return the files of sliders on top of each other along x, with gravity along -x."""
    parts, above = ['<link name="base"/>'], "base"
    for k, mass in enumerate(masses):
        parts.append(
            f'<link name="b{k}"><inertial><mass value="{mass!r}"/>'
            '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="x{k}" type="prismatic"><parent link="{above}"/><child link="b{k}"/>'
            '<axis xyz="1 0 0"/></joint>'
        )
        above = f"b{k}"
    mechanism = f'name = "m"\nurdf = "m.urdf"\ngravity = [{-gravity!r}, 0.0, 0.0]\n'
    return {"mechanism.toml": mechanism, "m.urdf": f'<robot name="m">{"".join(parts)}</robot>'}


def impact_velocities(masses: list[float], rates: list[float], e: list[float]) -> tuple[Array, float]:
    """Return world velocities after the impact of a stack without gaps, and the energy lost."""
    bodies = np.tril(np.ones((len(masses), len(masses))))
    impact = apply_impact_law(bodies.T @ np.diag(masses) @ bodies, np.eye(len(masses)), np.array(rates), np.array(e))
    return bodies @ impact.v, impact.lost


def test_impact_law_propagates_through_a_cradle() -> None:
    """Equal masses in contact: the last one leaves at the speed of the first."""
    after, lost = impact_velocities([1.0] * 4, [0.0, 0.0, 0.0, -1.0], [1.0] * 4)
    # the last body hits the stack, the first one bounces off the ground, and the last one leaves the stack
    assert_close(after, [0.0, 0.0, 0.0, 1.0], 1e-14)
    assert lost == 0.0


@pytest.mark.parametrize("seed", range(40))
def test_impact_law_leaves_no_stop_approaching_and_balances_energy(seed: int) -> None:
    random = np.random.default_rng(seed)
    n, m = int(random.integers(1, 6)), int(random.integers(1, 7))
    root = random.normal(size=(n, n)) * 10 ** random.uniform(-2, 2, n)
    D, N, v = root @ root.T + 1e-3 * np.eye(n), random.normal(size=(m, n)), random.normal(size=n)
    e = random.choice([0.0, 0.5, 1.0, 0.9], m)
    for rechoose in (False, True):
        impact = apply_impact_law(D, N, v, e, rechoose=rechoose)
        size = np.sqrt(v @ D @ v)
        assert np.all(
            N @ impact.v >= -1e-9 * size * np.linalg.norm(np.linalg.solve(np.linalg.cholesky(D), N.T), axis=0)
        )
        assert impact.lost >= 0.0
        assert_close(0.5 * impact.v @ D @ impact.v + impact.lost, 0.5 * size**2, 1e-9 * size**2)


def test_a_single_impact_obeys_newtons_law() -> None:
    random = np.random.default_rng(3)
    root = random.normal(size=(3, 3))
    D, n, v = root @ root.T, random.normal(size=(1, 3)), random.normal(size=3)
    v = v if (n @ v)[0] < 0 else -v
    impact = apply_impact_law(D, n, v, np.array([0.3]))
    assert_close(n @ impact.v, -0.3 * n @ v, 1e-12)
    assert_close(impact.lost, 0.5 * (1 - 0.09) * (n @ v) ** 2 / (n @ np.linalg.solve(D, n.T)), 1e-12)


@pytest.mark.parametrize(("k", "count"), [(0, 3), (1, 31), (2, 314)])
def test_reference_of_slides_counts_collisions_that_give_pi(k: int, count: int) -> None:
    """A unit mass between a wall and a mass of 100^k has floor(pi 10^k) impacts."""
    model = read_model(stack([1.0, 100.0**k]))
    elastic = Contact(lower=0.0, restitution=1.0)
    history = Slides(model, {"x0": elastic, "x1": elastic}).run(np.array([1.0, 1.0]), np.array([0.0, -1.0]), 20.0)
    assert len(history.impacts) == count


def test_reference_of_slides_agrees_with_closed_forms() -> None:
    model = read_model(stack([2.0], G))
    history = Slides(model, {"x0": Contact(lower=0.0, restitution=0.5)}).run(np.array([1.0]), np.zeros(1), 2.0)
    flight = np.sqrt(2 / G)
    ends = flight + np.cumsum(np.r_[0.0, flight * 2 * 0.5 ** np.arange(1, 30)])
    times = [t for t, _ in history.impacts]
    assert len(times) > 10
    assert_close(times, ends[: len(times)], 1e-12)
    rubbing = Slides(model, {"x0": Contact(friction=30.0)}).run(np.zeros(1), np.array([3.0]), 2.0)
    stops_after = 3.0 / (G + 15.0)  # 30 N of friction on 2 kg; then the joint sticks
    q, v = rubbing.at(np.array([stops_after + 0.1]))
    assert_close(q[0, 0], 1.5 * stops_after, 1e-12)
    assert_close(v[0, 0], 0.0, 0.0)


def test_time_stepping_converges_to_the_reference_of_slides() -> None:
    model = read_model(stack([1.0, 3.0], G))
    contacts = {"x0": Contact(0.7, 0.0, np.inf, 0.6), "x1": Contact(2.0, 0.0, np.inf, 0.3)}
    q, v, end = np.array([0.05, 0.1]), np.array([-0.4, 0.2]), 0.15
    history = Slides(model, contacts).run(q, v, end)
    assert history.certain_until > end
    assert [joints for _, joints in history.impacts] == [("x0",), ("x1",)]
    exact, _ = history.at(end * np.arange(1, 11) / 10)
    errors = [np.abs(TimeStepping(model, contacts).run(q, v, end, n, 10) - exact).mean() for n in (400, 1600)]
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 2  # first order, but not smoothly: impacts are rounded to a step


def test_time_stepping_converges_on_closed_chains_without_contact() -> None:
    """Without contact the scheme integrates the same equations as the reference integrator."""
    model = read_model(dict(ckc_pin.load("five_bar").sources.texts))
    at = ckc_pin.load("five_bar").assembled
    order = [ckc_pin.load("five_bar").coordinates.index(label) for label in model.labels]
    q, v = at.q_tree[order], (at.rho @ np.array([1.0, -2.0]))[order]
    end = ReferenceIntegrator(model).integrate_segments(q[None], v[None], np.array([0.2]), 1e-9)
    assert end.resolved.all()
    errors = [np.abs(TimeStepping(model, {}).run(q, v, 0.2, n, 1)[-1] - end.q[0]).max() for n in (50, 200)]
    assert errors[0] < 1e-2
    assert errors[1] < errors[0] / 3


def bouncing(tmp_path: Path) -> tuple[Case, ckc_pin.Run]:
    contacts = {"x0": Contact(0.0, 0.0, np.inf, 0.5), "x1": Contact(0.0, 0.0, np.inf, 0.8)}
    overrides = {
        "t_end": 0.4,
        "solver.rtol": 1e-11,
        "initial": {"q": {"x0": 0.1, "x1": 0.1}, "q_dot": {"x0": 0.0, "x1": 0.0}},
    }
    case = Case(0, "stack", stack([1.0, 2.0], G), contacts, overrides, linear=True)
    return case, ckc_pin.simulate(case.write(tmp_path / "case"), overrides)


def test_checks_accept_a_correct_run_and_reject_wrong_ones(tmp_path: Path) -> None:
    case, run = bouncing(tmp_path)
    model = read_model(case.texts)
    assert len(run.events) >= 2
    assert checks.check_energy(run, model, case) == ("", "")
    assert checks.check_limits(run, case) == ""
    assert comparisons.compare_with_event_driven(run, model, case) == ("", "")
    bouncier = {**case.contacts, "x0": Contact(0.0, 0.0, np.inf, 0.6)}
    other = replace(case, contacts={**case.contacts, "x1": Contact(0.0, 0.0, np.inf, 0.81)})
    assert comparisons.compare_with_event_driven(run, model, other)[0] == "reference"
    assert comparisons.compare_with_time_stepping(run, model, case) == ("", "")
    assert comparisons.compare_with_time_stepping(run, model, replace(case, contacts=bouncier))[0] == "stepping"
    faster = replace(run, v_tree=run.v_tree * np.linspace(1, 1.001, len(run.t))[:, None])
    assert checks.check_energy(faster, model, case)[0] in ("grown", "energy")
    assert run.dissipated is not None
    assert checks.check_energy(replace(run, dissipated=-run.dissipated), model, case)[0] == "dissipated"
    assert checks.check_limits(replace(run, q_tree=run.q_tree - 1e-6), case).startswith("x0 is 1e-06 beyond")
    assert comparisons.compare(run, run, model, 1e-8).fault == ""
    assert comparisons.compare(run, faster, model, 1e-8).fault.startswith("states")
    later = [{**event, "t": event["t"] + 1e-6} for event in run.events]
    assert "bounces" in comparisons.compare(run, replace(run, events=later), model, 1e-8).fault
    assert "inf" in comparisons.compare(run, replace(run, events=run.events[:1]), model, 1e-8).fault


@pytest.mark.parametrize("kind", ["pendulums", "closed"])
def test_runs_of_random_chains_are_correct(kind: str) -> None:
    record = check_seed(1, kind)
    assert record.faults == [], record
    assert record.runs >= 3


def test_a_seed_always_draws_the_same_case() -> None:
    for seed in range(4):
        assert draw(seed) == draw(seed)


def test_table_names_the_seeds_of_wrong_runs() -> None:
    record = Record(17, "stack", runs=3, compared=True)
    record.add("grown", "dae", "energy grows by 0.1 of the largest")
    text = format_table([record, Record(18, "stack", runs=3, compared=True)])
    assert "1 seeds: 17" in text
    assert "seed 17 stack (dae): energy grows by 0.1" in text


def test_fuzz_command_runs_seeds_and_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = tmp_path / "rows.csv"
    assert main(["--contact", "--kind", "truss", "--seed", "2000", "--runs", "2", "--out", str(rows)]) == 0
    assert "formulations agree in 100.00 % of 2 cases" in capsys.readouterr().out
    assert [line.split(",")[:2] for line in rows.read_text().splitlines()[1:]] == [
        ["2000", "trusses"],
        ["2001", "trusses"],
    ]
