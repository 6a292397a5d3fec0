"""An event.

Any function of time and terms is an event where it crosses zero. Here: where the left arm turns, and a stop when the
tip first rises above a height.
"""

import matplotlib.pyplot as plt

import ckc_pin

HEIGHT = -0.45  # m


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

    figure, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    ax.plot(run.t, tip)
    ax.axhline(HEIGHT, color="black", lw=0.8, ls="--")
    for event in run.events:
        ax.axvline(event["t"], color="tab:orange", lw=0.8)
    ax.set(xlabel="t / s", ylabel="height of the tip / m", title="events (orange)")
    return figure


if __name__ == "__main__":
    main().savefig("event.png")
