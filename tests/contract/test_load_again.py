"""Mechanisms that are loaded again come from a cache as independent copies."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import load
from ckc_pin.kinematics import loading
from ckc_pin.mechanism.library import library


def mine(folder: Path, name: str = "five_bar") -> Path:
    return Path(shutil.copytree(library() / name, folder / name)) / "mechanism.toml"


def test_mechanism_is_built_once(tmp_path: Path, monkeypatch) -> None:
    built, assemble_mechanism = [], loading.assemble_mechanism
    monkeypatch.setattr(loading, "assemble_mechanism", lambda *args: built.append(1) or assemble_mechanism(*args))
    path = mine(tmp_path)
    first, again = load(path), load(path)
    assert len(built) == 1
    assert again.independent == first.independent
    assert np.array_equal(again.q_tree, first.q_tree)
    assert again.sources.texts == first.sources.texts


def test_changed_file_is_read_again(tmp_path: Path) -> None:
    path = mine(tmp_path)
    before = load(path)
    urdf = path.parent / "five_bar.urdf"
    text = urdf.read_text()
    mass = text.split('<mass value="')[1].split('"')[0]
    urdf.write_text(text.replace(f'<mass value="{mass}"', '<mass value="7.5"', 1))
    after = load(path)
    assert 7.5 in [inertia.mass for inertia in after.tree.model.inertias]
    assert 7.5 not in [inertia.mass for inertia in before.tree.model.inertias]
    path.write_text(path.read_text() + "\n# a remark\n")
    assert load(path).sources.texts["mechanism.toml"].endswith("# a remark\n")


def test_loaded_mechanisms_do_not_share_mutable_data(tmp_path: Path) -> None:
    path = mine(tmp_path)
    state = ({"theta_1": -1.2, "theta_3": -1.9}, {"theta_1": 0.4, "theta_3": -0.3})
    first = load(path)
    cached = ckc_pin.terms(first, *state).D.copy()
    first.tree.model.inertias[1].mass = 50.0
    first.tree.model.gravity.linear = np.zeros(3)
    first.q_tree[:] = 0.0
    first.springs.joint_stiffness[:] = 1e3
    second = load(path)
    assert second.tree is not first.tree
    assert np.array_equal(ckc_pin.terms(second, *state).D, cached)
    assert second.tree.model.gravity.linear[1] != 0.0
    assert second.q_tree.any()
    assert not second.springs.joint_stiffness.any()


def test_copies_have_separate_workspaces() -> None:
    one, other = load("delta"), load("delta")
    placements, _ = one.tree.kinematics(one.q_tree)
    q_tree = other.tree.integrate(other.q_tree, 0.1 * np.ones(other.n))
    other.tree.kinematics(q_tree)
    ours = one.tree._workspace.oMi[5].translation
    assert not np.array_equal(ours, other.tree._workspace.oMi[5].translation)
    assert np.array_equal(placements[5, 9:], ours)
    assert other.springs.tree is other.tree


def test_workspace_is_allocated_on_demand() -> None:
    """The mechanisms of the cache have none, and only a full one takes about n^3 numbers."""
    load("delta")
    assert all(not {"data", "_workspace"} & set(vars(kept.tree)) for kept in loading.cache.values())
    again = load("delta")
    assert not {"data", "_workspace"} & set(vars(again.tree))
    again.tree.kinematics(again.q_tree)
    assert "_workspace" in vars(again.tree)
    assert "data" not in vars(again.tree)


def test_cache_has_a_limited_size(tmp_path: Path, monkeypatch) -> None:
    """Mechanisms loaded long ago are rebuilt; recent ones are copied."""
    paths = [mine(tmp_path / str(k), "slider_crank") for k in range(loading.cache.capacity + 3)]
    for path in paths:
        load(path)
    built, assemble_mechanism = [], loading.assemble_mechanism
    monkeypatch.setattr(loading, "assemble_mechanism", lambda *args: built.append(1) or assemble_mechanism(*args))
    load(paths[-1]), load(paths[3])
    assert not built
    load(paths[0])
    assert len(built) == 1


def test_immutable_data_are_shared() -> None:
    """Immutable parts are shared and their arrays are read-only. Tables and springs are copied."""
    one, other = load("five_bar"), load("five_bar")
    assert other.closure is one.closure
    assert other.partition is one.partition
    assert other.springs.anchors is one.springs.anchors
    for array in (other.closure.anchors.point_local, other.partition.q, other.frames.find("link_1", "test").rotation):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0
    assert other.frames.links is not one.frames.links
    assert other.spec.q_guess is not one.spec.q_guess
    assert other.spec.q_guess == one.spec.q_guess
    back = pickle.loads(pickle.dumps(one))
    assert not back.closure.anchors.point_local.flags.writeable
