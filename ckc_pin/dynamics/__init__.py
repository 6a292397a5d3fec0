"""Terms of the equations of motion at one state, the formulations as functions of them, equilibria, and wrenches."""

from ckc_pin.dynamics.equilibrium import h_gradient, stable_equilibrium
from ckc_pin.dynamics.formulations import (
    dae_acceleration,
    multipliers,
    reduced_acceleration,
    spf_terms,
    spf_z_dot,
    tangent_basis,
    tree_force,
)
from ckc_pin.dynamics.inverse import friction_force, joint_wrenches, loop_wrenches
from ckc_pin.dynamics.terms import Terms, terms

__all__ = [
    "Terms",
    "dae_acceleration",
    "friction_force",
    "h_gradient",
    "joint_wrenches",
    "loop_wrenches",
    "multipliers",
    "reduced_acceleration",
    "spf_terms",
    "spf_z_dot",
    "stable_equilibrium",
    "tangent_basis",
    "terms",
    "tree_force",
]
