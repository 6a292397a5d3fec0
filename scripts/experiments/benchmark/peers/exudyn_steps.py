"""Step a mechanism with Exudyn's solvers, for spatial and planar models."""

from __future__ import annotations

from typing import Any

from scripts.experiments.benchmark.work import Work

__all__ = ["Steps"]

MAX_DENSE_BODIES = 20  # number of bodies up to which the dense solver is faster


class Steps:
    """An Exudyn system: first constructed, then stepped."""

    def __init__(self, work: Work) -> None:
        import exudyn
        from exudyn import itemInterface

        exudyn.config.printToConsole = False
        self.mechanism, self.exudyn, self.items, self.t = work.mechanism, exudyn, itemInterface, 0.0
        self._container = exudyn.SystemContainer()
        self.mbs: Any = self._container.AddSystem()
        self._bodies: list[Any] = []  # the ground first

    def assemble(self) -> None:
        """Assemble the system after its construction."""
        self.mbs.Assemble()
        self._settings: Any = self.exudyn.SimulationSettings()
        time, linear = self._settings.timeIntegration, self.exudyn.LinearSolverType
        time.newton.modifiedNewtonJacUpdatePerStep = (
            True  # fewer iterations, a third of the time; the other options are defaults
        )
        time.verboseMode = 0
        time.adaptiveStep = False  # otherwise a failing step is repeated with shorter steps without end
        self._settings.solution.file.write = False
        redundant = bool(self.mechanism.redundant)  # the sparse solver fails with a singular Jacobian
        dense = redundant or self.mechanism.tree.model.njoints <= MAX_DENSE_BODIES
        self._settings.linearSolver.solverType = linear.EigenDense if dense else linear.EigenSparse
        self._settings.linearSolver.ignoreSingularJacobian = redundant

    def kinetic_energy(self) -> float:
        """Return the kinetic energy of all bodies, J."""
        kind = self.exudyn.OutputVariableType.KineticEnergy
        return float(sum(self.mbs.GetObjectOutputBody(body, kind, [0, 0, 0]) for body in self._bodies[1:]))

    def advance(self, solver: str, radius: float, dt: float, many: int) -> None:
        """Advance the state by `many` steps."""
        time = self._settings.timeIntegration
        time.generalizedAlpha.spectralRadius = radius
        time.numberOfSteps, time.startTime, time.endTime = many, self.t, self.t + many * dt
        kind = getattr(self.exudyn.DynamicSolverType, solver)
        self.mbs.SolveDynamic(self._settings, solverType=kind, updateInitialValues=True, showHints=False)
        self.t += many * dt
