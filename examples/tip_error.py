"""Which length matters to the tip.

The five-bar tracks its desired angles by a controller that believes the drawing, while the links are as they were made.
One run with its variational equations says how far each length moves the tip at each instant, to first order; a run of
a five-bar all of whose links are 0.1 mm too long shows that the first order is enough.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.canvas import look

LENGTHS = {
    "joint.theta_2.xyz.x": "left proximal",
    "loop.elbow.frame_a.xyz.x": "left distal",  # beyond the frame at the link's end
    "joint.theta_4.xyz.x": "right proximal",
    "loop.elbow.frame_b.xyz.x": "right distal",
}
IN_FILE = np.array([0.2794, 0.0, 0.2794, 0.0])  # m
DRAWN = np.array([0.2794, 0.3048, 0.2794, 0.3048])  # m
WRONG = 1e-4  # m
SETTINGS = {"formulation": "reduced", "controller.model": "mechanism.toml", "solver.rtol": 1e-10}


def tip(run, lengths):
    """Return where the pin at the end of the left chain is, shape (m, 2)."""
    one = run["theta_1"]
    both = one + run["theta_2"]
    return np.column_stack([lengths[0] * f(one) + lengths[1] * f(both) for f in (np.cos, np.sin)])


def slopes(found):
    """Return how the tip moves with each length, m/m, shape (m, 2, 4): by the angles, and by the left lengths."""
    one = found.run["theta_1"]
    both = one + found.run["theta_2"]
    turned = [found.q_tree[:, found.run.coordinates.index(name)] for name in ("theta_1", "theta_2")]
    moved = np.empty((len(one), 2, len(LENGTHS)))
    for axis, (along, across) in enumerate([(np.cos, lambda x: -np.sin(x)), (np.sin, np.cos)]):
        moved[:, axis] = (DRAWN[0] * across(one) + DRAWN[1] * across(both))[:, None] * turned[0]
        moved[:, axis] += (DRAWN[1] * across(both))[:, None] * turned[1]
        moved[:, axis, 0] += along(one)
        moved[:, axis, 1] += along(both)
    return moved


@look()
def main():
    found = ckc_pin.sensitivities("five_bar/tracking", list(LENGTHS), SETTINGS)
    moved = slopes(found)
    made = dict(zip(LENGTHS, IN_FILE + WRONG, strict=True))
    as_made = ckc_pin.simulate("five_bar/tracking", SETTINGS | made)
    off = np.linalg.norm(tip(as_made, DRAWN + WRONG) - tip(found.run, DRAWN), axis=1)
    said = np.linalg.norm(WRONG * moved.sum(axis=2), axis=1)
    each = WRONG * np.linalg.norm(moved, axis=1)
    for name, most in zip(LENGTHS.values(), each.max(axis=0), strict=True):
        print(f"{name:14s} 0.1 mm longer: the tip is up to {1e6 * most:.0f} µm off")
    print(f"all of them: {1e6 * off.max():.1f} µm; to first order {1e6 * said.max():.1f} µm")
    assert np.abs(off - said).max() < 0.005 * off.max()

    figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
    for k, name in enumerate(LENGTHS.values()):
        ax.plot(found.t, 1e6 * each[:, k], label=name)
    ax.plot(found.t, 1e6 * said, color="black", linewidth=1, label="all four")
    ax.plot(as_made.t[::20], 1e6 * off[::20], "o", color="black", markersize=3, label="a run with all four")
    ax.set(xlabel="t (s)", ylabel="the tip is off by (µm)", ylim=(0, None), title="links 0.1 mm too long")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("tip_error.png")
