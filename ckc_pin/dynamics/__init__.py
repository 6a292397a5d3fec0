"""Terms at one state, and the formulations as functions of them."""

from ckc_pin.dynamics.equilibrium import h_gradient, stable_equilibrium
from ckc_pin.dynamics.formulations import (
    dae_acceleration,
    multipliers,
    reduced_acceleration,
    spf_terms,
    spf_z_dot,
    tangent_basis,
)
from ckc_pin.dynamics.terms import Terms, terms

__all__ = [
    "Terms",
    "dae_acceleration",
    "h_gradient",
    "multipliers",
    "reduced_acceleration",
    "spf_terms",
    "spf_z_dot",
    "stable_equilibrium",
    "tangent_basis",
    "terms",
]
