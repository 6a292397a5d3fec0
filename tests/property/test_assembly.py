"""Assembly keeps the values of q_guess: of independent coordinates, of masters of couplings, within the stops."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.kinematics.assembly import OpenLoopsError, assemble_mechanism
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.spec import FrameSpec, LoopType
from tests.contract.sketches import FOUR_BAR, FOUR_BAR_LOOP
from tests.property.mechanisms import closed_mechanism
from tests.property.worlds import random_world

LIMIT = '<limit lower="-9" upper="9" effort="1" velocity="1"/>'
INERTIAL = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'


@pytest.mark.parametrize("kind", ["point", "hinge", "weld", "distance", "universal"])
@pytest.mark.parametrize("seed", range(4))
def test_chosen_independent_coordinates_keep_their_guess(kind: LoopType, seed: int) -> None:
    """Random spatial mechanisms, all coordinates guessed up to 0.05 rad or m beside a closed configuration."""
    closed = closed_mechanism(kind, seed, free=False)
    random, spec = np.random.default_rng(seed), closed.mechanism.spec
    assert spec.independent is None
    guess = {name: x + random.uniform(-0.05, 0.05) for name, x in closed.q.items()}
    mechanism = assemble_mechanism(msgspec.structs.replace(spec, q_guess=guess), closed.mechanism.sources)
    assert mechanism.independent_part(mechanism.q_tree).tolist() == [guess[name] for name in mechanism.independent]
    assert mechanism.residual <= mechanism.tolerance
    named = msgspec.structs.replace(spec, q_guess=guess, independent=list(mechanism.independent))
    written = assemble_mechanism(named, closed.mechanism.sources)
    assert np.abs(mechanism.q_tree - written.q_tree).max() < 1e-9


def four_bar(folder: Path, more: str, urdf: str = FOUR_BAR, **guess: float) -> Mechanism:
    loop = FOUR_BAR_LOOP.replace('independent = ["alpha"]', more)
    for name, value in {"alpha": -0.5, "beta": 0.0, "gamma": -1.5}.items():
        loop = loop.replace(f"{name} = {value}", f"{name} = {guess[name]}" if name in guess else "")
    (folder / "m.urdf").write_text(urdf)
    (folder / "mechanism.toml").write_text(f'name = "four_bar"\nurdf = "m.urdf"\n{loop}')
    return load(folder / "mechanism.toml")


def test_driven_crank_keeps_its_guess(tmp_path: Path) -> None:
    """A motor makes the crank independent, although no key `independent` names it."""
    mechanism = four_bar(tmp_path, 'actuated = ["alpha"]', alpha=1.0, beta=0.0, gamma=-1.5)
    assert mechanism.independent == ("alpha",)
    assert mechanism.tree.named(mechanism.q_tree)["alpha"] == 1.0


def test_guess_out_of_reach_leads_to_the_nearest_closed_configuration(tmp_path: Path) -> None:
    """The rocker reaches from -2.498 to -1.369 rad only (law of cosines), so gamma = -2.7 cannot be kept."""
    mechanism = four_bar(tmp_path, 'actuated = ["gamma"]', alpha=3.0, beta=1.0, gamma=-2.7)
    assert mechanism.independent == ("gamma",)
    assert mechanism.residual <= mechanism.tolerance
    assert -2.498 < mechanism.tree.named(mechanism.q_tree)["gamma"] < -1.369


def test_guess_beyond_a_stop_is_not_kept(tmp_path: Path) -> None:
    limits = '<limit lower="-0.4" upper="0.4" effort="1" velocity="1"/>'
    urdf = FOUR_BAR.replace('"alpha" type="continuous">', f'"alpha" type="revolute">{limits}')
    more = 'actuated = ["alpha"]\njoint = [{name = "alpha", stops = true}]'
    mechanism = four_bar(tmp_path, more, urdf, alpha=-0.5, beta=0.0, gamma=-1.5)
    assert -0.4 <= mechanism.tree.named(mechanism.q_tree)["alpha"] < -0.3999
    assert any("assembled within the stops" in warning for warning in mechanism.warnings)


def test_free_root_keeps_its_guess() -> None:
    """With a free root, the coordinates on the other side of the loop are kept, too."""
    closed = closed_mechanism("point", 3, free=True)
    assert closed.mechanism.d > 6
    random, spec = np.random.default_rng(1), closed.mechanism.spec
    guess = {name: x + random.uniform(-0.02, 0.02) for name, x in closed.q.items()}
    mechanism = assemble_mechanism(msgspec.structs.replace(spec, q_guess=guess), closed.mechanism.sources)
    expected = [guess[name] for name in mechanism.independent]
    np.testing.assert_allclose(mechanism.independent_part(mechanism.q_tree), expected, atol=1e-12)


def coupled(folder: Path, mimics: dict[str, tuple[str, float, float]], guess: str) -> dict[str, float]:
    """Return the assembled configuration of three slides in a row; `mimics` gives master, multiplier and offset."""
    joints = ""
    for parent, name in (("base", "a"), ("a", "b"), ("b", "c")):
        mimic = '<mimic joint="{}" multiplier="{}" offset="{}"/>'.format(*mimics[name]) if name in mimics else ""
        joints += (
            f'<link name="{name}">{INERTIAL}</link><joint name="{name}" type="prismatic"><parent link="{parent}"/>'
            f'<child link="{name}"/><axis xyz="0 0 1"/>{LIMIT}{mimic}</joint>'
        )
    (folder / "m.urdf").write_text(f'<robot name="slides"><link name="base"/>{joints}</robot>')
    (folder / "mechanism.toml").write_text(f'name = "slides"\nurdf = "m.urdf"\nq_guess = {guess}\n')
    mechanism = load(folder / "mechanism.toml")
    return mechanism.tree.named(mechanism.tree.to_coordinates(mechanism.q_tree))


@pytest.mark.parametrize(
    ("mimics", "guess", "expected"),
    [
        ({"b": ("a", -0.98, 0.48)}, "{}", {"a": 0.0, "b": 0.48, "c": 0.0}),
        ({"b": ("a", 2.0, 0.5)}, "{a = 0.25}", {"a": 0.25, "b": 1.0, "c": 0.0}),
        ({"b": ("a", 2.0, 0.5)}, "{b = 1.5}", {"a": 0.5, "b": 1.5, "c": 0.0}),
        ({"b": ("c", 2.0, 0.5), "c": ("a", -1.0, 0.1)}, "{}", {"a": 0.0, "b": 0.7, "c": 0.1}),
        ({"b": ("c", 2.0, 0.5), "c": ("a", -1.0, 0.1)}, "{c = 1.0}", {"a": -0.9, "b": 2.5, "c": 1.0}),
    ],
)
def test_follower_of_a_mimic_moves_and_its_master_stays(
    tmp_path: Path, mimics: dict[str, tuple[str, float, float]], guess: str, expected: dict[str, float]
) -> None:
    """Masters keep their guess, also in chains; a master without a guess follows a follower that has one."""
    assert coupled(tmp_path, mimics, guess) == pytest.approx(expected, abs=1e-12)


def test_kept_guess_is_on_the_branch_of_the_nearest_closed_configuration() -> None:
    """The sign of phi_z's determinant is that of the configuration which the guess was made from."""
    for seed in range(6):
        closed = closed_mechanism("point", seed, free=False)
        mechanism = closed.mechanism
        guess = {name: x + random_world(seed, free=False).random.uniform(-0.02, 0.02) for name, x in closed.q.items()}
        moved = assemble_mechanism(msgspec.structs.replace(mechanism.spec, q_guess=guess), mechanism.sources)
        if moved.independent != mechanism.independent or not closed.regular:
            continue
        followed = sigma(mechanism, moved.independent_part(moved.q_tree))
        np.testing.assert_allclose(moved.q_tree, followed.at.q_tree, atol=1e-9)


def test_message_names_the_loop_that_cannot_close_alone_with_its_miss() -> None:
    """A plate whose corner 3 is 2 m from corner 1: from base 1 the corner stays 1.6 m away, leg 3 reaches 0.4 m."""
    mechanism = load("three_rrr")
    corner_2, corner_3 = mechanism.spec.loop
    far = msgspec.structs.replace(corner_3, frame_a=FrameSpec(link="plate", xyz=(0.0, -2.0, 0.0)))
    with pytest.raises(OpenLoopsError, match="cannot close even alone: corner_3 ") as error:
        assemble_mechanism(msgspec.structs.replace(mechanism.spec, loop=[corner_2, far]), mechanism.sources)
    miss, alone = (float(x) for x in re.findall(r"miss ([0-9.]+)", str(error.value)))
    nearest = 2.0 - 0.4 - 0.4 - float(np.hypot(0.303109, 0.525))  # m; the base points' distance is subtracted
    assert miss == alone
    assert nearest / np.sqrt(2) <= miss <= nearest  # The message gives the larger component.
