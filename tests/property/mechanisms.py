"""Random spatial mechanisms with a loop of a given type, whose frames coincide at a random configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import make_interp_spline

from ckc_pin.base.sources import Sources
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.spec import (
    CouplingSpec,
    FrameSpec,
    JointSpec,
    LoopSpec,
    LoopType,
    MechanismSpec,
    SpringSpec,
    TreeSpec,
)
from scripts.experiments.mechanism_files import closing_frame, roll_pitch_yaw
from tests.analytic.five_bar import Array
from tests.property.worlds import Numbers, World, random_world, rotation, slope

RowsIn = Literal["a", "world"]

LENGTH = 0.4  # of a distance loop
MAX_RHO, MIN_SIGMA = 10.0, 0.05  # differences are inaccurate closer to a singular phi_z
SPRINGS = [
    SpringSpec(joint="a_j4", rest=0.3, stiffness=5.0, damping=0.2),
    SpringSpec(joint="b_j2", rest=-0.1, stiffness=20.0),
    SpringSpec(frame_a="a_4", frame_b=FrameSpec(link="b_4", xyz=(0.1, 0.2, 0.3)), rest_length=0.5, stiffness=30.0),
    SpringSpec(frame_a="world", frame_b="b_3", rest_length=0.2, stiffness=10.0, damping=1.5),
]


ROTORS = [
    JointSpec(name="a_j2", armature=0.4),
    JointSpec(name="b_j3", armature=0.2),
    JointSpec(name="b_j4", armature=1),
]


@dataclass(frozen=True)
class Closed:
    """A mechanism, the world that it is built from, and a closed configuration."""

    mechanism: Mechanism
    world: World
    q: Numbers

    @property
    def regular(self) -> bool:
        """Whether the assembled configuration is not close to singular."""
        at = self.mechanism.assembled
        return bool(np.abs(at.rho).max() < MAX_RHO / 2 and at.sigma_min() > 2 * MIN_SIGMA)

    def random_state(self, spread: float = 0.1) -> Terms:
        """Return a random state with closed loops near the assembled configuration."""
        random, mechanism = self.world.random, self.mechanism
        at = mechanism.assembled
        while spread > 1e-3:
            step = at.rho @ random.uniform(-spread, spread, mechanism.d)
            solution = sigma(mechanism, mechanism.independent_part(mechanism.tree.integrate(mechanism.q_tree, step)))
            is_regular = np.abs(solution.at.rho).max() < MAX_RHO and solution.at.sigma_min() > MIN_SIGMA
            if solution.verdict == "converged" and is_regular:
                v_tree = solution.at.rho @ random.uniform(-1, 1, mechanism.d)
                return Terms(mechanism, solution.at, v_tree / max(1.0, np.abs(v_tree).max()))
            spread /= 2
        raise AssertionError(f"no regular configuration near the assembled one: {solution}")

    def u_tree(self) -> Array:
        """Return random generalized forces on the tree."""
        return self.world.random.uniform(-5, 5, self.mechanism.n)


def closed_mechanism(
    kind: LoopType,
    seed: int,
    *,
    free: bool = True,
    redundant: bool = False,
    turn: Array | None = None,
    rows_in: RowsIn = "a",
    nonlinear: bool = False,
) -> Closed:
    """Return a mechanism with a loop between the links a_3 and b_3, a coupling, springs, dampers and rotors.

    Parameters
    ----------
    kind, seed, free
        The loop's type, the world's seed, whether the tree "b" has a free root.
    redundant
        Close the same loop twice.
    turn
        Rotation of everything, gravity included, about the world's origin.
    rows_in
        Axes in which the loop's rows are resolved: frame A's or the world's.
    nonlinear
        Couple joints by a polynomial, by a table, and three joints at once, instead of two by a gear.
    """
    world = random_world(seed, free=free)
    q = world.configuration()
    loop = _closing_loop(kind, world, q, rows_in)
    turn = np.eye(3) if turn is None else turn
    trees = [
        TreeSpec(file=prefix, prefix=prefix, root="free" if prefix == "b_" and free else "fixed",
                 xyz=_triple(turn @ xyz), rpy=_triple(roll_pitch_yaw(turn @ rotation(rpy))))
        for prefix, (xyz, rpy) in world.stands.items()
    ]  # fmt: skip
    duplicate = [LoopSpec(**{name: getattr(loop, name) for name in loop.__struct_fields__} | {"name": "again"})]
    spec = MechanismSpec(
        name=kind,
        tree=trees,
        gravity=_triple(turn @ world.gravity),
        q_guess=q,
        loop=[loop, *(duplicate if redundant else [])],
        coupling=nonlinear_couplings(q)
        if nonlinear
        else [CouplingSpec(joint="a_j1", other="b_j4", ratio=0.7, offset=q["a_j1"] - 0.7 * q["b_j4"])],
        spring=SPRINGS,
        joint=ROTORS,
    )
    texts = {prefix: world.urdf(prefix) for prefix in world.stands}
    return Closed(assemble_mechanism(spec, Sources("a random world", None, texts)), world, q)


def nonlinear_couplings(q: Numbers) -> list[CouplingSpec]:
    """Return couplings of three joints, by a polynomial, and by a table of a sine, which hold at q."""
    sums = {"a_j3": 0.3, "b_j2": -0.5, "b_j3": 1.2}
    powers = [0.1, 0.8, -0.3, 0.2, -0.05, 0.01]
    at, x = q["b_j4"], np.linspace(-3.2, 3.2, 15)
    table = [(float(a), float(np.sin(a))) for a in x]
    return [
        CouplingSpec(joints=sums, offset=sum(c * q[name] for name, c in sums.items())),
        CouplingSpec(joint="a_j1", other="b_j4", polynomial=powers,
                     offset=q["a_j1"] - float(np.polynomial.polynomial.polyval(at, powers))),
        CouplingSpec(joint="a_j4", other="b_j1", table=table,
                     offset=q["a_j4"] - float(make_interp_spline(x, np.sin(x), 5)(q["b_j1"]))),
    ]  # fmt: skip


def _closing_loop(kind: LoopType, world: World, q: Numbers, rows_in: RowsIn) -> LoopSpec:
    """Return a loop that is closed at q."""
    random = world.random
    xyz_a, axis = random.uniform(-0.3, 0.3, 3), random.normal(size=3)
    normal = np.cross(axis, random.normal(size=3))
    placement_a, placement_b = world.placement("a_3", q), world.placement("b_3", q)
    offset = LENGTH * normal / np.linalg.norm(normal) if kind == "distance" else np.zeros(3)
    xyz, rpy = closing_frame(placement_a, placement_b, xyz_a + offset)
    return LoopSpec(
        name="loop",
        type=kind,
        frame_a=FrameSpec(link="a_3", xyz=_triple(xyz_a)),
        frame_b=FrameSpec(link="b_3", xyz=_triple(xyz), rpy=_triple(rpy)),
        rows_in=rows_in,
        axis_a=_triple(axis),
        axis_b=_triple(normal if kind == "universal" else axis),
        length=LENGTH if kind == "distance" else None,
    )


def differentiate_along(
    mechanism: Mechanism, q_tree: Array, v_tree: Array, f: Callable[[Array], Array], step: float = 2e-4
) -> Array:
    """Return the derivative of f(q') along a tangent velocity, by differences."""
    return slope(lambda t: f(mechanism.tree.integrate(q_tree, t * v_tree)), step)


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
