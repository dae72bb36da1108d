"""The short way for one input of one stream decides as the aligner for any inputs."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from dataflow.sync import Aligner, AlignSpec, Entry, SampledSpec, StreamOrderError, TriggerSpec
from dataflow.sync.single import SingleAligner, make_aligner

STAMPS = st.integers(0, 60)
ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just("push"), STAMPS, st.integers(0, 2)),
        st.tuples(st.just("advance"), STAMPS, st.just(0)),
        st.tuples(st.just("force"), STAMPS, st.just(0)),
        st.tuples(st.sampled_from(["poll", "poll", "frontier", "idle", "waiting"]), st.just(0), st.just(0)),
        st.tuples(st.just("end"), st.none() | STAMPS, st.just(0)),
    ),
    max_size=30,
)


def told(aligner: Aligner, what: str, stamp: Any, incarnation: int, seq: int) -> Any:
    """What an aligner answers to one action."""
    try:
        match what:
            case "push":
                return aligner.push("s", Entry(stamp, None, seq, incarnation, b"", "s"))
            case "advance":
                return aligner.advance("s", stamp)
            case "force":
                return aligner.force("a", stamp)
            case "end":
                return aligner.end("s", stamp, "over")
            case "poll":
                return aligner.poll(3), aligner.paused
            case "idle":
                return aligner.idle_frontier()
            case "frontier":
                return aligner.output_frontier()
            case _:
                return aligner.waiting()
    except StreamOrderError as error:
        return str(error)


@given(ACTIONS, st.booleans(), st.none() | STAMPS)
def test_both_decide_the_same(actions: list[tuple[str, Any, int]], many: bool, begin: int | None) -> None:
    spec = AlignSpec((TriggerSpec("a", ("s",), many),), mode="merge" if many else "join")
    short, general = SingleAligner(spec), Aligner(spec)
    if begin is not None:
        short.begin_at(begin)
        general.begin_at(begin)
    for seq, (what, stamp, incarnation) in enumerate([*actions, *[("poll", 0, 0), ("frontier", 0, 0)] * 8]):
        assert told(short, what, stamp, incarnation, seq) == told(general, what, stamp, incarnation, seq)
        assert (short.drops, short.late, short.ended(), short.final_stamp()) == (
            general.drops,
            general.late,
            general.ended(),
            general.final_stamp(),
        )
    assert short.take_drops() == general.take_drops()


def test_the_short_way_is_for_one_stream_and_nothing_else() -> None:
    one = TriggerSpec("a", ("s",))
    assert isinstance(make_aligner(AlignSpec((one,))), SingleAligner)
    for spec in (
        AlignSpec((one, TriggerSpec("b", ("t",)))),
        AlignSpec((TriggerSpec("a", ("s", "t"), many=True),), mode="merge"),
        AlignSpec((one,), (SampledSpec("x", ("x",)),)),
        AlignSpec((one,), every=10),
        AlignSpec((one,), static=frozenset(["s"])),
    ):
        assert not isinstance(make_aligner(spec), SingleAligner)
