"""A controller of your own.

Any object with a method `u(t, terms)` can control a run. It gets the terms that the step loop has already computed.
This one compensates gravity exactly, and D and C of the reduced model make the closed loop a critically damped
oscillator. Its motion is therefore known in closed form.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

TARGET = np.array([0.2, 0.4])
RATE = 4.0  # 1/s


class ComputedTorque:
    """u = D q̈_d + C q̇ + h, with q̈_d that of a critically damped oscillator."""

    def u(self, t, terms):
        q_ddot = -2 * RATE * terms.q_dot - RATE**2 * (terms.q - TARGET)
        return terms.D @ q_ddot + terms.C @ terms.q_dot + terms.h


@figure_style()
def main():
    overrides = {"formulation": "reduced", "initial": {"at": "equilibrium"}, "t_end": 3.0}
    run = ckc_pin.simulate("five_bar/swing", overrides, controller=ComputedTorque())
    q = run.q
    decay = (1 + RATE * run.t) * np.exp(-RATE * run.t)
    exact = TARGET + (q[0] - TARGET) * decay[:, np.newaxis]
    print(
        f"off the closed form by {np.abs(q - exact).max():.1e} rad; Python was called {run.stats['python_calls']} times"
    )
    assert np.abs(q - exact).max() < 1e-6

    figure, ax = plt.subplots()
    ax.plot(run.t, q, lw=3, alpha=0.4, label=["θ₁", "θ₃"])
    ax.plot(run.t, exact, "k:", label=["closed form", None])
    ax.set(xlabel="t (s)", ylabel="angle (rad)", title="From rest to the target, critically damped")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("own_controller.png")
