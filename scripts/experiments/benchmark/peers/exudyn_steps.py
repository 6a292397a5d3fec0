"""Exudyn's solvers on a mechanism, however it is modelled in it."""

from __future__ import annotations

from typing import Any

from scripts.experiments.benchmark.work import Work

__all__ = ["Steps"]

FEW = 20  # bodies, up to which the dense solver is the faster one


class Steps:
    """A system of Exudyn's under construction, then one that takes steps."""

    def __init__(self, work: Work) -> None:
        import exudyn
        from exudyn import itemInterface

        exudyn.config.printToConsole = False
        self.mechanism, self.exudyn, self.items, self.t = work.mechanism, exudyn, itemInterface, 0.0
        self._container = exudyn.SystemContainer()
        self.mbs: Any = self._container.AddSystem()
        self._bodies: list[Any] = []  # the ground first

    def assemble(self) -> None:
        """End construction."""
        self.mbs.Assemble()
        self._settings: Any = self.exudyn.SimulationSettings()
        time, linear = self._settings.timeIntegration, self.exudyn.LinearSolverType
        time.newton.modifiedNewtonJacUpdatePerStep = True  # fewer iterations, a third of the time; else its defaults
        time.verboseMode = 0
        time.adaptiveStep = False  # else a step that fails is tried shorter without end
        self._settings.solution.file.write = False
        redundant = bool(self.mechanism.redundant)  # the sparse solver does not take a singular Jacobian
        dense = redundant or self.mechanism.tree.model.njoints <= FEW
        self._settings.linearSolver.solverType = linear.EigenDense if dense else linear.EigenSparse
        self._settings.linearSolver.ignoreSingularJacobian = redundant

    def kinetic_energy(self) -> float:
        """Return the sum over the bodies."""
        kind = self.exudyn.OutputVariableType.KineticEnergy
        return float(sum(self.mbs.GetObjectOutputBody(body, kind, [0, 0, 0]) for body in self._bodies[1:]))

    def advance(self, solver: str, radius: float, dt: float, many: int) -> None:
        """Take steps; the state is where they end."""
        time = self._settings.timeIntegration
        time.generalizedAlpha.spectralRadius = radius
        time.numberOfSteps, time.startTime, time.endTime = many, self.t, self.t + many * dt
        kind = getattr(self.exudyn.DynamicSolverType, solver)
        self.mbs.SolveDynamic(self._settings, solverType=kind, updateInitialValues=True, showHints=False)
        self.t += many * dt
