"""MJCF in.

A slider-crank written for MuJoCo, with a soft `connect`, becomes a mechanism with an exact loop. The example imports
the model, writes it as a folder, adds a scene and runs it.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.formats import importing
from ckc_pin.view.style import figure_style

MODEL = """
<mujoco model="press">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="crank">
      <joint name="crank" axis="0 1 0" pos="0 0 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.01" mass="0.5"/>
      <body name="rod" pos="0 0 0.2">
        <joint name="pin" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.01" mass="0.4"/>
      </body>
    </body>
    <body name="slider" pos="0.5 0 0.2">
      <joint name="slider" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.03 0.03 0.03" mass="1"/>
    </body>
  </worldbody>
  <equality><connect name="wrist" body1="rod" body2="slider" anchor="0.5 0 0"/></equality>
</mujoco>
"""

SCENE = """
mechanism = "mechanism.toml"
formulation = "dae"
t_end = 1.0
[initial]
at = "assembled"
[initial.q_dot]
crank = 8.0
[solver]
output_dt = 0.005
"""


@figure_style()
def main():
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "press.xml"
        source.write_text(MODEL)
        imported = Path(folder) / "press"
        importing.write(importing.read(source), imported)
        report = ckc_pin.check(imported)
        print(f"{report.d} freedom, {report.rows} rows of rank {report.rank}; redundant: {', '.join(report.redundant)}")
        assert report.d == 1
        scene = imported / "default.scene.toml"
        scene.write_text(SCENE)
        run = ckc_pin.simulate(scene)
    assert run.max_phi < 1e-9
    crank = run["crank"]
    exact = 0.2 * np.sin(crank) + np.sqrt(0.5**2 - (0.2 - 0.2 * np.cos(crank)) ** 2) - 0.5
    assert np.abs(run["slider"] - exact).max() < 1e-9

    figure, ax = plt.subplots()
    ax.plot(run.t, run["slider"], lw=3, alpha=0.4, label="slider, in the run")
    ax.plot(run.t, exact, "k:", label="from the crank's angle, by Pythagoras")
    ax.set(xlabel="t (s)", ylabel="displacement (m)")
    ax.set_title(f"A press read from MJCF: its loop stays closed to {run.max_phi:.0e} m")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


if __name__ == "__main__":
    main().savefig("mjcf_in.png")
