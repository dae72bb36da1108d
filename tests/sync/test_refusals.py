"""What breaks the promise of its stream is refused by an error that names the stream, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from dataflow.sync import FOREVER, Aligner, AlignSpec, Entry, Firing, StreamOrderError, TriggerSpec

from .scenarios import poll_all

A = TriggerSpec("a", ("left/a",))
B = TriggerSpec("b", ("right/b",))


@pytest.mark.parametrize(
    "says",
    [
        lambda aligner: aligner.advance("left/a", FOREVER),
        lambda aligner: aligner.push("left/a", Entry(30, seq=9)),  # of the incarnation before
        lambda aligner: aligner.push("left/a", Entry(20, seq=9, incarnation=1)),  # twice the same stamp
        lambda aligner: aligner.push("left/a", Entry(25, seq=9, incarnation=1)),  # below the frontier
        lambda aligner: aligner.push("left/a", Entry(FOREVER, seq=9, incarnation=2)),
        lambda aligner: aligner.end("left/a", 20),  # below the frontier
        lambda aligner: aligner.end("left/a", FOREVER),
    ],
    ids=["frontier", "incarnation", "stamp", "promise", "end of time", "end", "final stamp"],
)
def test_a_refusal_names_the_stream_and_changes_nothing(says: Callable[[Aligner], None]) -> None:
    def fired(*, disturbed: bool) -> list[Firing]:
        aligner = Aligner(AlignSpec((A, B), mode="merge"))
        aligner.push("left/a", Entry(10))
        aligner.push("left/a", Entry(20, incarnation=1))
        aligner.advance("left/a", 26)
        if disturbed:
            with pytest.raises(StreamOrderError) as refusal:
                says(aligner)
            assert refusal.value.stream == "left/a"
            assert str(refusal.value) == f"stream 'left/a': {refusal.value.problem}"
        aligner.push("left/a", Entry(30, seq=1, incarnation=1))
        aligner.end("left/a", 40)
        aligner.push("right/b", Entry(35))
        aligner.end("right/b", 35)
        return poll_all(aligner)

    assert [f.stamp for f in fired(disturbed=False)] == [10, 20, 30, 35, 41]
    assert fired(disturbed=True) == fired(disturbed=False)


@pytest.mark.parametrize("order", ["ab", "ba"])
def test_a_join_at_the_end_of_time_is_decided_when_its_streams_end(order: str) -> None:
    late = FOREVER - 5
    aligner = Aligner(AlignSpec((A, B), tolerance=100))
    aligner.push("left/a", Entry(late))
    for which in order:
        aligner.end("left/a" if which == "a" else "right/b")

    assert [(f.kind, f.stamp) for f in poll_all(aligner)] == [("finish", late + 1)]
    assert aligner.drops == {("a", "unmatched"): 1}
