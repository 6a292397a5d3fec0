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
        for (name, changes), style in zip(FORMULATIONS.items(), ("-", "k:"), strict=True):
            run = ckc_pin.simulate(f"five_bar/{case}", changes)
            for k, joint in enumerate(run.independent):
                colour = {} if "k" in style else {"color": f"C{k}"}
                column[0].plot(run.t, run[joint], style, label=f"{joint}, {name}", **colour)
                column[1].plot(run.t, run.u[:, k], style, **colour)
            assert np.abs(run.u).max() < 30.0  # N m, what the paper allows
            ends.append([run[joint][-1] for joint in run.independent])
        assert np.abs(np.subtract(*ends)).max() < 1e-6
        column[0].set(title=case, ylabel="angle (rad)")
        column[1].set(xlabel="t (s)", ylabel="u (N m)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles[:3], [*labels[:2], "reduced"], loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("the_paper.png")
