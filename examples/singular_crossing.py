"""Through a loss of rank.

Four-bars in a row lie flat at t = 0.718 s, where J loses one rank per four-bar. The projected DAE continues on its own
branch by a checked collocation step. All rods have the same angle θ with θ'' = -k cos θ. SciPy integrates this equation
as an independent check.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import ckc_pin
from ckc_pin.view.style import figure_style

N = 4
K = 9.81 * 3 * (3 * N + 1) / (2 * (4 * N + 1))  # 1/s²


@figure_style()
def main():
    run = ckc_pin.simulate("n_four_bar", {"t_end": 2.0, "mechanism.N": N})
    theta = run.q_tree[:, run.column("theta_0")]
    exact = solve_ivp(lambda t, y: [y[1], -K * np.cos(y[0])], (0, 2), [np.pi / 2, -1.0], "DOP853", run.t,
                      rtol=1e-12, atol=1e-12).y[0]  # fmt: skip
    error = np.abs(theta - exact).max()
    print(f"{run.stats['steps']} steps, off by {error:.1e} rad at most")
    assert run.status == "done"
    assert error < 1e-7

    sigma = [np.linalg.svd(ckc_pin.terms(run.mechanism, dict(zip(run.coordinates, q, strict=True))).at.J)[1][-1]
             for q in run.q_tree.tolist()]  # fmt: skip
    figure, (angle, rank) = plt.subplots(1, 2, figsize=(7.0, 3.0))
    angle.plot(run.t, theta, lw=3, alpha=0.4, label="ckc_pin")
    angle.plot(run.t, exact, "k:", label="θ'' = -k cos θ, by SciPy")
    angle.set(xlabel="t (s)", ylabel="θ₀ (rad)", title="The row swings through flat")
    rank.semilogy(run.t, np.maximum(sigma, 1e-12))
    rank.set(xlabel="t (s)", ylabel="smallest singular value of J (m)", title="J loses rank where it is flat")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("singular_crossing.png")
