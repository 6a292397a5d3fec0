"""The paper's five-bar.

Both control cases of the paper, each as the singular perturbation formulation that eq. 8 prints and as the reduced
model of eq. 6. The figure shows the angles of the arms, and torques within the 30 N m that the paper states.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.layout import clip_end_peaks
from ckc_pin.view.style import COLOURS, figure_style

FORMULATIONS = {"reduced": {"formulation": "reduced"},
                "SPF, ε = 1e-3": {"formulation": "spf", "spf_coordinates": "z", "epsilon": 1e-3}}  # fmt: skip
CASES = {"set_point": ("Set-point control", 0.6), "tracking": ("Tracking control", 9.5)}  # title, and the time shown, s
LOOKS = {"lw": 3, "alpha": 0.4}, {"ls": "--", "lw": 1.2}


@figure_style()
def main():
    figure, axes = plt.subplots(2, 2, figsize=(7.0, 4.6), sharex="col")
    for (angles, torques), (case, (title, shown)) in zip(axes.T, CASES.items(), strict=True):
        for ax in (angles, torques):
            ax.set_prop_cycle(color=COLOURS[:2])  # one colour per arm, for both formulations
        ends = []
        for (name, overrides), style in zip(FORMULATIONS.items(), LOOKS, strict=True):
            run = ckc_pin.simulate(f"five_bar/{case}", overrides)
            q = run.q_tree[:, [run.column(joint) for joint in run.independent]]
            angles.plot(run.t, q, **style, label=[f"{joint}, {name}" for joint in ("θ₁", "θ₃")])
            torques.plot(run.t, run.u, **style)
            assert np.abs(run.u).max() < 30.0  # N m, what the paper allows
            ends.append(q[-1])
        assert np.abs(ends[0] - ends[1]).max() < 1e-6
        angles.set(title=title, ylabel="angle (rad)")
        torques.set(xlabel="t (s)", ylabel="torque (N m)", xlim=(0, shown))
        torques.set(title=f"Torques {clip_end_peaks(torques, [(run.t, run.u)], shown)}")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


if __name__ == "__main__":
    main().savefig("the_paper.png")
