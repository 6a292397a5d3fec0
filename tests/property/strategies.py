"""What hypothesis draws: seeds of worlds, frames, axes, loops."""

from __future__ import annotations

from typing import get_args

from hypothesis import strategies as st

from ckc_pin.mechanism.spec import FrameSpec, LoopSpec, LoopType
from tests.property.worlds import JOINTS

TYPES: tuple[LoopType, ...] = get_args(LoopType)

seeds = st.integers(0, 2**32 - 1)
numbers = st.floats(-1, 1, allow_subnormal=False)
vectors = st.tuples(numbers, numbers, numbers)
angles = st.tuples(*3 * [st.floats(-3, 3, allow_subnormal=False)])
coordinate_axes = [tuple(float(s * (k == j)) for j in range(3)) for k in range(3) for s in (1, -1)]
axes = st.sampled_from(coordinate_axes) | vectors.filter(lambda a: sum(x * x for x in a) > 0.01)


def frames(tree: str) -> st.SearchStrategy[str | FrameSpec]:
    """A link or joint of a tree, plain or with a frame placed in it."""
    names = [f"{tree}0"] + [f"{tree}{name[1:]}" for name, *_ in JOINTS] + [f"joint:{tree}{name}" for name, *_ in JOINTS]
    named = st.sampled_from(names)
    return named | st.builds(FrameSpec, link=named, xyz=vectors, rpy=angles)


@st.composite
def loops(draw: st.DrawFn, kind: LoopType) -> LoopSpec:
    """A loop of a type between the two trees, or between one and the world, either way around."""
    world = st.just("world") | st.builds(FrameSpec, link=st.just("world"), xyz=vectors, rpy=angles)
    ends = [draw(frames("b_")), draw(frames("a_") | world)]
    if draw(st.booleans()):
        ends.reverse()
    return LoopSpec(
        name="loop",
        type=kind,
        frame_a=ends[0],
        frame_b=ends[1],
        rows_in=draw(st.sampled_from(("a", "world"))),
        axis_a=draw(axes),
        axis_b=draw(axes),
        length=draw(st.floats(0.1, 2)) if kind == "distance" else None,
    )
