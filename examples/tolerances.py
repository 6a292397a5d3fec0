"""As a workshop makes them.

Forty five-bars whose lengths and masses are not quite those of the drawing, which their controller believes: where does
each tip come to rest? Three sweeps, of lengths, of masses and of both, each one call. At rest a motor gives what its
own five-bar weighs, which is checked for the one that is farthest off.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.canvas import look

LENGTHS = {"joint.theta_2.xyz.x": 0.2794, "joint.tip_left_fixed.xyz.x": 0.3048,
           "joint.theta_4.xyz.x": 0.2794, "joint.tip_right_fixed.xyz.x": 0.3048}  # fmt: skip
MASSES = {"link.link_1.mass": 0.2451, "link.link_2.mass": 0.2611,
          "link.link_3.mass": 0.2352, "link.link_4.mass": 0.2611}  # fmt: skip
LENGTH_OFF, MASS_OFF = 2e-4, 0.005  # standard deviations: m, and relative
CHANGES = {"formulation": "reduced", "controller.model": "mechanism.toml", "t_end": 3.0, "solver.rtol": 1e-7}


def tip(q_tree, left):
    """Return where the pin at the end of the left chain is; left are its two lengths."""
    one, both = q_tree[..., 0], q_tree[..., 0] + q_tree[..., 1]
    return np.stack([left[0] * f(one) + left[1] * f(both) for f in (np.cos, np.sin)], axis=-1)


def sweep(lengths, masses):
    """Run forty that differ in one, the other or both; return the results and the tips' places, m."""
    variables = {name: {"normal": [x, LENGTH_OFF]} for name, x in LENGTHS.items() if lengths}
    variables |= {name: {"normal": [x, MASS_OFF * x]} for name, x in MASSES.items() if masses}
    found = ckc_pin.ensemble("five_bar/set_point", variables, {"end": "q_tree", "u": "u"}, members=40, seed=3,
                             changes=CHANGES)  # fmt: skip
    left = [found[name].to_numpy() if lengths else LENGTHS[name] for name in list(LENGTHS)[:2]]
    return found, tip(found["end"].to_numpy(), left)


@look()
def main():
    drawn = ckc_pin.simulate("five_bar/set_point", CHANGES)
    target = tip(drawn.q_tree[-1], list(LENGTHS.values())[:2])
    figure, ax = plt.subplots(figsize=(5.2, 4.0), layout="constrained")
    spread = {}
    for label, lengths, masses, marker in (("both", True, True, "o"), ("masses", False, True, "^"),
                                           ("lengths", True, False, "s")):  # fmt: skip
        found, places = sweep(lengths, masses)
        off = 1e3 * (places - target)
        spread[label] = np.sqrt(np.mean(np.sum(off**2, axis=1)))
        print(f"{label}: {spread[label]:.3f} mm off in the mean, {np.linalg.norm(off, axis=1).max():.3f} at worst")
        if label == "both":
            worst = found.isel(member=int(np.argmax(np.linalg.norm(off, axis=1))))
        ax.plot(*off.T, marker, markersize=4, linestyle="none", label=label)
    ax.plot(0, 0, "+", color="black", markersize=12, label="as drawn")
    ax.set(xlabel="x from the target (mm)", ylabel="y from the target (mm)", aspect="equal")
    ax.set(title=f"lengths ± {1e3 * LENGTH_OFF} mm, masses ± {100 * MASS_OFF} %")
    figure.legend(loc="outside lower center", ncols=4)

    own = ckc_pin.load("five_bar", {name: float(worst[name]) for name in LENGTHS | MASSES})
    weighs = ckc_pin.terms(own, dict(zip(own.coordinates, worst["end"].to_numpy().tolist(), strict=True))).h
    assert np.abs(weighs - worst["u"].to_numpy()).max() < 1e-3 * np.abs(weighs).max()
    assert abs(spread["both"] - np.hypot(spread["lengths"], spread["masses"])) < 0.3 * spread["both"]
    return figure


if __name__ == "__main__":
    main().savefig("tolerances.png")
