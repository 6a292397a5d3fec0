"""Exploring a branch: the flood of a lattice, rays, least values and following, on chains whose answers are known."""

from __future__ import annotations

import numpy as np

from ckc_pin.kinematics.sigma import sigma
from scripts.experiments.certificate.branch_walk import (
    find_minimum,
    follow,
    margin,
    same_configuration,
    wrapped_difference,
)
from scripts.experiments.certificate.exploration import explore
from scripts.experiments.tests.set_point_cases import pendulum
from tests.conftest import Pair, assert_close


def test_flood_explores_disc_and_its_edges() -> None:
    mechanism = pendulum(2)
    centre = mechanism.assembled
    explored = explore(mechanism, centre, np.full(2, 0.1), lambda at: float(np.sum(at.q_tree**2)), 1.0)
    lattice = [(i, j) for i in range(-12, 13) for j in range(-12, 13) if 0.01 * (i * i + j * j) <= 1]
    assert len(explored.nodes) == len(lattice)
    assert len(explored.edges) == sum((i + 1, j) in lattice for i, j in lattice) * 2
    assert explored.water == sorted(explored.water)
    assert not explored.ends
    assert not explored.sampled
    assert not explored.truncated


def test_node_behind_ridge_has_level_of_ridge() -> None:
    """A node behind a ridge is connected at the ridge's height, not at its own."""
    mechanism = pendulum(1)

    def height(at) -> float:
        return float(np.sin(at.q_tree[0]) ** 2)

    explored = explore(mechanism, mechanism.assembled, np.full(1, 0.1), height, 2.0, np.array([63]))
    far = min(range(len(explored.nodes)), key=lambda k: abs(explored.nodes[k].q_tree[0] - 3.1))
    assert np.sin(explored.nodes[far].q_tree[0]) ** 2 < 0.01
    assert_close(explored.water[far], 1.0, 0.01)
    assert len(explored.nodes) == 63  # the lattice meets itself after a turn


def test_rays_stay_below_level() -> None:
    mechanism = pendulum(3)
    explored = explore(mechanism, mechanism.assembled, np.full(3, 0.2), lambda at: float(np.sum(at.q_tree**2)), 1.0)
    radii = np.array([np.linalg.norm(at.q_tree) for at in explored.nodes])
    assert explored.sampled
    assert radii.max() <= 1.0 < radii.max() + 0.2
    directions = np.array([np.sign(at.q_tree) for at in explored.nodes[1:]])
    assert len(np.unique(directions, axis=0)) == 8


def test_find_minimum_reaches_constrained_minimum() -> None:
    mechanism = pendulum(2)
    minimum = find_minimum(
        mechanism,
        sigma(mechanism, np.array([1.0, 1.0])).at,
        lambda at: float(1 + np.sum(at.q_tree**2)),
        np.full(2, 0.1),
        lambda at: at if at.q_tree[0] >= 0.5 else None,
    )
    assert_close(minimum.q_tree, [0.5, 0.0], 3e-3)


def test_follow_stops_at_end_of_branch(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    at, reached = follow(mechanism, sigma(mechanism, np.array([0.0, 0.5])).at, np.array([3.0, -0.5]))
    assert 0 < reached < 1
    assert margin(at) < 0.01
    back, whole = follow(mechanism, at, np.array([0.0, 0.5]) - mechanism.independent_part(at.q_tree))
    assert whole == 1.0
    assert_close(mechanism.independent_part(back.q_tree), [0.0, 0.5], 1e-12)
    turned = mechanism.kinematics(back.q_tree + np.array([0, 2 * np.pi, 0, 0]))
    assert same_configuration(mechanism, back, turned)
    assert_close(wrapped_difference(mechanism, back, turned), np.zeros(2), 1e-12)
