"""A sweep with its basin of attraction.

Set-point control starts from rest on a grid of configurations. From which of them does the five-bar settle at its
target within 5 s? One call runs them all. Starts for which the loops cannot be closed stay in the result as failed,
with the reason.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

GRID = {"start": -1.9, "stop": 1.9, "count": 15}  # rad, for both angles


@figure_style()
def main():
    results = ckc_pin.ensemble(
        "five_bar/set_point",
        {"initial.q.theta_1": {"grid": GRID}, "initial.q.theta_3": {"grid": GRID}},
        {"settled": {"of": "settled", "tolerance": 1e-2}, "end": "q_tree"},
        overrides={
            "formulation": "reduced",
            "initial": {"q": {"theta_1": -1.4, "theta_3": -1.7}},  # instead of the scene's equilibrium
            "t_end": 5.0,
            "solver.rtol": 1e-6,
        },
    )
    done, settled = results["status"].to_numpy() == 1, results["settled"].to_numpy() == 1
    theta_1, theta_3 = results["initial.q.theta_1"].to_numpy(), results["initial.q.theta_3"].to_numpy()
    target = ckc_pin.load_scene("five_bar/set_point").to_dict()["controller"]["q_d"]
    print(f"{done.sum()} of {done.size} starts can be assembled and run to the end; {settled.sum()} settle")
    figure, ax = plt.subplots(figsize=(4.0, 4.2))
    for members, label, marker, size in (
        (settled, "settles at the target", "o", 6),
        (done & ~settled, "runs, does not settle", "X", 7),
        (~done, "loops cannot be closed", "k_", 4),
    ):
        ax.plot(theta_1[members], theta_3[members], marker, label=label, markersize=size)
    ax.plot(*target.values(), "k*", markersize=11, label="the target")
    ax.set(xlabel="θ₁ at the start (rad)", ylabel="θ₃ at the start (rad)", aspect="equal")
    ax.set_title("Where the five-bar settles within 5 s")
    figure.legend(loc="outside lower center", ncols=2)
    ends = results["end"].sel(coordinate="theta_1").to_numpy()[settled]
    assert settled.sum() > 20
    assert np.abs(ends - target["theta_1"]).max() < 1e-2
    return figure


if __name__ == "__main__":
    main().savefig("basin.png")
