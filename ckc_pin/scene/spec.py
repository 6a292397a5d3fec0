"""Typed structures of a scene file, `NAME.scene.toml`; its table `[controller]` is in `control.spec`."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from ckc_pin.base.toml import FileStruct
from ckc_pin.control.forces import LinkForceSpec
from ckc_pin.control.spec import ControllerSpec, MotionSpec
from ckc_pin.mechanism.library import GeneratorSpec
from ckc_pin.mechanism.spec import Name, Vector3

__all__ = ["EventSpec", "InitialSpec", "Method", "SceneSpec", "SolverSpec", "TermsOf"]

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Tolerance = Annotated[float, msgspec.Meta(ge=2.3e-14, lt=1)]  # SciPy's solvers raise smaller values to about this

Method = Literal["auto", "DOP853", "RK45", "Radau"]
TermsOf = Literal["auto", "pinocchio", "generated"]


class InitialSpec(FileStruct, frozen=True):
    """Initial state of a run: at q, at the stable equilibrium reached from q_guess, or as assembled from q_guess.

    Attributes
    ----------
    at
        Instead of ``q``: ``"equilibrium"``, the stable equilibrium reached from ``q_guess``, or ``"assembled"``, the
        configuration assembled from ``q_guess``.
        ``at = "equilibrium"``
    q : rad, m
        Values of the independent coordinates. Dependent ones may be added to select the assembly branch. A list is in
        the order of ``independent``, or has all coordinates.
        ``q = {theta_1 = -1.2, theta_3 = -1.9}``
    q_dot : rad/s, m/s
        Rates of the independent coordinates; default 0. A free root has velocity and angular velocity in its own axes.
        A list is in the order of ``independent``.
        ``q_dot = {theta_1 = 0.4}``
    w : m, rad
        Initial residual φ of the loop closures, by row; SPF only; default 0.
        ``w = [0.01, -0.006]``
    """

    at: Literal["equilibrium", "assembled"] | None = None
    q: dict[str, float] = {}
    q_dot: dict[str, float] = {}
    w: list[float] | None = None


class SolverSpec(FileStruct, frozen=True):
    """Integration method, tolerances, budgets and output of a run.

    Attributes
    ----------
    method
        Integration method. ``auto`` selects DOP853, RK45 for short segments, and Radau IIA where the motion is stiff.
        ``method = "Radau"``
    rtol
        Relative tolerance of a step (see "how errors are controlled").
        ``rtol = 1e-10``
    atol
        Absolute tolerance; default rtol / 100.
        ``atol = 1e-12``
    max_step : s
        Largest step size; default unlimited.
        ``max_step = 0.01``
    min_step : s
        The run stops with exit code 3 if a step becomes smaller.
        ``min_step = 1e-9``
    max_rhs
        The run stops after this many right-hand sides. By default it stops if the rest would take more than 1e9.
        ``max_rhs = 100000``
    max_wall_s : s
        The run stops after this much wall-clock time; default unlimited.
        ``max_wall_s = 60.0``
    output_dt : s
        Interval between output instants; by default there are 501 instants including both ends.
        ``output_dt = 0.01``
    projection
        Project the DAE's state onto φ = 0 and φ̇ = 0 after each step.
        ``projection = false``
    terms
        Source of D', C', h', φ and J: Pinocchio, or terms compiled for the mechanism. ``auto`` uses compiled terms if
        ``ckc compile`` has made them. It compiles them itself after 2,000,000 right-hand sides if half of the run or
        more remains, so short runs never wait.
        ``terms = "pinocchio"``
    baumgarte : 1/s
        Baumgarte gains α and β of a DAE with ``projection = false``.
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


class EventSpec(FileStruct, frozen=True):
    """An event: a coordinate, its rate or a smallest singular value crosses a value, or a joint passes its limit.

    Attributes
    ----------
    coordinate
        The coordinate. With ``of = "limit"``, all coordinates by default. Singular values have none.
        ``coordinate = "theta_1"``
    of
        The monitored quantity: a coordinate, its rate, its limits in the URDF, or the smallest singular value of φ_z
        or J.
        ``of = "q_dot"``
    value : unit of the quantity
        The value to cross; default 0. Singular values need one greater than 0; limits have none.
        ``value = 0.5``
    direction
        1: rising only; -1: falling only; 0: both.
        ``direction = -1``
    stop
        Whether the event ends the run.
        ``stop = true``
    name
        Name in the run's events; default: such as ``theta_1 = 0.5``.
        ``name = "contact"``
    """

    coordinate: str | None = None
    of: Literal["q", "q_dot", "limit", "sigma_min_phi_z", "sigma_min_J"] = "q"
    value: float | None = None
    direction: Literal[-1, 0, 1] = 0
    stop: bool = False
    name: Name | None = None


class PrescribedSpec(MotionSpec, frozen=True, kw_only=True):
    """A joint whose motion is imposed exactly, as a constraint row in time. `tau` is the torque that this takes.

    Attributes
    ----------
    joint
        The joint. It is no longer an independent coordinate.
        ``joint = "crank"``
    begins : s
        An instant, or the name of an event; default: the start. Before, the joint moves freely. The motion is then
        counted from this instant and from the joint's position there.
        ``begins = 0.5``
    ends : s
        An instant, or the name of an event. From there on the joint moves freely; default: never.
        ``ends = "theta_3 = -1.5"``
    """

    joint: Name
    begins: Positive | Name | None = None
    ends: Positive | Name | None = None

    @property
    def can_be_free(self) -> bool:
        """Whether the joint moves freely during a part of the run."""
        return self.begins is not None or self.ends is not None


class SceneSpec(FileStruct, frozen=True):
    """A scene file: mechanism, formulation, start, solver, controller and events of a run.

    Attributes
    ----------
    mechanism
        The mechanism's file, relative to the scene, or a table ``{generator, N}``.
        ``mechanism = "mechanism.toml"``
    formulation
        ``dae``: eq. 1, projected; ``reduced``: eq. 6; ``spf``: the singular perturbation formulation, eqs. 8 and 17.
        ``formulation = "reduced"``
    t_end : s
        End time.
        ``t_end = 9.5``
    epsilon : s
        ε of the SPF.
        ``epsilon = 1e-4``
    spf_coordinates
        Coordinates of the SPF: eq. 17, exact in w, or eq. 8 as printed, in z.
        ``spf_coordinates = "z"``
    coriolis_velocity
        Velocity in C off the manifold, for plant and controller: ρ q̇ (eq. 8) or the actual velocity (eq. 16).
        ``coriolis_velocity = "actual"``
    friction_smoothing : rad/s, m/s
        Smooth dry friction, friction * tanh(rate / friction_smoothing), instead of joints that stick. Its work is not
        in `dissipated`, but in `works`.
        ``friction_smoothing = 1e-3``
    parameters : as in the files
        Other values of the mechanism's parameters, by name (see "parameters").
        ``parameters = {"link.link_2.mass" = 0.3}``
    initial
        Initial state.
        ``initial = {at = "equilibrium"}``
    solver
        Integration method, tolerances, budgets and output.
        ``solver = {rtol = 1e-10}``
    controller
        Controller; default u = 0.
        ``controller = {type = "torques", file = "torques.csv"}``
    event
        Events that are recorded, or that end the run.
        ``event = [{of = "limit", stop = true}]``
    force
        Forces and moments on links.
        ``force = [{frame = "rod", force = [0.0, 0.0, -20.0]}]``
    work
        Integrate the works of motors, dampers, friction and forces with the motion: ``work.motors`` and others of the
        run's quantities, and the error of the energy balance.
        ``work = true``
    prescribed
        Joints that move as prescribed, whatever torque that takes.
        ``prescribed = [{joint = "crank", rate = 6.2832}]``
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
    force: list[LinkForceSpec] = []
    work: bool = False
    prescribed: list[PrescribedSpec] = []
