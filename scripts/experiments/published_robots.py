"""Make the tables of docs/published_robots.md: `ckc import`, `ckc check` and a motion of published robots.

    ./scripts/experiment robots FOLDER

FOLDER holds a checkout of each repository below, in a folder of the repository's name, at the commit listed here.
Robots of example-robot-data come from its package (pip install example-robot-data). A missing robot stops the script.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import ckc_pin
from ckc_pin.base.sources import resolve_path
from ckc_pin.formats.importing import read, write
from scripts.experiments.published_robots_motion import measure_reproduction_error

PACKAGE = "package://example-robot-data/robots"


@dataclass(frozen=True)
class Origin:
    """A repository of robots: its name, its commit and the files to import."""

    title: str
    commit: str
    files: tuple[str, ...]

    @property
    def folder(self) -> str:
        return self.title.rpartition("/")[2]


PARALLEL_ROBOTS = (
    "5bar_linkage 5bar_linkage_iso3d 5bar_linkage_iso6d battobot_6d cassie_like digit_like digit_like_2legs "
    "digit_like_2legs_6D disney_like disney_robot kangaroo_like kangaroo_like_2legs robot_delta talos_like "
    "true_talos_2_legs wl16_like"
)

ORIGINS = (
    Origin(
        "Gepetto/example-parallel-robots",
        "52e64b31",
        tuple(f"robots/{name}/robot.yaml" for name in PARALLEL_ROBOTS.split()),
    ),
    Origin(
        "ROAM-Lab-ND/generalized_rbda",
        "45fa7c46",
        (
            *(f"robot-models/{name}.urdf" for name in ("four_bar", "six_bar", "planar_leg_linkage")),
            *(f"robot-models/{name}.urdf" for name in ("mini_cheetah", "mit_humanoid", "jvrc1_humanoid")),
            "Benchmarking/urdfs/parallel_chains/Implicit/depth5/loop_size5.urdf",
        ),
    ),
    Origin(
        "Rhoban/placo-examples",
        "3edf600f",
        (
            *(f"models/{name}/robot.urdf" for name in ("planar-2dof", "orbita", "megabot", "spm")),
            "models/spm/robot.xml",
        ),
    ),
    Origin(
        "Rhoban/onshape-to-robot-examples",
        "a0f8b921",
        ("planar-2dof/robot.xml", "orbita_mujoco/robot.xml"),
    ),
    Origin("osudrl/cassie-mujoco-sim", "188d3d7f", ("model/cassie.xml",)),
    Origin(
        "kevinzakka/mink",
        "cf1a302f",
        tuple(f"examples/{name}.xml" for name in ("ufactory_xarm7/xarm7", "stanford_tidybot/tidybot", "aloha/aloha")),
    ),
    Origin(
        "google-deepmind/mujoco_playground",
        "d5e6b475",
        tuple(
            f"mujoco_playground/_src/manipulation/{name}.xml"
            for name in ("franka_emika_panda_robotiq/xmls/panda_updated_robotiq_2f85", "aero_hand/xmls/right_hand")
        ),
    ),
    Origin(
        "google-deepmind/mujoco",
        "a7255075",
        tuple(
            f"test/engine/testdata/{name}.xml"
            for name in ("core_constraint/jdotv_connect_2d", "core_constraint/jdotv_weld_3d", "armature_equivalence")
        ),
    ),
    Origin(
        "example-robot-data",
        "package 6.0.0",
        (
            "talos_data/robots/talos_full_v2.urdf",
            "romeo_description/urdf/romeo.urdf",
            "tiago_pro_description/robots/tiago_pro.urdf",
            "pr2_description/urdf/pr2.urdf",
            "panda_description/urdf/panda.urdf",
            "alex_description/urdf/alex_psyonic_hands.urdf",
        ),
    ),
)


def row(name: str, path: Path) -> str:
    """Import, check and move one robot; return its line of the table."""
    draft = read(path)
    motors = str(len(draft.actuated)) if draft.actuated else ""
    joints = [spec for spec, _ in draft.joints]
    counts = {"rotor": sum(spec.armature is not None for spec in joints), "stop": sum(spec.stops for spec in joints)}
    counted = [f"{count} {what}{'s' * (count > 1)}" for what, count in counts.items() if count]
    remarks = counted + _remarks([*draft.guessed, *draft.left_out])
    with tempfile.TemporaryDirectory() as folder:
        file, *_ = write(draft, Path(folder))
        try:
            checked = ckc_pin.check(file)
        except ckc_pin.MechanismError as error:
            what = str(error).partition("mechanism.toml: ")[2].partition(". Check")[0]
            return _line(name, "yes", "no", motors, *[""] * 6, "; ".join([*remarks, what]))
    try:
        back = f"{measure_reproduction_error(draft):.0e}"
    except ckc_pin.CkcError as error:
        print(f"{path}: {error}", file=sys.stderr)
        back = "none"
    numbers = (*(str(x) for x in (checked.n, checked.rows, checked.rank, checked.d)), f"{checked.mass:.4g}", back)
    return _line(name, "yes", "yes", motors, *numbers, "; ".join([*remarks, *_remarks(checked.warnings)]))


# Part of a note or warning -> its short form. {n}: number of names after the colon; {m}: number of names before it;
# {first}: the text before it.
REMARKS = {
    "point_2d for loop": "point_2d guessed ({m})",
    "hinge for loop": "hinge guessed ({m})",
    "point for loop": "point guessed ({m})",
    "joints called spherical": "joints called spherical stay hinges",
    "ball joint": "ball joints as three hinges",
    "the three slides": "slides and a ball as a free root",
    "masses of shapes": "masses of meshes left out",
    "actuator ": "actuator on a tendon left out",
    "coupling ": "coupling of three joints left out",
    " follows '": "mimic of no joint left out",
    "robot.yaml: joint_name": "joint_name of no joint left out",
    "idle freedoms": "{n} idle",
    "links that move without mass": "{n} without mass",
    "from q_guess: ": "assembled far from the guess",
    "leads beyond joints' stops": "{n} moved within stops",
    "outside joint limits": "{n} beyond limits",
    "the assembled configuration is singular": "singular where it is drawn",
    "the loops close to": "{first}",
}


def _remarks(notes: Iterable[str]) -> list[str]:
    remarks = []
    for note in notes:
        short = next((short for long, short in REMARKS.items() if long in note), "")
        first, _, names = note.partition(":")
        remarks.append(short.format(n=names.count(",") + 1, m=first.count(",") + 1, first=first.partition(", not")[0]))
    return list(dict.fromkeys(filter(None, remarks)))


def _line(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def main(root: Path) -> None:
    """Print the tables of all robots under a folder."""
    for origin in ORIGINS:
        print(f"\n## {origin.title} ({origin.commit})\n")
        print(_line("robot", "imported", "closed", "motors", "n", "rows", "rank", "d", "kg", "back", "remarks"))
        print(_line(*["---"] * 11))
        for file in origin.files:
            named = origin.title == "example-robot-data"
            path = resolve_path(f"{PACKAGE}/{file}", Path(), file) if named else root / origin.folder / file
            if not path.is_file():
                raise FileNotFoundError(f"{path}: not there")
            stem = path.parent.name if path.stem == "robot" else path.stem
            print(row(f"{stem}{'' if path.suffix != '.xml' else ' (MJCF)'}", path), flush=True)
