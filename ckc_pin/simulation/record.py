"""What a run keeps at its output instants."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ckc_pin.control.actuation import Effort
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.systems import Native, System

__all__ = ["Recorder", "Watch"]

Watch = Callable[[float, Array], None]  # (t, q_tree), q_tree by coordinate


class Recorder:
    """Collects rows of a `Run`, one an output instant.

    Parameters
    ----------
    system : System
    effort : callable
        (t, terms) to the actuators' effort.
    lyapunov : callable or None
        (t, terms, w) to the controller's Lyapunov function.
    watch : callable or None
        Told each output instant as soon as it is recorded.
    """

    def __init__(
        self,
        system: System,
        effort: Callable[[float, Terms], Effort],
        lyapunov: Callable[[float, Terms, Array], float] | None,
        watch: Watch | None = None,
    ) -> None:
        self.system, self.effort, self.lyapunov, self.watch = system, effort, lyapunov, watch
        self.rows: dict[str, list[Array | float]] = {
            name: [] for name in ("t", "q_tree", "v_tree", "u", "tau", "phi", "w", "energy")
        }
        if lyapunov is not None:
            self.rows["lyapunov"] = []
        self.max_phi = self.max_phi_dot = 0.0

    def add(self, t: float, y: Array) -> None:
        """Record the state at an instant; instants not after the last one are passed over."""
        if self.rows["t"] and t <= self.rows["t"][-1]:
            return
        row = self._native_row(t, y)
        if row is not None:
            self.extend(row[None, :])
            return
        with np.errstate(all="ignore"):
            self._add(t, y)

    def _native_row(self, t: float, y: Array) -> Array | None:
        system = self.system
        if isinstance(system, Native) and (self.lyapunov is None or system.controls):
            return system.row(t, y)
        return None

    def _add(self, t: float, y: Array) -> None:
        system = self.system
        terms = system.terms(t, y)
        velocity, w = system.velocity(t, terms), system.w(t)
        effort = self.effort(t, terms)
        values: dict[str, Array | float] = {
            "t": t,
            "q_tree": system.mechanism.tree.to_coordinates(terms.q_tree),
            "v_tree": velocity,
            "u": effort.u,
            "tau": effort.tau,
            "phi": terms.phi,
            "w": w,
            "energy": terms.energy,
        }
        if self.lyapunov is not None:
            values["lyapunov"] = self.lyapunov(t, terms, terms.phi)
        for name, value in values.items():
            self.rows[name].append(value)
        self.max_phi = max(self.max_phi, float(np.abs(terms.phi - w).max(initial=0.0)))
        drift_rate = terms.at.J @ velocity - system.w_dot(t)
        self.max_phi_dot = max(self.max_phi_dot, float(np.abs(drift_rate).max(initial=0.0)))
        if self.watch is not None:
            self.watch(t, np.asarray(values["q_tree"]))

    def extend(self, rows: Array) -> None:
        """Take over what the native core has recorded, a row an instant (`Record` in record.hpp)."""
        if not len(rows):
            return
        mechanism = self.system.mechanism
        n, d, m = mechanism.n, mechanism.d, mechanism.closure.rows
        widths = {"t": 1, "q_tree": n, "v_tree": n, "u": d, "phi": m, "w": m, "energy": 1, "lyapunov": 1}
        parts, at = {}, 0
        for name, width in widths.items():
            parts[name], at = rows[:, at : at + width], at + width
        direct = mechanism.actuated == mechanism.independent
        parts["tau"] = parts["u"] if direct else np.zeros((len(rows), len(mechanism.actuated)))
        for name, kept in self.rows.items():
            part = parts[name]
            kept.extend(part[:, 0] if widths.get(name) == 1 and name in ("t", "energy", "lyapunov") else part)
        if self.watch is not None:
            for t, q_tree in zip(parts["t"][:, 0], parts["q_tree"], strict=True):
                self.watch(float(t), q_tree)
        self.max_phi = max(self.max_phi, float(rows[:, -2].max()))
        self.max_phi_dot = max(self.max_phi_dot, float(rows[:, -1].max()))

    def arrays(self) -> dict[str, Array]:
        """Return the rows as arrays."""
        return {name: np.array(values, dtype=float) for name, values in self.rows.items()}
