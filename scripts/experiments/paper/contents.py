"""Contents of the page on the paper: sections and claims in the paper's order, and the module of each claim."""

from __future__ import annotations

__all__ = ["KEYS", "SECTIONS", "STUDIES"]

# The claims that each module of this package answers. The slowest modules come first.
STUDIES: dict[str, tuple[str, ...]] = {
    "tracking": ("tracking-lyapunov", "tracking-skew", "tracking-gains", "tracking-deviations"),
    "cost_claims": ("cost",),
    "set_point": (
        "set-point-lyapunov", "set-point-gradient-bound", "set-point-gain-condition", "set-point-unique",
    ),
    "along_eq21": ("no-singularities",),
    "results": (
        "appendix", "initial-equilibrium", "figure-3", "figure-4", "torques", "tracking-error-law",
    ),
    "tikhonov": ("tikhonov-order", "tikhonov-velocity"),
    "consistent_start": ("epsilon-irrelevant",),
    "boundary_layer": ("boundary-layer", "eq-13"),
    "singular_claims": ("singular-type-1", "singular-type-2", "singular-freedoms"),
    "domain": ("implicit-function", "spf-domain"),
}  # fmt: skip

# The paper's order.
SECTIONS: dict[str, tuple[str, ...]] = {
    "II. Problem definition": ("implicit-function",),
    "II-A. Singular perturbation formulation": (
        "tikhonov-order", "boundary-layer", "eq-13", "epsilon-irrelevant", "spf-domain",
    ),
    "II-B. Set-point control": (
        "set-point-gradient-bound", "set-point-gain-condition", "set-point-unique", "set-point-lyapunov",
    ),
    "II-C. Tracking control": ("tracking-lyapunov", "tracking-skew", "tracking-gains", "tikhonov-velocity"),
    "III-A. Singular configurations": ("singular-type-1", "singular-type-2", "singular-freedoms"),
    "III-B. Set-point control, results": ("initial-equilibrium", "figure-3", "cost"),
    "III-C. Tracking control, results": (
        "no-singularities", "figure-4", "torques", "tracking-error-law", "tracking-deviations",
    ),
    "Appendix": ("appendix",),
}  # fmt: skip
KEYS = tuple(key for keys in SECTIONS.values() for key in keys)
