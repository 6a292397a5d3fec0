"""Manufacturing tolerances.

Forty five-bars have lengths and masses that differ from the drawing. Their controllers use the drawing. Where does
each tip come to rest? Three sweeps vary the lengths, the masses and both. At rest, the motors must compensate the
weight of their own five-bar. This is checked for the one that is farthest off.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style

LENGTHS = {"joint.theta_2.xyz.x": 0.2794, "joint.tip_left_fixed.xyz.x": 0.3048,
           "joint.theta_4.xyz.x": 0.2794, "joint.tip_right_fixed.xyz.x": 0.3048}  # fmt: skip
MASSES = {"link.link_1.mass": 0.2451, "link.link_2.mass": 0.2611,
          "link.link_3.mass": 0.2352, "link.link_4.mass": 0.2611}  # fmt: skip
LENGTH_SIGMA, MASS_SIGMA = 2e-4, 0.005  # standard deviations: m, and relative
OVERRIDES = {"formulation": "reduced", "controller.model": "mechanism.toml", "t_end": 3.0, "solver.rtol": 1e-7}


def tip_position(q_tree, chain_lengths):
    """Return the position of the tip from the angles and the lengths of the left chain, m."""
    proximal, distal = q_tree[..., 0], q_tree[..., 0] + q_tree[..., 1]
    return np.stack([chain_lengths[0] * f(proximal) + chain_lengths[1] * f(distal) for f in (np.cos, np.sin)], axis=-1)


def sweep(lengths, masses):
    """Vary lengths, masses or both of forty members; return the results and the positions of their tips, m."""
    variables = {name: {"normal": [x, LENGTH_SIGMA]} for name, x in LENGTHS.items() if lengths}
    variables |= {name: {"normal": [x, MASS_SIGMA * x]} for name, x in MASSES.items() if masses}
    results = ckc_pin.ensemble("five_bar/set_point", variables, {"end": "q_tree", "u": "u"}, members=40, seed=3,
                             overrides=OVERRIDES)  # fmt: skip
    chain_lengths = [results[name].to_numpy() if lengths else LENGTHS[name] for name in list(LENGTHS)[:2]]
    return results, tip_position(results["end"].to_numpy(), chain_lengths)


@figure_style()
def main():
    drawn = ckc_pin.simulate("five_bar/set_point", OVERRIDES)
    target = tip_position(drawn.q_tree[-1], list(LENGTHS.values())[:2])
    figure, ax = plt.subplots(figsize=(5.2, 4.0), layout="constrained")
    spread = {}
    for label, lengths, masses, marker in (("both", True, True, "o"), ("masses", False, True, "^"),
                                           ("lengths", True, False, "s")):  # fmt: skip
        results, tips = sweep(lengths, masses)
        errors = 1e3 * (tips - target)
        spread[label] = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
        print(f"{label}: {spread[label]:.3f} mm off in the mean, {np.linalg.norm(errors, axis=1).max():.3f} at worst")
        if label == "both":
            worst = results.isel(member=int(np.argmax(np.linalg.norm(errors, axis=1))))
        ax.plot(*errors.T, marker, markersize=4, linestyle="none", label=label)
    ax.plot(0, 0, "+", color="black", markersize=12, label="as drawn")
    ax.set(xlabel="x from the target (mm)", ylabel="y from the target (mm)", aspect="equal")
    ax.set(title=f"lengths ± {1e3 * LENGTH_SIGMA} mm, masses ± {100 * MASS_SIGMA} %")
    figure.legend(loc="outside lower center", ncols=4)

    mechanism = ckc_pin.load("five_bar", {name: float(worst[name]) for name in LENGTHS | MASSES})
    weight = ckc_pin.terms(mechanism, dict(zip(mechanism.coordinates, worst["end"].to_numpy().tolist(), strict=True))).h
    assert np.abs(weight - worst["u"].to_numpy()).max() < 1e-3 * np.abs(weight).max()
    assert abs(spread["both"] - np.hypot(spread["lengths"], spread["masses"])) < 0.3 * spread["both"]
    return figure


if __name__ == "__main__":
    main().savefig("tolerances.png")
