"""The paper's five-bar.

Both of its control cases, each as the singular perturbation formulation that eq. 8 prints and as the reduced model of
eq. 6: errors of the arms, and torques within the 30 N m that the paper states.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin

FORMULATIONS = {"SPF, ε = 1e-3": {"formulation": "spf", "spf_coordinates": "z", "epsilon": 1e-3},
                "reduced": {"formulation": "reduced"}}  # fmt: skip


def main():
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.5), sharex="col", layout="constrained")
    for column, case in zip(axes.T, ("set_point", "tracking"), strict=True):
        ends = []
        for (name, changes), style in zip(FORMULATIONS.items(), ("-", "--"), strict=True):
            run = ckc_pin.simulate(f"five_bar/{case}", changes)
            q = run.q_tree[:, [run.column(joint) for joint in run.independent]]
            column[0].plot(run.t, q, style, label=[f"{joint}, {name}" for joint in run.independent])
            column[1].plot(run.t, run.u, style)
            assert np.abs(run.u).max() < 30.0  # N m, what the paper allows
            ends.append(q[-1])
        assert np.abs(ends[0] - ends[1]).max() < 1e-6
        column[0].set(title=case, ylabel="angle / rad")
        column[1].set(xlabel="t / s", ylabel="u / N m")
    axes[0, 0].legend(fontsize=7)
    return figure


if __name__ == "__main__":
    main().savefig("the_paper.png")
