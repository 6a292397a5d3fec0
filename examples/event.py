"""An event.

Any function of time and terms is an event where it crosses zero. One event here records when the left arm reverses.
The other one stops the run when the tip first rises above a height.
"""

import matplotlib.pyplot as plt

import ckc_pin
from ckc_pin.view.style import figure_style

HEIGHT = -0.45  # m


@figure_style()
def main():
    mechanism = ckc_pin.load("five_bar")

    def height(t, terms):
        return mechanism.point_positions(terms.at.q_tree)["tip"][1] - HEIGHT

    events = [
        ckc_pin.Event(lambda t, terms: terms.q_dot[0], name="theta_1 turns"),
        ckc_pin.Event(height, direction=1, stop=True, name="high enough"),
    ]
    run = ckc_pin.simulate(
        "five_bar/swing", {"t_end": 5.0, "initial.q_dot": {"theta_1": 2.0, "theta_3": -2.5}}, events=events
    )
    tip = run.points["tip"][:, 1]
    print(*(f"{event['t']:.6f} s  {event['name']}" for event in run.events), sep="\n")
    assert run.events[-1]["name"] == "high enough"
    assert abs(tip[-1] - HEIGHT) < 1e-9

    figure, ax = plt.subplots()
    ax.plot(run.t, tip, label="tip")
    turns = [event["t"] for event in run.events[:-1]]
    ax.plot(turns, tip[[run.at(t) for t in turns]], "D", label="θ₁ turns")
    ax.plot(run.t[-1], tip[-1], "k*", markersize=11, label="high enough: stop")
    ax.axhline(HEIGHT, color="black", lw=0.8, ls="--", label="threshold")
    ax.set(xlabel="t (s)", ylabel="height of the tip (m)", title="Events of a free swing")
    figure.legend(loc="outside lower center", ncols=4)
    return figure


if __name__ == "__main__":
    main().savefig("event.png")
