"""A gymnasium environment.

The five-bar as a task for reinforcement learning. Actions are the motor torques, observations are angles, rates and
the tip's position, and the reward is highest with the tip at a goal. A `Simulator` computes the physics, with the
tolerance of a run. Gymnasium's own checker accepts the environment, and random torques play an episode.
"""

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from gymnasium.utils.env_checker import check_env

import ckc_pin
from ckc_pin.view.style import figure_style

GOAL = np.array([0.15, -0.45])
TORQUE = 1.0  # N m
DT = 0.02  # s


class FiveBar(gym.Env):
    """Observation: sin(q), cos(q), q_dot and the tip's position; action: motor torques relative to their limit."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self):
        self.simulator = ckc_pin.Simulator("five_bar/swing", {"formulation": "dae", "solver.rtol": 1e-6})
        self.start = self.simulator.state
        self.motors = self.simulator.mechanism.actuated
        self.point = ckc_pin.Point(self.simulator.mechanism, "tip")
        self.observation_space = gym.spaces.Box(-100.0, 100.0, (8,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.simulator.reset(self.start)
        for _ in range(10):  # random torques lead to a random start
            self.simulator.step(self.np_random.uniform(-0.3, 0.3, 2), DT)
        return self.observe(), {}

    def step(self, action):
        try:
            self.simulator.step(tau=dict(zip(self.motors, (TORQUE * action).tolist(), strict=True)), dt=DT)
        except ckc_pin.NumericalError as stop:  # a singular configuration ends the episode
            return self.observe(), -1.0, True, False, {"why": str(stop)}
        observation = self.observe()
        return observation, float(-np.sum((observation[6:] - GOAL) ** 2)), False, self.simulator.state.t > 5.0, {}

    def observe(self):
        state = self.simulator.state
        tip = self.point.position(state.terms.at.q_tree)[:2]
        return np.concatenate([np.sin(state.q), np.cos(state.q), state.q_dot, tip])


@figure_style()
def main(steps=150):
    check_env(FiveBar(), skip_render_check=True)
    env = FiveBar()
    observation, _ = env.reset(seed=1)
    env.action_space.seed(1)
    tips, rewards = [observation[6:]], []
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        tips.append(observation[6:])
        rewards.append(reward)
        if terminated or truncated:
            break
    assert max(rewards) <= 0.0
    figure, ax = plt.subplots(figsize=(5.2, 2.9))
    ax.plot(*np.transpose(tips), label="path of the tip")
    ax.plot(*tips[0], "ko", label="its start")
    ax.plot(*GOAL, "*", ms=14, label="goal")
    ax.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="An episode of random torques")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main().savefig("gym_env.png")
