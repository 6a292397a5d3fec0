"""A mode of a closed chain.

The linear model of the five-bar about its stable equilibrium gives its modes. A small swing along one of them has its
frequency. The larger the swing, the further its period is from the linear model's.
"""

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.style import figure_style


@figure_style()
def main():
    model = ckc_pin.linearize("five_bar")
    mode = model.modes[0]
    rest = dict(zip(model.coordinates, model.q_tree, strict=True))
    names = model.states[: len(model.states) // 2]
    shape = np.array([mode.shape[model.coordinates.index(name)] for name in names]).real
    shape /= np.abs(shape).max()
    print(model)
    figure, ax = plt.subplots()
    errors = []
    for size in (0.02, 0.2, 0.4):
        start = {name: rest[name] + size * x for name, x in zip(names, shape, strict=True)}
        run = ckc_pin.simulate(
            "five_bar/swing",
            {"formulation": "reduced", "t_end": 4.0, "initial": {"q": start}},
            events=[ckc_pin.Event(lambda t, terms: terms.q_dot[0], direction=-1 if shape[0] < 0 else 1, name="turns")],
        )
        turns = [event["t"] for event in run.events if event["t"] > 0.1]
        period = np.diff(turns).mean()
        errors.append(abs(period * mode.frequency - 1))
        print(f"{size} rad: period {period:.5f} s, linear model {1 / mode.frequency:.5f} s")
        ax.plot(run.t * mode.frequency, (run[names[0]] - rest[names[0]]) / size, label=f"from {size} rad")
    ax.set(xlabel="time (periods of the linear model)", ylabel="swing of θ₁, scaled")
    ax.set(title="The larger the swing, the longer its period")
    figure.legend(loc="outside lower center", ncols=3)
    assert errors[0] < 1e-3
    assert errors[0] < errors[1] < errors[2]
    return figure


if __name__ == "__main__":
    main().savefig("modes.png")
