"""The scene file, `NAME.scene.toml`, as a typed structure; its `[controller]` is in `control.spec`."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from ckc_pin.control.spec import ControllerSpec
from ckc_pin.mechanism.library import GeneratorSpec
from ckc_pin.mechanism.spec import Vector3

__all__ = ["EventSpec", "InitialSpec", "Method", "SceneSpec", "SolverSpec", "TermsOf"]

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Tolerance = Annotated[float, msgspec.Meta(ge=2.3e-14, lt=1)]  # SciPy's solvers replace anything finer

Method = Literal["auto", "DOP853", "RK45", "Radau"]
TermsOf = Literal["auto", "pinocchio", "generated"]


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class InitialSpec(_Spec, frozen=True):
    """Where a run starts: at q, at the stable equilibrium reached from q_guess, or as assembled from q_guess.

    Attributes
    ----------
    at
        In the place of ``q``: the stable equilibrium reached from ``q_guess``, or as assembled from it.
        ``at = "equilibrium"``
    q : rad, m
        The independent coordinates; dependent ones may be added to pick the branch.
        ``q = {theta_1 = -1.2, theta_3 = -1.9}``
    q_dot : rad/s, m/s
        The independent rates; 0 for what is not named. Of a free root velocity and angular velocity in its own axes.
        ``q_dot = {theta_1 = 0.4}``
    w : m, rad
        φ at the start, of the SPF alone; absent: 0.
        ``w = [0.01, -0.006]``
    """

    at: Literal["equilibrium", "assembled"] | None = None
    q: dict[str, float] = {}
    q_dot: dict[str, float] = {}
    w: list[float] | None = None


class SolverSpec(_Spec, frozen=True):
    """How a run is integrated.

    Attributes
    ----------
    method
        ``auto``: DOP853, RK45 for segments that are short for it, Radau IIA where the motion is stiff.
        ``method = "Radau"``
    rtol
        Relative tolerance of a step (see "how errors are controlled").
        ``rtol = 1e-10``
    atol
        Absolute tolerance; absent: rtol / 100.
        ``atol = 1e-12``
    max_step : s
        No longer steps.
        ``max_step = 0.01``
    min_step : s
        A step below it stops the run, exit code 3.
        ``min_step = 1e-9``
    max_rhs
        So many right-hand sides, then the run stops; absent: where the rest would take more than 1e9.
        ``max_rhs = 100000``
    max_wall_s : s
        So much time of the clock, then the run stops.
        ``max_wall_s = 60.0``
    output_dt : s
        Between output instants; absent: 501 instants, both ends among them.
        ``output_dt = 0.01``
    projection
        Of the DAE: back onto φ = 0 and φ̇ = 0 after each step.
        ``projection = false``
    terms
        Whose D', C', h', φ, J: Pinocchio's, or those written out and compiled for the mechanism; ``auto``
        takes the latter where ``ckc compile`` has left them, and compiles them itself once a run has evaluated
        2,000,000 right-hand sides with half of its time or more still ahead: a short run never waits.
        ``terms = "pinocchio"``
    baumgarte : 1/s
        α and β, of a DAE with ``projection = false``.
        ``baumgarte = [50.0, 50.0]``
    """

    method: Method = "auto"
    rtol: Tolerance = 1e-8
    atol: Positive | None = None
    max_step: Positive | None = None
    min_step: NonNegative = 0.0
    max_rhs: Annotated[int, msgspec.Meta(ge=1, le=2**62)] | None = None
    max_wall_s: Positive | None = None
    output_dt: Positive | None = None
    projection: bool = True
    terms: TermsOf = "auto"
    baumgarte: tuple[NonNegative, NonNegative] | None = None


class EventSpec(_Spec, frozen=True):
    """A coordinate or its rate crossing a value, a joint limit passed, or a singularity margin crossing a value.

    Attributes
    ----------
    coordinate
        Whose; a margin has none, and a limit without it means every coordinate's.
        ``coordinate = "theta_1"``
    of
        A coordinate, its rate, its limits in the URDF, or how near φ_z or J is to singular.
        ``of = "q_dot"``
    value : of what crosses
        Absent: 0; a margin needs one greater than 0, a limit has none.
        ``value = 0.5``
    direction
        -1 falling, 1 rising, 0 both.
        ``direction = -1``
    stop
        End the run there.
        ``stop = true``
    """

    coordinate: str | None = None
    of: Literal["q", "q_dot", "limit", "sigma_min_phi_z", "sigma_min_J"] = "q"
    value: float | None = None
    direction: Literal[-1, 0, 1] = 0
    stop: bool = False


class SceneSpec(_Spec, frozen=True):
    """The whole file.

    Attributes
    ----------
    mechanism
        The mechanism's file, beside the scene; or a table ``{generator, N}``.
        ``mechanism = "mechanism.toml"``
    formulation
        ``dae``: eq. 1, projected; ``reduced``: eq. 6; ``spf``: the singular perturbation formulation, eqs. 8 and 17.
        ``formulation = "reduced"``
    t_end : s
        How long.
        ``t_end = 9.5``
    epsilon : s
        ε of the SPF.
        ``epsilon = 1e-4``
    spf_coordinates
        Eq. 17, exact in w, or eq. 8 as printed, in z.
        ``spf_coordinates = "z"``
    coriolis_velocity
        The velocity in C off the manifold: ρ q̇ (eq. 8) or the actual one (eq. 16), for plant and
        controller.
        ``coriolis_velocity = "actual"``
    friction_smoothing : rad/s, m/s
        Dry friction grows as tanh over such a rate, instead of joints that stick; its work is not in `dissipated`.
        ``friction_smoothing = 1e-3``
    parameters : as in the files
        Numbers of the mechanism that are other ones, by name (see "parameters").
        ``parameters = {"link.link_2.mass" = 0.3}``
    initial
        Where it starts.
        ``initial = {at = "equilibrium"}``
    solver
        How it is integrated.
        ``solver = {rtol = 1e-10}``
    controller
        Absent: u = 0.
        ``controller = {type = "torques", file = "torques.csv"}``
    event
        What is recorded, or ends the run, where it crosses a value.
        ``event = [{of = "limit", stop = true}]``
    """

    mechanism: str | GeneratorSpec
    formulation: Literal["reduced", "spf", "dae"]
    t_end: Positive
    epsilon: Positive = 1e-3
    spf_coordinates: Literal["w", "z"] = "w"
    coriolis_velocity: Literal["rho", "actual"] = "rho"
    friction_smoothing: Positive | None = None
    parameters: dict[str, float | Vector3] = {}
    initial: InitialSpec = InitialSpec()
    solver: SolverSpec = SolverSpec()
    controller: ControllerSpec | None = None
    event: list[EventSpec] = []
