"""Scenes of the benchmark whose mechanisms are not shipped: a pendulum, and the chains of generalized_rbda."""

from __future__ import annotations

from collections.abc import Iterator

from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import Scene

__all__ = ["parallel_chains", "pendulum"]

GRAVITY = 9.81  # m/s^2


def pendulum() -> Scene:
    """Return problem A01 of IFToMM's library: a point mass of 1 kg on a massless rod of 1 m, released horizontal."""
    inertial = '<origin xyz="1 0 0"/><mass value="1"/>' + _inertia(0.0, 0.0, 0.0)
    urdf = _robot("pendulum", _link("rod", inertial) + _joint("theta", "base", "rod", (0.0, 0.0, 0.0)))
    mechanism = Mechanism.from_urdf(
        urdf,
        gravity=(0.0, -GRAVITY, 0.0),
        independent=["theta"],
        points=[{"name": "P1", "frame": {"link": "rod", "xyz": [1.0, 0.0, 0.0]}}],
    )
    return Scene(mechanism, t_end=10.0, formulation="dae", initial={"q": {"theta": 3.141592653589793}})


def parallel_chains(depth: int, loop_size: int) -> Scene:
    """Return two planar chains that are joined by a rod, released horizontal; generalized_rbda's, closed by position.

    Its files are ``Benchmarking/urdfs/parallel_chains/Implicit/depth{depth}/loop_size{loop_size}.urdf``. Each link of
    both chains is 1 m long. The rod joins the ends of links number ``(loop_size - 1) / 2``. The moments of inertia
    about axes in the plane differ: those of the files violate the triangle inequality, which MuJoCo and Drake check.
    They do not act in the plane.
    """
    joined = (loop_size - 1) // 2
    inertial = '<origin xyz="0 0.5 0"/><mass value="0.25"/>' + _inertia(0.01, 0.01, 0.01)

    def parts() -> Iterator[str]:
        for k in range(1, depth + 1):
            for chain in (1, 2):
                yield _link(f"link_{chain}_{k}", inertial)
                origin = (float(chain - 1), 0.0, 0.0) if k == 1 else (0.0, 1.0, 0.0)
                parent = "base" if k == 1 else f"link_{chain}_{k - 1}"
                yield _joint(f"joint_{chain}_{k}", parent, f"link_{chain}_{k}", origin)
        yield _link("connecting_rod", inertial)
        yield _joint("connecting_rod_joint", f"link_1_{joined}", "connecting_rod", (0.0, 1.0, 0.0))

    loop = {
        "name": "position", "type": "point_2d", "rows_in": "world",
        "frame_a": {"link": "connecting_rod", "xyz": [1.0, 0.0, 0.0]},
        "frame_b": {"link": f"link_2_{joined}", "xyz": [0.0, 1.0, 0.0]},
    }  # fmt: skip
    name = f"parallel_chains_{depth}_{loop_size}"
    mechanism = Mechanism.from_urdf(_robot(name, "".join(parts())), loops=[loop], gravity=(GRAVITY, 0.0, 0.0))
    return Scene(mechanism, t_end=1.0, formulation="dae", initial={"at": "assembled"})


def _robot(name: str, parts: str) -> str:
    return f'<robot name="{name}"><link name="base"/>{parts}</robot>'


def _link(name: str, inertial: str) -> str:
    return f'<link name="{name}"><inertial>{inertial}</inertial></link>'


def _inertia(ixx: float, iyy: float, izz: float) -> str:
    return f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>'


def _joint(name: str, parent: str, child: str, origin: tuple[float, float, float]) -> str:
    xyz = " ".join(map(str, origin))
    return (
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="0 0 1"/></joint>'
    )
