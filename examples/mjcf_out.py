"""MJCF out.

The swinging five-bar is exported as a MuJoCo model, and MuJoCo steps it. MuJoCo's loop is a soft constraint, so the
difference from the exact run grows.
"""

import matplotlib.pyplot as plt
import mujoco
import numpy as np

import ckc_pin
from ckc_pin.formats.exporting import export
from ckc_pin.view.style import figure_style


@figure_style()
def main():
    exported = export(ckc_pin.load("five_bar"), "mjcf")
    print("Differences in MuJoCo:", *exported.differences, sep="\n  ")
    run = ckc_pin.simulate("five_bar/swing")

    model = mujoco.MjModel.from_xml_string(exported.text)
    model.opt.timestep = 1e-4
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    columns = [model.joint(name).qposadr[0] for name in run.coordinates]
    data.qpos[columns] = run.q_tree[0]
    mujoco_q = []
    for t in run.t:
        while data.time < t - 0.5e-4:
            mujoco.mj_step(model, data)
        mujoco_q.append(data.qpos[columns].copy())
    error = np.abs(np.array(mujoco_q) - run.q_tree).max(axis=1)
    assert 0 < error.max() < 0.1

    figure, ax = plt.subplots()
    ax.semilogy(run.t[1:], error[1:])
    ax.set(xlabel="t (s)", ylabel="largest difference of an angle (rad)")
    ax.set(title="MuJoCo, Runge-Kutta steps of 0.1 ms, off the exact loop")
    return figure


if __name__ == "__main__":
    main().savefig("mjcf_out.png")
